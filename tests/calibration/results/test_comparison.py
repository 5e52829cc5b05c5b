"""The table of lenses compared."""

import torch

from diffproj.calibration.results.comparison import LensComparison


def test_the_best_lens_is_named_and_the_others_told_how_much_worse_they_are() -> None:
    off = torch.tensor([1.0, 0.0, float("inf")], dtype=torch.float64)
    table = LensComparison(
        models=("none", "brown5", "brown8"),
        chosen="brown5",
        held_out="views",
        fitted_px=0.2 + off,
        held_out_px=0.25 + off,
        worse_px=off,
        deviation_px=0.1 * off,
        causes=("", "", "DIVERGED"),
    )
    _, none, five, eight, _ = table.summary().splitlines()
    assert none.startswith("  none")
    assert none.endswith("1.0000 ± 0.1000")
    assert five.startswith("* brown5")
    assert five.endswith("0.2500   the best")
    assert eight.endswith("DIVERGED")
