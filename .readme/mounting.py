"""Draws how `Camera.mounted` counts height, tilt, roll and heading, with a camera that it made."""

from pathlib import Path

import torch
from matplotlib.figure import Figure

import diffproj as dp

HEIGHT, TILT, ROLL, HEADING = 2.0, 22.0, 8.0, 30.0
INK, LIGHT = "#1f4e79", "#999999"


def figure() -> Figure:
    """The side, the picture and the view from above."""
    camera = dp.Camera.mounted(HEIGHT, TILT, ROLL, HEADING, fov_deg=85.0, size=(640, 480))
    drawn = Figure(figsize=(9.0, 2.7), layout="constrained")
    side, picture, above = drawn.subplots(1, 3, width_ratios=[1.4, 1.0, 1.0])
    _side(side, camera)
    _picture(picture, camera)
    _above(above, camera)
    return drawn


def _side(axes, camera) -> None:
    (foot,), _ = dp.back_project([[319.5, 239.5]], camera, dp.Plane.z(0.0))
    reach = float(foot.norm())
    axes.plot([-0.6, reach + 0.8], [0, 0], color=LIGHT)
    axes.plot([0, reach + 0.8], [HEIGHT, HEIGHT], "--", color=LIGHT)
    axes.annotate("", (reach, 0), (0, HEIGHT), arrowprops={"arrowstyle": "->", "color": INK})
    axes.annotate("", (-0.25, HEIGHT), (-0.25, 0), arrowprops={"arrowstyle": "<->", "color": INK})
    axes.plot(0, HEIGHT, "o", color=INK)
    axes.text(-0.33, HEIGHT / 2, "height", rotation=90, va="center", ha="right", color=INK)
    axes.text(1.1, HEIGHT - 0.04, "tilt", va="top", color=INK)
    axes.text(reach / 2 + 0.3, HEIGHT / 2 + 0.05, "optical axis", rotation=-TILT, ha="center", color=INK)
    axes.text(reach + 0.8, HEIGHT + 0.05, "horizon", ha="right", color=LIGHT)
    axes.text(reach + 0.8, -0.06, "ground z = 0", ha="right", va="top", color=LIGHT)
    axes.set(title="from the side", aspect="equal", xlim=(-0.9, reach + 0.9), ylim=(-0.3, HEIGHT + 0.5))
    axes.axis("off")


def _picture(axes, camera) -> None:
    around = torch.tensor([HEADING - 22, HEADING + 22], dtype=torch.float64).deg2rad()
    far = camera.center + 1e9 * torch.stack([around.sin(), around.cos(), torch.zeros_like(around)], dim=-1)
    (left, right), _ = camera.project(far)
    axes.plot(*torch.stack([left, right]).T, color=INK)
    middle = (left + right) / 2
    axes.plot([float(left[0]), float(right[0])], [float(left[1])] * 2, "--", color=LIGHT)
    axes.text(float(right[0]) + 10, float(left[1] + right[1]) / 2, "roll", ha="left", va="center", color=INK)
    axes.text(float(middle[0]), float(middle[1]) + 50, "horizon", ha="center", color=INK, rotation=-ROLL)
    axes.plot(319.5, 239.5, "+", color=LIGHT)
    axes.text(319.5, 262, "middle of the image", color=LIGHT, va="top", ha="center")
    axes.set(title="the picture", aspect="equal", xlim=(-0.5, 639.5), ylim=(479.5, -0.5), xticks=[], yticks=[])


def _above(axes, camera) -> None:
    (foot,), _ = dp.back_project([[319.5, 239.5]], camera, dp.Plane.z(0.0))
    x, y = (foot[:2] / foot[:2].norm()).tolist()
    for end, name in (((1.0, 0.0), "x, east or right"), ((0.0, 1.0), "y, north or ahead")):
        axes.annotate("", end, (0, 0), arrowprops={"arrowstyle": "->", "color": LIGHT})
        axes.text(end[0], end[1] + 0.04, name, ha="center", color=LIGHT)
    axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "color": INK})
    turn = torch.linspace(0, HEADING, 30, dtype=torch.float64).deg2rad()
    axes.plot(0.6 * turn.sin(), 0.6 * turn.cos(), color=INK)
    axes.text(0.42, 0.5, "heading", color=INK, ha="left")
    axes.plot(0, 0, "o", color=INK)
    axes.set(title="from above", aspect="equal", xlim=(-0.6, 1.5), ylim=(-0.15, 1.25))
    axes.axis("off")


if __name__ == "__main__":
    figure().savefig(Path(__file__).parent / "mounting.png", dpi=90)
