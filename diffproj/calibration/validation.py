"""Cross-validation and bootstrap of a calibration, over its views.

`cross_validate` refits without each fold of the views in turn and evaluates on that fold; `bootstrap` refits on views
resampled with replacement (Efron 1979). Both solve all refits as one batch.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj._core.arguments import checked_seed, whole_number
from diffproj._core.shown import Shown
from diffproj.calibration.circle_centres import with_true_centres
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.options import CalibrationOptions, Options, calibration_options
from diffproj.calibration.held_out import (
    errors_of,
    folds_of,
    over_folds,
    repeated,
    table_of_folds,
    without_error,
    without_views,
)
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.distinct import alike
from diffproj.lens.models import LensModel
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.target import Target
from diffproj.targets.views import Views, as_views


@dataclass(frozen=True, eq=False, repr=False)
class CrossValidation(Shown):
    """Errors of k refits on the views that they were fitted to, and on those held out.

    Attributes:
        fits: the k refits, as one calibration of batch shape `(k,)`.
        in_sample_px: RMS reprojection error of the fitted corners in pixels `(k,)`.
        held_out_px: the same for the held-out corners, `(k,)`.
        in_sample_world: RMS error of the fitted corners, back-projected onto the board, in world units `(k,)`.
        held_out_world: the same for the held-out corners, `(k,)`.
        lost: how many held-out corners lie beyond the fold of the lens that was fitted without them, `(k,)`. Where
            there are any, the fold's errors are infinite.
    """

    fits: Calibration
    in_sample_px: Float[Tensor, " k"]
    held_out_px: Float[Tensor, " k"]
    in_sample_world: Float[Tensor, " k"]
    held_out_world: Float[Tensor, " k"]
    lost: Int[Tensor, " k"]

    def to_dict(self) -> dict[str, list[Any]]:
        """The folds as columns of Python's own numbers and words: `pandas.DataFrame` takes it."""
        names = "in_sample_px", "held_out_px", "in_sample_world", "held_out_world", "lost"
        columns: dict[str, list[Any]] = {"fold": list(range(1, len(self.lost) + 1))}
        columns["status"] = [Status(code).name for code in self.fits.status.tolist()]
        return columns | {name: getattr(self, name).tolist() for name in names}

    def _facts(self) -> list[str]:
        held_out, fitted = (over_folds(part) for part in (self.held_out_px, self.in_sample_px))
        missing = without_error(self.held_out_px)
        return [f"{len(self.lost)} folds", f"held out RMS {held_out:.4f} px", f"fitted {fitted:.4f} px", missing]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()

    def summary(self) -> str:
        """A table of text: each fold, and the root mean square over the folds."""
        lines = [table_of_folds(self.in_sample_px, self.held_out_px, self.in_sample_world, self.held_out_world)]
        if bool(self.lost.any()):
            which = ", ".join(str(i + 1) for i in self.lost.nonzero().flatten().tolist())
            lines.append(
                f"{int(self.lost.sum())} held-out corners lie beyond the fold of the lens that was fitted without them "
                f"(fold {which}): take one with fewer coefficients"
            )
        return "\n".join(lines)


def cross_validate(
    views: Views,
    target: Target,
    distortion: LensModel = "brown5",
    folds: int = 5,
    **options: Unpack[CalibrationOptions],
) -> CrossValidation:
    """Refit without each of k folds of the views, and evaluate on the held-out fold.

    The pose of a held-out view is estimated from every second corner and evaluated on the others, then with the roles
    exchanged, so that no corner is evaluated with a pose that it contributed to. (A view with fewer than 4 such corners
    is not evaluated, nor one where they lie on a line.) A target's shape is that of the views of the fit alone. With
    `reject_outliers`, what the fit to all views rejects is left out first: such a corner is wrong, and tells nothing of
    the camera.

    Args:
        views: corners `(V, N, 2)` of one camera; view i is left out of fit i mod k.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`.
        distortion: the lens.
        folds: k.
        options: as `calibrate` takes them.

    Raises:
        TypeError: views are no `dp.Views`, folds no whole number, or an option is unknown or of another type.
        ValueError: fewer views than folds, fewer than 2 folds, or more than one camera.
        CalibrationError: a refit did not converge.

    Example:
        >>> import diffproj as dp
        >>> outcome = cross_validate(dp.example_views("left"), dp.Chessboard())
        >>> bool((outcome.held_out_px < 0.3).all())
        True
    """
    _check_views(views)
    _check_lens(distortion)
    chosen = calibration_options("cross_validate", options)
    want = f"a whole number from 2 to the number of views, {len(views)}"
    folds = whole_number("folds", folds, want, least=2, most=len(views))
    views = _with_true_centres(views, target, distortion, chosen, "cross_validate")
    if chosen.outlier_limit is not None:
        views = views.hiding(
            calibrated(views, target, distortion, chosen.but(progress=None), "cross_validate").rejected
        )
    fits, errors = without_views(views, target, distortion, folds_of(views, folds), chosen, who="cross_validate")
    held_out_px, held_out_world, lost = errors.over_views()
    in_sample_px, in_sample_world, _ = errors_of(fits, fits.views.pixels, fits.used).over_views()
    parts = in_sample_px, held_out_px, in_sample_world, held_out_world
    # With throw=False some may not have converged.
    in_px, out_px, in_world, out_world = (torch.where(fits.converged, part, torch.inf) for part in parts)
    return CrossValidation(fits, in_px, out_px, in_world, out_world, lost)


def bootstrap(
    views: Views,
    target: Target,
    distortion: LensModel = "brown5",
    draws: int = 200,
    seed: int = 0,
    **options: Unpack[CalibrationOptions],
) -> Mapping[str, Float[Tensor, ""]]:
    """Standard deviations of the shared parameters over refits to views resampled with replacement.

    No noise model is assumed. With few views the estimates are rough: from 13 views, accurate to about a third. Views
    that show the board alike are drawn together, for they are no independent evidence.

    Args:
        views: corners `(V, N, 2)` of one camera.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`.
        distortion: the lens.
        draws: number of refits.
        seed: of the random draws.
        options: as `calibrate` takes them, except `weights`, which count here how often a view was drawn.

    Returns:
        The standard deviations by parameter name, as in `Covariance.deviations` but for free points. Draws that did
        not converge are left out.

    Raises:
        TypeError: views are no `dp.Views`, draws or seed no whole numbers, or an option is unknown or of another type.
        ValueError: more than one camera, all views alike, fewer than 2 draws, or weights.
        CalibrationError: fewer than half of the draws, or fewer than 2, converged.

    Example:
        >>> import diffproj as dp
        >>> spread = bootstrap(dp.example_views("left"), dp.Chessboard(), draws=50)
        >>> 0.2 < float(spread["f_x"]) < 2.0
        True
    """
    _check_views(views)
    draws = whole_number("draws", draws, "a whole number of at least 2 and at most a million", least=2, most=10**6)
    _check_lens(distortion)
    chosen = calibration_options("bootstrap", options)
    if "weights" in options:
        raise ValueError("weights: want none, for they count here how often a view was drawn")
    generator = torch.Generator().manual_seed(checked_seed(seed))
    views = _with_true_centres(views, target, distortion, chosen, "bootstrap")
    group = _groups(Data(views, target, None))
    number = int(group.amax()) + 1
    if number < 2:
        alone = "one" if len(views) == 1 else f"{len(views)} alike"
        raise ValueError(f"views: want some that show the board differently, got {alone}")
    drawn = torch.randint(number, (draws, number), generator=generator, device="cpu").to(views.device)
    counts = torch.nn.functional.one_hot(drawn, number).sum(1).to(torch.float64)[:, group]
    every = repeated(views, draws)
    hidden = (counts == 0).unsqueeze(-1).expand(every.visible.shape)
    chosen = chosen.but(weights=counts.unsqueeze(-1), pixel_sigma=None, throw=False)
    found = calibrated(every.hiding(hidden), target, distortion, chosen, "bootstrap")
    kept = found.converged
    if int(kept.sum()) < max(2, draws // 2):
        raise CalibrationError(f"bootstrap: {int(kept.sum())} of {draws} draws determine the camera; add views", found)
    names, spread = found.parameters.few_names, found.shared[kept].std(0)
    return dict(zip(names, spread[: len(names)].unbind(), strict=True))


def _check_views(views: Views) -> None:
    if as_views(views).batch_shape:
        raise ValueError(f"views: want those of one camera, got batch shape {tuple(views.batch_shape)}")


def _check_lens(distortion: str) -> None:
    if isinstance(distortion, str) and distortion == "auto":
        raise ValueError(
            "distortion: want the name of a lens, got 'auto'; calibrate with it, and give the lens it took"
        )


def _with_true_centres(views: Views, target: Target, distortion: LensModel, chosen: Options, who: str) -> Views:
    """The views; of circles, with their middles moved to where all views together put the centres."""
    if not isinstance(target, CircleGrid):
        return views
    return with_true_centres(lambda moved: calibrated(moved, target, distortion, chosen, who), views, target).views


def _groups(data: Data) -> Tensor:
    """Numbers `(V,)`, from 0, of what is drawn together: views that show the board alike."""
    same = alike(data.points, data.pixels, data.used)[0]
    same = same | torch.eye(len(same), dtype=torch.bool, device=same.device)
    first = same.to(torch.uint8).argmax(-1)
    for _ in range(len(same)):
        if torch.equal(first[first], first):
            break
        first = first[first]
    return first.unique(return_inverse=True)[1]
