"""A camera that is handed to `refine` or `locate`, looked at: values, poses, and whether it is of these photographs."""

from collections.abc import Sequence

from torch import Tensor

from diffproj._core.warn import warn_caller
from diffproj.geometry.rotations import is_rotation

Size = tuple[int, int] | None

OUTSIDE = 0.02
"""Part of the image's size by which a corner may lie outside of it, by noise or a cut-off board."""
OFF_CENTER = 1.25
"""How far off, as a factor and on both axes, a principal point makes K that of another resolution. Those of lenses lie
within a tenth of the middle; the usual resolutions of a camera are a third apart at least."""
SPANNED = 0.5
"""Part of the principal point's distance from the first pixel, on both axes, that corners must span for it to tell that
none lies beyond."""


def check_size(size: Size, of_photographs: Size) -> None:
    """Check that a camera is of photographs of that `(width, height)`, where both are known.

    Raises:
        ValueError: it is not.
    """
    if None not in (size, of_photographs) and size != of_photographs:
        raise ValueError(f"camera: want the size of the photographs, {of_photographs}, got {size}; see resized()")


def check_finite(K: Tensor) -> None:
    """Check intrinsics `(*B, 3, 3)` that may come from a calibration that failed.

    Raises:
        ValueError: they are not finite.
    """
    lacking = ~K.isfinite().all(-1).all(-1)
    if bool(lacking.any()):
        where = f" in camera {', '.join(map(str, lacking.nonzero()[0].tolist()))}" * bool(lacking.ndim)
        raise ValueError(
            f"camera: want finite intrinsics, got NaN or infinity{where}; a calibration that did not converge is no "
            "start"
        )


def check_poses(R: Tensor, t: Tensor, names: Sequence[str]) -> None:
    """Check poses `(*B, V)` to start from.

    Raises:
        ValueError: they are not finite, or no rotations.
    """
    finite = R.isfinite().all(-1).all(-1) & t.isfinite().all(-1)
    rotation = is_rotation(R)
    for sound, want, got in (
        (finite, "finite poses", "NaN or infinity"),
        (rotation, "poses with rotation matrices (orthonormal to 1e-5, determinant +1)", "others"),
    ):
        if not bool(sound.all()):
            *camera, view = (~sound).nonzero()[0].tolist()
            where = f" of camera {', '.join(map(str, camera))}" * bool(camera)
            raise ValueError(
                f"camera: want {want} to start from, got {got} for {int((~sound).sum())} of {sound.numel()} views, "
                f"the first {names[view]!r}{where}; a camera without them, such as calibration.camera, starts from "
                "the corners alone"
            )


def check_resolution(center: Tensor, pixels: Tensor, used: Tensor, size: Size, of_photographs: Size) -> None:
    """Warn of intrinsics that look like those of another resolution: nothing else tells, and every distance is wrong.

    The principal point is near the middle of the image. Where the photographs' size is known, it is compared with that
    of a camera without size; where it is not, the corners tell that the image reaches too far, or not far enough.

    Args:
        center: principal points `(P, 2)` in px.
        pixels: corners `(P, V, N, 2)` in px.
        used: which of them count `(P, V, N)`.
        size: `(width, height)` of the camera, where it knows its own.
        of_photographs: that of the photographs.

    Raises:
        ValueError: the camera knows its size, and corners lie outside of it.
    """
    reach = pixels.masked_fill(~used.unsqueeze(-1), -float("inf")).amax((1, 2))
    if size is not None:
        if of_photographs is None and bool((reach > (1 + OUTSIDE) * pixels.new_tensor(size)).any()):
            u, v = reach.amax(0).tolist()
            raise ValueError(
                f"camera: want that of the photographs, got one of {size[0]} x {size[1]} px, and corners reach "
                f"({u:.1f}, {v:.1f}); see resized()"
            )
        return
    least = pixels.masked_fill(~used.unsqueeze(-1), float("inf")).amin((1, 2))
    if of_photographs is not None:
        middle = (pixels.new_tensor(of_photographs) - 1) / 2
        short, far = OFF_CENTER * center < middle, center > OFF_CENTER * middle
    else:
        short, far = reach > 2 * OFF_CENTER * center, (reach < center) & (reach - least > SPANNED * center)
    # Coordinates below 0 are none of a whole photograph: of a part of one, or on the normalised plane.
    whole = (least >= -0.5).all(-1) & (center > 0).all(-1)
    doubtful = whole & (short.all(-1) | far.all(-1))
    if not bool(doubtful.any()):
        return
    first = int(doubtful.nonzero()[0])
    (c_x, c_y), low, high = center[first].tolist(), least[first].tolist(), reach[first].tolist()
    seen = f"corners from ({low[0]:.0f}, {low[1]:.0f}) to ({high[0]:.0f}, {high[1]:.0f})"
    if of_photographs is not None:
        seen = f"photographs of {of_photographs[0]} x {of_photographs[1]} px"
    warn_caller(
        f"camera: its principal point ({c_x:.0f}, {c_y:.0f}) is not near the middle of {seen}, as if K were that of "
        "another resolution; give Camera(..., size=(width, height)), and resized() where it is another",
    )
