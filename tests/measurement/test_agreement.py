"""Which sources disagree: of many points at once what each alone says."""

import torch

from diffproj.measurement.agreement import Sources, disagreeing, growth

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
    sources = Sources(y, C, information, both, C, freedom)
    found = disagreeing(sources)
    for i in range(6):
        alone = disagreeing(Sources(*(part[i] for part in sources)))
        assert found[i].tolist() == alone.tolist(), i
    assert found[0].tolist() == [False] * 3
    assert found[1].tolist() == [False, False, True]
    assert found[2].tolist() == [True] * 3
    assert found[3].tolist() == [False, True, False]


def test_who_agrees_is_not_judged_anew_for_others_sake() -> None:
    """Where the sources of one element of a batch disagree, those of another are as they are alone."""
    y = torch.zeros(2, 3, 2, dtype=D)
    y[1, 2] = 90.0
    C = torch.eye(2, dtype=D).expand(2, 3, 2, 2).clone()
    both, freedom = torch.ones(2, 3, 2, dtype=torch.bool), torch.full((2, 3), torch.inf, dtype=D)
    elsewhere = Sources(torch.full_like(y, 0.0).index_fill(1, torch.tensor([0]), 90.0), C, C, both, C, freedom)
    found = disagreeing(Sources(y, C, C, both, C, freedom), lambda _: elsewhere)
    assert found.tolist() == [[False, False, False], [True, False, False]]


def test_of_two_that_disagree_nothing_tells_which_is_wrong() -> None:
    """Whatever their covariances, and however rounding makes the chances of the two differ."""
    root = torch.randn(200, 2, 2, 2, dtype=D)
    C = root @ root.mT + 0.1 * torch.eye(2, dtype=D)
    y = torch.stack([torch.randn(200, 2, dtype=D), 100 + torch.randn(200, 2, dtype=D)], dim=1)
    both = torch.ones(200, 2, 2, dtype=torch.bool)
    freedom = torch.full((200, 2), torch.inf, dtype=D)
    assert bool(disagreeing(Sources(y, C, torch.linalg.inv(C), both, C, freedom)).all())


def test_of_two_that_share_numbers_with_each_other_alone_nothing_tells_either() -> None:
    """Whoever else there is."""
    root = torch.randn(100, 3, 4, 4, dtype=D)
    both = torch.tensor([[True, True, False, False], [True, True, False, False], [False, False, True, True]])
    y = torch.where(both, torch.randn(100, 3, 4, dtype=D) + 50 * torch.tensor([[1.0], [0], [0]], dtype=D), 0.0)
    known = both.unsqueeze(-1) & both.unsqueeze(-2)
    C = torch.where(known, root @ root.mT, 0.0) + torch.eye(4, dtype=D)
    information = torch.where(known, torch.linalg.inv(C), 0.0)
    freedom = torch.full((100, 3), torch.inf, dtype=D)
    found = disagreeing(Sources(y, C, information, both.expand(100, 3, 4), C, freedom))
    assert bool((found == torch.tensor([True, True, False])).all())


def test_many_numbers_that_agree_do_not_hide_how_far_one_source_is_off() -> None:
    """The worst of three knows two numbers of a hundred: chi-square over all is near 1."""
    both = torch.ones(3, 100, dtype=torch.bool)
    both[2, 2:] = False
    y = torch.zeros(3, 100, dtype=D)
    y[2, :2] = 12.0
    C = torch.eye(100, dtype=D).expand(3, 100, 100)
    information = torch.where(both.unsqueeze(-1) & both.unsqueeze(-2), C, 0.0)
    sources = Sources(y, C, information, both, 0 * C, torch.full((3,), torch.inf, dtype=D))
    found = disagreeing(sources)
    assert found.tolist() == [False, False, True]
    torch.testing.assert_close(growth(sources, found), torch.tensor(48.0, dtype=D))  # 2 * 144 * 2 / 3 over 4
