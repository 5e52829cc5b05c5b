"""The paper's experiment: the bounds of its Table 1 on real corners, its trends on synthetic ones, its figure."""

import csv
import io

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import figures, synthetic
from diffproj.paper import experiment


@pytest.fixture(scope="module", params=["left", "right"])
def views(request: pytest.FixtureRequest) -> dp.Views:
    return dp.example_views(request.param)


def run(views: dp.Views, **options: object) -> dp.Experiment:
    fit, test = experiment.choose(views, experiment.default_split(len(views)))
    return dp.run_experiment(fit, test, dp.Chessboard(axes="paper"), **options)


def test_table_1_on_real_corners(views: dp.Views) -> None:
    *rows, total = run(views).rows
    assert len(rows) == 5
    assert all(row.corners == 54 for row in rows)
    for row in rows:
        assert max(row.mean[:2]) <= 0.12
        assert row.mean[2] <= 1e-12
    assert max(total.mean[:2]) <= 0.09


def test_strict_measures_corners_that_did_not_find_the_pose(views: dp.Views) -> None:
    usual, strict = run(views), run(views, strict=True)
    assert [row.corners for row in strict.rows] == [27] * 5 + [135]
    assert not (strict.measured & strict.test.views.visible).any()
    assert (strict.measured | strict.test.views.visible).all()
    for strictly, usually in zip(strict.rows[-1].mean[:2], usual.rows[-1].mean[:2], strict=True):
        assert strictly <= 1.25 * usually


def test_the_lens_costs_about_half_a_millimetre(views: dp.Views) -> None:
    total = run(views, distortion="none").rows[-1]
    assert 0.35 < max(total.mean[:2]) < 1.0


def test_error_bars_in_test_views_hold_what_the_fit_leaves_open(views: dp.Views) -> None:
    outcome = run(views)
    assert torch.equal(outcome.test.covariance.shared, outcome.fit.covariance.shared)
    held = dp.locate(views[8:], outcome.board, outcome.fit.camera)
    assert torch.equal(outcome.test.cameras.t, held.cameras.t)
    corners = views.pixels[8, [0, 53]]
    full, noise_alone = (dp.measure(corners, found, dp.Plane.z(0.0), view=0) for found in (outcome.test, held))
    assert full.includes_intrinsics
    assert (full.lengths().deviation > noise_alone.lengths().deviation).all()


def test_errors_are_what_equations_15_to_17_say(views: dp.Views) -> None:
    outcome = run(views)
    row = outcome.rows[2]
    error = (outcome.approximated[2] - outcome.exact).abs()
    torch.testing.assert_close(torch.tensor(row.mean).double(), error.mean(dim=0), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(torch.tensor(row.deviation).double(), error.std(dim=0), rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_trends_of_the_paper_on_photographs_with_known_truth() -> None:
    setup = dp.paper_setup()
    images = [
        synthetic.photograph(camera, setup.board, seed=i).numpy()
        for i, camera in enumerate(setup.cameras[i] for i in range(15))
    ]
    found = dp.detect(images, setup.board)
    assert len(found) == 15
    outcome = dp.run_experiment(found[:10], found[10:], setup.board)
    *rows, _ = outcome.rows
    assert all(max(row.mean) < 0.37 and max(row.deviation) < 0.27 for row in rows)
    near, middle, far = (sum(row.mean) for row in rows[:3])
    assert near < middle < far
    # The truth itself: poses to a few millimetres, the focal length to a few pixels.
    assert (outcome.test.cameras.center - setup.test.center).norm(dim=-1).max() < 5
    assert (outcome.fit.camera.K - setup.fit.K[0]).abs().max() < 2


def test_csv_holds_the_table(views: dp.Views) -> None:
    outcome = run(views)
    lines = list(csv.DictReader(io.StringIO(outcome.to_csv())))
    assert [line["view"] for line in lines] == [row.view for row in outcome.rows]
    assert float(lines[0]["mean_E_x"]) == pytest.approx(outcome.rows[0].mean[0], rel=1e-5)
    assert float(lines[-1]["deviation_E_y"]) == pytest.approx(outcome.rows[-1].deviation[1], rel=1e-5)


@pytest.mark.parametrize("axes", ["paper", "opencv"])
def test_figure_7_shows_the_board_as_one_looks_at_it(axes: str) -> None:
    views = dp.example_views("left")
    outcome = dp.run_experiment(views[:8], views[8:], dp.Chessboard(axes=axes), strict=True)
    figure = figures.fig7(outcome)
    assert len(figure.axes) == 5
    first = figure.axes[0]
    assert first.get_xlabel() == {"paper": "y", "opencv": "x"}[axes]
    exact = next(line for line in first.lines if line.get_marker() == "s")
    assert exact.get_xdata().max() == 200  # eight squares to the right
    assert exact.get_ydata().max() == 125  # five down
    assert first.yaxis_inverted()
    image = cv2.imdecode(np.frombuffer(figures.png(figure, dpi=50), np.uint8), cv2.IMREAD_COLOR)
    assert image.std() > 10


def test_splits() -> None:
    assert experiment.default_split(13) == (list(range(8)), list(range(8, 13)))
    assert experiment.parse_split("3", 5) == ([0, 1, 2], [3, 4])
    assert experiment.parse_split("5,1-2/3-4", 5) == ([4, 0, 1], [2, 3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("some", "split: want a number such as 8"),
        ("1-2/", "split: want a number such as 8"),
        ("1-2/9", "split: want views from 1 to 5, got 9"),
        ("0,1/2", "split: want views from 1 to 5, got 0"),
        ("5", "at least 2 views to fit and 1 to test, got 5 and 0 of 5"),
        ("1/2", "at least 2 views to fit and 1 to test, got 1 and 1 of 5"),
    ],
)
def test_bad_splits_are_named(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        experiment.parse_split(text, 5)
