"""What the learnable modules share: their precision, and parameters learned for all, some or none of a batch."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from diffproj._core.arguments import booleans, words
from diffproj._core.numerics import has_values
from diffproj._core.torch_private import has_no_values
from diffproj.geometry.camera import Camera
from diffproj.lens.models import MODELS, model_of
from diffproj.nn.whole_numbers import digits_of, numbers_of

PARTS = ("focal", "principal_point", "distortion", "pose")
"""The parts of a camera that can be learned."""
TURNS = ("pitch", "yaw", "roll")
"""Parts of a pose: angles about the camera's x, y and z."""
OF_POSE = ("rotation", "translation", *TURNS, "height")
"""Parts of a pose that can be learned in its place."""


Learn = Sequence[str] | Mapping[str, Any]
"""Names of the parts to learn; or a mapping from each name to the elements of the batch for which the part is learned:
True, False, or booleans that broadcast to the batch shape."""


class GeometryModule(nn.Module):
    """Base of modules that hold geometry, which half precision would spoil.

    `network.half()` and `network.bfloat16()` move the rest of a network and leave the tensors of these modules in the
    precision that they have; `.to(device)`, `.float()` and `.double()` work as for any module.

    Attributes:
        lowest_precision: a conversion to a dtype with fewer bits than this one changes nothing but the device.
        masked: names of the parameters that are learned for a part of the batch only; see `add_parameter`.
        own_kind: lens model and image size, and the buffer that says so; see `add_kind`.
    """

    lowest_precision: ClassVar[torch.dtype] = torch.float32
    own_kind: tuple[tuple[int, ...], Tensor]
    kind: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.masked: set[str] = set()

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        """As any module does; what inference mode made is copied, so that the module can be trained afterwards."""
        if tensor is not None and tensor.is_inference():
            with torch.inference_mode(False):
                tensor = tensor.clone()
        super().register_buffer(name, tensor, persistent)

    def register_parameter(self, name: str, param: nn.Parameter | None) -> None:
        """Likewise."""
        if param is not None and param.is_inference():
            with torch.inference_mode(False):
                param = nn.Parameter(param.detach().clone(), param.requires_grad)
        super().register_parameter(name, param)

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        least = torch.finfo(self.lowest_precision).bits

        def convert(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            if moved.is_floating_point() and torch.finfo(moved.dtype).bits < least:
                return tensor.to(moved.device)
            return moved

        with torch.inference_mode(False):  # a module that is moved in inference mode can still be trained afterwards
            super()._apply(convert, recurse)
        if "own_kind" in self.__dict__:
            self.own_kind = self.own_kind[0], self.kind
        return self


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """A context in which autocast is off on a device."""
    kind = "cpu" if device.type == "meta" else device.type
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


def add_kind(module: GeometryModule, camera: Camera) -> None:
    """Make lens model and image size a part of the module's state, and refuse a state with others.

    The coefficients of a fisheye and of another lens may be as many, and one would be taken for the other.
    """
    own = (list(MODELS).index(model_of(camera.distortion).name), *(camera.size or NO_SIZE))
    module.register_buffer("kind", digits_of(own, camera.device))
    module.own_kind = own, module.kind
    module.register_load_state_dict_pre_hook(partial(_check_kind, own))


def check_swapped_kind(module: GeometryModule) -> None:
    """That what stands in the place of a module's state, as in `functional_call`, is of the same lens and size.

    It is looked at on a CPU, outside of graphs and of `vmap`.

    Raises:
        ValueError: it is another's.
    """
    if torch.compiler.is_compiling():
        return
    (own, before), now = module.own_kind, module._buffers["kind"]
    if now is before or now is None or now.device.type != "cpu" or not has_values(now):
        return
    if wrong := _other_kind(own, now):
        raise ValueError(f"kind: {wrong}")


def _check_kind(own: tuple[int, ...], _: nn.Module, state: dict[str, Any], prefix: str, *rest: Any) -> None:
    """Called before `load_state_dict`, which adds the message to its own."""
    saved = state.get(f"{prefix}kind")
    if saved is None or saved.ndim != 2 or not has_values(saved):
        return
    if wrong := _other_kind(own, saved):
        rest[-1].append(f"{prefix}kind: {wrong}")


def _other_kind(own: tuple[int, ...], saved: Tensor) -> str:
    """What is wrong with a state of this kind; nothing where it fits."""
    theirs = tuple(numbers_of(saved).tolist())
    if theirs[0] != own[0]:
        names = dict(enumerate(MODELS))
        want, got = f"lens {names[own[0]]!r}", f"lens {names.get(theirs[0], 'of another release')!r}"
    elif theirs[1:] != own[1:] and NO_SIZE not in (theirs[1:], own[1:]):
        want, got = f"size {own[1:]}", f"size {theirs[1:]}"
    else:
        return ""
    return f"want the state of a camera with {want}, got {got}; build the module from such a one"


NO_SIZE = (0, 0)
"""In a state, of a camera that does not know its size."""


def asked_parts(learn: Learn) -> dict[str, Any]:
    """From each name that is asked for to where.

    Raises:
        TypeError: no names.
    """
    if isinstance(learn, Mapping):
        return {part: learn[part] for part in words("learn", tuple(learn), "names of parts")}
    return dict.fromkeys((learn,) if isinstance(learn, str) else words("learn", learn, "names of parts"), True)


def learned_parts(learn: Learn, available: Sequence[str]) -> dict[str, Any]:
    """From each part that is learned to True, or to the booleans that say for which elements of the batch.

    Args:
        learn: what the user asked for.
        available: the parts that there are.

    Raises:
        TypeError: no names, or no booleans for one.
        ValueError: a part that is not available.
    """
    wanted = asked_parts(learn)
    unknown = [part for part in wanted if part not in available]
    if unknown:
        raise ValueError(f"learn: want parts of {', '.join(available)}, got {unknown[0]!r}")
    masks = {part: _mask(where) for part, where in wanted.items()}
    chosen = {part: mask for part, mask in masks.items() if bool(mask.any())}
    for whole, within in (("pose", OF_POSE), ("rotation", TURNS), ("translation", ("height",))):
        twice = [part for part in within if part in chosen and whole in chosen]
        if twice:
            raise ValueError(f"learn: want {whole!r} or parts of it, got both {whole!r} and {twice[0]!r}")
    return chosen


def _mask(where: Any) -> np.ndarray:
    """Booleans as an array, which has values under `FakeTensorMode` too.

    Raises:
        TypeError: no booleans.
        ValueError: a tensor without values.
    """
    if isinstance(where, bool):
        return np.array(where)
    mask = booleans("learn", where, torch.device("cpu"))
    if has_no_values(mask):
        if isinstance(where, Tensor):
            raise ValueError("learn: want True, False or booleans, got a tensor without values")
        return np.array(where, dtype=bool)
    return mask.numpy(force=True)


def add_parameter(module: GeometryModule, name: str, like: Tensor, where: Any, batch: torch.Size) -> None:
    """Add zeros of shape `(*B, k)` to a module: a parameter if they are learned, otherwise a buffer.

    A parameter that is learned for a part of the batch comes with a mask, the buffer `NAME_learned`.

    Args:
        module: the module.
        name: of the parameter or buffer.
        like: a tensor with the shape, dtype and device to use. An axis of the batch along which all elements share one
            value has length 1.
        where: True or False, or booleans that broadcast to the batch shape: the elements for which it is learned.
        batch: the batch shape `*B`.

    Raises:
        ValueError: `where` does not broadcast to the batch shape, or differs along an axis with one shared value.
    """
    zero = torch.zeros_like(like, memory_format=torch.contiguous_format)
    mask = where if isinstance(where, np.ndarray) and where.dtype == np.bool_ else _mask(where)
    try:
        mask = np.broadcast_to(mask, tuple(batch))
    except ValueError:
        raise ValueError(
            f"learn: want booleans that broadcast to the batch shape {tuple(batch)}, got shape {mask.shape}"
        ) from None
    if not mask.any():
        module.register_buffer(name, zero)
        return
    module.register_parameter(name, nn.Parameter(zero))
    if mask.all():
        return
    for axis, length in enumerate(like.shape[:-1]):
        if length < mask.shape[axis]:
            first = mask.take([0], axis)
            if not (mask == first).all():
                raise ValueError(
                    f"learn: want the same for all poses of one camera, got {mask.tolist()} for {name}, which they "
                    "share because they start with the same intrinsics; tied_intrinsics=False gives each its own"
                )
            mask = first
    module.masked.add(name)
    where = torch.tensor(mask.tolist(), dtype=like.dtype, device=like.device)
    module.register_buffer(f"{name}_learned", where.unsqueeze(-1))


def learned(module: GeometryModule, name: str) -> Tensor:
    """The value of what `add_parameter` added, zero for the elements of the batch for which it is not learned."""
    value: Tensor = getattr(module, name)
    return value * getattr(module, f"{name}_learned") if name in module.masked else value


def same_values(now: Tensor, before: Tensor) -> bool:
    """Whether a tensor holds what another does: in whatever way it was written to, of which not all are counted."""
    return now.dtype == before.dtype and now.device == before.device and torch.equal(now, before)
