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

LEAST_CORNERS = 4
"""That tell a pose; views of fewer take no part."""
THIN = 1e-2
"""Width of points, relative to their length, below which they lie on a line."""


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
    """Errors `(k,)` of fitted and of held-out corners, in pixels and in world units: each fold, and all together.

    Folds without an error (NaN) take no part in what all have together.
    """
    rows = [*torch.stack(columns, dim=-1).tolist(), [over_folds(c) for c in columns]]
    names = [*map(str, range(1, len(rows))), "all"]
    lines = [f"{n:<4} {a:11.4f} {b:13.4f} {c:14.4f} {d:16.4f}" for n, (a, b, c, d) in zip(names, rows, strict=True)]
    lines = ["fold   fitted px   held out px   fitted world   held out world", *lines]
    if (missing := without_error(columns[1])) != "":
        lines.append(f"{missing}: no view there had corners enough, and 'all' is of the others")
    return "\n".join(lines)


def over_folds(errors: Tensor) -> float:
    """The root mean square of the errors of folds `(k,)` that have one; NaN where none has."""
    return float(errors.square().nanmean().sqrt())


def without_error(errors: Tensor) -> str:
    """How many folds could not be evaluated, of their errors `(k,)`; nothing where all could."""
    missing = int(errors.isnan().sum())
    return f"{missing} of {len(errors)} folds not evaluated" if missing else ""


def repeated(views: Views, count: int) -> Views:
    """The same views for a batch of cameras."""
    pixels = views.pixels.expand(count, *views.pixels.shape)
    return Views.unchecked(pixels, views.visible.expand(count, *views.visible.shape), views.names, views.size)


def folds_of(views: Views, folds: int) -> Tensor:
    """Which views are left out of which fit `(k, V)`: view i of fit i mod k."""
    return torch.arange(len(views), device=views.device) % folds == torch.arange(folds, device=views.device)[:, None]


class Half(NamedTuple):
    """Half of the corners of each view, from which its pose is told, and the other one, on which it is evaluated.

    Attributes:
        hidden: corners that tell no pose `(V, N)`; all of a view whose half lies on a line.
        evaluated: the other half `(V, N)`.
    """

    hidden: Tensor
    evaluated: Tensor


def halves(views: Views, points: Tensor) -> tuple[Half, Half]:
    """Every second corner of each view, and the others, each to be evaluated with the pose that the other half tells.

    Of a board seen in part, every second corner may lie on a line, which tells no pose: of two columns, where rows have
    an even number of corners. Then the visible corners are taken in another order: the first, not the next two, the
    next two, and so on. Where even that does not help, no pose is told from that half.

    Args:
        views: `(V, N)`, without batch axes.
        points: of the target `(N, 3)`.
    """
    visible, points = views.visible, points.to(views.device, torch.float64)
    every_second = (torch.arange(len(points), device=views.device) % 2 == 1).expand(visible.shape)
    order = visible.long().cumsum(-1) % 4
    in_pairs = (order == 2) | (order == 3)

    def telling(half: Tensor) -> Tensor:
        return (half.sum(-1) < LEAST_CORNERS) | ~_on_a_line(points, half)

    usual = telling(visible & every_second) & telling(visible & ~every_second)
    second = torch.where(usual.unsqueeze(-1), every_second, in_pairs)
    return tuple(Half(out | ~telling(visible & ~out).unsqueeze(-1), out) for out in (second, ~second))  # type: ignore[return-value]


def _on_a_line(points: Tensor, some: Tensor) -> Tensor:
    """Where some of the points `(V, N)` lie on a line `(V,)`."""
    weight = some.to(points).unsqueeze(-1)
    count = weight.sum(-2, keepdim=True).clamp(min=1)
    off = weight * (points - (weight * points).sum(-2, keepdim=True) / count)
    spread = torch.linalg.eigvalsh(off.mT @ off)
    return spread[..., 1] < THIN**2 * spread[..., 2]


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
    errors = []
    posing: dict[str, Any] = {"loss": chosen.loss if chosen.objective == "image" else None, "throw": False}
    for half in halves(views, target.points):
        hidden = half.hidden.expand(every.visible.shape)
        located = located_without_warning(held_out.hiding(hidden), target, fits.camera, fits, **posing)
        if bool((located.covariance.undetermined_views & located.used.any(-1)).any()):
            raise CalibrationError(f"{who}: a view that was held out has no pose: {located.message}", located)
        posed = located.used.any(-1, keepdim=True)
        errors.append(errors_of(located, every.pixels, held_out.visible & half.evaluated & posed, measure))
    return fits, errors[0].plus(errors[1])


def without_corners(
    views: Views, target: Target, distortion: LensModel, chosen: Options, measure: Loss | None = None
) -> tuple[Calibration, Errors]:
    """Two refits, each to every second corner of the views, and their errors on the others; see `without_views`."""
    every = repeated(views, 2)
    hidden, evaluated = (torch.stack(masks) for masks in zip(*halves(views, target.points), strict=True))
    fits = calibrated(every.hiding(hidden), target, distortion, chosen)
    return fits, errors_of(fits, every.pixels, every.visible & evaluated & fits.used.any(-1, keepdim=True), measure)


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


def _corners(which: Tensor, views: Views) -> Tensor:
    return which.unsqueeze(-1).expand(views.visible.shape)
