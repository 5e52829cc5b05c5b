"""`distortion="auto"`: lenses fitted side by side, compared by their errors on what was held out, the simplest taken.

A richer lens fits better whatever the truth; on corners that it was not fitted to, it does so only where it is right.
So each lens is refitted without some of the views and judged by these; where there are few views, without every second
corner of each. The views are paired: what one lens is worse than the best, it is so in each view, and the spread of
these differences from view to view tells how far the mean difference can be trusted. The simplest lens is taken that
is not worse than the best by more than a few of its standard deviations.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from diffproj._core.arguments import tensor_of
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.held_out import Errors, folds_of, without_corners, without_views
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.problem.constraints import of_points
from diffproj.calibration.problem.parametrisation import BOW, INTRINSICS
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.comparison import LensComparison
from diffproj.calibration.results.remark import OF_THE_CAMERA, Kind
from diffproj.calibration.trust.verdict import LacksViews
from diffproj.lens.models import MODELS, LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views

COMMON: tuple[LensModel, ...] = ("none", "brown5", "fisheye", "brown8")
"""The lenses compared, in the order in which they are taken where they do equally well."""
LONGER: tuple[LensModel, ...] = ("brown12", "brown14")
"""Lenses for a prism and a tilted sensor, which are tried where the others leave something over."""
FOLDS = 5
MANY_VIEWS = 6
"""Views from which on views are held out, and not corners."""
ALLOWED = 2.0
"""Standard deviations of its difference by which a simpler lens may be worse."""
ALIKE = 0.01
"""Part of the best mean square by which it may be worse in any case: 0.5 % of the error in pixels."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A lens with its fit to everything and the mean square `(V,)` of its errors on what was held out, in px^2."""

    model: LensModel
    fit: Calibration
    cause: str
    squares: Tensor


def chosen_lens(views: Views, target: Target, chosen: Options) -> Calibration:
    """The calibration with the lens that is taken, and the comparison with it.

    Raises:
        ValueError: many cameras, or a lens that is held.
        CalibrationError: no lens can be fitted.
    """
    if views.batch_shape:
        raise ValueError(
            f"distortion: want the name of a lens for many cameras, got 'auto' for batch shape "
            f"{tuple(views.batch_shape)}; calibrate one of them with it"
        )
    if "distortion" in chosen.fixed:
        raise ValueError("distortion: want the name of a lens that is held by fixed=('distortion',), got 'auto'")
    _check_names(chosen)
    by_views = len(views) >= MANY_VIEWS
    fits = _fits(views, target, COMMON, chosen)
    candidates = _compared(views, target, fits, chosen, by_views)
    if by_views and not any(_judged(c) for c in candidates):
        by_views = False
        candidates = _compared(views, target, fits, chosen, by_views)
    best = _simplest(candidates)
    if best is not None and _inadequate(best):
        fits |= _fits(views, target, LONGER, chosen)
        candidates = _compared(views, target, fits, chosen, by_views)
        best = _simplest(candidates)
    usual = next(c for c in candidates if c.model == "brown5")
    if best is None or (_inadequate(best) and _lacks_views(usual)):  # what most cameras have, or why even that fails
        best = usual
        if not bool(best.fit.converged):
            if chosen.throw:
                raise CalibrationError(f"calibrate: {best.fit.message}", best.fit)
            return best.fit
    return replace(best.fit, comparison=_comparison(candidates, best, by_views))


def _fits(views: Views, target: Target, models: tuple[LensModel, ...], chosen: Options) -> dict[LensModel, Calibration]:
    return {model: calibrated(views, target, model, _options(chosen, model)) for model in models}


def _options(chosen: Options, model: LensModel) -> Options:
    """Those that concern a lens."""
    priors = chosen.priors and {name: value for name, value in chosen.priors.items() if _known(name, model)}
    return chosen.but(fixed=tuple(name for name in chosen.fixed if _known(name, model)), priors=priors, throw=False)


def _compared(
    views: Views, target: Target, fits: dict[LensModel, Calibration], chosen: Options, by_views: bool
) -> list[_Candidate]:
    # All are judged by the same corners: without those that no lens could explain.
    outliers = torch.stack([fit.rejected for fit in fits.values() if bool(fit.converged)] or [~views.visible]).all(0)
    if chosen.weights is not None:
        outliers = outliers | (tensor_of("weights", chosen.weights).to(views.device).expand(outliers.shape) <= 0)
    return [_candidate(views.hiding(outliers), target, model, fit, chosen, by_views) for model, fit in fits.items()]


def _candidate(
    views: Views, target: Target, model: LensModel, fit: Calibration, chosen: Options, by_views: bool
) -> _Candidate:
    nothing = torch.full(fit.used.shape[:1], torch.inf, dtype=fit.points.dtype, device=fit.used.device)
    if not bool(fit.converged):
        cause = LacksViews(fit.message) if isinstance(fit.causes[0], LacksViews) else fit.message
        return _Candidate(model, fit, cause, nothing)
    own = _options(chosen, model).but(progress=None)
    measure = chosen.loss if chosen.objective == "image" else None
    try:
        if by_views:
            refits, errors = without_views(views, target, model, folds_of(views, FOLDS), own, measure)
        else:
            refits, errors = without_corners(views, target, model, own, measure)
    except CalibrationError as error:  # a view that was held out has no pose
        return _Candidate(model, fit, LacksViews(error), nothing)
    if not bool(refits.converged.all()):
        part = "some of the views" if by_views else "every second corner"
        return _Candidate(model, fit, LacksViews(f"not determined without {part}"), nothing)
    return _Candidate(model, fit, "", _mean_squares(errors))


def _mean_squares(errors: Errors) -> Tensor:
    number = errors.number.sum(0)
    return torch.where(number > 0, errors.px.sum(0) / number.clamp(min=1), torch.nan)


def _judged(candidate: _Candidate) -> bool:
    return not bool(candidate.squares.isinf().any())


def _simplest(candidates: list[_Candidate]) -> _Candidate | None:
    judged = [c for c in candidates if _judged(c)]
    # Views that do not determine an ordinary camera may still determine a fisheye: that is no reason to take it.
    if any(c.model == "brown5" and _lacks_views(c) for c in candidates):
        judged = [c for c in judged if MODELS[c.model].perspective]
    if not judged:
        return None
    best = min(judged, key=lambda c: float(c.squares.nanmean()))
    for candidate in judged:
        if _inadequate(candidate) and not _inadequate(best):
            continue
        worse, deviation = _difference(candidate, best)
        if worse <= max(ALLOWED * deviation, ALIKE * float(best.squares.nanmean())):
            return _without_needless_terms(candidate, judged)
    return best


def _without_needless_terms(candidate: _Candidate, judged: list[_Candidate]) -> _Candidate:
    """The lens, or of `"brown8"` whose denominator stands for noise the one without, whatever that leaves over."""
    needless = any(remark.kind == Kind.NEEDLESS for remark in candidate.fit.findings[0])
    shorter = [c for c in judged if c.model == "brown5"]
    return shorter[0] if candidate.model == "brown8" and needless and shorter else candidate


def _lacks_views(candidate: _Candidate) -> bool:
    """Whether the views do not determine its camera."""
    return isinstance(candidate.cause, LacksViews)


def _inadequate(candidate: _Candidate) -> bool:
    """Whether its residuals themselves ask for another lens."""
    return any(remark.kind in OF_THE_CAMERA for remark in candidate.fit.findings[0])


def _difference(candidate: _Candidate, best: _Candidate) -> tuple[float, float]:
    """By how much the mean square is more than the best's, and the standard deviation of that, from view to view."""
    difference = (candidate.squares - best.squares)[~best.squares.isnan()]
    return float(difference.mean()), float(difference.std() / len(difference) ** 0.5) if len(difference) > 1 else 0.0


def _comparison(candidates: list[_Candidate], taken: _Candidate, by_views: bool) -> LensComparison:
    best = min(candidates, key=lambda c: float(c.squares.nanmean()))
    scale = best.squares.nanmean().sqrt()
    squares = torch.stack([c.squares.nanmean() for c in candidates])
    differences = squares.new_tensor([_difference(c, best) for c in candidates])
    held_out: Literal["views", "corners"] = "views" if by_views else "corners"
    return LensComparison(
        tuple(c.model for c in candidates),
        taken.model,
        held_out,
        torch.stack([c.fit.rms.detach() for c in candidates]),
        squares.sqrt(),
        (squares.sqrt() - scale).nan_to_num(torch.inf, torch.inf),
        (differences[:, 1] / (squares.sqrt() + scale)).nan_to_num(torch.inf),
        tuple(c.cause for c in candidates),
    )


def _known(name: str, model: LensModel) -> bool:
    return bool(of_points(name)) or name in (
        "focal",
        "principal_point",
        "distortion",
        "bow",
        *INTRINSICS,
        *BOW,
        *MODELS[model].coefficient_names,
    )


def _check_names(chosen: Options) -> None:
    """A name that no lens has is a mistake, and no reason to hold nothing."""
    for option, names in (("fixed", chosen.fixed), ("priors", chosen.priors or ())):
        for name in names:
            if not any(_known(name, model) for model in (*COMMON, *LONGER)):
                raise ValueError(f"{option}: want names of parameters, got {name!r}")
