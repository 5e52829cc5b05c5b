"""Which sources disagree: of many points at once what each alone says."""

import torch

from diffproj.measurement.agreement import disagreeing

D = torch.float64


def test_many_points_are_judged_as_each_alone() -> None:
    """Of three sources one is told; of two that are left nothing tells which is wrong, and both are."""
    y = torch.zeros(6, 3, 2, dtype=D)
    y[1, 2] = 9.0
    y[2, 0], y[2, 1] = 9.0, -30.0  # all three apart
    y[3, 1] = -9.0
    C = torch.eye(2, dtype=D).expand(6, 3, 2, 2).clone()
    both = torch.ones(6, 3, 2, dtype=torch.bool)
    both[4:, 2] = False
    y[4, 0] = 9.0  # two know, and disagree
    information = torch.where(both.unsqueeze(-1) & both.unsqueeze(-2), C, 0.0)
    freedom = torch.full((6, 3), torch.inf, dtype=D)
    found = disagreeing(information, y, C, both, freedom)
    for i in range(6):
        alone = disagreeing(*(part[i] for part in (information, y, C, both, freedom)))
        assert found[i].tolist() == alone.tolist(), i
    assert found[0].tolist() == [False] * 3
    assert found[1].tolist() == [False, False, True]
    assert found[2].tolist() == [True] * 3
    assert found[3].tolist() == [False, True, False]


def test_of_two_that_disagree_nothing_tells_which_is_wrong() -> None:
    """Whatever their covariances, and however rounding makes the chances of the two differ."""
    root = torch.randn(200, 2, 2, 2, dtype=D)
    C = root @ root.mT + 0.1 * torch.eye(2, dtype=D)
    y = torch.stack([torch.randn(200, 2, dtype=D), 100 + torch.randn(200, 2, dtype=D)], dim=1)
    both = torch.ones(200, 2, 2, dtype=torch.bool)
    freedom = torch.full((200, 2), torch.inf, dtype=D)
    assert bool(disagreeing(torch.linalg.inv(C), y, C, both, freedom).all())
