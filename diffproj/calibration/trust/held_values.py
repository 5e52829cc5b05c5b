"""Whether the views contradict a focal length or principal point that was held.

A wrong value that is held bends all else. Poses and lens take up most of that, so that the residuals hardly grow, and
deviations take it for right: with a focal length 2 % off principal points are off by up to twice theirs. So each is set
free by the score test of `leftover.py`, which tells where the views want it, and how surely.
"""

import math

from diffproj.calibration.results.remark import Kind, Remark
from diffproj.calibration.trust.adequacy import counts
from diffproj.calibration.trust.leftover import Leftover

DEVIATIONS, OF_A_FIELD = 5.0, 3.0
"""Deviations from which on it is no chance; and where a smooth field over the image is none."""
FAR = 1.0
"""Per cent by which the ratio of focal lengths may be off that one step tells by how much."""
PART = 0.5
"""Part of what a smooth field over the image explains, from which on it is the word for that. (Right values of cameras
with another lens than the one that was fitted explained up to .27 of it; wrong ones, .7 and more.)"""


def held_value(left: Leftover, i: int) -> tuple[Remark | None, float]:
    """What the views of a camera, number `i` of those tested, contradict most of what was held, if anything.

    With it the part of the residuals' sum of squares that another value explains; 0 where they contradict nothing.
    """
    held = (
        (left.focal, "focal length that was held", "let it free, or say by priors= how surely it is known"),
        (left.ratio, "ratio f_y : f_x that was held", "take tied_focal=False, or are the board's squares no squares?"),
        (left.point, "principal point that was held", "let it free, or say by priors= how surely it is known"),
    )
    field = counts(left.smooth, i, 0.0) or counts(left.radial, i, 0.0)
    beyond, least = OF_A_FIELD if field else DEVIATIONS, PART * float(left.smooth.least_share[i])
    if counts(left.bow, i, 0.0):  # a bent board looks like another focal length, too
        least = max(least, float(left.bow.least_share[i]))
    most: tuple[Remark | None, float] = None, least
    for effect, name, remedy in held:
        if effect is None or effect.deviations[i] <= beyond or effect.least_share[i] <= most[1]:
            continue
        moved = effect.strengths[i].tolist()  # type: ignore[index]
        percent = 100 * abs(moved[0])
        told = effect is left.focal or percent <= FAR  # of the ratio one step tells much only roughly
        by = f"{percent:.2g} % " * told + ("larger" if moved[0] > 0 else "smaller")
        by = f"{math.hypot(*moved):.2g} px elsewhere" if effect is left.point else by
        reason = f"the views contradict the {name}"
        sentence = f"{reason}: they want it {by}, and all else follows it, beyond the error bars; {remedy}"
        most = Remark(sentence, Kind.WRONG_PRIOR, reason), float(effect.least_share[i])
    return most if most[0] else (None, 0.0)
