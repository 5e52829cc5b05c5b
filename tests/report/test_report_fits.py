"""Reports say of landmarks, wide lenses, small residuals and tied focal lengths what fits them."""

import re
from dataclasses import replace

import numpy as np
import torch

import diffproj as dp
from diffproj.report import svg
from diffproj.report.facts import Facts
from diffproj.report.parameters import parameters_part
from diffproj.report.residuals import residuals_part
from diffproj.report.suggestions import NINTHS, suggestions
from diffproj.report.verdict import verdict_part
from tests.report.test_report import BOARD, D, few, landmarks, report, words


def test_landmarks_are_not_called_corners() -> None:
    page = report(landmarks(), folds=None)
    page = re.sub(r"<(style|script).*?</\1>", "", page, flags=re.DOTALL)
    assert "corner" not in words(page).lower().replace("corner of the image", "")
    assert not re.search(r'(aria-label|title)="[^"]*corner', page)
    assert "1 view with 14 landmarks" in words(page)
    assert "A detector in sharp photographs" not in words(page)
    assert "2 views with 108 corners" in words(report(few(2), folds=None))


def test_a_suggested_board_is_not_seen_from_the_side() -> None:
    """Tilted by 35 degrees at the border of a fisheye's image it was a line."""
    lens = dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.002, 0.0], dtype=D))
    camera = dp.Camera(torch.tensor([[300.0, 0, 400], [0, 300, 300], [0, 0, 1]], dtype=D), None, None, lens, (800, 600))
    turns = 0.5 * torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0.5, 0.5, 0.2], [0, 0.3, 0.5]], dtype=D)
    R = torch.stack([dp.rotation_from_euler(*turn) for turn in turns])
    t = torch.tensor([0.0, 0, 260], dtype=D) - R @ BOARD.points.to(D).mean(0)
    pixels, _ = camera.at(R, t).project(BOARD.points.to(D))
    noise = 0.05 * torch.randn(pixels.shape, dtype=D, generator=torch.Generator().manual_seed(3))
    facts = Facts(dp.calibrate(dp.Views(pixels + noise, size=(800, 600)), BOARD, "fisheye"), (800, 600))
    wanted = suggestions(facts)
    bare = facts.calibration.judgement.bare
    assert {"top left", "top right", "bottom left"} <= {one.place for one in wanted} == set(bare[:6])
    for one in wanted:
        row, column = divmod(NINTHS.index(one.place), 3)
        u, v = one.outline.mean(0)
        assert (int(u // (800 / 3)), int(v // 200)) == (column, row)
        along, across = (np.linalg.norm(one.outline[i] - one.outline[j]) for i, j in ((0, 2), (1, 3)))
        x, y = one.outline.T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        assert area > 0.2 * along * across  # of a rectangle of two squares 0.4; of the line 0.07


def test_names_at_the_axis_of_small_residuals_do_not_run_into_its_label() -> None:
    pixels, _ = few(5).cameras.project(BOARD.points.to(D))
    noise = 0.02 * torch.randn(pixels.shape, dtype=D, generator=torch.Generator().manual_seed(4))
    small = dp.calibrate(dp.Views(pixels + noise, size=(640, 480)), BOARD, "none")
    part = residuals_part(Facts(small, (640, 480)))
    assert "\N{MINUS SIGN}0.02<" in part.html
    for x, name in re.findall(
        r'<text class="tick" x="(.*?)" y=".*?" text-anchor="end">(\N{MINUS SIGN}?[\d.]+)</', part.html
    ):
        assert float(x) - svg.DIGIT * len(name) >= 15


def test_focal_lengths_that_were_tied_are_not_said_to_be_hardly_told_apart() -> None:
    tied = dp.calibrate(dp.example_views("left"), BOARD, "none", tied_focal=True)
    assert "f_x and f_y" not in words(parameters_part(Facts(tied, (640, 480))).html)
    free = dp.calibrate(dp.example_views("left"), BOARD, "none")
    assert "f_x and f_y" in words(parameters_part(Facts(free, (640, 480))).html)


def test_remedies_have_the_command_s_options_beside_python_s() -> None:
    found = few(13)
    vars(found)["judgement"] = replace(found.judgement, remedies=("no other photograph yet, but shape='free'",))
    assert "but shape='free' (--shape free)." in words(verdict_part(Facts(found, (640, 480))).html)
