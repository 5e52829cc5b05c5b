"""`cross_validate_rig`: refits of a rig without some of its moments, and their errors there."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Unpack

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import whole_number
from diffproj._core.shown import Shown
from diffproj.calibration.held_out import LEAST_CORNERS, halves, over_folds, table_of_folds, without_error
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.locate import located
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.one import rig_calibrated, rig_task
from diffproj.calibration.rigs.options import RigOptions, rig_options
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.rigs.views import Moments, rig_views
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane
from diffproj.lens.models import LensModel
from diffproj.targets.residuals import nearest_minus_known, projected_minus_seen, put_back_minus_known
from diffproj.targets.target import Target
from diffproj.targets.views import Views


class _Errors(NamedTuple):
    """Sums of squares, and how many corners: on the image in px^2, on the target in squared world units."""

    px: float = 0.0
    world: float = 0.0
    number: int = 0

    def plus(self, other: "_Errors") -> "_Errors":
        return _Errors(self.px + other.px, self.world + other.world, self.number + other.number)

    @property
    def rms(self) -> tuple[float, float]:
        if self.number == 0:  # no corner to say so of, which is not an error of 0
            return torch.nan, torch.nan
        return (self.px / self.number) ** 0.5, (self.world / self.number) ** 0.5


@dataclass(frozen=True, eq=False, repr=False)
class RigCrossValidation(Shown):
    """Errors of k refits of a rig at the moments that they were fitted to, and at those held out, over all cameras.

    Attributes:
        fits: the k refits. Of those that did not converge, with `throw=False`, all errors are infinite.
        in_sample_px: RMS reprojection error of the fitted corners in pixels `(k,)`.
        held_out_px: the same at the held-out moments `(k,)`; NaN where no view there had corners enough to say so.
        in_sample_world: RMS error of the fitted corners, back-projected onto the target, in world units `(k,)`.
        held_out_world: the same at the held-out moments `(k,)`.
    """

    fits: tuple[RigCalibration, ...]
    in_sample_px: Float[Tensor, " k"]
    held_out_px: Float[Tensor, " k"]
    in_sample_world: Float[Tensor, " k"]
    held_out_world: Float[Tensor, " k"]

    def to_dict(self) -> dict[str, list[Any]]:
        """The folds as columns of Python's own numbers and words: `pandas.DataFrame` takes it."""
        names = "in_sample_px", "held_out_px", "in_sample_world", "held_out_world"
        columns: dict[str, list[Any]] = {"fold": list(range(1, len(self.fits) + 1))}
        columns["status"] = [fit.status.name for fit in self.fits]
        return columns | {name: getattr(self, name).tolist() for name in names}

    def summary(self) -> str:
        """A table of text: each fold, and the root mean square over the folds."""
        return table_of_folds(self.in_sample_px, self.held_out_px, self.in_sample_world, self.held_out_world)

    def _facts(self) -> list[str]:
        held_out, fitted = (over_folds(part) for part in (self.held_out_px, self.in_sample_px))
        missing = without_error(self.held_out_px)
        return [f"{len(self.fits)} folds", f"held out RMS {held_out:.4f} px", f"fitted {fitted:.4f} px", missing]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()


def cross_validate_rig(
    views_by_camera: Mapping[str, Views],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel] = "brown5",
    folds: int = 5,
    moments: Moments | None = None,
    cameras: Any = None,
    **options: Unpack[RigOptions],
) -> RigCrossValidation:
    """Refit a rig without each of k folds of its moments, and evaluate on the fold that was held out.

    At a held-out moment the target is located with the rig from every second corner of all cameras together, and
    evaluated on the others, then with the roles exchanged, so that no corner is evaluated with a pose that it
    contributed to. (Of a view, these have to be 4 that do not lie on a line.) A view that contradicts the others at its
    moment counts no more than `calibrate_rig` counts it. With `reject_outliers`, what the fit to all moments rejects is
    left out first.

    Args:
        views_by_camera: corners by the camera's name, as for `calibrate_rig`; moment i is left out of fit i mod k.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`. Errors of points in space are distances from
            the pixels' rays.
        distortion: the lens, or one by camera.
        folds: k.
        moments: of each view, by camera, as for `calibrate_rig`.
        cameras: known beforehand, as for `calibrate_rig`.
        options: as `calibrate_rig` takes them.

    Raises:
        TypeError: no mapping from names to views, folds no whole number, or an option is unknown or of another type.
        ValueError: fewer moments than folds, or fewer than 2 folds; or weights.
        CalibrationError: a refit did not converge.

    Example:
        >>> import diffproj as dp
        >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
        >>> dp.cross_validate_rig(pair, dp.Chessboard(), folds=3)
        RigCrossValidation(3 folds, held out RMS 0.1987 px, fitted 0.1703 px)
    """
    who = "cross_validate_rig"
    chosen = rig_options(who, options)
    if chosen.weights is not None:
        raise ValueError("weights: want none, for held-out corners count alike")
    whole = rig_views(views_by_camera, target, moments, None, who)
    want = f"a whole number from 2 to the number of moments, {len(whole.moments)}"
    folds = whole_number("folds", folds, want, least=2, most=len(whole.moments))
    labels = {name: [whole.moments[i] for i in where.tolist()] for name, where in whole.where.items()}
    if chosen.outlier_limit is not None:
        every = rig_calibrated(rig_task(views_by_camera, target, distortion, labels, cameras, chosen, who)).calibrations
        views_by_camera = {name: views.hiding(every[name].rejected) for name, views in views_by_camera.items()}
    fits, inside, outside = [], [], []
    for fold in range(folds):
        out = {name: where % folds == fold for name, where in whole.where.items()}
        kept = {name: views.hiding(_every_corner(views, out[name])) for name, views in views_by_camera.items()}
        fit = rig_calibrated(rig_task(kept, target, distortion, labels, cameras, chosen, who))
        fits.append(fit)
        if not fit.converged:  # with throw=False
            inside.append((torch.inf, torch.inf))
            outside.append((torch.inf, torch.inf))
            continue
        errors = _Errors()
        for one in fit.calibrations.values():
            errors = errors.plus(_errors(one, one.used))
        inside.append(errors.rms)
        held = {name: views.hiding(_every_corner(views, ~out[name])) for name, views in views_by_camera.items()}
        outside.append(_held_out(fit, held, target, labels, chosen.loss, who).rms)
    like = whole.points
    columns = [like.new_tensor([row[i] for row in rows]) for i in (0, 1) for rows in (inside, outside)]
    return RigCrossValidation(tuple(fits), *columns)


def _every_corner(views: Views, which: Tensor) -> Tensor:
    """All corners of some views `(V, N)`."""
    return which.unsqueeze(-1).expand(views.visible.shape)


def _held_out(
    fit: RigCalibration,
    held: Mapping[str, Views],
    target: Target,
    labels: Mapping[str, list[str]],
    loss: Loss | None,
    who: str,
) -> _Errors:
    """Errors at moments that were held out, by two halves of the corners in turn, with poses by the loss of the fit."""
    posing: dict[str, Any] = {"loss": loss, "throw": False}
    total = _Errors()
    both = {name: halves(views, target.points) for name, views in held.items()}
    for i in (0, 1):
        half = {name: views.hiding(both[name][i].hidden) for name, views in held.items()}
        seen = {name: views for name, views in half.items() if bool((views.visible.sum(-1) >= LEAST_CORNERS).any())}
        found: dict[str, Calibration] = {}
        if len(seen) == 1:
            name = next(iter(seen))
            camera = fit.cameras[name].without_pose()
            found[name] = located(seen[name], target, camera, fit.calibrations[name], **posing)
        elif seen:
            chosen = rig_options(who, {"fixed": ("rig", "intrinsics"), **posing})
            known = {name: fit.cameras[name] for name in seen}
            theirs = {name: labels[name] for name in seen}
            moved = None if fit.shape == "flat" else fit.points - next(iter(fit.calibrations.values())).nominal
            found = rig_calibrated(rig_task(seen, target, "none", theirs, known, chosen, who, moved)).calibrations
        for name, one in found.items():
            counts = held[name].visible & both[name][i].evaluated & one.used.any(-1, keepdim=True)
            total = total.plus(_errors(one, counts, held[name]))
    return total


def _errors(one: Calibration, counts: Tensor, views: Views | None = None) -> _Errors:
    """Errors of some corners `(V, N)` with the poses of a calibration; infinite where a corner is not projected."""
    pixels = one.views.pixels if views is None else views.pixels.to(one.views.pixels)
    off, projected = projected_minus_seen(one.cameras, one.points, pixels, counts)
    heights, level = one.points[:, 2], bool((one.nominal[:, 2] == 0).all())
    if one.shape == "flat" and level:
        landed, valid = put_back_minus_known(one.cameras, one.points, pixels, counts)
    elif not level:  # landmarks in space, which no plane holds
        landed, valid = nearest_minus_known(one.cameras, one.points, pixels, counts)
    else:  # onto the plane through each point as it was printed
        plane = Plane.per_point([0.0, 0.0, 1.0], heights.expand(counts.shape))
        found, valid = back_project(pixels, one.cameras, plane)
        landed, valid = found - one.points, valid & counts
        landed = torch.where(valid.unsqueeze(-1), landed, 0.0)
    if bool((counts & ~(projected & valid)).any()):
        return _Errors(torch.inf, torch.inf, int(counts.sum()))
    return _Errors(float(off.square().sum()), float(landed.square().sum()), int(counts.sum()))
