"""Whether an image size can be that of its camera: what the principal point says of it.

It lies near the image's middle, but for images that were cut out of larger ones. Of 37 cameras of public files none is
off by more than a quarter of half a side, but for two of one file, whose sides are in the wrong order. (Of images that
are half of a larger one, from anywhere in it, one in 150 passes for that, and is refused.)
"""

from diffproj.geometry.camera import Camera

ASIDE = 0.18
"""Part of half a side by which the principal point must be off along both, in the way that exchanged sides put it."""
NEAR = 0.3
"""The same up to which it may be off along both if the sides are exchanged."""
BETTER = 0.65
"""Times the distance from the middle that it must come down to then."""
LARGER, SMALLER, ALIKE = 1.4, 0.65, 0.1
"""Relative to the middle, from where on along both sides K is that of another image, if both are alike to a part."""


def exchanged_sides(camera: Camera) -> str:
    """What makes the size look like height and width, in words; empty where nothing does."""
    places = _places(camera)
    if places is None or camera.size is None or camera.size[0] == camera.size[1]:
        return ""
    width, height = camera.size
    x, y = places[0] - 1, places[1] - 1
    other = places[0] * width / height - 1, places[1] * height / width - 1
    if not (min(abs(x), abs(y)) > ASIDE and x * y < 0 and max(map(abs, other)) < NEAR):
        return ""
    if not (other[0] ** 2 + other[1] ** 2) ** 0.5 < BETTER * (x * x + y * y) ** 0.5:
        return ""
    return f"which looks like height and width: c is {_principal_point(camera)}"


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


def _principal_point(camera: Camera) -> str:
    x, y = camera.K.reshape(-1, 3, 3)[0, :2, 2].tolist()
    return f"({x:g}, {y:g})"


def _places(camera: Camera) -> tuple[float, float] | None:
    """Where the principal point of the first camera is along both sides, 1 being the middle."""
    if camera.size is None or camera.K.numel() == 0:
        return None
    x, y = camera.K.reshape(-1, 3, 3)[0, :2, 2].tolist()
    return 2 * (x + 0.5) / camera.size[0], 2 * (y + 0.5) / camera.size[1]
