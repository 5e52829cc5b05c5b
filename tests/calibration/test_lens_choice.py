"""`distortion="auto"` takes the simplest lens that is no worse than the best on corners held out."""

from typing import Any
from unittest.mock import Mock

import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.lens_choice import _Candidate, _simplest
from diffproj.calibration.trust.verdict import LacksViews

D = torch.float64
BOARD = dp.Chessboard()
BROWN = dp.BrownConrady(torch.tensor([-0.25, 0.09, 0.0, 0.0, -0.01], dtype=D))
WIDE = dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=D))


def seen(
    f: float, lens: object, views: int, size: tuple[int, int] = (640, 480), seed: int = 0, **poses: Any
) -> dp.Views:
    K = torch.tensor([[f, 0, size[0] / 2 + 10], [0, f, size[1] / 2 - 10], [0, 0, 1]], dtype=D)
    drawn = synthetic.random_cameras(dp.Camera(K, distortion=lens, size=size), BOARD, 3 * views, seed=seed, **poses)  # type: ignore[arg-type]
    faces = (drawn.R[..., 2] * (drawn.R @ BOARD.points.mean(0) + drawn.t)).sum(-1) > 0
    return synthetic.corner_views(drawn[faces][:views], BOARD, seed=seed)


SCENES: dict[str, tuple[float, object, tuple[int, int], tuple[float, float]]] = {
    "none": (600, None, (640, 480), (1.5, 3)),
    "brown5": (600, BROWN, (640, 480), (1.5, 3)),
    "fisheye": (300, WIDE, (1024, 768), (0.5, 1.5)),
}


@pytest.mark.slow
@pytest.mark.parametrize("truth", SCENES)
def test_the_truth_is_found(truth: str) -> None:
    f, lens, size, distance = SCENES[truth]
    for seed in range(4):
        found = dp.calibrate(seen(f, lens, 13, size, seed, distance=distance), BOARD, "auto")
        assert found.comparison is not None
        assert found.comparison.chosen == truth
        assert found.comparison.held_out == "views"
        again = dp.calibrate(found.views, BOARD, truth)  # type: ignore[arg-type]
        assert torch.equal(found.camera.K, again.camera.K)


def test_a_lens_of_180_degrees() -> None:
    f, lens, size, distance = SCENES["fisheye"]
    found = dp.calibrate(seen(f, lens, 5, size, distance=distance), BOARD, "auto")
    assert found.comparison is not None
    assert found.comparison.chosen == "fisheye"
    assert found.rms < 0.3


@pytest.mark.parametrize("views", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_few_views_are_judged_by_their_corners(views: int) -> None:
    found = dp.calibrate(dp.example_views("left")[2 : 2 + views], BOARD, "auto")
    assert found.comparison is not None
    assert found.comparison.held_out == "corners"
    assert found.comparison.chosen == "brown5"


def test_the_table_tells_what_was_compared() -> None:
    found = dp.calibrate(dp.example_views("right"), BOARD, "auto")
    compared = found.comparison
    assert compared is not None
    assert compared.chosen == "brown5"
    assert torch.equal(found.shared, dp.calibrate(dp.example_views("right"), BOARD).shared)
    place = compared.models.index("brown5")
    held_out = dp.cross_validate(dp.example_views("right"), BOARD)
    assert float(compared.fitted_px[place]) == float(found.rms)
    # Over folds of nearly as many corners, and over all corners: the same mean but for that.
    assert float(compared.held_out_px[place]) == pytest.approx(
        float(held_out.held_out_px.square().mean().sqrt()), rel=0.02
    )
    assert bool((compared.worse_px >= 0).all())
    lines = compared.summary().splitlines()
    assert [line.startswith("*") for line in lines[1:-1]] == [model == "brown5" for model in compared.models]
    assert all(len(line) < 80 for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("view", [0, 6])
def test_one_view_is_no_fisheye_because_it_determines_one(view: int) -> None:
    one = dp.example_views("left")[view : view + 1]
    usual = dp.calibrate(one, BOARD, throw=False)
    found = dp.calibrate(one, BOARD, "auto", throw=False)
    assert torch.equal(found.shared, usual.shared)
    assert torch.equal(found.status, usual.status)
    # Without a lens one view determines the focal length, but the corners ask for one.
    with pytest.raises(dp.CalibrationError, match="one view does not tell"):
        dp.calibrate(one, BOARD, "auto", fixed=("principal_point",))


def test_corners_of_no_weight_are_not_judged_by() -> None:
    views = dp.example_views("left")[:3]
    pixels, weights = views.pixels.clone(), torch.ones(3, 54, dtype=D)
    pixels[0, 7] += 30
    weights[0, 7] = 0
    found = dp.calibrate(dp.Views(pixels, size=views.size), BOARD, "auto", weights=weights)
    assert found.comparison is not None
    assert found.comparison.chosen == "brown5"
    assert found.comparison.held_out_px[1] < 0.3


def test_options_go_to_the_lenses_that_have_them() -> None:
    views = dp.example_views("left")[:4]
    found = dp.calibrate(views, BOARD, "auto", fixed=("k3",), priors={"p1": 0.01})
    assert found.comparison is not None
    assert found.comparison.chosen == "brown5"
    assert float(found.shared[8]) == 0


@pytest.mark.plain
def test_what_cannot_be_chosen_is_refused() -> None:
    views = dp.example_views("left")
    with pytest.raises(ValueError, match="distortion: want the name of a lens for many cameras, got 'auto'"):
        dp.calibrate(dp.Views(views.pixels[None], size=views.size), BOARD, "auto")
    with pytest.raises(ValueError, match=r"distortion: want the name of a lens that is held"):
        dp.calibrate(views, BOARD, "auto", fixed=("distortion",))
    with pytest.raises(ValueError, match="fixed: want names of parameters, got 'k9'"):
        dp.calibrate(views, BOARD, "auto", fixed=("k9",))
    with pytest.raises(ValueError, match="distortion: want one of none"):
        dp.calibrate(views, BOARD, "best")  # type: ignore[arg-type]
    with pytest.raises(dp.CalibrationError, match="calibrate: "):
        dp.calibrate(views[:1], BOARD, "auto")


def test_no_fisheye_is_taken_where_views_do_not_determine_an_ordinary_camera() -> None:
    def candidate(model: Any, error: float, cause: str = "") -> _Candidate:
        fit = Mock(spec=dp.Calibration)
        return _Candidate(model, fit, cause, torch.full((3,), error, dtype=torch.float64))

    lacking = candidate("brown5", float("inf"), LacksViews("not determined"))
    assert _simplest([lacking, candidate("fisheye", 0.01)]) is None
