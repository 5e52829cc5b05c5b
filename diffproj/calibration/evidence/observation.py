"""`Observation`: a piece of evidence about a camera, as `adjust` asks for it, and what its classes share."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called
from diffproj._core.copying import Copied
from diffproj._core.numerics import broadcast_batches, check_tensor, in_float64
from diffproj._core.shown import Shown
from diffproj.calibration.least_squares.losses import Loss, check_loss
from diffproj.geometry.camera import Camera, as_camera

Deviation = Float[Tensor, "..."] | Array | float
"""A standard deviation, or one for each item."""


@runtime_checkable
class Observation(Protocol):
    """Interface of a piece of evidence; a class of your own needs this method alone.

    It may have a `loss` as well, such as `dp.Huber(2.0)`, of scale in deviations, and pixels of batch shape `*B`; and
    `own_unknowns`, how many numbers besides the camera's it finds from its residuals, as the level of `Coplanar`.

    Example:
        >>> import diffproj as dp
        >>> class Gps:  # a place whose errors go together; priors know numbers one by one
        ...     def __init__(self, place, covariance):
        ...         covariance = torch.tensor(covariance, dtype=torch.float64)
        ...         self.place = torch.tensor(place, dtype=torch.float64)
        ...         self.whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
        ...
        ...     def residuals(self, camera):
        ...         off = camera.center - self.place  # (*B, 3)
        ...         return (self.whiten @ off.unsqueeze(-1)).mT  # (*B, 1, 3): one item of three components
        >>> where = Gps([3.0, 4.0, 6.0], [[0.5, 0.3, 0.0], [0.3, 0.5, 0.0], [0.0, 0.0, 1.0]])
        >>> mast = dp.Camera.mounted(5.0, 20.0, focal=900.0, size=(1280, 960))
        >>> known = dp.adjust(mast, [where], priors={"tilt": 1.0, "roll": 1.0, "heading": 2.0})
        >>> [round(float(x), 2) for x in known.mounting_covariance[3, 3:5]]
        [0.5, 0.3]
    """

    def residuals(self, camera: Camera) -> Float[Tensor, "*batch m k"]:
        """What the camera predicts minus what was seen, over its standard deviation `(*B, M, k)`.

        M items, each of k components that are independent and of variance 1 where the camera is right; written in
        PyTorch's functions, through which derivatives of the camera's K, R, t and lens flow. NaN where a camera cannot
        have made the observation, as of a point behind it; 0 where there is none.
        """
        ...


class Observed(Copied, Shown):
    """The base of the observations of this package: a loss, and how they show themselves."""

    __slots__ = ("loss",)
    own_unknowns = 0

    loss: Loss | None

    def __init__(self, loss: Loss | None) -> None:
        check_loss(loss)
        self.loss = loss

    def residuals(self, camera: Camera) -> Float[Tensor, "*batch m k"]:
        """What the camera predicts minus what was seen, over the deviation, in float64: see `Observation`.

        Raises:
            TypeError: it is no camera.
            ValueError: it has no values, on the device meta.
        """
        camera = as_camera(camera)
        if camera.K.is_meta:
            raise ValueError("camera: want values, got tensors on the device meta")
        return self._residuals(camera if camera.dtype == torch.float64 else camera.to(torch.float64))

    def _residuals(self, camera: Camera) -> Float[Tensor, "*batch m k"]:
        """The same of a camera in float64."""
        raise NotImplementedError

    def __len__(self) -> int:
        """The number of items, M."""
        raise NotImplementedError

    def _facts(self) -> list[str]:
        return [f"{len(self)} seen", *([] if self.loss is None else [repr(self.loss)])]


def valued(name: str, value: Any, *shape: int | str) -> Tensor:
    """Numbers of that shape in float64, with their graph.

    Raises:
        TypeError: no numbers.
        ValueError: another shape, or a tensor without values, on the device meta.
    """
    tensor = in_float64(check_tensor(name, value, *shape))
    if tensor.is_meta:
        raise ValueError(f"{name}: want values, got a tensor on the device meta")
    return tensor


def checked_pixels(name: str, value: Any, *shape: int | str) -> Tensor:
    """Pixels `(*B, *shape)` in float64, all finite, with their graph.

    Raises:
        TypeError: no numbers.
        ValueError: another shape, or values that are not finite.
    """
    pixels = valued(name, value, *shape)
    if not bool(pixels.detach().isfinite().all()):
        raise ValueError(f"{name}: want finite pixels, got NaN or infinity; leave out what was not seen")
    return pixels


def checked_deviation(name: str, value: Any, want: str, *, zero: bool = False) -> Tensor:
    """Standard deviations in float64: a number, or one for each item, above 0, or from 0 on.

    Raises:
        TypeError: no numbers.
        ValueError: negative ones, or such as are not finite.
    """
    if value is None or isinstance(value, bool | str):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    sigma = valued(name, value)
    known = sigma.detach()
    lost = ~((known >= 0 if zero else known > 0) & known.isfinite())
    if bool(lost.any()):
        least = "at least" if zero else "more than"
        raise ValueError(f"{name}: want {want}, {least} 0 and finite, got {float(known[lost][0]):g}{_at(lost)}")
    return sigma


def check_apart(name: str, ends: Tensor, like: str, others: Tensor, remedy: str) -> None:
    """Check that the two pixels `(*B, M, 2)` of each item are not the same.

    Raises:
        ValueError: some are.
    """
    alike = (ends.detach() == others.detach()).all(-1)
    if bool(alike.any()):
        raise ValueError(f"{name}: want other pixels than {like}, got the same ones{_at(alike)}; {remedy}")


def _at(which: Tensor) -> str:
    """The place of the first item, where there are several."""
    if which.numel() < 2:
        return ""
    place = which.nonzero()[0].tolist()
    return f" at {place[0] if len(place) == 1 else tuple(place)}"


def check_broadcast(name: str, tensor: Tensor, like: str, shape: torch.Size) -> None:
    """Check that a tensor broadcasts over items `(*B, M)`.

    Raises:
        ValueError: it does not.
    """
    try:
        whole = torch.broadcast_shapes(tensor.shape, shape)
    except RuntimeError:
        whole = torch.Size()
    if (len(whole) == 0 and len(shape) > 0) or (shape and whole[-1] != shape[-1]):
        raise ValueError(f"{name}: want a number or one for each of {like} {tuple(shape)}, got {tuple(tensor.shape)}")


def with_spread(function: Callable[..., Tensor], pixels: list[Tensor], sigma: Tensor) -> tuple[Tensor, Tensor]:
    """A number `(*B, M)` of pixels `(*B, M, 2)` each, and its variance by their noise of deviation sigma.

    The items are independent of each other: one backward pass gives the derivative of each by its own pixels.
    """
    if not bool((sigma.detach() > 0).any()):
        value = function(*pixels)
        return value, torch.zeros_like(value)
    with torch.enable_grad():
        steps = [torch.zeros_like(each, requires_grad=True) for each in pixels]
        value = function(*(each + step for each, step in zip(pixels, steps, strict=True)))
        slopes = torch.autograd.grad(value.sum(), steps, create_graph=True)
    return value, sum(slope.square().sum(-1) for slope in slopes) * sigma.square()  # type: ignore[return-value]


def batched(pixels: Tensor, camera: Camera) -> Tensor:
    """Pixels with the batch axes that they and the camera have together, so that each has its own slope."""
    batch = broadcast_batches(pixels=pixels.shape[:-2], camera=camera.batch_shape)
    return pixels.to(camera.K).expand(*batch, *pixels.shape[-2:])
