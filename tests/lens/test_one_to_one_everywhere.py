"""Trigonometric polynomials that dip below zero between the places where they are sampled."""

import math

import torch

from diffproj.lens.brown_domain import DEGREE, _Circles

D = torch.float64


def test_dips_between_nodes_are_found() -> None:
    """Against values at 20,000 places, and at 2,000 more about the least of them: of a least value a hair off zero."""
    circles = _Circles(torch.tensor([[-0.2, 0.05, 0.001, 0.002, 0.0, 0, 0, 0, 0.001, 0, 0, 0]], dtype=D))
    orders = torch.arange(DEGREE + 1, dtype=D)

    def waves(angles: torch.Tensor) -> torch.Tensor:
        turned = angles[:, None] * orders
        return torch.cat([turned.cos(), turned.sin()], dim=-1)

    parts = torch.randn(2000, 2 * (DEGREE + 1), dtype=D)
    many = torch.linspace(0, 2 * math.pi, 20001, dtype=D)[:-1]
    lowest = torch.cat([many[(part @ waves(many).mT).argmin(-1)] for part in parts.split(100)])
    about = torch.linspace(-1, 1, 2001, dtype=D) * (2 * math.pi / 20000)
    least = torch.stack([(waves(at + about) @ part).amin() for at, part in zip(lowest, parts, strict=True)])
    nodes = torch.arange(circles.synthesis.shape[-1], dtype=D) * (2 * math.pi / circles.synthesis.shape[-1])
    between = (parts @ waves(nodes).mT).amin(-1) - least  # how much deeper it is between the nodes
    at = torch.arange(circles.analysis.shape[0], dtype=D) * (2 * math.pi / circles.analysis.shape[0])
    for lift, positive in ((1e-4, True), (1e-9, True), (-1e-4, False), (-1e-9, False)):
        lifted = parts @ waves(at).mT - least[:, None] + lift
        found = circles._positive(lifted)
        assert bool((found == positive)[between > 1e-3].all())
    assert int((between > 1e-3).sum()) > 1000
