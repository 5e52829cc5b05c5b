"""The picture of a camera's landmarks: where a photograph shows them, and where the camera sees them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from diffproj.calibration.results.calibration import Calibration, as_calibration

SEEN, PROJECTED, REJECTED = "#d6336c", "#0b6bcb", "#e8590c"
OUTLINE = [withStroke(linewidth=2.5, foreground="white")]
WIDTH, HIGHEST = 8.0, 12.0
"""Width of the picture, and its greatest height, in inches."""
FIELD = 0.9
"""Part of that which the photograph takes, about."""
SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1))
"""Where a name may stand beside its mark, right and up, the best first."""
LETTER, LINE = 5.5, 11.0
"""Width of a letter and height of a line in points, about."""


def landmarks(
    calibration: Calibration, view: int = 0, photograph: Shaped[np.ndarray, "h w"] | None = None, title: str = ""
) -> Figure:
    """A photograph with its landmarks: crosses where they were seen, circles where the camera sees them.

    A landmark that the photograph was not said to show has a circle and its name alone: there it is to be looked for.

    Args:
        calibration: of one camera, found from `Landmarks`; its size is known, or the photograph given.
        view: the number of the photograph's view.
        photograph: its grey values; white where there is none.
        title: over the picture.

    Raises:
        ValueError: there are many cameras, or neither a size nor a photograph is known.

    Example:
        >>> import diffproj as dp
        >>> views, corners = dp.example_views("left"), dp.Landmarks(dp.Chessboard().points)
        >>> located = dp.locate(views[:1], corners, dp.calibrate(views, dp.Chessboard()))
        >>> [text.get_text() for text in landmarks(located).axes[0].texts][:3]
        ['1', '2', '3']
    """
    size = as_calibration(calibration).views.size or calibration.camera.size
    size = size if photograph is None else (photograph.shape[1], photograph.shape[0])
    if calibration.views.batch_shape or size is None:
        raise ValueError("calibration: want one camera, whose size or photograph is known, got many, or neither")
    width, height = size
    figure = Figure(figsize=(WIDTH, min(HIGHEST, max(2.5, WIDTH * height / width + 0.6))), layout="constrained")
    axes = figure.add_subplot()
    if photograph is not None:
        axes.imshow(photograph, cmap="gray", vmin=0, vmax=255)
    projected, valid = calibration.cameras[view].project(calibration.points)
    inside = valid & calibration.cameras[view].in_image(projected) if calibration.camera.size else valid
    projected, inside, pixels, seen, rejected = (
        tensor.detach().cpu()
        for tensor in (
            projected,
            inside,
            calibration.views.pixels[view],
            calibration.views.visible[view],
            calibration.rejected[view],
        )
    )
    axes.plot(*projected[inside].T, "o", color=PROJECTED, markersize=10, markerfacecolor="none", path_effects=OUTLINE)
    for mask, colour in ((seen & ~rejected, SEEN), (rejected, REJECTED)):
        axes.plot(*pixels[mask].T, "+", color=colour, markersize=9, markeredgewidth=1.5, path_effects=OUTLINE)
    names = calibration.landmarks or tuple(str(number + 1) for number in range(len(pixels)))
    each = zip(names, pixels.tolist(), projected.tolist(), seen.tolist(), inside.tolist(), strict=True)
    told = [(name, (*(pixel if has else place),), has) for name, pixel, place, has, shown in each if has or shown]
    points_of_px = 72 * FIELD * min(WIDTH / width, figure.get_figheight() / height)
    marks = points_of_px * np.array([place for _, place, _ in told]).reshape(-1, 2)
    sides = _sides([name for name, _, _ in told], marks)
    for (name, place, has), (right, up) in zip(told, sides, strict=True):
        axes.annotate(
            name,
            place,
            (6 * right, 6 * up),
            ha="left" if right > 0 else "right",
            va="bottom" if up > 0 else "top",
            textcoords="offset points",
            color=SEEN if has else PROJECTED,
            fontsize=9,
            path_effects=OUTLINE,
            parse_math=False,
        )
    axes.set_aspect("equal")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_xlabel("u, px", labelpad=1, fontsize=9)
    axes.set_ylabel("v, px", labelpad=1, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def _sides(names: Sequence[str], places: Float[np.ndarray, "n 2"]) -> list[tuple[int, int]]:
    """On which side of its mark each name stands, so that it covers no other name and no other mark, if that can be.

    Args:
        names: what is to be written.
        places: of the marks, in points, down.
    """
    # Marks, and behind them the names that stand: left, top, right and bottom.
    taken, found = np.concatenate([places - 5, places + 5], axis=1), []
    taken = np.concatenate([taken, np.zeros_like(taken)])
    for n, (name, (x, y)) in enumerate(zip(names, places.tolist(), strict=True)):
        across, boxes = LETTER * len(name) + 6, []
        for right, up in SIDES:
            left, top = x + (6 if right > 0 else -across), y + (-6 - LINE if up > 0 else 6)
            boxes.append((left, top, left + across - 6, top + LINE))
        covered = _overlap(np.array(boxes)[:, None], taken[: len(names) + n])
        covered[:, n] = 0  # its own mark
        best = int(covered.sum(1).argmin())
        taken[len(names) + n] = boxes[best]
        found.append(SIDES[best])
    return found


def _overlap(one: Float[np.ndarray, "*#n 4"], other: Float[np.ndarray, "*#n 4"]) -> Float[np.ndarray, "*n"]:
    """The areas that rectangles share: left, top, right and bottom each."""
    sides = np.minimum(one[..., 2:], other[..., 2:]) - np.maximum(one[..., :2], other[..., :2])
    return sides.clip(min=0).prod(-1)
