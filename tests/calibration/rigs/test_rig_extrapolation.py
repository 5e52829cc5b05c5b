"""Points that a rig's cameras see outside of the region of their corners: they are told, and the deviations hold them."""

import functools
import math

import pytest
import torch

import diffproj as dp
from diffproj.calibration.problem.parametrisation import moved
from diffproj.calibration.rigs import extrapolation, triangulation
from diffproj.lens.names import LensModel

D = torch.float64


@functools.cache
def _rig(lens: LensModel) -> dp.RigCalibration:
    return dp.calibrate_rig({name: dp.example_views(name) for name in ("left", "right")}, dp.Chessboard(), lens)


def _places(rig: dp.RigCalibration) -> torch.Tensor:
    """Points 600 mm away, all over the left image, that the right camera sees too."""
    u, v = torch.meshgrid(torch.linspace(5, 634, 15, dtype=D), torch.linspace(5, 474, 11, dtype=D), indexing="ij")
    _, direction, seen = rig.cameras["left"].rays(torch.stack([u, v], dim=-1).flatten(0, 1))
    places = 600 * direction[seen]
    pixels, valid = rig.cameras["right"].project(places)
    return places[valid & rig.cameras["right"].in_image(pixels)]


def _seen(rig: dp.RigCalibration, places: torch.Tensor) -> dict[str, torch.Tensor]:
    return {name: camera.project(places)[0] for name, camera in rig.cameras.items()}


def _parts(rig: dp.RigCalibration) -> triangulation.Rig:
    columns = {name: rig.parameters_of(name) for name in rig.names}
    return triangulation.Rig(rig.cameras, rig.calibrations, rig.covariance, columns)


def _drawn(rig: dp.RigCalibration, pixels: dict[str, torch.Tensor], draws: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The points of pixels in rigs drawn from the covariance `(draws, N, 3)`, and where there are any."""
    parts, generator = _parts(rig), torch.Generator().manual_seed(0)
    root = triangulation._root(parts)
    everywhere = {name: torch.ones(len(uv), dtype=torch.bool) for name, uv in pixels.items()}
    points, valid = [], []
    for _ in range(draws):
        step = root @ torch.randn(root.shape[1], generator=generator, dtype=D)
        cameras = {}
        for name, camera in rig.cameras.items():
            own, parameters = step[parts.columns[name]], rig[name].parameters.of_camera
            pose = (camera.R, camera.t)
            if len(own) > parameters.size:
                pose = moved(pose, own[parameters.size :])
            cameras[name] = parameters.unpack(parameters.pack(camera) + own[: parameters.size], pose)
        X, found = triangulation._nearest(parts._replace(cameras=cameras), pixels, everywhere)
        points.append(X)
        valid.append(found)
    return torch.stack(points), torch.stack(valid)


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["brown4", "brown5"])
def test_deviations_are_those_of_rigs_drawn_from_the_covariance(lens: LensModel) -> None:
    """Of 200: brown4 0.95 to 1.08 of theirs, brown5 0.82 to 1.08; all but where some of these have no ray."""
    rig = _rig(lens)
    places = _places(rig)
    pixels = _seen(rig, places)
    found = rig.triangulate(pixels, pixel_sigma=1e-6)
    points, valid = _drawn(rig, pixels, 200)
    sampled = (points - places).square().mean(0).sqrt()
    certain = found.extrapolated & valid.all(0) & found.deviations.isfinite().all(-1)
    assert int(found.extrapolated.sum()) == 57
    assert int(certain.sum()) > 45
    ratio = (found.deviations / sampled)[certain]
    assert float(ratio.amin()) > 0.75
    assert float(ratio.amax()) < 1.15


def test_where_the_lens_may_end_nothing_is_known_as_in_measure() -> None:
    """Of 200 rigs with rational lenses that are as good, fewer than half have rays for these pixels."""
    rig = _rig("brown8")
    places = _places(rig)
    pixels = _seen(rig, places)
    found = rig.triangulate(pixels, pixel_sigma=0.2)
    far = found.extrapolated
    assert found.valid.all()
    assert 40 < int(far.sum()) < 80
    assert found.deviations[far].isinf().all()
    assert found.deviations[~far].isfinite().all()
    on_board = dp.measure(pixels["left"], rig["left"], dp.Plane.z(0.0), view=0, pixel_sigma=0.2)
    assert on_board.extrapolated is not None
    assert on_board.deviations[on_board.extrapolated].isinf().any(-1).all()
    assert far[on_board.extrapolated].all()
    _, valid = _drawn(rig, pixels, 50)
    assert float(valid[:, far].double().mean()) < 0.6
    one, other = int(far.nonzero()[0]), int((~far).nonzero()[0])
    length, deviation = found.length(one, other)
    assert math.isfinite(length)
    assert deviation == math.inf
    assert found.between(one, other).abs().amax() == 0
    assert not found.covariance.isnan().any()
    assert f"{int(far.sum())} extrapolated" in repr(found)
    assert found.to_dict()["extrapolated"] == far.tolist()


def test_points_among_the_corners_stay_as_they_are() -> None:
    """Those beside them that are extrapolated change nothing."""
    rig = _rig("brown5")
    places = _places(rig)
    pixels = _seen(rig, places)
    whole = rig.triangulate(pixels, pixel_sigma=0.2)
    near = ~whole.extrapolated
    alone = rig.triangulate({name: uv[near] for name, uv in pixels.items()}, pixel_sigma=0.2)
    assert not alone.extrapolated.any()
    torch.testing.assert_close(alone.covariance, whole.covariance[near], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["left", "right"])
def test_small_moves_are_those_to_first_order(name: str) -> None:
    """Against the derivative by intrinsics and place: a ray that moves one way sees the point move the other."""
    rig = _rig("brown5")
    parts, places = _parts(rig), _places(rig)[::7]
    slope = triangulation._by_parameters(parts, name, places)  # (n, 2, own)
    size = 1e-6 * torch.tensor([1.0 if one > 1.0 else 1e-2 for one in slope.abs().amax((0, 1)).tolist()], dtype=D)
    off, seen = extrapolation._moved_pixels(parts, name, torch.diag(size), places)
    assert seen.all()
    expected = -(slope * size).movedim(-1, 0)
    assert float((off - expected).abs().amax()) < 1e-4 * float(expected.abs().amax())
