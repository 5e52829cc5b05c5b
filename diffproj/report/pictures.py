"""The photographs of a report: each made small while it is decoded, and given to the view of its name."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from diffproj.report.document import data_uri
from diffproj.targets.detection import Searched
from diffproj.targets.images import Orientation, Photograph, Source, as_8_bit, grey, listed
from diffproj.targets.videos import Frame

MOST_VIEWS = 60
"""Photographs that are shown."""
MOST_BYTES = 1_800_000
"""Of all photographs of a page together; as text they take a third more."""
LARGEST, SMALLEST = 720, 100
"""Pixels of the longer side of a photograph in the page."""
QUALITY = 78
SMALLER = 0.8
LOUPE = 12
"""Pixels on each side of a corner that its enlargement shows."""
SIDE = 2 * LOUPE + 1
MOST_LOUPES = 160_000
"""Corners of all photographs above which none is enlarged: these are kept until it is known which fits worst."""


class Picture(NamedTuple):
    """What a page shows of a photograph: the small part of it that is kept.

    Attributes:
        jpeg: grey.
        size: width and height of the photograph in px.
        corners: in px, NaN where hidden.
        loupes: what surrounds each corner, pixel by pixel; none where no corner is to be enlarged.
    """

    jpeg: bytes
    size: tuple[int, int]
    corners: Float[np.ndarray, "n 2"]
    loupes: UInt8[np.ndarray, "_ side side"]


@dataclass(frozen=True)
class Pictures:
    """Photographs by the number of their view.

    Attributes:
        of_views: what is shown; those of views without a photograph are missing.
        others: the names of photographs that belong to no view.
        searched: whether that is since they show no board, or for whatever reason.
        size: of all, width and height in px; `None` where there are none.
        sources: of the pictures: a file, or an array or tensor with its colours.
    """

    of_views: dict[int, Picture]
    others: tuple[str, ...] = ()
    searched: bool = False
    size: tuple[int, int] | None = None
    sources: dict[int, Path | Frame | np.ndarray | Tensor] = field(default_factory=dict)

    def addresses(self, views: list[int]) -> dict[int, str]:
        """Those of some views as addresses for a page."""
        return {view: data_uri(self.of_views[view].jpeg, "image/jpeg") for view in views if view in self.of_views}

    def enlarged(self, view: int, u: float, v: float) -> tuple[str, int, int] | None:
        """The surroundings of a corner as an address, and the pixel at their top left; `None` where they are not kept.

        The corner is that closest to (u, v), for views may count the corners another way than each photograph alone.
        """
        picture = self.of_views.get(view)
        if picture is None or not len(picture.loupes):
            return None
        away = np.hypot(*(picture.corners - (u, v)).T)
        if not (np.isfinite(away).any() and np.nanmin(away) < 1):
            return None
        corner = int(np.nanargmin(away))
        left, top = np.rint(picture.corners[corner]).astype(int) - LOUPE
        part = picture.loupes[corner]
        low, high = int(part.min()), int(part.max())
        part = ((part.astype(np.float32) - low) * (255 / max(1, high - low))).astype(np.uint8)
        return data_uri(cv2.imencode(".png", part)[1].tobytes()), int(left), int(top)


def picture(
    image: Shaped[np.ndarray, "h w"], corners: Float[np.ndarray, "n 2"], most_bytes: int = MOST_BYTES, loupes: int = 1
) -> Picture:
    """What a page shows of a grey photograph from 0 to 255.

    Args:
        image: the photograph.
        corners: in px, NaN where hidden.
        most_bytes: that it may have.
        loupes: 0 where no corner is to be enlarged.
    """
    whole = as_8_bit(image)
    side = LARGEST
    jpeg = _jpeg(whole, side)
    while len(jpeg) > most_bytes and side > SMALLEST:
        side = int(side * SMALLER)
        jpeg = _jpeg(whole, side)
    size = whole.shape[1], whole.shape[0]
    return Picture(jpeg, size, corners, _surroundings(whole, corners if loupes else corners[:0]))


def keeper(photographs: int, corners: int) -> partial[Picture]:
    """What makes the pictures of so many photographs with so many corners each, small enough for one page."""
    most_bytes = MOST_BYTES // max(1, min(photographs, MOST_VIEWS))
    return partial(picture, most_bytes=most_bytes, loupes=int(photographs * corners <= MOST_LOUPES))


def of_search(found: Searched) -> Pictures:
    """The pictures that `keeper` made while the photographs were searched for the board."""
    made = {view: one for view, one in enumerate(found.beside) if isinstance(one, Picture)}
    sources = {view: one.source for view, one in enumerate(found.photographs)}
    return Pictures(made, tuple(one.name for one in found.without), True, found.views.size, sources)


def pictures(
    photographs: Source | Iterable[Source] | None,
    names: tuple[str, ...],
    corners: Float[np.ndarray, "v n 2"],
    size: tuple[int, int] | None,
    orientation: Orientation = "sensor",
) -> Pictures:
    """The photographs of views of these names, read one after the other.

    A photograph belongs to the view that has its name, as `detect` names them; where none has the name of any, and
    there are as many as views, they are taken in order.

    Raises:
        ValueError: none belongs to a view, or one that does has another size than the views.
    """
    if photographs is None:
        return Pictures({}, size=size)
    listing = listed(photographs)
    keep = keeper(len(names), corners.shape[1])
    made, sources = {}, {}
    belongs = _belonging(listing, names)
    for photograph, view in zip(listing, belongs, strict=True):
        if view is None:
            continue
        one = keep(grey(photograph, orientation), corners[view])
        size = size or one.size
        if one.size != size:
            raise ValueError(
                f"photographs: want {size[0]} x {size[1]} px as the views have, got {one.size[0]} x {one.size[1]} px "
                f"in {photograph.label}; give the photographs that were calibrated on, and the same orientation"
            )
        made[view], sources[view] = one, photograph.source
    others = tuple(one.name for one, view in zip(listing, belongs, strict=True) if view is None)
    return Pictures(made, others, False, size, sources)


def _belonging(listing: list[Photograph], names: tuple[str, ...]) -> list[int | None]:
    """The number of each photograph's view.

    Raises:
        ValueError: none belongs to a view.
    """
    waiting: dict[str, list[int]] = {}
    for view, name in enumerate(names):
        waiting.setdefault(name, []).append(view)
    belongs = [waiting[one.name].pop(0) if waiting.get(one.name) else None for one in listing]
    if any(view is not None for view in belongs):
        return belongs
    if len(listing) != len(names):
        raise ValueError(
            f"photographs: want those of the views, {', '.join(names[:3])}{', ...' * (len(names) > 3)}, got "
            f"{len(listing)} others, such as {listing[0].label}; give the photographs that were calibrated on"
        )
    return list(range(len(names)))


def _jpeg(image: UInt8[np.ndarray, "h w"], side: int) -> bytes:
    height, width = image.shape
    scale = min(1.0, side / max(height, width))
    if scale < 1:
        small = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1].tobytes()


def _surroundings(image: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, "n s s"]:
    """The pixels around each corner `(N, SIDE, SIDE)`, the border's repeated beyond it."""
    around = np.arange(-LOUPE, LOUPE + 1)
    middles = np.rint(np.nan_to_num(corners, posinf=0, neginf=0)).astype(int)
    rows = np.clip(middles[:, 1, None] + around, 0, image.shape[0] - 1)
    columns = np.clip(middles[:, 0, None] + around, 0, image.shape[1] - 1)
    return image[rows[:, :, None], columns[:, None, :]]
