"""Shapes that broadcast as PyTorch's do, without its own function, which loads a library of symbols on its first call."""

import itertools

import pytest
import torch

from diffproj._core.numerics import broadcast_batches

SHAPES = [(), (1,), (3,), (0,), (2, 1), (2, 3), (1, 3), (4, 1, 1), (4, 2, 3), (1, 0)]


@pytest.mark.parametrize("shapes", list(itertools.combinations_with_replacement(SHAPES, 3)))
def test_batches_broadcast_as_tensors_do(shapes: tuple[tuple[int, ...], ...]) -> None:
    given = dict(zip("abc", shapes, strict=True))
    try:
        want = torch.broadcast_shapes(*shapes)
    except RuntimeError:
        with pytest.raises(ValueError, match=r"^batch shapes do not broadcast: a \(.*\), b \(.*\), c \("):
            broadcast_batches(**given)
    else:
        got = broadcast_batches(**given)
        assert isinstance(got, torch.Size)
        assert got == want
