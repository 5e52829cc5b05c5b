"""The solver run over tasks: where coefficients that are held at 0 are left out, as where they are not."""

from dataclasses import replace

import pytest
import torch

import diffproj as dp
from diffproj.calibration.fitting.task import Task, solved
from diffproj.calibration.least_squares.solver import Prior, Status
from diffproj.calibration.problem.parametrisation import Pose
from diffproj.lens.models import LensModel

VIEWS, BOARD = dp.example_views("left")[:5], dp.Chessboard()


def task(lens: LensModel, skew: bool, held: tuple[str, ...]) -> tuple[Task, torch.Tensor, Pose]:
    """Two fits to the same views from nearby, with some parameters held."""
    found = dp.calibrate(VIEWS, BOARD, "brown4")
    whole = Task(BOARD.points, VIEWS.pixels.expand(2, -1, -1, -1), VIEWS.visible.expand(2, -1, -1), lens, skew=skew)
    start = whole.pixels.new_zeros(2, len(whole.names))
    start[:, :4] = found.parameters.pack(found.camera)[:4] * torch.tensor([[1.02], [0.97]])
    poses = tuple(z.expand(2, *z.shape) for z in (found.cameras.R, found.cameras.t))
    return whole.holding([whole.names.index(name) for name in held]), start, poses


PRISM, TILT = ("s1", "s2", "s3", "s4"), ("tau_x", "tau_y")


@pytest.mark.parametrize(
    ("lens", "skew", "held", "fitted"),
    [
        ("brown12", False, ("k3", "k4", "k5", "k6", *PRISM), "brown4"),
        ("brown8", True, ("k4", "k5", "k6"), "brown5"),
        ("brown14", True, ("k3", "k4", "k5", "k6", *PRISM, *TILT), "brown4"),
        ("brown14", False, ("k3", "k4", "k5", "k6", *TILT), "brown12"),
        ("brown14", False, ("k3", "k4", "k5", "k6", *PRISM), "brown14"),
    ],
)
@pytest.mark.parametrize("known", [False, True])
def test_held_coefficients_are_left_out(
    lens: LensModel, skew: bool, held: tuple[str, ...], fitted: LensModel, known: bool
) -> None:
    whole, start, poses = task(lens, skew, held)
    if known:
        precision = torch.zeros_like(start)
        precision[:, whole.names.index("c_x")] = 0.3
        whole = replace(whole, prior=Prior(start, torch.diag_embed(precision)))
    brief = replace(whole, brief=True)
    assert brief.lens_from(start) == fitted
    options = {"max_iterations": 100, "tolerance": 1e-14}
    want, got = (solved(each, start, poses, **options) for each in (whole, brief))  # type: ignore[arg-type]
    assert got.status.tolist() == [Status.CONVERGED] * 2
    torch.testing.assert_close(got.shared, want.shared, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(got.cost, want.cost, rtol=1e-12, atol=0)
    short = whole.with_shorter_lens(fitted)[0].names
    there = torch.tensor([name in short for name in whole.names])
    assert (got.shared[:, ~there] == 0).all()
    want, got = (solved(each, start, poses, max_iterations=0, tolerance=1e-14) for each in (whole, brief))
    U, E, g = (there[:, None] & there), there[:, None], there
    for name, kept in {"U": U, "E": E, "g": g, "W": True, "h": True, "c": True}.items():
        one, other = getattr(got.equations, name), getattr(want.equations, name)
        torch.testing.assert_close(
            one, other * torch.as_tensor(kept), rtol=1e-9, atol=1e-12 * float(other.abs().amax())
        )


def test_coefficients_that_are_not_0_or_known_stay() -> None:
    whole, start, _ = task("brown14", False, ("k3", "k4", "k5", "k6", *PRISM, *TILT))
    brief = replace(whole, brief=True)
    at = whole.names.index("k5")
    start[1, at] = 1e-3
    assert brief.lens_from(start) == "brown8"
    start[1, at] = 0.0
    precision = torch.zeros_like(start)
    precision[0, at] = 1.0
    assert replace(brief, prior=Prior(start, torch.diag_embed(precision))).lens_from(start) == "brown8"
    assert whole.lens_from(start) == "brown14"
