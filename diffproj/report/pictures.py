"""The photographs of a report: found by the names of the views, decoded once, and made small enough for a page."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped
from torch import Tensor

from diffproj.report.document import data_uri
from diffproj.targets.images import Orientation, Source, as_8_bit, grey, listed
from diffproj.targets.videos import Frame

MOST_BYTES = 1_800_000
"""Of all photographs of a page together; as text they take a third more."""
LARGEST = 720
"""Pixels of the longer side of a photograph in the page."""
QUALITY = 78
SMALLER = 0.8
LOUPE = 12
"""Pixels on each side of a corner that its enlargement shows."""


@dataclass(frozen=True)
class Pictures:
    """Photographs by the number of their view.

    Attributes:
        images: grey, in full size; those of views without a photograph are missing.
        others: the names of photographs that belong to no view, for no board was found in them.
        size: of all, width and height in px; `None` where there are none.
        sources: of the images: a file, or an array or tensor with its colours.
    """

    images: dict[int, Shaped[np.ndarray, "h w"]]
    others: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    sources: dict[int, Path | np.ndarray | Tensor] = field(default_factory=dict)

    def small(self, views: list[int]) -> dict[int, str]:
        """Those of some views as addresses for a page, all together within `MOST_BYTES`."""
        shown = [view for view in views if view in self.images]
        side = LARGEST
        while True:
            found = {view: _jpeg(self.images[view], side) for view in shown}
            if sum(map(len, found.values())) <= MOST_BYTES or side < 100:
                return {view: data_uri(content, "image/jpeg") for view, content in found.items()}
            side = int(side * SMALLER)

    def enlarged(self, view: int, u: float, v: float) -> tuple[str, int, int] | None:
        """The surroundings of a pixel as an address, and the pixel at their top left; `None` without a photograph."""
        if view not in self.images:
            return None
        image = self.images[view]
        left, top = round(u) - LOUPE, round(v) - LOUPE
        side = 2 * LOUPE + 1
        padded = cv2.copyMakeBorder(image, side, side, side, side, cv2.BORDER_REPLICATE)
        if not (-LOUPE <= left + LOUPE < image.shape[1] + LOUPE and -LOUPE <= top + LOUPE < image.shape[0] + LOUPE):
            return None
        part = padded[top + side : top + 2 * side, left + side : left + 2 * side]
        low, high = int(part.min()), int(part.max())
        part = ((part.astype(np.float32) - low) * (255 / max(1, high - low))).astype(np.uint8)
        return data_uri(cv2.imencode(".png", part)[1].tobytes()), left, top


def pictures(
    photographs: Source | Iterable[Source] | None,
    names: tuple[str, ...],
    size: tuple[int, int] | None,
    orientation: Orientation = "sensor",
) -> Pictures:
    """The photographs of views of these names.

    A photograph belongs to the view that has its name, as `detect` names them; where none has the name of any, and
    there are as many as views, they are taken in order.

    Raises:
        ValueError: none belongs to a view, or one that does has another size than the views.
    """
    if photographs is None:
        return Pictures({}, (), size)
    listing = listed(photographs)
    waiting: dict[str, list[int]] = {}
    for view, name in enumerate(names):
        waiting.setdefault(name, []).append(view)
    belongs = [waiting[one.name].pop(0) if waiting.get(one.name) else None for one in listing]
    if all(view is None for view in belongs):
        if len(listing) != len(names):
            raise ValueError(
                f"photographs: want those of the views, {', '.join(names[:3])}{', ...' * (len(names) > 3)}, got "
                f"{len(listing)} others, such as {listing[0].label}; give the photographs that were calibrated on"
            )
        belongs = list(range(len(names)))
    images, sources = {}, {}
    for photograph, view in zip(listing, belongs, strict=True):
        if view is None:
            continue
        image = as_8_bit(grey(photograph, orientation))
        found = (image.shape[1], image.shape[0])
        size = size or found
        if found != size:
            raise ValueError(
                f"photographs: want {size[0]} x {size[1]} px as the views have, got {found[0]} x {found[1]} px in "
                f"{photograph.label}; give the photographs that were calibrated on, and the same orientation"
            )
        images[view] = image
        sources[view] = image if isinstance(photograph.source, Frame) else photograph.source
    others = tuple(one.name for one, view in zip(listing, belongs, strict=True) if view is None)
    return Pictures(images, others, size, sources)


def _jpeg(image: np.ndarray, side: int) -> bytes:
    height, width = image.shape
    scale = min(1.0, side / max(height, width))
    if scale < 1:
        small = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1].tobytes()
