"""What whoever measures has to say, for nothing else tells it: which view the pixels are in, and how good they are."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from diffproj._core.arguments import Array, first_of
from diffproj._core.numerics import check_tensor
from diffproj._core.warn import warn_caller
from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results import ambiguity, left_out, mismatch
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.mismatch import CameraMismatchWarning

PixelSigma = float | Tensor | Array | Literal["detector"] | None
"""A number of pixels, one or two or a covariance for each pixel; `"detector"` stands for that of the calibration's
corners, and `None` was not said."""

HAND_PX = 0.5
"""Standard deviation of a coordinate that a hand picked on a screen."""
SHOWN = 3
"""Names of views in a message."""


class PixelNoiseWarning(UserWarning):
    """Pixels were measured without a word on how good they are, and count as found by the corner detector."""


def chosen_view(calibration: Calibration, view: int | str | None) -> int | str:
    """The view that was asked for; the only one where nothing was said.

    Raises:
        ValueError: nothing was said, and there are several.
    """
    if view is not None:
        return view
    names = calibration.views.names
    if len(names) == 1:
        return 0
    listed = ", ".join(map(repr, names[:SHOWN])) + (", ..." if len(names) > SHOWN else "")
    raise ValueError(
        f"view: want one of the calibration's {len(names)} views, in whose photograph the pixels are, by number or "
        f"name (0 to {len(names) - 1}; {listed}), got none; in a new photograph, measure with what dp.locate finds"
    )


def detector_noise(calibration: Calibration, view: int) -> Tensor | None:
    """The standard deviation of a corner's coordinate in a view `(*B,)`; `None` where it is not known.

    That of all corners; where the calibration does not fit the view, that view's own if it is larger.
    """
    level = calibration.pixel_sigma
    doubtful = calibration.mismatch.doubtful[..., view]
    if level is None or not bool(doubtful.any()):
        return level
    count = calibration.used[..., view, :].sum(-1)
    own = calibration.view_rms[..., view] * (count / (2 * count - POSE).clamp(min=1)).sqrt()
    return torch.where(doubtful, own.maximum(level), level)


def pixel_noise(
    pixels: Tensor, pixel_sigma: PixelSigma, calibration: Calibration | None, view: int
) -> tuple[float | Tensor | Array, bool]:
    """The standard deviation of the pixels' coordinates, and whether the calibration's residuals told it.

    Where nothing was said, a warning says what was taken, unless the pixels are corners that the view was given with.

    Raises:
        ValueError: the calibration does not know the noise, or it is a word that means nothing.
    """
    if isinstance(pixel_sigma, str) and pixel_sigma != "detector":
        raise ValueError(f"pixel_sigma: want px, or 'detector' for the noise of the corners, got {pixel_sigma!r}")
    if not isinstance(pixel_sigma, str | None):
        return pixel_sigma, False
    level = None if calibration is None else detector_noise(calibration, view)
    if calibration is None or level is None:
        source = "a camera alone" if calibration is None else "this calibration"
        raise ValueError(
            f"pixel_sigma: want the noise of the pixels in px, for {source} does not know it: {HAND_PX:g} for points "
            "that a hand picked"
        )
    if pixel_sigma is None and not _are_corners(pixels, calibration.views.pixels[..., view, :, :]):
        warn_caller(
            f"measure: pixel_sigma was left out, so the pixels count as found by the corner detector, to "
            f"{float(level.detach().amax()):.2g} px in each coordinate; say pixel_sigma='detector' if they are, or how "
            f"good they are: {HAND_PX:g} for points that a hand picked",
            PixelNoiseWarning,
        )
    return level.unsqueeze(-1), True


def doubts(calibration: Calibration, view: int) -> str:
    """What makes the pose of a view doubtful, in words; with a warning where it does not fit the calibration."""
    only, name = slice(view, view + 1), calibration.views.names[view : view + 1]
    found = mismatch.Mismatch(*(part[..., only] for part in calibration.mismatch))
    misfit = mismatch.described(found, name, calibration.lens_region is not None)
    if misfit:
        warn_caller(f"measure: {misfit}", CameraMismatchWarning)
    if isinstance(calibration, Adjustment):
        return "; ".join(filter(None, [misfit, calibration.doubts]))
    two = ambiguity.described(calibration.ambiguous[..., only], name) if calibration.has_alternatives else ""
    points = "corners" if calibration.landmarks is None else "landmarks"
    robust = calibration.discounted is not None
    few = left_out.described(
        calibration.counting[..., only, :], calibration.left_out[..., only, :], name, points, robust
    )
    return "; ".join(filter(None, [misfit, two, few, calibration.contradiction]))


def _are_corners(pixels: Tensor, corners: Tensor) -> bool:
    """Whether all pixels `(*B, N, 2)` are among the corners `(*B, M, 2)` of the view."""
    if pixels.shape[-2] > corners.shape[-2] or pixels.ndim > corners.ndim:
        return False
    same = (pixels.detach().unsqueeze(-2) == corners.detach().to(pixels).unsqueeze(-3)).all(-1)
    return bool(same.any(-1).all())


def deviation_matrices(pixel_sigma: float | Tensor | Array, points: Tensor) -> Tensor:
    """A matrix L `(*B, N, 2, 2)` for each pixel, whose error is L times two independent ones of deviation 1.

    Args:
        pixel_sigma: a number, `(*B, N)` or `(*B, N, 2)` deviations, or `(*B, N, 2, 2)` covariances.
        points: `(*B, N, 3)`, whose shape counts. What fits one deviation for each pixel is that, not two.

    Raises:
        TypeError: no numbers.
        ValueError: a shape that does not fit, or what is no deviation and no covariance.
    """
    given = check_tensor("pixel_sigma", pixel_sigma, like=points)
    if given.is_meta:
        raise ValueError("pixel_sigma: want values, got a tensor on the device meta")
    given = given.to(points)
    *batch, N = points.shape[:-1]
    if _may_be_either(given.detach(), N, len(batch)):
        want = (*batch, N, 2, 2)
        raise ValueError(
            f"pixel_sigma: want deviations or covariances, got shape {tuple(given.shape)}, which fits deviations, and "
            f"values that a covariance has; give covariances as {want}"
        )
    if _expands(given.shape, (*batch, N)):
        _check_deviations(given.detach())
        each = given.expand(*batch, N)
        return torch.diag_embed(torch.stack([each, each], dim=-1))
    if given.shape[-2:] == (N, 2) and _expands(given.shape, (*batch, N, 2)):
        _check_deviations(given.detach())
        return torch.diag_embed(given.expand(*batch, N, 2))
    if given.shape[-2:] == (2, 2) and given.ndim >= 3 and _expands(given.shape, (*batch, N, 2, 2)):
        return _root2(given).expand(*batch, N, 2, 2)
    want = (*batch, N)
    raise ValueError(
        f"pixel_sigma: want a number or a shape that broadcasts to {want}, {(*want, 2)} or {(*want, 2, 2)}, got "
        f"{tuple(given.shape)}"
    )


def _may_be_either(given: Tensor, count: int, axes: int) -> bool:
    """Whether it has the shape of deviations of two pixels, and is a covariance of u and v besides: nobody can tell.

    Where all are alike they are deviations: as a covariance they would say that u and v err alike.
    """
    if given.shape[-2:] != (2, 2) or count != 2 or given.ndim - axes > 2:
        return False
    a, b, c, d = given.flatten(-2).unbind(-1)
    return bool(((b == c) & (b * c < a * d)).all())


def _expands(shape: Sequence[int], to: Sequence[int]) -> bool:
    pairs = zip(reversed(shape), reversed(to), strict=False)
    return len(shape) <= len(to) and all(mine in (1, theirs) for mine, theirs in pairs)


def _check_deviations(given: Tensor) -> None:
    wrong = ~((given >= 0) & given.isfinite())
    if bool(wrong.any()):
        raise ValueError(f"pixel_sigma: want finite standard deviations of at least 0, got {first_of(given, wrong)}")


def _root2(covariance: Tensor) -> Tensor:
    """Lower triangular matrices L `(*, 2, 2)` with `L L^T` the covariance, with slopes."""
    seen = covariance.detach()
    size = seen.abs().amax((-2, -1))
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    even = size.isfinite() & ((seen - seen.mT).abs().amax((-2, -1)) <= 1e-6 * size)
    wrong = ~even | (a < 0) | (c < 0) | (a * c - b * b < -1e-6 * size.square())
    if bool(wrong.any()):
        raise ValueError(
            f"pixel_sigma: want symmetric covariances without negative eigenvalues, got {first_of(seen, wrong)}"
        )
    first = torch.where(a > 0, torch.where(a > 0, a, 1.0).sqrt(), 0.0)
    across = torch.where(a > 0, b / torch.where(a > 0, first, 1.0), 0.0)
    rest = c - across.square()
    second = torch.where(rest > 0, torch.where(rest > 0, rest, 1.0).sqrt(), 0.0)
    rows = [torch.stack([first, torch.zeros_like(first)], dim=-1), torch.stack([across, second], dim=-1)]
    return torch.stack(rows, dim=-2)
