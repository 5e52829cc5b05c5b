"""A prior that weighs against corners known to 1 px, where these are known better, is told, with what would be right."""

from typing import Any

import pytest
import torch

import diffproj as dp

BOARD, VIEWS = dp.Chessboard(), dp.example_views("left")
WORDS = "the priors weigh against corners that are known to 1 px"


def remark(**options: Any) -> str:
    return dp.calibrate(VIEWS, BOARD, **options).remarks[0]


@pytest.mark.parametrize("options", [{}, {"tied_focal": True}, {"loss": dp.Huber(0.3)}, {"fixed": ("k3",)}], ids=str)
def test_the_remark_says_what_the_remedy_gives(options: dict[str, Any]) -> None:
    priors = {"focal": (520.0, 3.0)}
    found = dp.calibrate(VIEWS, BOARD, priors=priors, **options)
    assert WORDS in found.remarks[0]
    assert WORDS in found.message
    sigma, rest = found.remarks[0].split("pixel_sigma=")[1].split(" ", 1)
    name, value = rest.split(" would be about ")
    there, here = (float(part.split(";")[0]) for part in value.split(", not "))
    again = dp.calibrate(VIEWS, BOARD, priors=priors, pixel_sigma=float(sigma), **options)
    assert WORDS not in again.message
    k = found.parameters.names.index(name)
    assert here == pytest.approx(float(found.shared[k]), rel=1e-4)
    # It moves by 6 to 9 px; the step foresees that to 0.4 under a robust loss, and 0.1 without.
    assert there == pytest.approx(float(again.shared[k]), abs=0.6)
    assert abs(there - here) > 5


def test_nothing_is_said_where_the_weight_makes_no_difference() -> None:
    for priors in ({"focal": (520.0, 1e6)}, {"focal": (520.0, 1e-6)}, {"k3": 0.01}):
        assert WORDS not in remark(priors=priors)
    weights = torch.tensor(50.0, dtype=torch.float64)
    for options in ({"pixel_sigma": 1.0}, {"weights": weights}):
        assert WORDS not in remark(priors={"focal": (520.0, 3.0)}, **options)


def test_of_many_cameras_the_one_it_is_about() -> None:
    views = dp.Views(VIEWS.pixels.expand(2, -1, -1, -1), VIEWS.visible.expand(2, -1, -1), size=VIEWS.size)
    priors = {"focal": (torch.tensor([[520.0], [533.5]]), torch.tensor([[3.0], [1e4]]))}
    first, second = dp.calibrate(views, BOARD, priors=priors).remarks
    assert WORDS in first
    assert WORDS not in second
