"""What the writers ask of a camera, and how they write numbers: as short as reads back exactly."""

import torch

from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera


def cameras_of(item: Camera | Calibration, what: str) -> list[Camera]:
    """The single cameras of a batch, upright, without skew, in float64 on the CPU; of a calibration, that without pose.

    Raises:
        ValueError: the format does not hold their skew.
    """
    camera = item.camera if isinstance(item, Calibration) else item
    camera = camera.detach().to("cpu", torch.float64).upright()
    skew = camera.K[..., 0, 1]
    if bool((skew != 0).any()):
        raise ValueError(
            f"K: want no skew, which {what} does not hold, got {float(skew.abs().max()):.3g} px; use .json"
        )
    check_not_mirrored(camera, what)
    if camera.batch_shape.numel() == 0:
        raise ValueError(f"want at least one camera for {what}, got batch shape {tuple(camera.batch_shape)}")
    if not camera.batch_shape:
        return [camera]
    rows = torch.arange(camera.batch_shape.numel(), device="cpu").reshape(camera.batch_shape)
    return [camera[tuple((rows == i).nonzero()[0].tolist())] for i in range(rows.numel())]


def check_not_mirrored(camera: Camera, what: str) -> None:
    """Refuse the camera of a mirrored image, whose file no reader takes, this package's own neither.

    Raises:
        ValueError: a focal length is negative.
    """
    if bool((camera.K.diagonal(dim1=-2, dim2=-1)[..., :2] < 0).any()):
        raise ValueError(f"K: want positive focal lengths, which {what} needs, got a mirrored image; use .json")


def one_camera(item: Camera | Calibration, what: str) -> Camera:
    """The only camera, as `cameras_of` gives it.

    Raises:
        ValueError: there are others.
    """
    batch = (item.camera if isinstance(item, Calibration) else item).batch_shape
    if batch:
        raise ValueError(f"{what} hold one camera, got batch shape {tuple(batch)}; use .json, or save them one by one")
    return cameras_of(item, what)[0]


def has_pose(camera: Camera) -> bool:
    """Whether the world frame is another than the camera's."""
    turned = camera.R != torch.eye(3, dtype=camera.dtype, device=camera.device)  # noqa: SIM300
    return bool(turned.any() or (camera.t != 0).any())


def without_pose(camera: Camera, what: str) -> Camera:
    """The camera, known to have no pose.

    Raises:
        ValueError: it has one.
    """
    if has_pose(camera):
        raise ValueError(f"{what} hold no pose; use .json, or save camera.without_pose()")
    return camera


def numbers_text(numbers: list[float]) -> str:
    """Numbers in brackets, for YAML 1.1 too: `1.0e-05`, for `1e-05` is text there."""
    return "[" + ", ".join(number_text(number) for number in numbers) + "]"


def number_text(number: float) -> str:
    """One number that reads back exactly."""
    text = repr(float(number))
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"
