"""What a tensor has to be before anything is done with it: dense."""

import torch
from torch import Tensor


def dense(name: str, tensor: Tensor) -> Tensor:
    """A tensor with its values in memory one by one, as all but sparse, nested and quantised ones are.

    One that PyTorch keeps as the negative of another, such as `z.conj().imag`, is worked out.

    Raises:
        TypeError: it is sparse, nested or quantised.
    """
    if torch.compiler.is_compiling():
        return tensor
    if tensor.is_nested:
        raise TypeError(f"{name}: want a dense tensor, got a nested one; torch.stack(...) joins tensors of one shape")
    if tensor.layout is not torch.strided:
        raise TypeError(f"{name}: want a dense tensor, got layout {tensor.layout}; .to_dense() makes one")
    if tensor.is_quantized:
        raise TypeError(f"{name}: want a dense tensor, got {tensor.dtype}; .dequantize() makes one")
    return tensor.resolve_neg() if tensor.is_neg() else tensor
