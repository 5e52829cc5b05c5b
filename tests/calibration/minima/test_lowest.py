"""A sample of what `python -m tests.calibration.minima` counts, and the minima of rational lenses that it found missing."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.results.border import border_with_rays

from .drawn import BOARD, KINDS, Draw
from .judged import judged

LONG = ("any brown12", "any brown14")


@pytest.mark.parametrize(
    "kind", [kind if kind == "near" else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
)
def test_nothing_ends_above_the_lowest_minimum_without_a_word(kind: str) -> None:
    found = list(judged(kind, 1000, 2 if kind in LONG else 5, scipy_share=0.0))
    assert not any(one["matters"] for one in found), found
    assert not any(one["falsely_refused"] for one in found), found


def test_the_minimum_of_a_rational_lens_that_does_not_fold() -> None:
    """Three cameras whose k4 to k6 were held, at costs of 14.870, 31.129 and 28.021.

    From the true cameras and from OpenCV's start one lens folds at its corners and two do not reach the whole image.
    The second, whose true focal length is 818.5 px, has a minimum with factors at 30.987, with 838.7 px +- 47.8: held, it
    is known to 0.9 px.
    """
    problems, rows = KINDS["any brown8"](25, Draw(0)), [1, 12, 15]
    views = dp.Views(problems.views.pixels[rows], problems.views.visible[rows], size=problems.views.size)
    found = dp.calibrate(views, BOARD, "brown8", throw=False)
    assert bool(found.converged.all())
    assert bool((border_with_rays(found.camera, views.size or (0, 0)) == 1).all())
    assert ["are held" in remark for remark in found.remarks] == [False, True, False]
    cost = found.residuals.square().sum((-3, -2, -1))
    torch.testing.assert_close(cost, cost.new_tensor([14.588, 31.129, 27.794]), rtol=1e-3, atol=0)
    f_x, deviation = found.shared[1, 0], found.covariance.shared[1, 0, 0].sqrt()
    assert float(deviation) < 1
    assert abs(float(f_x - problems.truth.K[12, ..., 0, 0].flatten()[0])) < 2 * float(deviation)
