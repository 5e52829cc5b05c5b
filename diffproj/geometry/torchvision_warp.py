"""Where torchvision's transforms (`torchvision.transforms.v2`) move the pixels of an image, as a matrix.

torchvision keeps no matrix of what it drew; it lets tensors of other kinds travel through a pipeline beside the image,
as boxes do. `torchvision_warp` makes such a tensor, which each geometric transform multiplies by its own matrix.

torchvision counts coordinates from the image's corner, (0.5, 0.5) in the middle of the first pixel; a resize scales
them. Here pixels are whole at their middles, which shifts every matrix by half a pixel: resized by a factor s, the
pixel u goes to `s u + (s - 1) / 2`, as in `Camera.resized`. Kornia's `Resize` scales the distance from the middle of
the first pixel to that of the last instead, and lies up to half a pixel beside it: each library's matrix goes with its
own images.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj._core.arguments import called
from diffproj._core.numerics import at_least_float32
from diffproj.geometry.grid import checked_size

Size = tuple[int, int]
"""Width and height."""
Moved = tuple[np.ndarray, Size]
"""The matrix of a transform `(3, 3)`, and the size of the image that it makes."""


def torchvision_warp(size: tuple[int, int], dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor that torchvision's transforms carry along with an image: how they moved its pixels.

    Hand it to a pipeline of `torchvision.transforms.v2` beside the image. What comes back is the matrix `(3, 3)` from
    pixels `(u, v, 1)` of the image that went in to those of the one that came out, for `Camera.warped` and for the
    `warp` of a `PlaneProjector`; its `image_size` is the `(width, height)` of the image that came out. A `DataLoader`
    stacks the matrices of a batch.

    Resizes, crops, paddings, flips, affine maps, rotations and perspectives change it, whatever draws them (`Compose`,
    `RandomApply`, `RandomChoice`, ...); what changes colours alone leaves it.

    Args:
        size: `(width, height)` of the image that goes in.
        dtype: of the matrix: the camera's.

    Raises:
        TypeError: no size, or a dtype that is none of floating-point type.
        ValueError: no positive size; from the pipeline, a transform that no matrix tells (`ElasticTransform`), or one
            that makes many images of one (`FiveCrop`).
        ModuleNotFoundError: torchvision is not installed.

    Example:
        >>> import diffproj as dp
        >>> from torchvision.transforms import v2  # doctest: +SKIP
        >>> augment = v2.Compose([v2.RandomResizedCrop((224, 224)), v2.RandomHorizontalFlip()])  # doctest: +SKIP
        >>> image, warp = augment(image, dp.torchvision_warp(camera.size))  # doctest: +SKIP
        >>> points, valid = projector(pixels, warp=warp)  # of pixels in the augmented image  # doctest: +SKIP
        >>> camera.warped(warp, size=warp.image_size)  # its camera  # doctest: +SKIP
    """
    shown = checked_size(size)
    if shown is None:
        raise TypeError("size: want (width, height) of the image, got None")
    if not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
        raise TypeError(f"dtype: want one of floating-point type, such as torch.float32, got {called(dtype)}")
    kind = _kind()
    return kind.of(at_least_float32(torch.eye(3, dtype=dtype, device="cpu")), shown)


def __getattr__(name: str) -> Any:
    """The class of the tensor, which torchvision's own is a base of: by this name pickles find it."""
    if name == "Warp":
        return _kind()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def _kind() -> Any:
    """The class, made once torchvision is needed, and known to all of its geometric transforms."""
    try:
        tv_tensors, functional = map(import_module, ("torchvision.tv_tensors", "torchvision.transforms.v2.functional"))
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "torchvision: want it installed, to follow its transforms; pip install torchvision"
        ) from error

    class Warp(tv_tensors.TVTensor):  # type: ignore[misc]
        """See `torchvision_warp`."""

        image_size: Size

        @classmethod
        def of(cls, matrix: Tensor, size: Size) -> Any:
            """A matrix that leads to an image of that size."""
            warp = matrix.as_subclass(cls)
            warp.image_size = size
            return warp

        @classmethod
        def wrap(cls, tensor: Tensor, like: Any, **_: Any) -> Any:
            return cls.of(tensor, like.image_size)

        @classmethod
        def _wrap_output(cls, output: Any, args: Sequence[Any] = (), kwargs: Any = None) -> Any:
            output = super()._wrap_output(output, args, kwargs)  # of .to(...), .clone() and the like
            if isinstance(output, cls) and args and isinstance(args[0], cls):
                output.image_size = args[0].image_size
            return output

        def __reduce_ex__(self, protocol: Any) -> Any:
            return _again, (self.as_subclass(Tensor), self.image_size)

        def __repr__(self, *, tensor_contents: Any = None) -> str:
            return self._make_repr(image_size=self.image_size)

    Warp.__module__, Warp.__qualname__ = __name__, "Warp"
    for name, move in _MOVES.items():
        if hasattr(functional, name):
            functional.register_kernel(getattr(functional, name), Warp)(_kernel(functional, move))
    return Warp


def _again(matrix: Tensor, size: Size) -> Any:
    """What a pickle is read by."""
    return _kind().of(matrix, size)


def _kernel(functional: ModuleType, move: Callable[..., Moved]) -> Callable[..., Any]:
    """What torchvision calls for one of its transforms, with the transform's arguments."""

    def multiply(warp: Any, *args: Any, **kwargs: Any) -> Any:
        matrix, size = move(functional, warp.image_size, *args, **kwargs)
        so_far = warp.as_subclass(Tensor)
        step = torch.from_numpy(matrix).to(so_far.device)
        # Summed in float64, for shifts are of a thousand pixels, and elementwise, which autocast leaves alone.
        product = (step.unsqueeze(-1) * so_far.double().unsqueeze(-3)).sum(-2)
        return type(warp).of(product.to(so_far.dtype), size)

    return multiply


# ---------------------------------------------------------------- transforms, by the names and arguments of torchvision


def _horizontal_flip(_: ModuleType, shown: Size) -> Moved:
    return np.array([[-1.0, 0, shown[0] - 1], [0, 1, 0], [0, 0, 1]]), shown


def _vertical_flip(_: ModuleType, shown: Size) -> Moved:
    return np.array([[1.0, 0, 0], [0, -1, shown[1] - 1], [0, 0, 1]]), shown


def _resize(functional: ModuleType, shown: Size, size: Any, *_: Any, max_size: Any = None, **__: Any) -> Moved:
    width, height = after = _size_of(functional.resize(_nothing(shown), size, max_size=max_size))
    return _from_corner(np.diag([width / shown[0], height / shown[1], 1.0])), after


def _crop(_: ModuleType, shown: Size, top: int, left: int, height: int, width: int) -> Moved:  # noqa: ARG001
    return _shift(-left, -top), (width, height)


def _pad(functional: ModuleType, shown: Size, padding: Any, *_: Any, **__: Any) -> Moved:
    sides = [padding] if isinstance(padding, int) else list(padding)
    left, top = sides[0], sides[1 if len(sides) > 1 else 0]
    return _shift(left, top), _size_of(functional.pad(_nothing(shown), padding))


def _center_crop(_: ModuleType, shown: Size, output_size: Any) -> Moved:
    sides = [output_size] * 2 if isinstance(output_size, int) else list(output_size)
    wanted = int(sides[-1]), int(sides[0])  # torchvision has the height in front
    # torchvision rounds the half of what it cuts off to an even number, and of what it adds down.
    shift = [
        (want - have) // 2 if want > have else -round((have - want) / 2)
        for want, have in zip(wanted, shown, strict=True)
    ]
    return _shift(*shift), wanted


def _resized_crop(
    functional: ModuleType, shown: Size, top: int, left: int, height: int, width: int, size: Any, *_: Any, **__: Any
) -> Moved:
    cropped, part = _crop(functional, shown, top, left, height, width)
    resized, after = _resize(functional, part, size)
    return resized @ cropped, after


def _affine(
    _: ModuleType,
    shown: Size,
    angle: float,
    translate: Sequence[float],
    scale: float,
    shear: Any,
    interpolation: Any = None,  # noqa: ARG001
    fill: Any = None,  # noqa: ARG001
    center: Sequence[float] | None = None,
) -> Moved:
    along_x, along_y = (shear, 0.0) if isinstance(shear, int | float) else (shear[0], shear[-1])
    leaning = np.array([[1, -math.tan(math.radians(along_x))], [0, 1]])
    rising = np.array([[1, 0], [-math.tan(math.radians(along_y)), 1]])
    linear = scale * _turn(angle) @ rising @ leaning
    return _from_corner(_shift(*translate) @ _about(linear, _middle(shown) if center is None else center)), shown


def _rotate(
    functional: ModuleType,
    shown: Size,
    angle: float,
    interpolation: Any = None,  # noqa: ARG001
    expand: bool = False,
    center: Sequence[float] | None = None,
    fill: Any = None,  # noqa: ARG001
) -> Moved:
    """By an angle in degrees, counter-clockwise as one sees the image; with `expand` middle goes to middle."""
    turned = _about(_turn(-angle), _middle(shown) if center is None else center)
    if not expand:
        return _from_corner(turned), shown
    after = _size_of(functional.rotate(_nothing(shown), angle, expand=True, center=center))
    outward = [(new - old) / 2 for new, old in zip(after, shown, strict=True)]
    return _from_corner(_shift(*outward) @ turned), after


def _perspective(
    _: ModuleType,
    shown: Size,
    startpoints: Any,
    endpoints: Any,
    interpolation: Any = None,  # noqa: ARG001
    fill: Any = None,  # noqa: ARG001
    coefficients: Sequence[float] | None = None,
) -> Moved:
    if coefficients is None:
        rows, sides = [], []
        for (x, y), (u, v) in zip(startpoints, endpoints, strict=True):
            rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
            sides += [u, v]
        forth = np.append(np.linalg.solve(np.array(rows, dtype=np.float64), np.array(sides, dtype=np.float64)), 1.0)
        return _from_corner(forth.reshape(3, 3)), shown
    back = np.append(np.asarray(coefficients, dtype=np.float64), 1.0).reshape(3, 3)
    return _from_corner(np.linalg.inv(back)), shown


def _no_matrix(name: str, why: str) -> Callable[..., Moved]:
    def refuse(*_: Any, **__: Any) -> Moved:
        raise ValueError(f"torchvision_warp: want transforms that a matrix tells, got {name}, {why}; leave it out")

    return refuse


_MOVES: dict[str, Callable[..., Moved]] = {
    "horizontal_flip": _horizontal_flip,
    "vertical_flip": _vertical_flip,
    "resize": _resize,
    "crop": _crop,
    "pad": _pad,
    "center_crop": _center_crop,
    "resized_crop": _resized_crop,
    "affine": _affine,
    "rotate": _rotate,
    "perspective": _perspective,
    "elastic": _no_matrix("elastic", "which moves each pixel by itself"),
    "five_crop": _no_matrix("five_crop", "which makes five images of one"),
    "ten_crop": _no_matrix("ten_crop", "which makes ten images of one"),
}
"""What each of torchvision's functions does to pixels."""


def _nothing(shown: Size) -> Tensor:
    """An image of that size without a channel: what torchvision makes of it has the size that an image would."""
    width, height = shown
    return torch.empty(0, height, width, dtype=torch.float32, device="cpu")


def _size_of(image: Tensor) -> Size:
    return image.shape[-1], image.shape[-2]


def _shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def _middle(shown: Size) -> Size | Sequence[float]:
    return shown[0] / 2, shown[1] / 2


def _turn(degrees: float) -> np.ndarray:
    """The turn from x towards y."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[cosine, -sine], [sine, cosine]])


def _about(linear: np.ndarray, center: Sequence[float]) -> np.ndarray:
    """A linear map that leaves a point where it is."""
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    return _shift(*center) @ matrix @ _shift(-center[0], -center[1])


def _from_corner(matrix: np.ndarray) -> np.ndarray:
    """A matrix of coordinates from the image's corner as one of pixels that are whole at their middles."""
    return _shift(-0.5, -0.5) @ matrix @ _shift(0.5, 0.5)
