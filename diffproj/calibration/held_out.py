"""Refits without some of the data, and their errors on it: what cross-validation and the choice of a lens rest on."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.options import Options
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.locate import located as located_without_warning
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane
from diffproj.lens.models import LensModel
from diffproj.targets.residuals import nearest_minus_known, projected_minus_seen, put_back_minus_known
from diffproj.targets.target import Target
from diffproj.targets.views import Views


class Errors(NamedTuple):
    """Errors of k refits in each of V views `(k, V)`: sums of squares in pixels and in world units, and numbers.

    A corner that a refit's camera does not see is lost: its error is infinite.
    """

    px: Tensor
    world: Tensor
    number: Tensor
    lost: Tensor

    def plus(self, other: "Errors") -> "Errors":
        """Those of other corners of the same views added."""
        return Errors(*(a + b for a, b in zip(self, other, strict=True)))

    def over_views(self) -> tuple[Tensor, Tensor, Tensor]:
        """RMS errors `(k,)` in pixels and in world units, and the number of corners lost."""
        px, world, number, lost = (part.sum(-1) for part in self)
        return (px / number).sqrt(), (world / number).sqrt(), lost


def table_of_folds(*columns: Tensor) -> str:
    """Errors `(k,)` of fitted and of held-out corners, in pixels and in world units: each fold, and all together."""
    rows = [*torch.stack(columns, dim=-1).tolist(), [float(c.square().mean().sqrt()) for c in columns]]
    names = [*map(str, range(1, len(rows))), "all"]
    lines = [f"{n:<4} {a:11.4f} {b:13.4f} {c:14.4f} {d:16.4f}" for n, (a, b, c, d) in zip(names, rows, strict=True)]
    return "\n".join(["fold   fitted px   held out px   fitted world   held out world", *lines])


def repeated(views: Views, count: int) -> Views:
    """The same views for a batch of cameras."""
    pixels = views.pixels.expand(count, *views.pixels.shape)
    return Views.unchecked(pixels, views.visible.expand(count, *views.visible.shape), views.names, views.size)


def folds_of(views: Views, folds: int) -> Tensor:
    """Which views are left out of which fit `(k, V)`: view i of fit i mod k."""
    return torch.arange(len(views), device=views.device) % folds == torch.arange(folds, device=views.device)[:, None]


def without_views(
    views: Views,
    target: Target,
    distortion: LensModel,
    out: Tensor,
    chosen: Options,
    measure: Loss | None = None,
    who: str = "calibrate",
) -> tuple[Calibration, Errors]:
    """Refits without the views of each fold `(k, V)`, and their errors there.

    The pose of a view held out is estimated from every second corner and evaluated on the others, then with the roles
    exchanged. With a robust `measure` the squares in pixels are its values. Errors name `who` was asked.
    """
    every = repeated(views, len(out))
    fits = calibrated(every.hiding(_corners(out, every)), target, distortion, chosen, who)
    held_out = every.hiding(_corners(~out, every))
    second = _second(views)
    errors = []
    posing: dict[str, Any] = {"loss": chosen.loss if chosen.objective == "image" else None, "throw": False}
    for hidden in (second, ~second):
        located = located_without_warning(held_out.hiding(hidden), target, fits.camera, fits, **posing)
        if bool((located.covariance.undetermined_views & located.used.any(-1)).any()):
            raise CalibrationError(f"{who}: a view that was held out has no pose: {located.message}", located)
        posed = located.used.any(-1, keepdim=True)
        errors.append(errors_of(located, every.pixels, held_out.hiding(~hidden).visible & posed, measure))
    return fits, errors[0].plus(errors[1])


def without_corners(
    views: Views, target: Target, distortion: LensModel, chosen: Options, measure: Loss | None = None
) -> tuple[Calibration, Errors]:
    """Two refits, each to every second corner of the views, and their errors on the others; see `without_views`."""
    every = repeated(views, 2)
    second = _second(views)
    out = torch.stack([second, ~second])[:, None].expand(every.visible.shape)
    fits = calibrated(every.hiding(out), target, distortion, chosen)
    return fits, errors_of(fits, every.pixels, every.visible & out & fits.used.any(-1, keepdim=True), measure)


def errors_of(calibration: Calibration, pixels: Tensor, evaluated: Tensor, measure: Loss | None = None) -> Errors:
    """The errors of a calibration on corners `(k, V, N)` of its views, where `pixels` were seen."""
    cameras, pixels = calibration.cameras, pixels.to(calibration.nominal)
    points = calibration.board_points.unsqueeze(-3)
    px, seen = projected_minus_seen(cameras, points, pixels, evaluated)
    level = bool((calibration.nominal[:, 2] == 0).all())
    if calibration.shape != "flat" and level:  # each corner on a plane through its own place
        put_back, valid = back_project(pixels, cameras, Plane.per_point([0.0, 0.0, 1.0], points[..., 2]))
        landed = valid & evaluated
        world = torch.where(landed.unsqueeze(-1), put_back - points, 0.0)
    else:
        in_space = put_back_minus_known if level else nearest_minus_known
        world, landed = in_space(cameras, points, pixels, evaluated)
    squared = px.square().sum(-1)
    in_px = torch.where(evaluated & ~seen, torch.inf, squared if measure is None else measure.value(squared)).sum(-1)
    in_world = torch.where(evaluated & ~landed, torch.inf, world.square().sum(-1)).sum(-1)
    return Errors(in_px, in_world, evaluated.sum(-1), (evaluated & ~(seen & landed)).sum(-1))


def _second(views: Views) -> Tensor:
    return torch.arange(views.pixels.shape[-2], device=views.device) % 2 == 1


def _corners(which: Tensor, views: Views) -> Tensor:
    return which.unsqueeze(-1).expand(views.visible.shape)
