"""The first part: whether the camera is known well enough, for what, what to photograph next, and what not to trust."""

import re
import warnings
from typing import NamedTuple

import torch

from diffproj._core.shown import rounded
from diffproj.calibration.results.account import told_of
from diffproj.calibration.results.border import border_with_rays
from diffproj.calibration.results.distinct import alike, described
from diffproj.geometry.plane import Plane
from diffproj.measurement.choices import HAND_PX
from diffproj.measurement.measure import measure
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts
from diffproj.report.suggestions import place_sketch, suggestions, tilt_sketch

HEADINGS = {
    "Good": ("good", "Good: the camera is known well"),
    "Weak": ("doubt", "Weak: the camera is known, but not well"),
    "Not usable": ("bad", "Not usable: the camera was not found"),
}


class Use(NamedTuple):
    """How well something is measured.

    Attributes:
        what: it is.
        detector, hand: its deviation in world units where a program found the pixels, and where a hand picked them.
    """

    what: str
    detector: str
    hand: str


def verdict_part(facts: Facts) -> Part:
    """The verdict in words."""
    judgement = facts.calibration.judgement
    wanted = suggestions(facts)
    kind, heading = HEADINGS[judgement.word]
    sketches = []
    if facts.planar and facts.seen_views and facts.converged:
        sketches = [place_sketch(facts, wanted), tilt_sketch(facts, wanted)]
    html = render(
        "verdict.html",
        kind=kind,
        heading=heading,
        judgement=judgement,
        failed=kind == "bad",
        reasons=[sentence(facts.in_words(reason)) for reason in judgement.reasons],
        remedies=[sentence(facts.in_words(remedy)) for remedy in judgement.remedies],
        note=facts.in_words(judgement.note),
        figures=_figures(facts),
        uses=_uses(facts),
        view=facts.names[facts.usual_view] if facts.names else "",
        distance=f"{svg.plain(float(facts.distances[facts.usual_view]), 3)} {facts.unit}" if facts.names else "",
        hand=HAND_PX,
        doubts=doubts(facts),
        wanted=[sentence(one.words) for one in wanted],
        sketches=sketches,
        thing=facts.thing,
    )
    return Part("Is it good enough?", "verdict", html, svg.STYLE)


def doubts(facts: Facts) -> list[str]:
    """What is not to be trusted, and why, in sentences."""
    calibration = facts.calibration
    found = []
    if facts.converged:
        found += told_of(calibration)
        border = float(border_with_rays(calibration.camera.detach(), facts.size))
        if border < 1:
            found.append(
                f"{100 * (1 - border):.0f} % of the image's border lies beyond the fold of the lens: no rays there"
            )
        loose = [name for name, value in facts.deviations.items() if value == float("inf")]
        if loose:
            found.append(f"the views do not determine {', '.join(loose)}")
    if calibration.shares is not None:
        same = alike(calibration.nominal, calibration.views.pixels.unsqueeze(0), calibration.used.unsqueeze(0))[0]
        found.append(described(same, calibration.views.names))
    out = int(facts.rejected.sum())
    if out:
        found.append(f"{out} {facts.thing}{'s' * (out > 1)} lay more than 5 standard deviations off and did not count")
    idle = [name for view, name in enumerate(facts.names) if view not in facts.seen_views]
    if idle:
        found.append(
            f"{len(idle)} view{'s' * (len(idle) > 1)} did not count, with too few {facts.thing}s: {', '.join(idle[:4])}"
        )
    if not calibration.has_covariance:
        found.append(
            "the file that it was read from holds no deviations, so nothing here says how sure the numbers are"
        )
    return [sentence(facts.in_words(text)) for text in found]


def _figures(facts: Facts) -> list[tuple[str, str]]:
    """The few numbers that everybody asks for."""
    counts = facts.used.sum(-1)
    found = [
        (f"views, {facts.thing}s", f"{int((counts > 0).sum())}, {int(counts.sum())}"),
        ("RMS reprojection error", f"{svg.plain(facts.rms, 3)} px"),
    ]
    if facts.converged:
        f, sure = rounded(facts.calibration.shared[0].item(), facts.deviations.get("f_x", 0.0))
        found.append(("focal length", f"{f} ± {sure} px" if sure else f"{f} px"))
    return found


def _uses(facts: Facts) -> list[Use]:
    """How well points and lengths on the board are measured, from the view whose distance is the usual one."""
    calibration = facts.calibration
    if not (facts.converged and facts.planar and calibration.has_covariance and facts.seen_views):
        return []
    view = facts.usual_view
    low, high = calibration.nominal.amin(0), calibration.nominal.amax(0)
    middle, half = (low + high) / 2, (high - low) / 2
    along = torch.zeros_like(half)
    axis = int(half[:2].argmax())
    along[axis] = half[axis]
    ends = torch.stack([middle, middle - along, middle + along])
    pixels, valid = calibration.cameras[view].detach().project(ends)
    if not bool(valid.all()):
        return []
    with warnings.catch_warnings():  # what they say is among the doubts
        warnings.simplefilter("ignore")
        found = [
            measure(pixels, calibration, Plane.z(float(middle[2])), view, sigma) for sigma in ("detector", HAND_PX)
        ]
    along_length = ends[2] - ends[1]
    gradient = torch.cat([torch.zeros_like(along_length), -along_length, along_length]) / along_length.norm()
    points, lengths = [], []
    for one in found:
        joint = one.joint().detach().to(gradient)
        points.append(torch.linalg.eigvalsh(joint[:3, :3]).amax().clamp(min=0).sqrt())
        lengths.append((gradient @ joint @ gradient).clamp(min=0).sqrt())
    return [
        Use("a point in the middle of the board", *(f"{svg.plain(float(d))} {facts.unit}" for d in points)),
        Use(
            f"the board's length, {svg.plain(float(along_length.norm()), 3)} {facts.unit}",
            *(f"{svg.plain(float(d))} {facts.unit}" for d in lengths),
        ),
    ]


def sentence(text: str) -> str:
    """A remark as a sentence; the name of a parameter, such as k1 or f_x, stays as it is."""
    text = text.strip().rstrip(".")
    start = text[:1] if re.match(r"[a-z]+\d|[a-z]+_[xy]\b", text) else text[:1].upper()
    return f"{start}{text[1:]}{'' if text.endswith('?') else '.'}"
