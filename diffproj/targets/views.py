"""`Views`: the corners of a board as one camera, or many side by side, saw them in several photographs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import Array, booleans, called, instance, position
from diffproj._core.batched import Batched, check_index
from diffproj._core.numerics import broadcast_batches, check_tensor, has_values
from diffproj._core.shown import counted, in_pixels
from diffproj.geometry.grid import checked_size
from diffproj.targets.exif import Told

ArrayLike = Tensor | Array
"""What tensors are made of here."""


class Views(Batched, tensors={"pixels": 3, "visible": 2}, constants=("names", "size", "told")):
    """The pixels of a board's corners in V photographs, with a mask that says which corners were seen.

    Immutable in spirit: every method returns new views, and the caller's tensors are never written. Gradients flow
    through the pixels to the caller's tensor. It is a PyTree: `vmap` and `torch.func` carry it.

    Attributes:
        pixels: `(*B, V, N, 2)`, `(u, v)` in px, whole numbers at pixel centres; 0 where the corner was not seen. N
            counts the corners in the board's order; `*B` are cameras side by side.
        visible: `(*B, V, N)`, false where a corner was not seen.
        names: the names of the V photographs.
        size: `(width, height)` of the photographs in px, or `None`.
        told: what the file of each photograph tells of its camera, zoom and turn, as `detect` reads it: V tuples of
            names and values; empty where nothing is known. `calibrate` doubts photographs that contradict each other.

    Example:
        >>> views = Views(torch.rand(5, 54, 2), size=(640, 480))
        >>> views
        Views(5 views of 54 corners, 640 x 480 px, torch.float32)
        >>> len(views), views[1:3].names
        (5, ('view 2', 'view 3'))
    """

    __slots__ = ("names", "pixels", "size", "told", "visible")

    pixels: Float[Tensor, "*batch v n 2"]
    visible: Bool[Tensor, "*batch v n"]
    names: tuple[str, ...]
    size: tuple[int, int] | None
    told: tuple[Told, ...]

    def __init__(
        self,
        pixels: ArrayLike,
        visible: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        size: Sequence[int] | None = None,
        told: Sequence[Any] | None = None,
    ) -> None:
        """Copy pixels and mask, and check them.

        Args:
            pixels: `(*B, V, N, 2)`. A tensor keeps its dtype and device (half precision is lifted to float32); a
                NumPy array and a nested list of numbers are taken as well. (OpenCV 4 gives the corners of a view as
                `(N, 1, 2)`: `reshape(-1, 2)` brings them here.)
            visible: booleans `(*B, V, N)`; all true if left out. What `pixels` holds where it is false, be it NaN,
                does not matter.
            names: V strings; `"view 1"`, `"view 2"`, ... if left out.
            size: `(width, height)` in px, where known.
            told: what files tell, V tuples of a name and a text or number each, as other views' `told` holds it; empty
                where nothing is known. Views that are made from detected ones take it along.

        Raises:
            TypeError: pixels are not of floating-point type, visible is not boolean, names are not strings, size is
                not two whole numbers, or told no names with texts and numbers.
            ValueError: shapes or lengths do not fit, devices differ, or a visible corner is not finite (checked where
                values can be read).
        """
        points = check_tensor("pixels", pixels, "V", "N", 2)
        mask = _check_visible(visible, points)
        self.names = _check_names(names, points.shape[-3])
        self.size = checked_size(size)
        self.told = _check_told(told, points.shape[-3])
        batch = broadcast_batches(pixels=points.shape[:-3], visible=mask.shape[:-2])
        points, mask = points.expand(*batch, *points.shape[-3:]), mask.expand(*batch, *mask.shape[-2:])
        _check_finite(points, mask, self.names)
        self.pixels, self.visible = _masked(points, mask), mask.clone()

    @classmethod
    def unchecked(
        cls,
        pixels: Any,
        visible: Any,
        names: tuple[str, ...] = (),
        size: tuple[int, int] | None = None,
        told: tuple[Told, ...] = (),
    ) -> "Views":
        """Build without looking at anything: for parts that come from views, or from inside a transformation."""
        views = cls.__new__(cls)
        views.pixels, views.visible, views.names, views.size, views.told = pixels, visible, names, size, told
        return views

    @classmethod
    def _agreed(cls, name: str, items: Sequence[Any]) -> Any:
        """The constant that all have; what files tell is another thing for each camera, and none of all of them."""
        return super()._agreed(name, items) if name != "told" else ()

    def _facts(self) -> list[str]:
        views = f"{len(self)} view{'' if len(self) == 1 else 's'} of {self.pixels.shape[-2]} corners"
        hidden = ""
        if has_values(self.visible) and not self.visible.all():
            hidden = f" ({int((~self.visible).sum())} hidden)"
        return [counted(self.batch_shape, "camera"), views + hidden, in_pixels(self.size), str(self.dtype)]

    def _columns(self) -> dict[str, list[Any]]:
        seen = self.visible.sum(-1)
        if self.batch_shape or not has_values(self.visible):
            return {}
        return {"view": list(self.names), "corners": seen.tolist()}

    # ----------------------------------------------------------------------------------------------- what it is

    def __len__(self) -> int:
        """The number of views, V."""
        return self.pixels.shape[-3]

    # ------------------------------------------------------------------------------------------------ what it gives

    def __getitem__(self, index: Any) -> "Views":
        """Choose views; names go along, and the axis of views always stays.

        Args:
            index: along the axis of views: a number (one view, still as a `Views`, of length 1), a slice, a list of
                numbers, or a mask of V booleans. Iterating gives one `Views` of length 1 after the other.

        Raises:
            IndexError: out of range, or a mask of another length.
            TypeError: something else than the above.

        Example:
            >>> views = Views(torch.rand(5, 54, 2))
            >>> views[3].pixels.shape, views[[0, 3]].names
            (torch.Size([1, 54, 2]), ('view 1', 'view 4'))
            >>> [len(view) for view in views]
            [1, 1, 1, 1, 1]
        """
        chosen = _positions(index, len(self))
        where = torch.tensor(chosen, dtype=torch.long, device=self.device)
        pixels, visible = self.pixels.index_select(-3, where), self.visible.index_select(-2, where)
        told = tuple(self.told[i] for i in chosen) if self.told else ()
        return self.unchecked(pixels, visible, tuple(self.names[i] for i in chosen), self.size, told)

    def hiding(self, mask: ArrayLike) -> "Views":
        """Hide corners as if they had not been seen; their pixels become 0.

        Args:
            mask: booleans, true where a corner is to be hidden: `(N,)` for the same corners in every view, or
                `(*B, V, N)`.

        Raises:
            TypeError: the mask is not boolean.
            ValueError: its shape does not fit.

        Example:
            Fit to every second corner, and keep the others for a test.

            >>> views = Views(torch.rand(5, 54, 2))
            >>> odd = torch.arange(54) % 2 == 1
            >>> fit, test = views.hiding(odd), views.hiding(~odd)
            >>> fit
            Views(5 views of 54 corners (135 hidden), torch.float32)
        """
        hidden = booleans("mask", mask, self.device).to(self.device)
        try:
            visible = self.visible & ~hidden.expand(self.visible.shape)
        except RuntimeError:
            want = tuple(self.visible.shape)
            raise ValueError(f"mask: want shape ({want[-1]},) or {want}, got {tuple(hidden.shape)}") from None
        return self.unchecked(_masked(self.pixels, visible), visible, self.names, self.size, self.told)


# ------------------------------------------------------------------------------------------------------ the checks


def as_views(views: Views, name: str = "views") -> Views:
    """Views as they are.

    Raises:
        TypeError: they are none.
    """
    return instance(name, views, Views, "dp.Views", "dp.Views(pixels, size=...) makes them")


def view_number(view: int | str, names: Sequence[str]) -> int:
    """The number of a view, from 0, by its number or its name.

    Raises:
        TypeError: neither a whole number nor a string.
        ValueError: there is no such view.
    """
    if not isinstance(view, str):
        return position("view", view, len(names), "views")
    if view not in names:
        raise ValueError(f"view: want one of {', '.join(names)}, got {view!r}")
    if list(names).count(view) > 1:
        raise ValueError(f"view: want the number of one, got {view!r}, which is the name of several")
    return list(names).index(view)


def _masked(pixels: Tensor, visible: Tensor) -> Tensor:
    """A copy with 0 at unseen corners: selected, not multiplied, for NaN times 0 is NaN, in the gradient too."""
    return torch.where(visible.unsqueeze(-1), pixels, torch.zeros_like(pixels))


def _check_visible(visible: Any, pixels: Tensor) -> Tensor:
    shape = pixels.shape[-3:-1]
    if visible is None:
        return torch.ones(shape, dtype=torch.bool, device=pixels.device)
    tensor = booleans("visible", visible)
    if tensor.shape[-2:] != shape:
        raise ValueError(f"visible: want shape (*B, {shape[0]}, {shape[1]}) as pixels, got {tuple(tensor.shape)}")
    if isinstance(visible, Tensor) and tensor.device != pixels.device:
        raise ValueError(f"visible: want device {pixels.device} as pixels has, got {tensor.device}")
    return tensor.to(pixels.device)


def _check_names(names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"view {i}" for i in range(1, count + 1))
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names: want {count} strings, got {called(names)}")
    if len(names) != count:
        raise ValueError(f"names: want {count}, one for each view of pixels, got {len(names)}")
    return tuple(names)


def _check_told(told: Any, count: int) -> tuple[Told, ...]:
    if told is None or (isinstance(told, tuple | list) and not told):
        return ()
    if not isinstance(told, tuple | list) or not all(isinstance(one, tuple | list) for one in told):
        raise TypeError(f"told: want {count} tuples of names and values, as views.told, got {called(told)}")
    if len(told) != count:
        raise ValueError(f"told: want {count}, one for each view of pixels, got {len(told)}")
    for pair in (pair for one in told for pair in one):
        named = isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], str)
        if not named or type(pair[1]) not in (str, int, float):
            raise TypeError(f"told: want names with a text or a number each, as views.told, got {pair!r}")
    return tuple(tuple((name, value) for name, value in one) for one in told)


def _check_finite(pixels: Tensor, visible: Tensor, names: tuple[str, ...]) -> None:
    """Refuse a visible corner that is not finite, and say where it is, wherever values can be read."""
    if not has_values(pixels, visible):
        return
    wrong = visible & ~pixels.isfinite().all(dim=-1)
    if wrong.any():
        *camera, view, corner = wrong.nonzero()[0].tolist()
        where = f"camera {tuple(camera)}, " * bool(camera) + f"{names[view]!r} (view {view}), corner {corner}"
        got = pixels[(*camera, view, corner)].tolist()
        raise ValueError(f"pixels: want finite values at visible corners, got {got} at {where}; visible=... hides it")


def _positions(index: Any, count: int) -> list[int]:
    """What `index` chooses among `count` views, as numbers from 0."""
    index = list(index) if isinstance(index, tuple | range) else index
    check_index(index)
    if isinstance(index, slice):
        try:
            return list(range(count))[index]
        except (TypeError, ValueError) as error:
            raise IndexError(f"index: want a slice of whole numbers, got {index!r} ({error})") from None
    try:
        array = index.numpy(force=True) if isinstance(index, Tensor) else np.asarray(index)
    except (TypeError, ValueError, RuntimeError, NotImplementedError):
        array = np.asarray(None)
    if array.size == 0 and array.ndim == 1:
        return []
    if array.dtype == np.bool_:
        if array.shape != (count,):
            raise IndexError(f"index: want a mask of {count} booleans, one for each view, got shape {array.shape}")
        return np.flatnonzero(array).tolist()
    if not np.issubdtype(array.dtype, np.integer) or array.ndim > 1:
        raise IndexError(f"index: want a number, a slice, a list of numbers or a mask, got {called(index)}")
    for number in array.reshape(-1).tolist():
        if not -count <= number < count:
            raise IndexError(f"index: want a view from {-count} to {count - 1}, got {number}")
    return (array.reshape(-1) % max(count, 1)).tolist()
