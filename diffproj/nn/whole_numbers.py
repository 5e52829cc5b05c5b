"""Whole numbers in a module's state, as binary digits.

Averages of networks, such as `AveragedModel(use_buffers=True)`, average all that a state holds, and cut whole numbers
off behind the point: of 6 they make `0.9 * 6 + 0.1 * 6 = 5.99...`, which is 5. Digits, 0.0 or 1.0, stay next to what
they were, whatever an average does to them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

BITS = 32
"""Digits of a number, if not told otherwise."""


def digits_of(numbers: Sequence[int], device: torch.device, bits: int = BITS) -> Tensor:
    """The binary digits of `n` numbers from 0 to `2 ** bits - 1`, lowest first `(n, bits)`, in float32."""
    digits = [[float(number >> place & 1) for place in range(bits)] for number in numbers]
    return torch.tensor(digits, dtype=torch.float32, device=device).reshape(len(numbers), bits)


def numbers_of(digits: Tensor) -> Tensor:
    """The numbers `(*B)`, as int64, of digits `(*B, bits)`."""
    worth = torch.tensor([2**place for place in range(digits.shape[-1])], dtype=torch.int64, device=digits.device)
    return ((digits > 0.5).to(torch.int64) * worth).sum(-1)
