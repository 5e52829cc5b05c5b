"""`LearnablePlane`: how it moves, and which planes of a batch do."""

import numpy as np
import pytest
import torch

import diffproj as dp

D = torch.float64


@pytest.fixture
def plane() -> dp.Plane:
    return dp.Plane(torch.tensor([0.1, -0.2, 2.0], dtype=D), torch.tensor(30.0, dtype=D))


def test_the_plane_turns_and_moves(plane: dp.Plane) -> None:
    learnable = dp.LearnablePlane(plane, scale=10.0)
    now = learnable()
    torch.testing.assert_close(now.normal, plane.normal)
    torch.testing.assert_close(now.offset, plane.offset)
    with torch.no_grad():
        learnable.tilt.copy_(torch.tensor([0.3, -0.2]))
        learnable.shift.fill_(0.5)
    moved = learnable()
    torch.testing.assert_close(moved.normal.norm(), plane.normal.norm())
    cosine = (moved.normal * plane.normal).sum() / plane.normal.square().sum()
    torch.testing.assert_close(cosine.acos().tan(), torch.tensor(0.13**0.5, dtype=D))
    torch.testing.assert_close((moved.offset - plane.offset) / plane.normal.norm(), torch.tensor(5.0, dtype=D))


def test_planes_of_a_batch_learn_one_by_one(camera: dp.Camera, pixels: torch.Tensor) -> None:
    planes = dp.Plane.z(torch.tensor([0.0, 30, 60], dtype=D))
    projector = dp.PlaneProjector(camera, planes, {"plane": torch.tensor([False, True, False])})
    points, _ = projector(pixels)
    points.square().sum().backward()
    with torch.no_grad():
        for parameter in projector.parameters():
            parameter -= 1e-9 * parameter.grad
    moved = (projector(pixels)[0] != points).flatten(1).any(-1)
    assert moved.tolist() == [False, True, False]


@pytest.mark.plain
@pytest.mark.parametrize("learn", [np.array([0.5, 0.0]), np.array([2, 0]), np.array([None, 1]), [1, 0], torch.ones(2)])
def test_what_is_learned_is_told_by_booleans(learn: object) -> None:
    planes = dp.Plane(torch.tensor([[0.0, 0, 1], [0, 1, 1]]), torch.zeros(2))
    with pytest.raises(TypeError, match="^learn: want booleans, got"):
        dp.LearnablePlane(planes, learn=learn)
    assert dp.LearnablePlane(planes, learn=np.array([True, False])).tilt_learned.tolist() == [[True], [False]]
