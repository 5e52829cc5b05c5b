"""The remarks on a calibration that converged: what is to be known of each camera."""

from collections.abc import Sequence

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results import left_out
from diffproj.calibration.results.left_out import mostly_left_out
from diffproj.calibration.results.remark import OF_THE_CAMERA, Kind, Remark, Remarks
from diffproj.calibration.trust.adequacy import (
    BOW_PART,
    EXACT_PX,
    LENS_WORDS,
    NOISY_PX,
    PRINT_SHARE,
    RADIAL_SHARE,
    SHAPE_SHARE,
    SHAPE_VIEWS,
    SIGNIFICANT,
    SMOOTH_SHARE,
    counts,
    other_lens,
    poses_only,
    wants_skew,
)
from diffproj.calibration.trust.discounted import discounted
from diffproj.calibration.trust.dispersion import Pulls, contradiction, dispersion, pulls_of
from diffproj.calibration.trust.entangled import Entangled, Simpler
from diffproj.calibration.trust.flexing import of_a_flexing_board
from diffproj.calibration.trust.held_values import held_value
from diffproj.calibration.trust.leftover import Leftover, f_deviations, leftover
from diffproj.calibration.trust.own_intrinsics import OwnIntrinsics, own_intrinsics
from diffproj.calibration.trust.prior_contradiction import PriorContradiction, prior_contradictions
from diffproj.calibration.trust.prior_weight import Elsewhere, weighed_anew
from diffproj.calibration.trust.small_effects import SmallEffects
from diffproj.calibration.trust.tag_spacing import by_spacing, of_free_points, of_the_spacing
from diffproj.calibration.trust.turned_photographs import Turned, turned_photographs
from diffproj.calibration.trust.two_groups import TwoGroups, two_groups
from diffproj.lens.models import DENOMINATOR
from diffproj.targets.landmarks import Landmarks

UNSURE = 0.1
"""Deviation of a focal length, relative to it, from which on it is known roughly."""
CONTRADICTION = 1e-4
"""Chance of the residuals under the noise that was given below which they contradict it."""
NOTABLE = 1.25
"""Times that noise that residuals must be for a word."""
CLEAR = 4.0
"""Deviations of chance from which on views contradict each other."""
BETTER = 0.8
"""Part of what another lens would explain that two groups must save to be named in its place."""
LIFTED = 2.0
"""Times as far off the board's plane as within it that corners must lie for the plane to be named."""
CAMERAS_SAVE = 0.7
"""Part of the sum of squares that two groups must save to explain it: two zooms saved 0.74 to 0.99 in simulated views,
on boards that bent another way in each view two groups saved 0.50 to 0.71. And that a principal point for each view
must: of paper in hands .56, of recordings with corners that are .3 px off by it .73 to .9."""
MOST_NAMED = 5
"""Views that are named."""
NO_DENOMINATOR = {"brown8": "'brown5'"} | dict.fromkeys(("brown12", "brown14"), "fixed=('k4', 'k5', 'k6')")
"""What a lens with a denominator is without it."""


def remarks(
    found: Fit,
    status: Tensor,
    doubt: Entangled,
    names: Sequence[Sequence[str]],
    sizes: Sequence[tuple[int, int] | None],
    target: object,
) -> tuple[Remarks, ...]:
    """The remarks on each of P cameras; none on one that did not converge.

    Args:
        found: the fit.
        status: of each camera `(P,)`.
        doubt: what the views hardly tell apart.
        names: of the views of each camera.
        sizes: of the photographs of each camera.
        target: what they saw.
    """
    task = found.task
    of_landmarks = isinstance(target, Landmarks)  # which people click and survey
    converged = status == Status.CONVERGED
    held = found.is_restrained()
    said: list[list[Remark]] = [[] for _ in status]
    for p in (converged & held).nonzero().flatten().tolist():
        said[p].append(Remark(_restrained(found, p)))
    for p, growth in doubt.needless.items():
        if not bool(held[p]):
            said[p].append(
                Remark(
                    f"k4, k5 and k6 stand for noise, without them the residuals are {100 * growth:.1f} % larger: "
                    f"{NO_DENOMINATOR[task.lens]} fits as well",
                    Kind.NEEDLESS,
                )
            )
    for p, other in doubt.simpler.items():
        said[p].append(Remark(_not_told(other)))
    for p, elsewhere in weighed_anew(found).items():
        if bool(converged[p]):
            said[p].append(Remark(_weighed_anew(elsewhere), Kind.PRIOR_WEIGHT))
    for p in (converged & _unsure_focal(found)).nonzero().flatten().tolist():
        said[p].append(Remark(_unsure(found, p)))
    for p in (converged & _contradicts_noise(found)).nonzero().flatten().tolist():
        reason = f"the residuals are {float(found.variance_of_residuals()[p].sqrt()):.2g} times what pixel_sigma says"
        sentence = (
            f"{reason}, more than chance allows: the deviations are too small; look for wrong landmarks or corners, "
            "or give a larger pixel_sigma"
        )
        said[p].append(Remark(sentence, Kind.CONTRADICTION, reason))
    pulls = pulls_of(found)
    for p, times in _contradict_each_other(found, pulls).items():
        if bool(converged[p]):
            said[p].append(_of_each_other(times))
    wrong = discounted(found)
    out = found.rejected if wrong is None else found.rejected | wrong
    few = converged & mostly_left_out(task.used & ~out, out).any(-1)
    for p in map(int, few.nonzero().flatten().tolist()):
        points = "landmarks" if of_landmarks else "corners"
        said[p].append(
            Remark(
                left_out.described((task.used & ~out)[p], out[p], tuple(names[p]), points, wrong is not None),
                Kind.LEFT_OUT,
            )
        )
    sigma = found.pixel_sigma().detach()
    which = (converged & (sigma > EXACT_PX) & (not poses_only(task))).nonzero().flatten()
    if len(which):
        left, groups = leftover(found, which, SIGNIFICANT, by_spacing(target)), two_groups(found, which)
        wrong = prior_contradictions(found, which)
        # What is known beforehand and does not fit holds the camera where turned photographs would fit better.
        turned = turned_photographs(found, which[~found.has_prior()[which]], sizes)
        small = SmallEffects(found, which, left, of_landmarks)
        own = own_intrinsics(found, dispersion(found, pulls), pulls)
        for i, p in enumerate(map(int, which.tolist())):
            saved = groups[p].saved if p in groups else 0.0
            shaken = own is not None and bool(own.point_told[p])
            if p in turned and _is_turned(turned[p], shaken, max(BETTER * saved, _otherwise(left, i))):
                # All else may come from that.
                said[p].append(_turned(names[p], turned[p]))
                continue
            if p in wrong:
                said[p].append(_of_the_prior(wrong[p]))
                if wrong[p].saved > BETTER * max(saved, float(left.smooth.share[i])):
                    continue
            spacing = of_the_spacing(target, left, i, float(sigma[p])) or of_free_points(target, found, p)
            if spacing is not None:
                said[p].append(spacing)
                continue
            wrong_value, gained = held_value(left, i)
            if not of_landmarks and _uneven_print(task, left, i, p, max(saved, gained)):
                said[p].append(_of_the_print(left, i))
                continue
            if wrong_value is not None and gained > BETTER * saved:
                said[p].append(wrong_value)
                continue
            remark = _left_over(task, left, i, p)
            two = p in groups and saved > BETTER * float(left.smooth.share[i])
            differs = None if two or p in wrong or own is None else _of_own_intrinsics(own, p, found.knows_noise)
            # Cameras or intrinsics that differ leave residuals that are smooth in each view, too.
            told = (two and saved > CAMERAS_SAVE) or (differs is not None and _explains(differs, own, p)) or p in wrong
            if not (of_landmarks or told) and (remark is None or remark.kind not in OF_THE_CAMERA):
                flexing = of_a_flexing_board(found, p, float(sigma[p]), float(left.shape.share[i]))
                remark = flexing or remark or _noisy(float(sigma[p]))
            if two:
                said[p].append(_two_cameras(names[p], groups[p]))
                remark = None if remark is not None and remark.kind in OF_THE_CAMERA else remark
            elif remark is None and p not in wrong:
                remark = differs or small.of(i)
            said[p] += [] if remark is None else [remark]
    return tuple(map(tuple, said))


def _restrained(found: Fit, p: int) -> str:
    """That terms of the lens are held, and which."""
    drawn = zip(found.task.names, found.restrained_parameters()[p].tolist(), strict=True)
    others = [name for name, is_drawn in drawn if is_drawn and name not in DENOMINATOR]
    held = "k4, k5 and k6 are held near those of a poorer lens"
    held += f", and {_joined(others)} at 0" if others else ""
    return f"{held}, for without that the lens folds inside the image"


def _otherwise(left: Leftover, i: int) -> float:
    """The part of the squares that another kind of lens, skew, a bent or stretched board or what is held explains."""
    held = (effect for effect in (left.focal, left.ratio, left.point) if effect is not None)
    effects = (left.radial, left.skew, left.bow, left.print, *held)
    return max((float(effect.share[i]) for effect in effects if counts(effect, i, 0.0)), default=0.0)


def _of_the_prior(wrong: PriorContradiction) -> Remark:
    reason = f"the views contradict the prior on {wrong.name}"
    return Remark(
        f"{reason}: they tell {wrong.told:.6g} ± {wrong.deviation:.2g}, and it says {wrong.said:.6g} ± "
        f"{wrong.sure:.2g}, {wrong.far:.0f} deviations off: is it of this camera, its zoom, this lens model, and "
        "photographs of this size?",
        Kind.WRONG_PRIOR,
        reason,
    )


def _unsure_focal(found: Fit) -> Tensor:
    """Which cameras have a focal length that is known roughly `(P,)`, as one view may leave it."""
    variance = found.plain_covariance.shared.diagonal(dim1=-2, dim2=-1)[:, :2]
    return (variance.sqrt() > UNSURE * found.solution.shared[:, :2].detach().abs()).any(-1)


def _unsure(found: Fit, p: int) -> str:
    variance = found.plain_covariance.shared[p].diagonal()[:2]
    part = 100 * float((variance.sqrt() / found.solution.shared[p, :2].abs()).amax())
    return (
        f"the focal length is known only to {part:.0f} %: points put back near the target are as good as their error "
        'bars say, others follow it; priors={"focal": (value, deviation)} or other views tilted differently tell more'
    )


def _contradicts_noise(found: Fit) -> Tensor:
    """Which cameras have residuals larger than the noise that was given makes by chance `(P,)`."""
    if not found.knows_noise:
        return torch.zeros_like(found.solution.status, dtype=torch.bool)
    spare = found.degrees_of_freedom().to(torch.float64)
    squares = found.variance_of_residuals().detach().nan_to_num(0.0) * spare
    rare = torch.special.gammaincc(spare.clamp(min=1) / 2, squares / 2) < CONTRADICTION
    return rare & (squares > NOTABLE**2 * spare)


def _contradict_each_other(found: Fit, pulls: Pulls | None) -> dict[int, float]:
    """How many times more than corners of the noise that was given the views contradict each other, where they do.

    Where no noise is given the covariance holds it.
    """
    if pulls is None or not found.knows_noise:
        return {}
    told, level = contradiction(*pulls), found.variance_of_residuals().detach()
    clear = f_deviations(told.phi, told.spare, found.degrees_of_freedom().to(told.phi).clamp(min=5)) > CLEAR
    times = (dispersion(found, pulls) * level).sqrt()
    return {p: float(times[p]) for p in (clear & (times > NOTABLE)).nonzero().flatten().tolist()}


def _of_each_other(times: float) -> Remark:
    reason = f"the views contradict each other {times:.2g} times as much as corners of that pixel_sigma would"
    return Remark(
        f"{reason}, and deviations are too small by up to as much: corners of a view err together, for the board, the "
        "lens model or the detector are not quite right; leave out pixel_sigma, then the deviations hold that",
        Kind.CONTRADICTION,
        reason,
    )


def _two_cameras(names: Sequence[str], group: TwoGroups) -> Remark:
    sentence = (
        f"{_named(names, group.smaller)} want another camera than the other views (with one for each group "
        f"the residuals' sum of squares is {100 * group.saved:.0f} % smaller): was it one camera with one zoom and "
        "focus, no photograph turned, cropped or resized, and one flat board? Else calibrate the groups by themselves"
    )
    return Remark(sentence, Kind.TWO_CAMERAS, "its views fall into two groups that want different cameras")


def _turned(names: Sequence[str], turned: Turned) -> Remark:
    several = len(turned.views) > 1
    sentence = (
        f"{_named(names, turned.views)} {'are' if several else 'is'} turned by 180 degrees against the other views "
        f"(turned back, the residuals' sum of squares is {100 * turned.saved:.0f} % smaller): turn "
        f"{'these photographs' if several else 'this photograph'} as the others are"
    )
    return Remark(sentence, Kind.TURNED, "some of its photographs are turned by 180 degrees")


def _named(names: Sequence[str], views: Sequence[int]) -> str:
    named = [names[view] for view in views]
    named = named if len(named) <= MOST_NAMED else [*named[:MOST_NAMED], f"{len(named) - MOST_NAMED} more"]
    return _joined(named)


def _joined(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def _not_told(other: Simpler) -> str:
    it = "them" if len(other.held) > 1 else "it"
    grown = f"{100 * other.growth:.1f} % larger" if other.growth > 0 else "no larger"
    if other.elsewhere:
        what, hold = f"is {other.there:.1f} px, not {other.here:.1f}", "both"
    else:
        here, there = other.deviations
        what, hold = f"is known to {there:.1f} px, not {here:.1f}", "that"
    return (
        f"these views hardly tell {', '.join(other.held)} from {other.name}: without {it} it {what}, "
        f"at residuals {grown}; the error bars hold {hold}; fix {it}, or take a simpler lens"
    )


def _weighed_anew(other: Elsewhere) -> str:
    return (
        f"the priors weigh against corners that are known to 1 px, and these scatter by {other.sigma:.2g} px: with "
        f"pixel_sigma={other.sigma:.2g} {other.name} would be about {other.there:.5g}, not {other.here:.5g}"
    )


def _uneven_print(task: Task, left: Leftover, i: int, p: int, saved: float) -> bool:
    """Whether a print that is wider than high, or slanted, is what explains most of the residuals of camera `p`."""
    if task.solid or int(task.used[p].any(-1).sum()) < SHAPE_VIEWS or not counts(left.print, i, PRINT_SHARE):
        return False
    others = ((left.radial, RADIAL_SHARE), (left.smooth, SMOOTH_SHARE), (left.shape, SHAPE_SHARE))
    most = max((float(effect.share[i]) for effect, share in others if counts(effect, i, share)), default=0.0)
    return float(left.print.share[i]) > max(most, saved)


def _of_the_print(left: Leftover, i: int) -> Remark:
    return Remark(
        "the residuals repeat on the board, as if it were wider than high by more than it says, or less, or slanted "
        f"({100 * float(left.print.share[i]):.0f} % of their sum of squares), which focal lengths take for their own: "
        "take shape='free', which finds that, or print it at 100 % both ways and measure both sides of the whole board",
        Kind.UNEVEN_PRINT,
        "the board is not as wide and as high as it says",
    )


def _is_turned(turned: Turned, shaken: bool, otherwise: float) -> bool:
    """Whether photographs are turned, which saves more than all else does; principal points scatter in one heap."""
    return turned.saved > otherwise and (turned.in_heaps or not shaken)


def _explains(differs: Remark, own: OwnIntrinsics | None, p: int) -> bool:
    """Whether intrinsics that differ are what there is to say; on a board that bends principal points seem to, too."""
    return differs.kind != Kind.STEADIED or (own is not None and float(own.point.saved[p]) > CAMERAS_SAVE)


def _of_own_intrinsics(own: OwnIntrinsics, p: int, knows_noise: bool) -> Remark | None:
    if bool(own.focal_told[p]):
        part = f"{100 * float(own.focal.spread[p]):.1g} %"
        return Remark(
            f"the focal length differs by about {part} from view to view, as of a camera that focuses anew for each "
            "photograph: switch autofocus off and hold the zoom, for calibrating and for measuring; the deviations are "
            f"those of the mean, and in one photograph it may be off by {part}",
            Kind.FOCUS,
            "its focal length differs from view to view",
        )
    if bool(own.point_told[p]):
        part = f"{float(own.point.spread[p]):.2g} px"
        held = "those of pixel_sigma, which do not count that" if knows_noise else "those of the mean"
        return Remark(
            f"the principal point seems to differ by about {part} from view to view, as of a lens, a sensor or a "
            "recording that is steadied against shaking, or of a shutter that reads row after row of what moves: "
            "switch steadying off and photograph at rest, for calibrating and for measuring; the deviations are "
            f"{held}, and in one photograph it may be off by {part}",
            Kind.STEADIED,
            "its principal point seems to differ from view to view",
        )
    return None


def _left_over(task: Task, left: Leftover, i: int, p: int) -> Remark | None:
    """The remark on the residuals of camera `p`, number `i` of those that were tested; none where they are noise."""
    if wants_skew(task, left, i):
        part = f"{100 * float(left.skew.share[i]):.0f} % of their sum of squares"
        return Remark(
            f"the residuals {LENS_WORDS} over the image, as through a K with skew ({part}): take skew=True",
            Kind.SKEW,
            "a K without skew does not fit the camera",
        )
    for radial, effect, share in ((True, left.radial, RADIAL_SHARE), (False, left.smooth, SMOOTH_SHARE)):
        if counts(effect, i, share):
            where = "with the distance from the principal point" if radial else "over the image"
            part = f"{100 * float(effect.share[i]):.0f} % of their sum of squares"
            remedy = other_lens(task, p, radial)
            return Remark(
                f"the residuals {LENS_WORDS} {where}, as through another lens ({part}): {remedy}",
                Kind.OTHER_LENS,
                "this lens model does not fit the lens",
            )
    if int(task.used[p].any(-1).sum()) >= SHAPE_VIEWS and counts(left.shape, i, SHAPE_SHARE):
        if counts(left.bow, i, BOW_PART * float(left.shape.share[i])):
            return Remark(
                "the residuals repeat on the board, as if it were bent: take shape='bow'",
                Kind.BENT,
                "the board is bent",
            )
        moved, lifted = float(left.moved[i]), float(left.lifted[i])
        off = f"{moved:.2g} world units (RMS) off the target's"
        if lifted > LIFTED * moved:
            off = f"{lifted:.2g} world units (RMS) off the target's plane"
        return Remark(
            f"the residuals repeat on the board, whose corners lie {off}: take shape='free', which finds where they "
            "are, or a flatter or better print"
        )
    return None


def _noisy(sigma: float) -> Remark | None:
    if sigma <= NOISY_PX:
        return None
    return Remark(
        f"the corners scatter by {sigma:.1f} px in each coordinate, in sharp photographs by 0.1 to 0.3: "
        "look for blur and for wrong corners"
    )
