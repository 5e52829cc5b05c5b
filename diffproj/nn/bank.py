"""`ProjectorBank`: a `PlaneProjector` for cameras of any lenses and sizes."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from diffproj._core.arguments import Array, listing
from diffproj._core.numerics import check_tensor, has_values
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.collating import stack
from diffproj.geometry.plane import Plane
from diffproj.lens.models import model_of
from diffproj.nn.partial import Learn, asked_parts
from diffproj.nn.plane import check_one_plane
from diffproj.nn.projector import PlaneProjector, camera_numbers
from diffproj.nn.whole_numbers import digits_of, numbers_of


class ProjectorBank(nn.Module):
    """Pixels to points on a plane, each sample by one of several cameras, which may have different lenses and sizes.

    Cameras of one lens model and size are one `PlaneProjector`, so that a batch of samples takes as many calls as there
    are kinds of cameras in it; in a compiled or exported graph, which is made for any samples, each kind takes all.
    Cameras that are all of one kind need no bank: `PlaneProjector(dp.stack(cameras), ...)`.

    In `DistributedDataParallel` a bank that learns wants `find_unused_parameters=True`, for kinds that a batch has no
    sample of take no part.

    Args:
        cameras: at least one, each a single camera at its pose, all of one dtype on one device.
        plane: the plane that all look at.
        learn: the parts to learn of each camera, as for `PlaneProjector`; those that a kind of camera does not have,
            such as the distortion of a pinhole, are left out there.

    Attributes:
        projectors: one `PlaneProjector` for each kind.

    Raises:
        TypeError: no cameras, or different dtypes.
        ValueError: none, cameras that are batches themselves, or what `PlaneProjector` refuses.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> pinhole = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]))
        >>> fisheye = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), distortion=dp.KannalaBrandt(torch.zeros(4)))
        >>> bank = ProjectorBank([pinhole, fisheye], dp.Plane.z(0.0))
        >>> points, valid = bank(torch.tensor([[[370.0, 240.0]], [[370.0, 240.0]]]), camera=[0, 1])
        >>> points[:, 0, 0]
        tensor([100.0000, 100.3347])
    """

    kind_of: Tensor
    place_of: Tensor

    def __init__(self, cameras: Sequence[Camera], plane: Plane, learn: Learn = ()) -> None:
        super().__init__()
        given = [as_camera(camera, "cameras") for camera in listing("cameras", cameras, "several dp.Camera")]
        if not given or any(camera.batch_shape for camera in given):
            got = (
                "none"
                if not given
                else f"one of batch shape {next(tuple(c.batch_shape) for c in given if c.batch_shape)}"
            )
            raise ValueError(f"cameras: want at least one, each a single camera, got {got}")
        kinds: dict[object, list[int]] = {}
        for number, camera in enumerate(given):
            kinds.setdefault((model_of(camera.distortion).name, camera.size), []).append(number)
        kind_of, place_of = [0] * len(given), [0] * len(given)
        projectors = []
        for kind, numbers in enumerate(kinds.values()):
            for place, number in enumerate(numbers):
                kind_of[number], place_of[number] = kind, place
            own = asked_parts(learn)
            if given[numbers[0]].distortion is None:
                own.pop("distortion", None)
            projectors.append(PlaneProjector(stack([given[number] for number in numbers]), plane, own, False))
        self.projectors = nn.ModuleList(projectors)
        device, bits = given[0].device, max(1, (len(given) - 1).bit_length())
        with torch.inference_mode(False):  # so that a state can be loaded wherever the bank was built
            self.register_buffer("kind_of", digits_of(kind_of, device, bits))
            self.register_buffer("place_of", digits_of(place_of, device, bits))

    def __len__(self) -> int:
        """The number of cameras."""
        return len(self.kind_of)

    def forward(
        self,
        pixels: Float[Tensor, "samples n 2"] | Array,
        camera: Int[Tensor, " samples"] | Sequence[int],
        warp: Float[Tensor, "*#samples 3 3"] | Array | None = None,
        plane: Plane | None = None,
    ) -> tuple[Float[Tensor, "samples n 3"], Bool[Tensor, "samples n"]]:
        """Points on the plane.

        Args:
            pixels: `(S, N, 2)`, of S samples.
            camera: which of the cameras took each sample `(S,)`, whole numbers from 0.
            warp: how the images that they belong to were warped `(S, 3, 3)`, or one for all; see `PlaneProjector`.
            plane: of these samples, of batch shape `(S,)` or one for all, in place of the bank's own.

        Returns:
            Points `(S, N, 3)` in world units and `valid (S, N)`; see `back_project`.

        Raises:
            TypeError: no floating-point tensor, or no whole numbers.
            ValueError: shapes or devices that do not fit, or a number of no camera.
        """
        points, valid = self._by_kind(PlaneProjector.__call__, pixels, camera, warp, plane)
        return points, valid

    def miss(
        self,
        pixels: Float[Tensor, "samples n 2"] | Array,
        camera: Int[Tensor, " samples"] | Sequence[int],
        warp: Float[Tensor, "*#samples 3 3"] | Array | None = None,
        plane: Plane | None = None,
    ) -> Float[Tensor, "samples n"]:
        """The angles in radians by which rays miss the plane `(S, N)`, for a `PlaneLoss` that pulls.

        See `PlaneMap.miss`; arguments as for the call.
        """

        def miss(projector: PlaneProjector, pixels: Tensor, **options: Any) -> tuple[Tensor]:
            return (projector.miss(pixels, **options),)

        (missed,) = self._by_kind(miss, pixels, camera, warp, plane)
        return missed

    def _by_kind(
        self,
        work: Callable[..., tuple[Tensor, ...]],
        pixels: Tensor | Array,
        camera: Tensor | Sequence[int],
        warp: Tensor | Array | None,
        plane: Plane | None,
    ) -> list[Tensor]:
        """What each kind's projector makes of its samples, in the order of the samples."""
        pixels = check_tensor("pixels", pixels, "N", 2)
        chosen = camera_numbers(camera, len(self), self.kind_of.device)
        if pixels.ndim != 3 or chosen.shape != pixels.shape[:1]:
            raise ValueError(
                f"pixels, camera: want shapes (S, N, 2) and (S,), got {tuple(pixels.shape)} and {tuple(chosen.shape)}"
            )
        if warp is not None:
            warp = check_tensor("warp", warp, 3, 3, like=pixels)
            _check_of_samples("warp", pixels, warp.shape[:-2])
            warp = warp.expand(*pixels.shape[:1], 3, 3)
        if plane is not None:
            check_one_plane(plane)
            _check_of_samples("plane", pixels, plane.batch_shape)
            plane = plane.expand(*pixels.shape[:1])
        found: list[Tensor] = []
        kinds, places = numbers_of(self.kind_of)[chosen], numbers_of(self.place_of)[chosen]
        for kind, projector in enumerate(self.projectors):
            own = kinds == kind
            if not has_values(chosen, pixels):  # in a graph each kind takes all samples, and gives its own
                of_kind = torch.where(own, places, 0)
                new = work(projector, pixels, warp=warp, plane=plane, camera=of_kind)
                found = [_either(_beside(own, a), a, b.to(a)) for a, b in zip(new, found or new, strict=True)]
                continue
            (samples,) = own.nonzero(as_tuple=True)
            if not len(samples) and (found or len(chosen)):
                continue
            options = {
                "warp": None if warp is None else warp[samples],
                "plane": None if plane is None else plane[samples],
                "camera": places[samples],
            }
            new = work(projector, pixels[samples], **options)
            found = found or [part.new_zeros(len(chosen), *part.shape[1:]) for part in new]
            found = [a.to(b).index_put((samples,), b) for a, b in zip(found, new, strict=True)]
        return found

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward


def _beside(of_samples: Tensor, values: Tensor) -> Tensor:
    """A tensor `(S,)` that broadcasts against one of more axes `(S, ...)`."""
    return of_samples.reshape(-1, *(1,) * (values.ndim - 1))


def _either(which: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """`torch.where`, which ONNX runtimes do not have for booleans."""
    return (which & yes) | (~which & no) if yes.dtype == torch.bool else torch.where(which, yes, no)


def _check_of_samples(name: str, pixels: Tensor, batch: torch.Size) -> None:
    """Check that there is one for all samples, or one for each; in a graph, whose sizes are symbols, PyTorch does."""
    if has_values(pixels) and batch not in ((), (1,), pixels.shape[:1]):
        raise ValueError(
            f"{name}: want one, or one for each of the {len(pixels)} samples of pixels, got batch shape {tuple(batch)}"
        )
