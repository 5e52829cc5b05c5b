"""Does the calibration hold on views it has not seen, and would it come out the same on others like them?

`cross_validate` refits without each part of the views in turn and measures on the part that was left out; `bootstrap`
refits on views drawn again with repetition (Efron 1979). Both solve all refits side by side, as one batch.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.calibration.calibrate import calibrate, locate
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane
from diffproj.lens.models import LensModel
from diffproj.targets.target import Target
from diffproj.targets.views import Views


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors of a calibration inside and outside of the views that it was fitted to.

    Attributes:
        fits: the k refits, as one calibration of batch shape `(k,)`.
        in_sample_px: RMS error of the fitted corners in pixels `(k,)`.
        held_out_px: the same of the corners left out, `(k,)`.
        in_sample_world: RMS distance of the fitted corners, put back on the board, from their places `(k,)`.
        held_out_world: the same of the corners left out, `(k,)`, in world units.
    """

    fits: Calibration
    in_sample_px: Float[Tensor, " k"]
    held_out_px: Float[Tensor, " k"]
    in_sample_world: Float[Tensor, " k"]
    held_out_world: Float[Tensor, " k"]

    def summary(self) -> str:
        """A table for people: each fold, and the root mean square over them."""
        columns = [self.in_sample_px, self.held_out_px, self.in_sample_world, self.held_out_world]
        lines = ["fold   fitted px   held out px   fitted world   held out world"]
        rows = [*torch.stack(columns, dim=-1).tolist(), [float(c.square().mean().sqrt()) for c in columns]]
        names = [*map(str, range(1, len(rows))), "all"]
        lines += [
            f"{n:<4} {a:11.4f} {b:13.4f} {c:14.4f} {d:16.4f}" for n, (a, b, c, d) in zip(names, rows, strict=True)
        ]
        return "\n".join(lines)


def cross_validate(
    views: Views, board: Target, distortion: LensModel = "brown5", folds: int = 5, **options: Any
) -> CrossValidation:
    """Refit without each of k parts of the views, and measure on the part that was left out.

    The pose of a view that was left out is found from every second corner and judges the others, then the other way
    round, so that no corner judges itself.

    Args:
        views: corners `(V, N, 2)` of one camera; view i is left out of fit i mod k.
        board: anything with `.points (N, 3)` on z = 0.
        distortion: the lens.
        folds: k.
        options: as `calibrate` takes them.

    Raises:
        ValueError: there are fewer views than folds, or many cameras.
        CalibrationError: a refit did not converge.

    Example:
        >>> import diffproj as dp
        >>> outcome = cross_validate(dp.example_views("left"), dp.Chessboard())
        >>> bool((outcome.held_out_px < 0.3).all())
        True
    """
    if views.batch_shape:
        raise ValueError(f"views: want those of one camera, got batch shape {tuple(views.batch_shape)}")
    if options.get("bow"):
        raise ValueError("bow: want False, for held-out views are located on a flat board")
    if not 2 <= folds <= len(views):
        raise ValueError(f"folds: want from 2 to the number of views, {len(views)}, got {folds}")
    out = torch.arange(len(views), device=views.device) % folds == torch.arange(folds, device=views.device).unsqueeze(
        -1
    )
    every = _repeated(views, folds)
    fits = calibrate(every.hiding(out.unsqueeze(-1).expand(every.visible.shape)), board, distortion, **options)
    held_out = every.hiding(~out.unsqueeze(-1).expand(every.visible.shape))
    second = torch.arange(views.pixels.shape[-2], device=views.device) % 2 == 1
    errors = []
    for judges in (second, ~second):
        located = locate(held_out.hiding(judges), board, fits.camera)
        errors.append(_squared_errors(located, held_out.hiding(~judges)))
    px, world = (_rms([error[i] for error in errors], [error[2] for error in errors]) for i in range(2))
    own = _squared_errors(fits, Views.unchecked(every.pixels, fits.used, every.names, every.size))
    return CrossValidation(fits, _rms([own[0]], [own[2]]), px, _rms([own[1]], [own[2]]), world)


def bootstrap(
    views: Views,
    board: Target,
    distortion: LensModel = "brown5",
    draws: int = 200,
    seed: int = 0,
    **options: Any,
) -> Mapping[str, Float[Tensor, ""]]:
    """Standard deviations of the shared parameters over refits to views drawn with repetition.

    They believe no model of the noise; with few views they are rough: 13 views know them to a third.

    Args:
        views: corners `(V, N, 2)` of one camera.
        board: anything with `.points (N, 3)` on z = 0.
        distortion: the lens.
        draws: how many refits.
        seed: of the draws.
        options: as `calibrate` takes them, but for `weights`, which say how often a view was drawn.

    Returns:
        The deviations by name, as `Covariance.deviations` names them. Draws that did not converge are left out.

    Raises:
        ValueError: many cameras, fewer than 2 draws, or weights.
        CalibrationError: hardly any draw determines the camera.

    Example:
        >>> import diffproj as dp
        >>> spread = bootstrap(dp.example_views("left"), dp.Chessboard(), draws=50)
        >>> 0.2 < float(spread["f_x"]) < 2.0
        True
    """
    if views.batch_shape:
        raise ValueError(f"views: want those of one camera, got batch shape {tuple(views.batch_shape)}")
    if draws < 2:
        raise ValueError(f"draws: want at least 2, got {draws}")
    if "weights" in options:
        raise ValueError("weights: want none, for they say here how often a view was drawn")
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(len(views), (draws, len(views)), generator=generator).to(views.device)
    counts = torch.nn.functional.one_hot(drawn, len(views)).sum(1).to(torch.float64)
    every = _repeated(views, draws)
    hidden = (counts == 0).unsqueeze(-1).expand(every.visible.shape)
    options |= {"weights": counts.unsqueeze(-1), "throw": False}
    found = calibrate(every.hiding(hidden), board, distortion, **options)
    kept = found.converged
    if int(kept.sum()) < max(2, draws // 2):
        raise CalibrationError(f"bootstrap: {int(kept.sum())} of {draws} draws determine the camera; add views", found)
    return dict(zip(found.parameters.names, found.shared[kept].std(0).unbind(), strict=True))


def _repeated(views: Views, count: int) -> Views:
    """The same views for many cameras side by side."""
    pixels = views.pixels.expand(count, *views.pixels.shape)
    return Views.unchecked(pixels, views.visible.expand(count, *views.visible.shape), views.names, views.size)


def _squared_errors(calibration: Calibration, judged: Views) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of squared errors `(k,)` in pixels and in world units over the corners that are judged, and their number."""
    projected, valid = calibration.cameras.project(calibration.board_points.unsqueeze(-3))
    pixels = judged.pixels.to(projected)
    landed, on_plane = back_project(pixels, calibration.cameras, Plane.z(0.0))
    counts = judged.visible & valid & on_plane
    px = (projected - pixels).square().sum(-1)
    world = (landed - calibration.points)[..., :2].square().sum(-1)
    total = [torch.where(counts, part, 0.0).sum((-2, -1)) for part in (px, world)]
    return total[0], total[1], counts.sum((-2, -1))


def _rms(sums: list[Tensor], counts: list[Tensor]) -> Tensor:
    return (torch.stack(sums).sum(0) / torch.stack(counts).sum(0)).sqrt()
