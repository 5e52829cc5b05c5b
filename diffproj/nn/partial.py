"""Modules of geometry whose parameters are learned for all, some or none of a batch."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

PARTS = ("focal", "principal_point", "distortion", "pose")
"""What may be learned."""


Learn = Sequence[str] | Mapping[str, Any]
"""Parts to learn, or for each part the cameras whose it is, as booleans that broadcast to the batch shape."""


class GeometryModule(nn.Module):
    """A module of geometry: `network.half()` and `.bfloat16()` pass it by, moves and other dtypes do not.

    Attributes:
        partly: names of the parameters that are not learned everywhere; see `own`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.partly: set[str] = set()

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        def lifting(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return tensor.to(moved.device) if moved.dtype in (torch.float16, torch.bfloat16) else moved

        return super()._apply(lifting, recurse)


def learned_parts(learn: Learn, available: Sequence[str]) -> dict[str, Any]:
    """From part to whether, or for which cameras, it is learned; parts that are learned nowhere are left out.

    Raises:
        ValueError: a part that is not available.
    """
    names = (learn,) if isinstance(learn, str) else tuple(learn)
    unknown = [part for part in names if part not in available]
    if unknown:
        raise ValueError(f"learn: want parts of {', '.join(available)}, got {unknown[0]!r}")
    wanted = {part: learn[part] for part in names} if isinstance(learn, Mapping) else dict.fromkeys(names, True)
    return {part: where for part, where in wanted.items() if bool(torch.as_tensor(where).any())}


def own(module: GeometryModule, name: str, like: Tensor, where: Any, batch: torch.Size) -> None:
    """Give a module zeros `(*B, k)` of a name: a parameter if it is learned, with a mask if not everywhere.

    Args:
        module: whose they are.
        name: of the parameter or buffer; that of the mask is `NAME_learned`.
        like: of the shape, dtype and device that it has; an axis of the batch along which it is one has length 1.
        where: whether it is learned, or for which of the batch.
        batch: the batch shape.

    Raises:
        ValueError: `where` does not broadcast to the batch, or differs along an axis along which this is one.
    """
    zero = torch.zeros_like(like, memory_format=torch.contiguous_format)
    mask = torch.as_tensor(where, device=like.device)
    try:
        mask = mask.bool().expand(batch)
    except RuntimeError:
        raise ValueError(
            f"learn: want booleans that broadcast to the batch shape {tuple(batch)}, got shape {tuple(mask.shape)}"
        ) from None
    if not bool(mask.any()):
        module.register_buffer(name, zero)
        return
    module.register_parameter(name, nn.Parameter(zero))
    if bool(mask.all()):
        return
    for axis, length in enumerate(like.shape[:-1]):
        if length < mask.shape[axis]:
            first = mask.narrow(axis, 0, 1)
            if not bool((mask == first).all()):
                raise ValueError(f"learn: want the same for all poses of one camera, got {mask.tolist()} for {name}")
            mask = first
    module.partly.add(name)
    module.register_buffer(f"{name}_learned", mask.unsqueeze(-1).to(like.dtype))


def learned(module: GeometryModule, name: str) -> Tensor:
    """What `own` made, zero where it is not learned."""
    value: Tensor = getattr(module, name)
    return value * getattr(module, f"{name}_learned") if name in module.partly else value
