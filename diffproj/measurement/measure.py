"""Measuring on a plane with error bars: points, lengths, angles and areas, and how sure each of them is.

A pixel uv at the plane's point X satisfies `project(X, theta) = uv`, where theta are the camera's shared parameters and
the pose of its view. With T a basis of the plane's two directions, `J = d uv / d X` and an uncertain plane `n . X = d`,

    dX = T (J T)^-1 (d uv - (d uv / d theta) d theta)  +  (I - T (J T)^-1 J) n / |n|^2 (d d - X . d n)

so that the covariance of all points together is

    C_ij = G_i Sigma G_j^T  +  [i = j] D_i S_i D_i^T

with `D = dX / d uv`, S the covariance of a pixel, G the derivative by theta and by the plane, and Sigma their joint
covariance: the calibration's, with its correlations between intrinsics and pose, and the plane's where one is given. A
quantity of some of the points has the variance `g^T C g`, g its gradient. This is first order: sampling agrees as long
as standard deviations are small beside the distance. Beyond, `interval` follows the curve, and `lens_reach` tells how
much less is known where the lens is extrapolated. The covariance of all pairs of points is computed only where it is
asked for (`joint`).

Where a view's pose may be the wrong one of two, the other is too far away for that: see `doubt.py`.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj._core.numerics import broadcast_batches, check_not_mapped, check_tensor, in_float64, inverse2, transform
from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.evidence.observations import Seen
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.region import in_region
from diffproj.geometry.back_projection import back_project, warn_if_rounded
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.grid import warn_if_off_image
from diffproj.geometry.intrinsics import pixel_to_normalized
from diffproj.geometry.plane import Plane, as_plane
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.slopes import by_direction
from diffproj.measurement import lens_reach
from diffproj.measurement.choices import PixelSigma, chosen_view, deviation_matrices, doubts, pixel_noise
from diffproj.measurement.doubt import of_the_pose
from diffproj.measurement.measurement import Measurement
from diffproj.measurement.propagation import Noise
from diffproj.measurement.sight import Sight
from diffproj.targets.views import view_number

LOST = 1e100
"""Derivatives of a point, in world units, from which on squares may overflow: nothing is known of where it is."""


def measure(
    pixels: Float[Tensor, "*#batch n 2"] | Array,
    calibration: Calibration | Camera | PinholeCamera,
    plane: Plane,
    view: int | str | None = None,
    pixel_sigma: PixelSigma = None,
    plane_covariance: Float[Tensor, "*#batch 4 4"] | Array | None = None,
) -> Measurement:
    """Measure pixels on a plane, with error bars.

    Args:
        pixels: `(*B, N, 2)`, in the photograph of that view.
        calibration: of batch shape `*B`, from `calibrate` or `refine`, or from `locate` for a new photograph; or a
            camera at its pose, whose own uncertainty is then not included.
        plane: in the frame of the board that the view saw.
        view: the number or the name of the view whose pose holds, in whose photograph the pixels are; may be left out
            where there is one only.
        pixel_sigma: how far off the measured pixels are, in px: the standard deviation of both coordinates, a number or
            `(*B, N)`, that of u and v `(*B, N, 2)`, or their covariance in squared px `(*B, N, 2, 2)`. About 0.5 for
            points that a hand picked; for the foot of a detector's box a share of its width and height. `"detector"`
            stands for that of the calibration's corners, as its residuals tell it. It is that if left out, too, with a
            `PixelNoiseWarning` unless the pixels are corners of that view.
        plane_covariance: of the plane's normal and offset as they are given, `(*B, 4, 4)`; exact if left out.

    Returns:
        The measured points, in float64; gradients flow to pixels, plane, sigma and, where they carry one, the camera.
        A calibration's covariance, and how much larger deviations are where the lens is extrapolated, count as given.
        In a photograph that the calibration does not fit, as one of another camera, zoom or focus, deviations are as
        much larger as it takes to explain its corners; `doubts` and a `CameraMismatchWarning` say so. A warning tells
        points that are seen beyond the photograph, where the camera knows its size.

    Raises:
        TypeError: not pixels, a calibration or a camera, and a plane in this order, or another argument is of the wrong
            kind.
        ValueError: no such view, none said of several, a camera without `pixel_sigma`, or shapes, devices or values
            that cannot be, or cannot be read under `torch.func.vmap`.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> ends = calibration.views.pixels[0, [0, 8]]
        >>> length = dp.measure(ends, calibration, dp.Plane.z(0.0), view=0, pixel_sigma="detector").lengths()
        >>> print(f"{length.value[0]:.1f} ± {length.deviation[0]:.1f} mm")
        199.9 ± 0.2 mm
    """
    given = pixels, calibration, plane, pixel_sigma, plane_covariance
    check_not_mapped("measure", "pixels, cameras and planes take batch axes (*B), which one call measures", *given)
    pixels, plane = in_float64(check_tensor("pixels", pixels, "N", 2)), as_plane(plane)
    known, middle, doubtful, number, posed = None, None, "", 0, None
    if isinstance(calibration, Calibration):
        number = view_number(chosen_view(calibration, view), calibration.views.names)
        camera, known, middle = at_view(calibration, number)
        posed = calibration.posed[..., number]
        parameters = calibration.parameters.of_camera
        doubtful = doubts(calibration, number)
    else:
        camera = as_camera(calibration, "calibration").upright()
        parameters = Parametrisation.of(camera)
    noise, estimated = pixel_noise(
        pixels, pixel_sigma, calibration if isinstance(calibration, Calibration) else None, number
    )
    warn_if_rounded(camera, plane)
    camera = camera.to(torch.float64)
    plane = plane.like(camera.K).to(torch.float64)
    if plane_covariance is not None:
        plane_covariance = check_tensor("plane_covariance", plane_covariance, 4, 4)
        if plane_covariance.device != camera.device:
            raise ValueError(f"plane_covariance: want device {camera.device}, got {plane_covariance.device}")
        _check_covariance(plane_covariance.detach())
        if plane.is_per_point:
            raise ValueError("plane_covariance: want one plane for all points, got one for each (Plane.per_point)")
        many = broadcast_batches(pixels=pixels.shape[:-2], plane_covariance=plane_covariance.shape[:-2])
        pixels = pixels.expand(*many, *pixels.shape[-2:])
    points, valid = back_project(pixels, camera, plane)
    if posed is not None:
        valid = valid & posed.unsqueeze(-1)
        points = torch.where(valid.unsqueeze(-1), points, 0.0)
    warn_if_off_image("measure", pixels, valid, camera.size)
    batch = points.shape[:-2]
    sigma = deviation_matrices(noise, points)
    by_theta, by_point = _projection_derivatives(pixels, points, valid, camera, parameters, known, middle)
    tangents = plane.tangents()
    T = (tangents if plane.is_per_point else tangents.unsqueeze(-3)).expand(*points.shape, 2)  # (*B, N, 3, 2)
    D = torch.where(valid[..., None, None], T @ inverse2(by_point @ T), 0.0)
    lost = valid & ~((D.abs().sum((-2, -1)) > 0) & ((D @ by_theta).abs().sum((-2, -1)) < LOST))
    if bool(lost.any()):
        D, by_theta, by_point = (torch.where(lost[..., None, None], 0.0, z) for z in (D, by_theta, by_point))
    region = calibration.region if isinstance(calibration, Calibration) else None
    blocks, covariances = [-D @ by_theta], [D.new_zeros(*batch, 0, 0) if known is None else known]
    beyond = lost
    if region is not None and known is not None:
        extrapolated = valid & ~in_region(pixels, region)
        factor = lens_reach.stretch(extrapolated, pixels, points, camera, parameters, plane, known, middle, blocks[0])
        beyond = lost | factor.isinf()
        factor = torch.where(factor.isinf(), 1.0, factor)[..., None, None]
        blocks, by_theta = [factor * blocks[0]], factor * by_theta
    if plane_covariance is not None:
        n = plane.unit_normal.unsqueeze(-2).expand_as(points)
        lift = n / plane.length[..., None, None]
        lift = lift - (D @ (by_point @ lift.unsqueeze(-1))).squeeze(-1)
        with_offset = torch.cat([-points, torch.ones_like(points[..., :1])], dim=-1)
        blocks.append(lift.unsqueeze(-1) * with_offset.unsqueeze(-2))
        covariances.append(in_float64(plane_covariance))
    away = [points.new_zeros(*points.shape, 0)]
    if isinstance(calibration, Calibration) and calibration.has_alternatives:
        doubt = of_the_pose(pixels, calibration, number, plane, points, valid)
        away, covariances = [doubt.columns], [*covariances, doubt.covariance]
    if bool(beyond.any()):  # a parameter of which nothing is known, and no two points follow it alike
        unlike = torch.linspace(1, 2, points.shape[-2], dtype=points.dtype, device=points.device).unsqueeze(-1)
        away.append(torch.where(beyond.unsqueeze(-1), unlike * T.abs().sum(-1), 0.0).unsqueeze(-1))
        covariances.append(D.new_full((1, 1), torch.inf))
    beside = torch.cat(away, dim=-1)
    common = torch.where(valid[..., None, None], torch.cat([*blocks, beside], dim=-1), 0.0)
    rig = calibration.rig if isinstance(calibration, Calibration) else None
    sight = Sight(
        pixels.expand(*batch, *pixels.shape[-2:]),
        sigma,
        camera,
        plane,
        by_theta,
        beside,
        rig,
        _uncertain_landmarks(calibration),
    )
    errors = Noise(
        sight,
        common,
        _block_diagonal(covariances, batch),
        D @ sigma,
        _degrees_of_freedom(calibration, like=points),
        pixels_too=estimated,
    )
    includes_intrinsics = isinstance(calibration, Calibration) and known is not None and calibration.knows_intrinsics
    return Measurement(points, valid, includes_intrinsics, errors, region, doubtful)


def _degrees_of_freedom(calibration: Calibration | Camera | PinholeCamera, like: Tensor) -> Tensor:
    """Of the calibration's residual level, from which the scale of its covariance is taken, `(*B,)`."""
    found = calibration.degrees_of_freedom if isinstance(calibration, Calibration) else None
    return like.new_full(like.shape[:-2], torch.inf) if found is None else found.to(like).expand(like.shape[:-2])


def at_view(calibration: Calibration, number: int) -> tuple[Camera, Tensor | None, Tensor | None]:
    """The camera at the pose of a view, the covariance of both, and the point `(3,)` that the pose turns about in it.

    Of many cameras some may have no pose, for they used no corner of the view. What is not known is `None`. The
    covariance is larger where the calibration does not fit the view.
    """
    if not bool(calibration.posed[..., number].any()):
        name = calibration.views.names[number]
        raise ValueError(f"view: want one whose pose is known, got {number} ({name}), which nothing tells")
    known, middle = None, None
    if calibration.has_covariance:
        covariance = calibration.covariance_of_kept_poses
        known, middle = covariance.about_middle.view(number), covariance.middle
        known = calibration.mismatch.scale[..., number, None, None].square() * known
        # The shape is that of the target that was calibrated on, and not of what is measured.
        few, last = calibration.parameters.of_camera.size, known.shape[-1] - POSE
        rows = torch.tensor([*range(few), *range(last, last + POSE)], device=known.device)
        known = known[..., rows.unsqueeze(-1), rows]
    return calibration.cameras[..., number], known, middle


def _check_covariance(given: Tensor) -> None:
    size = given.abs().amax((-2, -1), keepdim=True)
    sound = given.isfinite().all() and bool(((given - given.mT).abs() <= 1e-6 * size).all())
    if not sound or bool((torch.linalg.eigvalsh(in_float64(given)) < -1e-6 * size.squeeze(-1)).any()):
        raise ValueError("plane_covariance: want a symmetric matrix without negative eigenvalues, got another")


def _projection_derivatives(
    pixels: Tensor,
    points: Tensor,
    valid: Tensor,
    camera: Camera,
    parameters: Parametrisation,
    known: Tensor | None,
    middle: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Derivatives of the pixels by theta `(*B, N, 2, s + 6)` and by the point `(*B, N, 2, 3)`.

    The pose turns about `middle (3,)`: about a distant origin a turn and a shift would nearly cancel. Where a point is
    not valid, they are those of some other point.
    """
    R, lens = camera.R.unsqueeze(-3), camera.distortion
    arm = _product(R, points if middle is None else points - middle)
    direction = _product(R, points) + camera.t.unsqueeze(-2)
    axis = torch.tensor([0.0, 0, 1], dtype=points.dtype, device=points.device)
    direction = torch.where(valid.unsqueeze(-1), direction, axis)
    F = camera.K[..., None, :2, :2].expand(*points.shape[:-1], 2, 2)
    by_camera_point = F @ by_direction(lens, direction)
    by_point = by_camera_point @ R
    if known is None:
        return by_point[..., :0], by_point
    center = camera.K[..., None, :2, 2]
    offset = torch.where(valid.unsqueeze(-1), pixels - center, 0.0)
    xy = transform(pixel_to_normalized(camera.K), offset)
    columns = [torch.diag_embed(xy), torch.eye(2, dtype=F.dtype, device=F.device).expand_as(F)]
    if isinstance(lens, CoefficientLens):
        columns.append(F @ lens.by_coefficients(direction))
    if parameters.skew:
        columns.append(torch.nn.functional.pad(xy[..., 1:, None], (0, 0, 0, 1)))
    turn = torch.linalg.cross(arm.unsqueeze(-2), by_camera_point)  # g . (omega x arm) = omega . (arm x g)
    return torch.cat([*columns, turn, by_camera_point], dim=-1), by_point


def _product(matrix: Tensor, vectors: Tensor) -> Tensor:
    return (matrix @ vectors.unsqueeze(-1)).squeeze(-1)


def _block_diagonal(blocks: list[Tensor], batch: Sequence[int]) -> Tensor:
    size = sum(block.shape[-1] for block in blocks)
    rows, start = [], 0
    for block in blocks:
        block = block.expand(*batch, *block.shape[-2:])
        rows.append(torch.nn.functional.pad(block, (start, size - start - block.shape[-1])))
        start += block.shape[-1]
    return torch.cat(rows, dim=-2)


def _uncertain_landmarks(calibration: object) -> frozenset[tuple[float, ...]]:
    """Where the landmarks are that a camera was found by and that are uncertain themselves."""
    if isinstance(calibration, Adjustment):
        seen_by = [one for one in calibration.observations if isinstance(one, Seen)]
        return frozenset().union(*(one.uncertain_places() for one in seen_by))
    if not isinstance(calibration, Calibration) or calibration.uncertain is None:
        return frozenset()
    seen = calibration.uncertain & calibration.used.flatten(0, -2).any(0)
    return frozenset(map(tuple, calibration.nominal[seen].tolist()))
