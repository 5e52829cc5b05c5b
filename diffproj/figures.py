"""Figures, drawn with matplotlib without a display: the paper's Fig. 7, and maps of accuracy over the image."""

import io

import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from diffproj.measurement.accuracy_map import AccuracyMap
from diffproj.paper.experiment import Experiment

EXACT, APPROXIMATED, ERROR = "#8a8f98", "#0b6bcb", "#d6336c"
HATCH = (1.0, 1.0, 1.0, 0.45)


def fig7(experiment: Experiment, magnification: float = 50.0) -> Figure:
    """Exact and approximated corners of each test view, as the paper's Fig. 7.

    The board is drawn as one looks at it: the paper's x points down, its y to the right. The errors are so small that
    both marks fall on one spot, so each error is drawn as well, magnified.

    Args:
        experiment: what to draw.
        magnification: how many times as long as they are the errors are drawn.

    Example:
        >>> import diffproj as dp
        >>> views = dp.example_views("left")
        >>> figure = fig7(dp.run_experiment(views[:8], views[8:], dp.Chessboard(axes="paper")))
        >>> figure.axes[0].get_title()
        'left09.jpg: mean $E_x$ 0.047, $E_y$ 0.089'
    """
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
        axes.set_title(f"{name}: mean $E_x$ {row.mean[0]:.3f}, $E_y$ {row.mean[1]:.3f}", fontsize=10)
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
    figure.suptitle("Corners of the test views on the board (world units)", fontsize=12)
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)
    return figure


def accuracy(found: AccuracyMap, unit: str = "world units") -> Figure:
    """Ground resolution and predicted standard deviation over the image.

    A line surrounds the calibration's corners. What lies outside of them is hatched: the lens is extrapolated there.
    Grey is where a pixel has no point, or a point no finite deviation.

    Args:
        found: the map, from `AccuracyMap.over_image`.
        unit: of the world, for the labels.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> figure = accuracy(dp.AccuracyMap.over_image(calibration, view=0, step=80), unit="mm")
        >>> figure.axes[2].get_title()  # the right panel; each is followed by its colour bar
        'standard deviation of a point, mm'
    """
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


def png(figure: Figure, dpi: int = 150) -> bytes:
    """The figure as the content of a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def _as_seen(experiment: Experiment, points: torch.Tensor) -> torch.Tensor:
    """World points `(N, 3)` as `(right, down)` on the drawing."""
    return points[:, [1, 0]] if experiment.board.axes == "paper" else points[:, :2]
