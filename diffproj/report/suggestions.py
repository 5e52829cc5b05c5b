"""Which views to add, and a sketch of them: where the board should be in the image, and how it should be tilted."""

import itertools
import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup

from diffproj.report import svg
from diffproj.report.facts import Facts

TILT = 35.0
"""Degrees by which a suggested board is tilted, the middle of the 20 to 50 that are wanted."""
STEEPEST = 65.0
"""Degrees between the ray to a suggested board's middle and its normal up to which its corners are found surely."""
DIRECTIONS = 8
MOST = 6
"""Suggested views in a sketch, more than which nobody can take in."""
SIZE = 0.5
"""Of a suggested board, as a part of the image's shorter side."""
NINTHS = [f"{down} {across}".strip() or "middle" for down in ("top", "", "bottom") for across in ("left", "", "right")]
"""The ninths of the image, as the verdict calls them, row by row."""
INWARD, FARTHER = (1.0, 0.85, 0.7, 0.55), tuple(1.08**k for k in range(13))
"""Tried until a board is wholly in view: places from a ninth's middle towards the principal point, and distances."""
OUTERMOST = 65.0
"""Degrees of tilt at the rim of the sketch."""


class Suggestion(NamedTuple):
    """A view to add.

    Attributes:
        place: the ninth of the image in which the board's middle should be.
        tilt: in degrees, how much nearer its right side should be, and its lower one.
        outline: the board's corners in the image, in px.
    """

    place: str
    tilt: tuple[float, float]
    outline: Float[np.ndarray, "4 2"]

    @property
    def words(self) -> str:
        """What to do, in words."""
        across, down = self.tilt
        sides = [
            side
            for side, much in (
                ("right", across > 10),
                ("left", across < -10),
                ("lower", down > 10),
                ("upper", down < -10),
            )
            if much
        ]
        where = "in the middle" if self.place == "middle" else f"at the {self.place}"
        return f"the board {where}, its {' and '.join(sides)} side{'s' * (len(sides) > 1)} nearer to the camera"


def suggestions(facts: Facts) -> list[Suggestion]:
    """The views to add: in ninths that no corner reached, tilted as no board was; none where nothing is asked for."""
    judgement = facts.calibration.judgement
    if not facts.planar or not (judgement.bare or judgement.tilt or judgement.views):
        return []
    count = min(MOST, max(judgement.views, len(judgement.bare), 4 if judgement.tilt else 0))
    bare = list(judgement.bare)
    places = [
        *bare,
        *sorted((place for place in NINTHS if place not in bare), key=lambda place: _corners(facts, place)),
    ]
    taken = [tuple(tilt) for tilt in facts.tilts[facts.seen_views].tolist() if math.hypot(*tilt) > 10]
    found = []
    for place in (places * MOST)[:count]:
        ways = sorted(_directions(), key=lambda way: -min((_apart(way, other) for other in taken), default=0.0))
        for share, tilt in itertools.product(INWARD, ways):  # rather tilted otherwise than farther inward
            outline = _outline(facts, place, tilt, share)
            if outline is not None:
                taken.append(tilt)
                found.append(Suggestion(place, tilt, outline))
                break
    return found


def place_sketch(facts: Facts, wanted: list[Suggestion]) -> Markup:
    """The image with the boards that were photographed, and those to add."""
    axes = svg.image_axes(facts.size)
    parts = [svg.rectangle(*axes.field, "paper")]
    width, height = (side / 3 for side in facts.size)
    for place in facts.calibration.judgement.bare:
        row, column = divmod(NINTHS.index(place), 3)
        x, y = axes.x(column * width - 0.5), axes.y(row * height - 0.5)
        parts.append(svg.rectangle(x, y, axes.field[2] / 3, axes.field[3] / 3, "missing"))
    boards = [svg.polyline(axes.at(hull), "outline", closed=True) for hull in facts.outlines if len(hull)]
    boards += [svg.polyline(axes.at(one.outline), "suggested", closed=True) for one in wanted]
    parts.append(svg.clipped("places", axes, *boards))
    parts += [_number(n, *axes.at(one.outline.mean(0)[None])[0].tolist()) for n, one in enumerate(wanted, start=1)]
    parts.append(axes.drawn("u, px", "v, px", grid=False))
    label = f"Outlines of the board in {len(facts.seen_views)} views over the image"
    added = f", and {len(wanted)} to add: {'; '.join(one.words for one in wanted)}" if wanted else ""
    return svg.picture(axes.width, axes.height, label + added, *parts)


def tilt_sketch(facts: Facts, wanted: list[Suggestion]) -> Markup:
    """How the board was tilted in each view, and how it should be in those to add."""
    side, middle, radius = 400.0, 200.0, 140.0
    scale = radius / OUTERMOST

    def placed(tilt: tuple[float, float]) -> tuple[float, float]:
        much = math.hypot(*tilt)
        shrink = min(1.0, OUTERMOST / much) if much > 0 else 1.0
        return middle + scale * shrink * tilt[0], middle + scale * shrink * tilt[1]

    parts = [
        Markup('<path class="zone" fill-rule="evenodd" d="{}{}"/>').format(
            _circle(middle, 50 * scale), _circle(middle, 20 * scale)
        )
    ]
    for degrees in (20, 40, 60):
        parts.append(Markup('<path class="rule" d="{}"/>').format(_circle(middle, degrees * scale)))
        right, up = (degrees * scale * part for part in (math.sin(math.pi / 8), math.cos(math.pi / 8)))
        parts.append(svg.text(middle + right, middle - up + 11, f"{degrees}°", kind="tick"))  # suggestions lie beside
    parts += [svg.line(middle - radius, middle, middle + radius, middle, "rule")]
    parts += [svg.line(middle, middle - radius, middle, middle + radius, "rule")]
    parts.append(svg.text(middle, 40, "upper side nearer", "middle"))
    parts.append(svg.text(middle, side - 32, "lower side nearer", "middle"))
    for x, word in ((4.0, "left"), (side - 4, "right")):
        anchor = "start" if x < middle else "end"
        parts.append(svg.text(x, middle - 8, word, anchor))
        parts.append(svg.text(x, middle + 6, "nearer", anchor))
    tilts = facts.tilts[facts.seen_views]
    parts.append(svg.dots([placed(tuple(tilt)) for tilt in tilts.tolist()], "large pale"))
    for n, one in enumerate(wanted, start=1):
        parts.append(_number(n, *placed(one.tilt)))
    most = float(np.hypot(*tilts.T).max()) if len(tilts) else 0.0
    label = f"Tilt of the board in {len(tilts)} views, up to {most:.0f} degrees; 20 to 50 are wanted, on all sides"
    box = Markup('<svg class="picture" viewBox="0 20 {} {}" role="img" aria-label="{}">{}</svg>')
    return box.format(side, side - 40, label, Markup("").join(parts))


def _number(n: int, x: float, y: float) -> Markup:
    """A number in a disc."""
    disc = Markup('<circle class="badge" cx="{}" cy="{}" r="8.5"/>').format(f"{x:.1f}", f"{y:.1f}")
    return disc + svg.text(x, y + 4, str(n), "middle", "in-badge")


def _circle(middle: float, radius: float) -> str:
    return f"M{middle - radius:.1f} {middle:.1f}" + "".join(
        f"a{radius:.1f} {radius:.1f} 0 1 0 {step:.1f} 0" for step in (2 * radius, -2 * radius)
    )


def _directions() -> list[tuple[float, float]]:
    angles = (2 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS))
    return [(TILT * math.cos(angle), TILT * math.sin(angle)) for angle in angles]


def _apart(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """How far two tilts are apart, in degrees."""
    return math.dist(one, other)


def _corners(facts: Facts, place: str) -> int:
    """How many corners a ninth of the image has."""
    row, column = divmod(NINTHS.index(place), 3)
    u, v = facts.pixels[facts.used].T
    width, height = facts.size
    return int(((3 * u // width == column) & (3 * v // height == row)).sum())


def _outline(facts: Facts, place: str, tilt: tuple[float, float], share: float) -> np.ndarray | None:
    """The board's corners in the image, wholly in view, its middle so far from the principal point to a ninth's middle.

    `None` if it never is, or is seen too much from the side, as a tilted board at the border of a wide view may be.
    """
    camera = facts.calibration.camera.detach().to("cpu", torch.float64).without_pose()
    row, column = divmod(NINTHS.index(place), 3)
    width, height = facts.size
    ninth = camera.K.new_tensor([(column + 0.5) * width / 3, (row + 0.5) * height / 3])
    nominal = facts.calibration.nominal.detach().to(ninth)
    low, high = nominal[:, :2].amin(0), nominal[:, :2].amax(0)
    (x, y), (x2, y2) = ((low - high) / 2).tolist(), ((high - low) / 2).tolist()
    R = _tilted(tilt).to(ninth)
    turned = ninth.new_tensor([[x, y, 0], [x2, y, 0], [x2, y2, 0], [x, y2, 0]]) @ R.mT
    near = float(camera.K[0, 0]) * (float((high - low).norm()) or 1.0) / (SIZE * min(width, height))
    ray, valid = camera.directions(torch.lerp(camera.K[:2, 2], ninth, share)[None])  # none where the lens sees nothing
    ray = ray[0] / ray[0].norm().clamp(min=1e-9)
    if not bool(valid.all()) or float(R[:, 2] @ ray) < math.cos(math.radians(STEEPEST)):
        return None
    for farther in FARTHER:
        outline, seen = camera.project(turned + farther * near * ray)
        inside = ((outline > -0.5) & (outline < outline.new_tensor([width, height]) - 0.5)).all()
        if bool(seen.all() & inside):
            return outline.numpy()
    return None


def _tilted(tilt: tuple[float, float]) -> torch.Tensor:
    """The rotation of a board that is tilted so, see `tilts_of`."""
    across, down = map(math.radians, tilt)
    # The normal goes from z towards (across, down): about the axis (-down, across, 0).
    return torch.from_numpy(cv2.Rodrigues(np.array([-down, across, 0.0]))[0])
