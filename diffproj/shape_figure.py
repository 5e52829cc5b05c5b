"""The picture of a target's shape: where its points lie, against where they should."""

import math

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from diffproj.calibration.results.calibration import Calibration, as_calibration

ARROW = 0.06
"""Length of a displacement within the plane as large as their RMS, as a part of the target's longer side."""
DOT, EDGE, ONE_DEVIATION = 90, "#8a8f98", "#d6336c"


def target_shape(calibration: Calibration) -> Figure:
    """How the target was printed: where each of its points lies, against where it should be.

    Arrows, magnified, are the displacements within the target's plane, each with the ellipse of one standard deviation
    at its tip; colours are those out of the plane, away from the camera or towards it as the target's z points. The
    target is drawn as its own axes say, x to the right; y is down for a target that is seen from its back along z.

    Args:
        calibration: of one camera, with `shape="free"` or `"bow"`.

    Raises:
        ValueError: there are many cameras, or the target was taken to be flat.

    Example:
        >>> import diffproj as dp
        >>> figure = target_shape(dp.calibrate(dp.example_views("left"), dp.Chessboard(), shape="free"))
        >>> figure.axes[0].get_title()[:37]
        'points off by 0.13 world units (RMS),'
    """
    if as_calibration(calibration).views.batch_shape or calibration.shape == "flat":
        raise ValueError("calibration: want one camera, with shape='free' or 'bow', got many, or a flat target")
    nominal, found = (points.detach().cpu() for points in (calibration.nominal, calibration.board_points))
    off = found - nominal
    size = (nominal[:, :2].amax(0) - nominal[:, :2].amin(0)).tolist()
    figure = Figure(figsize=(8.0, min(12.0, max(2.5, 7.0 * size[1] / size[0] + 0.6))), layout="constrained")
    axes = figure.add_subplot()
    unit = calibration.unit or "world units"
    rms = float(off.square().sum(-1).mean().sqrt())
    within = float(off[:, :2].square().sum(-1).mean().sqrt())
    magnification = float(f"{ARROW * max(size) / within:.2g}") if within > 0 else 1.0
    limit = float(off[:, 2].abs().amax()) or 1.0
    dots = axes.scatter(*nominal[:, :2].T, c=off[:, 2], cmap="RdBu_r", vmin=-limit, vmax=limit, s=DOT, edgecolors=EDGE)
    tips = nominal[:, :2] + magnification * off[:, :2]
    axes.quiver(
        *nominal[:, :2].T,
        *(magnification * off[:, :2]).T,
        angles="xy",
        scale_units="xy",
        scale=1,
        color="black",
        width=0.0025,
        zorder=3,
    )
    if calibration.displacements is not None and calibration.has_covariance:
        covariance = calibration.covariance.points.detach().cpu().unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3))
        for number, tip in enumerate(tips.tolist()):
            block = covariance[number, :2, number, :2]
            if bool(block.isfinite().all()):
                values, vectors = torch.linalg.eigh(block)
                width, height = (2 * magnification * values.clamp(min=0).sqrt()).tolist()
                angle = math.degrees(math.atan2(float(vectors[1, 0]), float(vectors[0, 0])))
                axes.add_patch(
                    Ellipse(tip, width, height, angle=angle, fill=False, edgecolor=ONE_DEVIATION, linewidth=0.8)
                )
    axes.set_aspect("equal")
    if bool(calibration.cameras.R[..., 2, 2].detach().mean() > 0):
        axes.invert_yaxis()
    axes.set_xlabel(f"x, {unit}", labelpad=1, fontsize=9)
    axes.set_ylabel(f"y, {unit}", labelpad=1, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.set_title(f"points off by {rms:.2g} {unit} (RMS), arrows {magnification:g} times as long", fontsize=10)
    bar = figure.colorbar(dots, ax=axes, shrink=0.85)
    bar.set_label(f"out of the plane (z), {unit}", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure
