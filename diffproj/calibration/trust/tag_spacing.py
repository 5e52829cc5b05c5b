"""Whether the tags of an AprilGrid stand as far apart as it says, relative to their sides.

A grid printed from other numbers, or with sides measured with their white rims, is found all the same. Poses take up
what is alike in sides and gaps, so that corners fit to some tenths of a pixel, focal lengths are nearly right, and all
lengths are wrong by as much as the distance from tag to tag is. But sides and gaps do not go together then, which is
one unknown, and every view tells it.

Blurred or overexposed tags have corners a few hundredths of a pixel inside of their own, which looks alike. So it is
only said of what moves corners farther.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.results.remark import Kind, Remark
from diffproj.calibration.trust.adequacy import BOW_PART, counts
from diffproj.calibration.trust.leftover import Leftover
from diffproj.targets.april_grid import AprilGrid

FARTHER_PX = 0.08
"""By how much it must move corners, in each coordinate: blur and gamma draw them inside by up to 0.06."""


def by_spacing(target: object) -> Tensor | None:
    """How the points of a target `(N, 3)` move with the distance of its tags; `None` where it has none."""
    if not isinstance(target, AprilGrid) or target.columns * target.rows == 1:
        return None
    return target.by_spacing


def of_the_spacing(target: object, left: Leftover, i: int, sigma: float) -> Remark | None:
    """The remark on camera number `i` of those tested; none where its tags stand as they should.

    Args:
        target: what was seen.
        left: what the residuals leave over.
        i: the number.
        sigma: of a corner's coordinate in px, with what is left over.
    """
    found = left.proportion
    if not isinstance(target, AprilGrid) or found is None or found.strengths is None or not counts(found, i, 0.0):
        return None
    share = float(found.share[i])
    others = max(float(effect.share[i]) for effect in (left.radial, left.smooth, left.print))
    if sigma * share**0.5 < FARTHER_PX or share < max(others, BOW_PART * float(left.shape.share[i])):
        return None
    return _remark(target, float(found.strengths[i, 0]), f"{100 * share:.0f} % of the residuals' sum of squares")


def of_free_points(target: object, found: Fit, p: int) -> Remark | None:
    """The same of camera `p` whose target's points are free: where they are tells it.

    They keep the size that the target says in the mean, which is wrong by as much.
    """
    task, moves = found.task, by_spacing(target)
    if not isinstance(target, AprilGrid) or moves is None or not task.free:
        return None
    seen = task.used[p].any(0)
    points = task.points[seen, :2]
    off = found.solution.shared[p, task.parameters.few :].detach().unflatten(-1, (-1, 3))[seen, :2]
    off, apart = (_without_similarity(field, points) for field in (off, moves.to(points)[seen, :2]))
    strength = float((off * apart).sum() / apart.square().sum())
    share = strength**2 * float(apart.square().sum() / off.square().sum().clamp(min=1e-300))
    scale = float((_spread(task.pixels[p], task.used[p]) / _spread(points, torch.ones_like(points[:, 0]) > 0)).amax())
    if share < BOW_PART or scale * abs(strength) * float(apart.square().mean().sqrt()) < FARTHER_PX:
        return None
    return _remark(target, strength, f"{100 * share:.0f} % of how far its points lie off, in squares")


def _remark(target: AprilGrid, strength: float, share: str) -> Remark:
    """That the tags stand apart by so much more, on a board that poses made as large as the one that was said."""
    told = max(target.spacing + strength / (1 - strength / (1 + target.spacing)), 0.0)
    return Remark(
        f"the tags stand {told:.3g} of their side apart, not {target.spacing:.3g} ({share}), so lengths are wrong: "
        "measure the side of a tag, with its black border and without the white rim, and the way from one edge of it "
        f"to the same edge of the next, about {1 + told:.4g} sides; then correct the board's tag and spacing",
        Kind.SPACING,
        "the tags do not stand as far apart as the board says",
    )


def _without_similarity(field: Tensor, points: Tensor) -> Tensor:
    """Moves `(n, 2)` of points `(n, 2)` without what shifts, turns and scales all of them."""
    x, y = points.unbind(-1)
    one, nothing = torch.ones_like(x), torch.zeros_like(x)
    every = torch.stack([torch.stack(pair, -1) for pair in ((one, nothing), (nothing, one), (x, y), (-y, x))], -1)
    every = every.flatten(0, 1)
    whole = field.reshape(-1, 1)
    return (whole - every @ torch.linalg.lstsq(every, whole).solution).reshape(field.shape)


def _spread(places: Tensor, used: Tensor) -> Tensor:
    """How far places `(*, n, 2)` that are used lie from their middle, RMS `(*)`."""
    used, count = used.unsqueeze(-1), used.sum(-1).clamp(min=1)
    middle = torch.where(used, places, 0.0).sum(-2, keepdim=True) / count[..., None, None]
    return (torch.where(used, places - middle, 0.0).square().sum((-2, -1)) / count).sqrt()
