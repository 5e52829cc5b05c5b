"""Where little is known, deviations hold what the evidence leaves open along its curve; where much is, they are slopes'."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.evidence.curved import _where_it_costs

D = torch.float64
COUNT = 200
SIZE = (1280, 960)
TRUE = dp.Camera.mounted(6.0, 20.0, 2.0, 30.0, focal=1200.0, size=SIZE)
START = dp.Camera.mounted(8.0, 30.0, 8.0, 50.0, position=[4.0, -4.0], focal=800.0, size=SIZE)


def landmarks(places: list[list[float]], heights: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Above the ground points that are seen there; and 200 draws of their pixels."""
    points, _ = dp.back_project(torch.tensor(places, dtype=D), TRUE, dp.Plane.z(0.0))
    points[:, 2] = torch.tensor(heights, dtype=D)
    pixels, valid = TRUE.project(points)
    assert bool(valid.all())
    draws = torch.randn(COUNT, *pixels.shape, generator=torch.Generator().manual_seed(0), dtype=D)
    return points, pixels + draws


def held(found: dp.Calibration) -> dict[str, float]:
    """In how many of a hundred cameras height, tilt and focal length lie within 1.96 deviations."""
    truth, value, spread = TRUE.mounting(), found.mounting, found.mounting_deviations  # type: ignore[attr-defined]
    off = {name: (getattr(value, name) - getattr(truth, name)) / getattr(spread, name) for name in ("height", "tilt")}
    off["focal"] = (found.camera.K[:, 0, 0] - 1200) / found.covariance.deviations["f_x"]
    return {name: 100 * float((part.abs() < 1.96)[found.converged].double().mean()) for name, part in off.items()}


WEAK = [[902.0, 703.0], [1028.0, 566.0], [946.0, 906.0], [549.0, 848.0]]


def test_a_focal_length_that_four_landmarks_hardly_tell() -> None:
    """To an eighth. Measured: 93.5 to 98 % of 200 lie within 1.96 deviations; 87.5 % within those of the slopes."""
    points, pixels = landmarks(WEAK, [2.9, 1.2, 0.9, 1.6])
    found = dp.adjust(START, dp.Seen(points, pixels), free=["focal"], throw=False)
    assert int(found.converged.sum()) > 0.9 * COUNT
    figures = held(found)
    assert min(figures.values()) > 92, figures


def test_what_is_well_known_is_as_slopes_tell() -> None:
    """Deviations of 200 draws are those of the estimates."""
    points, pixels = landmarks([[100.0, 400], [1200, 420], [1100, 900], [150, 880], [600, 650]], [0.0, 2, 1, 3, 0])
    found = dp.adjust(START, dp.Seen(points, pixels), free=["focal"])
    estimates = found.camera.K[:, 0, 0]
    assert float(found.covariance.deviations["f_x"].median() / estimates.std()) == pytest.approx(1, abs=0.12)
    assert min(held(found).values()) > 91


def test_priors_are_straight() -> None:
    """Followed to two deviations beside a person who tells nothing, they cost what their deviations say."""
    anyone = dp.Heights([[640.0, 900.0]], [[640.0, 600.0]], 1.7, 1e4)
    given = dp.adjust(TRUE, anyone, priors={"height": 2.0, "tilt": 10.0}, fixed=("roll", "heading", "position"))
    spread = given.mounting_deviations
    assert [float(spread.height), float(spread.tilt)] == pytest.approx([2.0, 10.0])


def test_where_a_cost_is_reached() -> None:
    times = torch.tensor([1.0, 2.0, 4.0], dtype=D)
    root = torch.tensor([[2.0, 0.5, 0.1, 1.0], [4.0, 1.5, 0.2, 0.8], [8.0, 3.0, 0.3, 1.2]], dtype=D)
    assert _where_it_costs(times, root, 1.0).tolist() == pytest.approx([0.5, 1.5, 4.0, 1.0])
