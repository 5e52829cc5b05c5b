"""What a `Camera` has, for the files that hold some of its methods."""

from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from diffproj.lens.protocol import Lens

C = TypeVar("C", bound="CameraParts")


class CameraParts:
    """Intrinsics, pose, lens and size; `Camera` says more of them."""

    __slots__ = ()

    K: Tensor
    R: Tensor
    t: Tensor
    distortion: Lens | None
    size: tuple[int, int] | None

    if TYPE_CHECKING:  # what `Batched` has

        @property
        def batch_shape(self) -> torch.Size:
            """See `Batched`."""
            ...

    def _with(self: C, **changes: Any) -> C:
        raise NotImplementedError
