"""Whether an image size can be that of its camera: what the principal point says of it.

It lies near the image's middle, but for images that were cut out of larger ones (`geometry.image_sides`). Of images
that are half of a larger one, from anywhere in it, one in 150 passes for one with exchanged sides, and is refused.
"""

import torch

from diffproj.geometry.camera import Camera
from diffproj.geometry.image_sides import exchanged, principal_point

LARGER, SMALLER, ALIKE = 1.4, 0.65, 0.1
"""Relative to the middle, from where on along both sides K is that of another image, if both are alike to a part."""
LONGEST = 30.0
"""Focal length in sides of the image up to which a centre within the first pixel says that K is in such parts."""


def exchanged_sides(camera: Camera) -> str:
    """What makes the size look like height and width, in words; empty where nothing does."""
    return "" if camera.size is None else exchanged(camera.K, camera.size)


def other_image(camera: Camera) -> str:
    """What makes K look like that of an image of another resolution, in words; empty where nothing does."""
    places = _places(camera)
    if places is None:
        return ""
    low, high = min(places), max(places)
    if not (low > LARGER or 0 < high < SMALLER) or high - low > ALIKE * high:
        return ""
    return (
        f"the principal point {_principal_point(camera)} is the middle of an image {(low + high) / 2:.2g} times as "
        f"large as {camera.size}: is K that of photographs of another resolution? Camera(..., size=...) with theirs, "
        "and resized() from there, mends it; of an image that was cut out of a larger one all may be well"
    )


def parts_of_the_image(camera: Camera) -> str:
    """What makes K look normalised, in parts of the image instead of pixels, in words; empty where nothing does.

    Parts may count from the image's corner or from its middle. The identity without a size is that of pixels which are
    rays, and is none of these.
    """
    if camera.K.numel() == 0:
        return ""
    K = camera.K.reshape(-1, 3, 3)[0]
    centre, focal = K[:2, 2], K.diagonal()[:2].abs()
    rays = camera.size is None and torch.equal(K, torch.eye(3, dtype=K.dtype, device=K.device))
    if rays or not (bool((centre.abs() <= 1).all()) and bool((focal < LONGEST).all())):
        return ""
    corner = bool((centre > 0.1).all())
    where = "as in parts of the image" if corner else "as in parts of the image, or in millimetres, from its middle"
    remedy = (
        "its first row times the width and its second times the height, less half a pixel of the principal point where "
        "(0, 0) is the image's corner, mend it"
        if corner
        else "where the parts run from -1 to 1, its first row times half the width and its second times half the "
        "height, and the principal point counted from the first pixel's centre, mend it"
    )
    return (
        f"K: want pixels, got focal lengths ({focal[0]:g}, {focal[1]:g}) and the principal point "
        f"{_principal_point(camera)}, {where}: {remedy}"
    )


def _principal_point(camera: Camera) -> str:
    x, y = principal_point(camera.K)
    return f"({x:g}, {y:g})"


def _places(camera: Camera) -> tuple[float, float] | None:
    """Where the principal point of the first camera is along both sides, 1 being the middle."""
    if camera.size is None or camera.K.numel() == 0:
        return None
    x, y = principal_point(camera.K)
    return 2 * (x + 0.5) / camera.size[0], 2 * (y + 0.5) / camera.size[1]
