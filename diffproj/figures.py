"""Figures, drawn with matplotlib without a display.

The paper's Fig. 7, accuracy over the image, what a calibration saw, the shape of its target, and what was measured in
a photograph.
"""

import io
import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Shaped
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from diffproj._core.arguments import instance, number
from diffproj.calibration.results.calibration import Calibration, as_calibration
from diffproj.landmarks_figure import landmarks as landmarks
from diffproj.measurement.accuracy_map import AccuracyMap
from diffproj.paper.experiment import Experiment
from diffproj.shape_figure import target_shape as target_shape

EXACT, APPROXIMATED, ERROR = "#8a8f98", "#0b6bcb", "#d6336c"
HATCH = (1.0, 1.0, 1.0, 0.45)
REJECTED = "#e8590c"
AXES = {"x": "#e03131", "y": "#2f9e44", "z": "#1c7ed6"}
OUTLINE = [withStroke(linewidth=2.5, foreground="white")]
"""Around texts and lines, so that they are seen on light and dark photographs."""

LABEL = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
"""Behind texts that stand on a line."""

ARROW = 0.03
"""Length of a residual as large as the RMS, as a part of the image's longer side."""

NEAR = 0.25
"""How far outside of the photograph points are still drawn, as a part of its sides."""

MARGIN = 0.05
"""How much of the picture lies at least beyond a point outside of the photograph, as a part of its sides."""


def fig7(experiment: Experiment, magnification: float = 50.0) -> Figure:
    """Exact and approximated corners of each test view, as the paper's Fig. 7.

    The board is drawn as one looks at it: the paper's x points down, its y to the right. The errors are so small that
    both marks fall on one spot, so each error is drawn as well, magnified.

    Args:
        experiment: what to draw.
        magnification: how many times as long as they are the errors are drawn.

    Raises:
        TypeError: it is no experiment, or the magnification no number.
        ValueError: the magnification is not positive.

    Example:
        >>> import diffproj as dp
        >>> views = dp.example_views("left")
        >>> figure = fig7(dp.run_experiment(views[:8], views[8:], dp.Chessboard(axes="paper")))
        >>> figure.axes[0].get_title()
        'left09.jpg: mean $E_x$ 0.046, $E_y$ 0.081'
    """
    instance("experiment", experiment, Experiment, "a dp.Experiment", "dp.run_experiment gives one")
    magnification = number("magnification", magnification, "a factor above 0", above=0)
    views = experiment.test.views.names
    columns = min(3, len(views))
    lines = -(-len(views) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.6 * lines + 0.9), layout="constrained")
    exact = _as_seen(experiment, experiment.exact)
    unit = experiment.board.square
    for position, (name, found, measured) in enumerate(
        zip(views, experiment.approximated, experiment.measured, strict=True)
    ):
        axes = figure.add_subplot(lines, columns, position + 1)
        approximated = _as_seen(experiment, found)[measured]
        known = exact[measured]
        tip = known + magnification * (approximated - known)
        axes.plot(*exact.T, "s", color=EXACT, markersize=7, markerfacecolor="none", markeredgewidth=1)
        axes.plot(*torch.stack([known, tip]).permute(2, 0, 1), color=ERROR, linewidth=1.4)
        axes.plot(*approximated.T, ".", color=APPROXIMATED, markersize=4)
        row = experiment.rows[position]
        plain = name.replace("$", r"\$")
        axes.set_title(f"{plain}: mean $E_x$ {row.mean[0]:.3f}, $E_y$ {row.mean[1]:.3f}", fontsize=10)
        horizontal, vertical = ("y", "x") if experiment.board.axes == "paper" else ("x", "y")
        axes.set_xlabel(horizontal, labelpad=1)
        axes.set_ylabel(vertical, labelpad=1)
        axes.set_aspect("equal")
        axes.set_xlim(float(exact[:, 0].min()) - unit, float(exact[:, 0].max()) + unit)
        axes.set_ylim(float(exact[:, 1].max()) + unit, float(exact[:, 1].min()) - unit)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    marks = [
        Line2D([], [], marker="s", color=EXACT, markerfacecolor="none", linestyle="none", label="exact corner"),
        Line2D([], [], marker=".", color=APPROXIMATED, linestyle="none", label="approximated by back-projection"),
        Line2D([], [], color=ERROR, label=f"error, {magnification:g} times as long"),
    ]
    unit_in_words = experiment.fit.unit or "world units"
    figure.suptitle(f"Corners of the test views on the board ({unit_in_words})", fontsize=12)
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)
    return figure


def accuracy(found: AccuracyMap, unit: str = "world units") -> Figure:
    """Ground resolution and predicted standard deviation over the image.

    A line surrounds the calibration's corners. What lies outside of them is hatched: the lens is extrapolated there.
    Grey is where a pixel has no point, or a point no finite deviation.

    Args:
        found: the map, from `AccuracyMap.over_image`.
        unit: of the world, for the labels.

    Raises:
        TypeError: it is no map, or the unit no string.
        ValueError: no place of the map is in the image.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> figure = accuracy(dp.AccuracyMap.over_image(calibration, view=0, step=80), unit="mm")
        >>> figure.axes[2].get_title()  # the right panel; each is followed by its colour bar
        'standard deviation of a point, mm'
    """
    instance("found", found, AccuracyMap, "a dp.AccuracyMap", "dp.AccuracyMap.over_image(calibration) gives one")
    instance("unit", unit, str, "a string")
    if min(found.pixels.shape[:2]) < 2 or not bool(found.pixels.isfinite().all()):
        raise ValueError(
            f"found: want a map of at least 2 x 2 places that all are in the image, got {_places(found)}; "
            "AccuracyMap.over_image(calibration) gives one, AccuracyMap.over_plane with an extent that is in view"
        )
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    u, v = (part.numpy() for part in found.pixels.cpu().unbind(-1))
    panels = (
        (found.resolution, f"ground resolution, {unit} a pixel"),
        (found.deviation, f"standard deviation of a point, {unit}"),
    )
    for position, (values, title) in enumerate(panels):
        axes = figure.add_subplot(1, 2, position + 1)
        shown = values.cpu().numpy()
        known = shown[(shown > 0) & (shown < float("inf"))]
        scale = LogNorm(known.min(), known.max()) if known.size else None
        axes.set_facecolor(EXACT)
        image = axes.pcolormesh(u, v, shown, norm=scale, cmap="viridis", shading="gouraud")
        covered = found.covered.cpu().double().numpy()
        if 0 < float(covered.mean()) < 1:
            axes.contour(u, v, covered, levels=[0.5], colors="white", linewidths=1.2)
        extrapolated = found.extrapolated.cpu().double().numpy()
        if bool(extrapolated.any()):
            outside = axes.contourf(u, v, extrapolated, levels=[0.5, 1.5], colors="none", hatches=["//"])
            outside.set(edgecolor=HATCH, linewidth=0)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("u, px", labelpad=1, fontsize=9)
        axes.set_ylabel("v, px", labelpad=1, fontsize=9)
        axes.set_aspect("equal")
        axes.set_xlim(float(u.min()), float(u.max()))
        axes.set_ylim(float(v.max()), float(v.min()))
        axes.tick_params(labelsize=8)
        bar = figure.colorbar(image, ax=axes, shrink=0.85)
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.yaxis.set_minor_formatter("")
        if known.size and known.max() < 10 * known.min():  # hardly any power of ten lies in there
            marks = (m * 10.0**e for e in range(-9, 9) for m in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9))
            bar.set_ticks([mark for mark in marks if known.min() <= mark <= known.max()], minor=False)
        bar.ax.tick_params(labelsize=8, which="both")
    if bool(found.extrapolated.any()):
        note = "hatched: outside of the calibration's corners, where the lens is extrapolated"
        lost = bool((found.deviation.isinf() | ~(found.resolution > 0)).any())
        figure.supxlabel(note + "; grey: not determined" * lost, fontsize=9)
    return figure


def corners(calibration: Calibration) -> Figure:
    """Where in the image a calibration saw corners, and how far off each one is.

    Left, all corners that were used, and the outline of the board in each view: where there are none, the lens is
    extrapolated. Right, the residuals, projected minus seen, magnified; arrows that follow a pattern are no noise.

    Args:
        calibration: of one camera whose size is known.

    Raises:
        ValueError: there are many cameras, or the size is not known.

    Example:
        >>> import diffproj as dp
        >>> figure = corners(dp.calibrate(dp.example_views("left"), dp.Chessboard()))
        >>> [axes.get_title() for axes in figure.axes]
        ['702 corners in 13 views', 'residuals, 121 times as long: RMS 0.16 px']
    """
    size = as_calibration(calibration).views.size or calibration.camera.size
    if calibration.views.batch_shape or size is None:
        raise ValueError("calibration: want one camera whose size is known, got many, or one without a size")
    figure = Figure(figsize=_beside(size, 2), layout="constrained")
    seen, used, rejected = calibration.views.pixels.cpu(), calibration.used.cpu(), calibration.rejected.cpu()
    left, right = (figure.add_subplot(1, 2, position) for position in (1, 2))
    for pixels, mask in zip(seen, used, strict=True):
        if bool(mask.any()):
            left.fill(
                *_hull(pixels[mask]).T, facecolor=to_rgba(APPROXIMATED, 0.06), edgecolor=APPROXIMATED, linewidth=0.7
            )
    left.plot(*seen[used].T, ".", color=APPROXIMATED, markersize=3)
    left.set_title(f"{int(used.sum())} corners in {int(used.any(-1).sum())} views", fontsize=10)
    residuals = calibration.residuals.detach().cpu()[used]
    projected = residuals.isfinite().all(-1)  # those beyond the fold of the lens are not
    tails, residuals = seen[used][projected], residuals[projected]
    rms = float(residuals.square().sum(-1).mean().sqrt())
    magnification = float(f"{ARROW * max(size) / rms:.3g}") if rms > 0 else 1.0
    right.quiver(
        *tails.T, *(magnification * residuals).T, angles="xy", scale_units="xy", scale=1, color=ERROR, width=0.0022
    )
    right.set_title(f"residuals, {magnification:g} times as long: RMS {rms:.2g} px", fontsize=10)
    if bool(rejected.any()):
        for axes in (left, right):
            axes.plot(*seen[rejected].T, "x", color=REJECTED, markersize=6)
        note = f"crosses: {int(rejected.sum())} rejected corners"
        figure.supxlabel(note, fontsize=9)
    for axes in (left, right):
        _as_image(axes, size)
    return figure


def measured(
    calibration: Calibration,
    view: int,
    pixels: Sequence[Sequence[float]],
    names: Sequence[str],
    lengths: Sequence[str],
    photograph: Shaped[np.ndarray, "h w"] | None = None,
    title: str = "",
) -> Figure:
    """A photograph with the board's corners, its origin and axes, and what was measured in it.

    Args:
        calibration: of one camera whose size is known, or with the photograph.
        view: the number of the photograph's view.
        pixels: `(N, 2)`, the points that were measured, in order; those far outside of the photograph are left out.
        names: of the points.
        lengths: what stands at the line from each point to the next, N - 1 texts; no line where it is empty.
        photograph: its grey values; white where there is none.
        title: over the picture.

    Raises:
        ValueError: neither a size nor a photograph is known.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> figure = measured(calibration, 0, [[250, 100], [500, 110]], ["A", "B"], ["200 ± 0.5 mm"])
        >>> [text.get_text() for text in figure.axes[0].texts]
        ['x', 'y', 'z', '200 ± 0.5 mm', 'A', 'B']
    """
    size = calibration.views.size or calibration.camera.size
    if photograph is not None:
        size = photograph.shape[1], photograph.shape[0]
    if size is None:
        raise ValueError("photograph: want one, for the calibration does not tell the image's size, got none")
    figure = Figure(figsize=_beside(size, 1), layout="constrained")
    axes = figure.add_subplot()
    if photograph is not None:
        axes.imshow(photograph, cmap="gray", vmin=0, vmax=255)
    used = calibration.used[view].cpu()
    axes.plot(*calibration.views.pixels[view].cpu()[used].T, ".", color=APPROXIMATED, markersize=3)
    _draw_axes(axes, calibration, view)
    width, height = size
    near = [-NEAR * width <= u <= (1 + NEAR) * width and -NEAR * height <= v <= (1 + NEAR) * height for u, v in pixels]
    for i, text in enumerate(lengths):
        if text and near[i] and near[i + 1]:
            (u, v), (u2, v2) = pixels[i], pixels[i + 1]
            axes.plot([u, u2], [v, v2], color=ERROR, linewidth=1.2, path_effects=OUTLINE)
            middle = ((u + u2) / 2, (v + v2) / 2)
            axes.annotate(text, middle, color=ERROR, fontsize=9, ha="center", va="center", bbox=LABEL, parse_math=False)
    for (u, v), name, shown in zip(pixels, names, near, strict=True):
        if shown:
            axes.plot(u, v, "+", color=ERROR, markersize=9, markeredgewidth=1.5, path_effects=OUTLINE)
            axes.annotate(
                name,
                (u, v),
                (5, 5),
                textcoords="offset points",
                color=ERROR,
                fontsize=10,
                path_effects=OUTLINE,
                parse_math=False,
            )
    _as_image(axes, size)
    for u, v in (pixel for pixel, shown in zip(pixels, near, strict=True) if shown):
        left, right = axes.get_xlim()
        bottom, top = axes.get_ylim()
        axes.set_xlim(min(left, u - MARGIN * width), max(right, u + MARGIN * width))
        axes.set_ylim(max(bottom, v + MARGIN * height), min(top, v - MARGIN * height))
    left_out = [name for name, near_enough in zip(names, near, strict=True) if not near_enough]
    if left_out:
        figure.supxlabel(f"far outside: {', '.join(left_out)}", fontsize=9, parse_math=False)
    axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def png(figure: Figure, dpi: int = 150) -> bytes:
    """The figure as the content of a PNG file."""
    return content(figure, "png", dpi)


def content(figure: Figure, format: str = "png", dpi: int = 150) -> bytes:  # noqa: A002
    """The figure as the content of a file: `"png"`, `"svg"`, `"pdf"`, or another format of matplotlib."""
    written = io.BytesIO()
    figure.savefig(written, format=format, dpi=dpi)
    return written.getvalue()


def _draw_axes(axes: Axes, calibration: Calibration, view: int) -> None:
    """The axes of the board's frame from its first corner on, a quarter of the board long."""
    points = calibration.points.cpu()
    origin = points[0]
    length = float((points.amax(0) - points.amin(0)).max()) / 4
    tips = origin + length * torch.eye(3, dtype=points.dtype, device="cpu")
    places, valid = calibration.cameras[view].project(torch.cat([origin[None], tips]).to(calibration.points))
    (u, v), *ends = places.detach().cpu().tolist()
    for (name, colour), (x, y), seen in zip(AXES.items(), ends, valid[1:].tolist(), strict=True):
        if seen:
            axes.plot([u, x], [v, y], color=colour, linewidth=2, path_effects=OUTLINE)
            away = math.hypot(x - u, y - v) or 1.0
            beyond = (8 * (x - u) / away, -8 * (y - v) / away)
            axes.annotate(
                name,
                (x, y),
                beyond,
                textcoords="offset points",
                color=colour,
                ha="center",
                va="center",
                path_effects=OUTLINE,
            )
    axes.plot(u, v, "o", color="black", markersize=5, markerfacecolor="white")


def _beside(size: tuple[int, int], columns: int) -> tuple[float, float]:
    """Width and height in inches of a figure of so many images side by side."""
    width, height = size
    across = 10.0 if columns > 1 else 8.0
    return across, min(12.0, max(2.5, across / columns * height / width + 0.6))


def _as_image(axes: Axes, size: tuple[int, int]) -> None:
    """The image's frame, with v downward."""
    width, height = size
    axes.set_aspect("equal")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_xlabel("u, px", labelpad=1, fontsize=9)
    axes.set_ylabel("v, px", labelpad=1, fontsize=9)
    axes.tick_params(labelsize=8)


def _hull(pixels: torch.Tensor) -> np.ndarray:
    """The convex outline `(M, 2)` of pixels `(N, 2)`."""
    return cv2.convexHull(pixels.numpy().astype(np.float32)).reshape(-1, 2)


def _places(found: AccuracyMap) -> str:
    rows, columns = found.pixels.shape[:2]
    return f"{int(found.pixels.isfinite().all(-1).sum())} of {rows} x {columns} in the image"


def _as_seen(experiment: Experiment, points: torch.Tensor) -> torch.Tensor:
    """World points `(N, 3)` as `(right, down)` on the drawing."""
    return points[:, [1, 0]] if experiment.board.axes == "paper" else points[:, :2]
