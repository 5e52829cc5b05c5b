"""Measuring on a plane with error bars: points, lengths, angles and areas, and how sure each of them is.

A pixel uv at the plane's point X satisfies `project(X, theta) = uv`, where theta are the camera's shared parameters and
the pose of its view. With T a basis of the plane's two directions, `J = d uv / d X` and an uncertain plane `n . X = d`,

    dX = T (J T)^-1 (d uv - (d uv / d theta) d theta)  +  (I - T (J T)^-1 J) n / |n|^2 (d d - X . d n)

so that the covariance of all points together is

    C_ij = G_i Sigma G_j^T  +  [i = j] sigma_i^2 D_i D_i^T

with `D = dX / d uv`, G the derivative by theta and by the plane, and Sigma their joint covariance: the calibration's,
with its correlations between intrinsics and pose, and the plane's where one is given. A quantity of some of the points
has the variance `g^T C g`, g its gradient. This is first order: sampling agrees as long as standard deviations are
small beside the distance. The covariance of all pairs of points is computed only where it is asked for (`joint`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.numerics import check_tensor, in_float64
from diffproj.calibration.covariance import zero_where_infinite
from diffproj.calibration.parametrisation import Parametrisation, moved
from diffproj.calibration.result import Calibration
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.float32 import warn_if_rounded
from diffproj.geometry.plane import Plane

SIGNIFICANT = 3.0
"""How many standard deviations a value has to be away from 0 to be told from it."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """Measured values with their standard deviations.

    Attributes:
        value: `(*B, M)`; NaN where a point that it needs is not valid.
        deviation: standard deviation `(*B, M)` in the unit of the value; infinite where the calibration does not
            determine it.
    """

    value: Float[Tensor, "*shape"]
    deviation: Float[Tensor, "*shape"]

    def interval(self, level: float = 0.95) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
        """Lower and upper bounds between which the truth lies with that probability, for Gaussian noise.

        Raises:
            ValueError: the level is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise ValueError(f"level: want a probability between 0 and 1, got {level}")
        reach = float(torch.special.ndtri(torch.tensor((1 + level) / 2, dtype=torch.float64)))
        return self.value - reach * self.deviation, self.value + reach * self.deviation

    @property
    def significant(self) -> Bool[Tensor, "*shape"]:
        """Whether the value is at least three of its standard deviations from 0; false where both are 0."""
        return (self.value.abs() >= SIGNIFICANT * self.deviation) & (self.value != 0)


@dataclass(frozen=True, eq=False)
class Measurement:
    """Points measured on a plane, with their joint covariance.

    Attributes:
        points: `(*B, N, 3)` in world units.
        valid: `(*B, N)`, as `back_project` gives it.
        includes_intrinsics: whether the standard deviations include the uncertainty of focal lengths, principal point
            and lens. They do for a calibration with its covariance. For a camera alone, or a calibration from a file
            without a covariance, they hold the pixels' noise only; for a pose that `locate` found with a camera alone,
            the pixels' noise and the pose's uncertainty.
    """

    points: Float[Tensor, "*batch n 3"]
    valid: Bool[Tensor, "*batch n"]
    includes_intrinsics: bool
    _common: Tensor  # G (*B, N, 3, Q)
    _sigma: Tensor  # Sigma (*B, Q, Q), infinite on the diagonal only
    _own: Tensor  # sigma_i D_i (*B, N, 3, 2)

    @property
    def covariance(self) -> Float[Tensor, "*batch n 3 3"]:
        """The covariance of each point `(*B, N, 3, 3)` in squared world units; infinite where it is not determined."""
        C = self._common @ zero_where_infinite(self._sigma).unsqueeze(-3) @ self._common.mT + self._own @ self._own.mT
        return _without(C, self._unknown(self._common))

    @property
    def deviations(self) -> Float[Tensor, "*batch n 3"]:
        """The standard deviations of each point's coordinates `(*B, N, 3)` in world units."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()

    def joint(self) -> Float[Tensor, "*batch all all"]:
        """The covariance of all coordinates together, `(*B, 3 N, 3 N)`, points in order."""
        G = self._common.flatten(-3, -2)
        own = self._own @ self._own.mT
        N = own.shape[-3]
        apart = torch.eye(N, dtype=own.dtype, device=own.device)[:, None, :, None]
        blocks = (own.unsqueeze(-2) * apart).flatten(-2).flatten(-3, -2)
        C = G @ zero_where_infinite(self._sigma) @ G.mT + blocks
        return _without(C, self._unknown(G))

    def quantity(self, function: Callable[[Tensor], Tensor], which: Sequence[Sequence[int]] | Tensor) -> Quantity:
        """Any number that depends on a few of the points, with its standard deviation.

        Args:
            function: takes k points `(k, 3)` to a number; written with PyTorch's functions, so that it has a gradient.
            which: the numbers of the k points of each of M quantities, `(M, k)`.

        Raises:
            IndexError: there is no such point.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> measured = dp.measure(calibration.views.pixels[0, :3], calibration, dp.Plane.z(0.0))
            >>> middle = measured.quantity(lambda p: p.mean(dim=0)[0], [[0, 1, 2]])
            >>> print(f"{middle.value[0]:.1f} mm")  # x of the centroid of three corners in a row
            25.0 mm
        """
        index, N = torch.as_tensor(which, device=self.points.device), self.points.shape[-2]
        if index.ndim != 2 or index.is_floating_point():
            raise ValueError(f"which: want the numbers of k points for each of M quantities, got {tuple(index.shape)}")
        if bool(((index < -N) | (index >= N)).any()):
            raise IndexError(f"which: want numbers of the {N} points, got {index.flatten().tolist()}")
        index = index % N
        k = index.shape[-1]
        chosen = self.points[..., index, :]  # (*B, M, k, 3)
        flat = chosen.reshape(-1, k, 3)
        gradient, value = torch.func.vmap(torch.func.grad_and_value(function))(flat)
        gradient, value = gradient.reshape(chosen.shape), value.reshape(chosen.shape[:-2])
        g = gradient.unsqueeze(-1)
        common = (self._common[..., index, :, :] * g).sum((-3, -2))  # (*B, M, Q)
        own = (self._own[..., index, :, :] * g).sum(-2)  # (*B, M, k, 2): points named twice count together
        same = (index.unsqueeze(-1) == index.unsqueeze(-2)).to(own.dtype)
        noise = (own * (same @ own)).sum((-2, -1))
        variance = ((common @ zero_where_infinite(self._sigma)) * common).sum(-1) + noise
        variance = torch.where(self._unknown(common.unsqueeze(-2)).squeeze(-1).squeeze(-1), torch.inf, variance)
        valid = self.valid[..., index].all(-1)
        # The root's slope at 0 is infinite: the length between a point and itself has deviation 0 and zero gradient.
        known = valid & (variance > 0)
        deviation = torch.where(known, torch.where(known, variance, 1.0).sqrt(), 0.0)
        return Quantity(torch.where(valid, value, torch.nan), torch.where(valid, deviation, torch.nan))

    def lengths(self, pairs: Sequence[Sequence[int]] | Tensor | None = None) -> Quantity:
        """Distances between points in world units: of successive points, or of `pairs (M, 2)`."""
        return self.quantity(_length, self._successive(2) if pairs is None else _sets("pairs", pairs, 2))

    def angles(self, triples: Sequence[Sequence[int]] | Tensor | None = None) -> Quantity:
        """Angles at the second of three points in radians: of successive points, or of `triples (M, 3)`."""
        return self.quantity(_angle, self._successive(3) if triples is None else _sets("triples", triples, 3))

    def area(self, corners: Sequence[int] | None = None) -> Quantity:
        """The area of the polygon with these corners in order (all points if left out), in squared world units.

        Parts of an outline that crosses itself cancel.
        """
        every = list(range(self.points.shape[-2])) if corners is None else list(corners)
        return self.quantity(_area, [every])

    def summary(self) -> str:
        """Points and successive lengths with their standard deviations, as a text for people; for one camera.

        Raises:
            ValueError: there are many cameras.
        """
        if self.points.ndim > 2:
            raise ValueError(f"summary: want one camera, got batch shape {tuple(self.points.shape[:-2])}")
        lines = []
        for n, (point, deviation, valid) in enumerate(
            zip(self.points.tolist(), self.deviations.tolist(), self.valid.tolist(), strict=True)
        ):
            texts = (f"{x:10.3f} ± {s:.3f}" for x, s in zip(point, deviation, strict=True))
            lines.append(f"point {n:<3} {'  '.join(texts) if valid else 'not on the plane'}")
        if len(lines) > 1:
            found = self.lengths()
            rows = zip(found.value.tolist(), found.deviation.tolist(), found.significant.tolist(), strict=True)
            for n, (length, deviation, significant) in enumerate(rows):
                note = "" if significant else "  less than three deviations from 0"
                lines.append(f"{n} to {n + 1:<4} {length:10.3f} ± {deviation:.3f}{note}")
        if not self.includes_intrinsics:
            known = "pixels and the pose" if self._sigma.shape[-1] else "pixels alone"
            lines.append(f"The deviations hold the noise of the {known}: the camera came without a covariance.")
        return "\n".join(lines)

    def _successive(self, k: int) -> Tensor:
        N = self.points.shape[-2]
        if k > N:
            raise ValueError(f"points: want at least {k}, got {N}")
        return torch.arange(N - k + 1).unsqueeze(-1) + torch.arange(k)

    def _unknown(self, rows: Tensor) -> Tensor:
        """Which rows `(..., r, Q)` depend on what the calibration does not determine, `(..., r, 1)`."""
        lost = self._sigma.diagonal(dim1=-2, dim2=-1).isinf()
        while lost.ndim < rows.ndim - 1:
            lost = lost.unsqueeze(-2)
        return (rows.abs() * lost.unsqueeze(-2)).sum(-1, keepdim=True) > 0


def measure(
    pixels: Float[Tensor, "*#batch n 2"],
    calibration: Calibration | Camera | PinholeCamera,
    plane: Plane,
    view: int | str = 0,
    pixel_sigma: float | Tensor | None = None,
    plane_covariance: Float[Tensor, "*#batch 4 4"] | None = None,
) -> Measurement:
    """Measure pixels on a plane, with error bars.

    Args:
        pixels: `(*B, N, 2)`, in the photograph of that view.
        calibration: of batch shape `*B`, from `calibrate` or `refine`, or from `locate` for a new photograph; or a
            camera at its pose, whose own uncertainty is then not included.
        plane: in the frame of the board that the view saw.
        view: the number or the name of the view whose pose holds.
        pixel_sigma: standard deviation of each coordinate of the measured pixels, a number or `(*B, N)`; the
            calibration's residual level if left out.
        plane_covariance: of the plane's normal and offset as they are given, `(*B, 4, 4)`; exact if left out.

    Returns:
        The measured points, in float64; gradients flow to pixels, plane, sigma and, where they carry one, the camera.

    Raises:
        ValueError: no such view, or a camera without `pixel_sigma`.
        TypeError: `pixels` are no floating-point tensor.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> ends = calibration.views.pixels[0, [0, 8]]
        >>> length = dp.measure(ends, calibration, dp.Plane.z(0.0)).lengths()
        >>> print(f"{length.value[0]:.1f} ± {length.deviation[0]:.1f} mm")
        199.9 ± 0.2 mm
    """
    pixels = in_float64(check_tensor("pixels", pixels, "N", 2))
    if isinstance(calibration, Calibration):
        camera, known, level = _at_view(calibration, view)
        parameters = replace(calibration.parameters, bow=False)
    else:
        camera, known, level = as_camera(calibration).upright(), None, None
        parameters = Parametrisation.of(camera)
    if pixel_sigma is None and level is None:
        source = "this calibration" if isinstance(calibration, Calibration) else "a camera alone"
        raise ValueError(f"pixel_sigma: want the noise of the pixels, for {source} does not know it")
    warn_if_rounded(camera, plane)
    camera, plane = camera.to(torch.float64), plane.to(torch.float64)
    points, valid = back_project(pixels, camera, plane)
    batch = points.shape[:-2]
    sigma = _expanded(level if pixel_sigma is None else pixel_sigma, like=points)
    by_theta, by_point = _projection_derivatives(points, camera, parameters, known)
    tangents = plane.tangents()
    T = (tangents if plane.is_per_point else tangents.unsqueeze(-3)).expand(*points.shape, 2)  # (*B, N, 3, 2)
    D = torch.where(valid[..., None, None], T @ _inverse2(by_point @ T), 0.0)
    blocks, covariances = [-D @ by_theta], [torch.zeros(*batch, 0, 0).to(D) if known is None else known]
    if plane_covariance is not None:
        plane_covariance = check_tensor("plane_covariance", plane_covariance, 4, 4)
        if plane.is_per_point:
            raise ValueError("plane_covariance: want one plane for all points, got one for each (Plane.per_point)")
        n = plane.normal.unsqueeze(-2).expand_as(points)
        lift = n / n.square().sum(-1, keepdim=True)
        lift = lift - (D @ (by_point @ lift.unsqueeze(-1))).squeeze(-1)
        with_offset = torch.cat([-points, torch.ones_like(points[..., :1])], dim=-1)
        blocks.append(lift.unsqueeze(-1) * with_offset.unsqueeze(-2))
        covariances.append(in_float64(plane_covariance))
    common = torch.where(valid[..., None, None], torch.cat(blocks, dim=-1), 0.0)
    own = sigma[..., None, None] * D
    includes_intrinsics = isinstance(calibration, Calibration) and known is not None and calibration.knows_intrinsics
    return Measurement(points, valid, includes_intrinsics, common, _block_diagonal(covariances, batch), own)


def _sets(name: str, which: Sequence[Sequence[int]] | Tensor, k: int) -> Tensor:
    index = torch.as_tensor(which)
    if index.ndim != 2 or index.shape[-1] != k:
        raise ValueError(f"{name}: want point numbers of shape (M, {k}), got {tuple(index.shape)}")
    return index


def view_number(calibration: Calibration, view: int | str) -> int:
    """The number of a view, from 0, by its number or its name."""
    names = calibration.views.names
    if isinstance(view, str):
        if view not in names:
            raise ValueError(f"view: want one of {', '.join(names)}, got {view!r}")
        return names.index(view)
    if not -len(names) <= view < len(names):
        raise ValueError(f"view: want a number below {len(names)}, got {view}")
    return view % len(names)


def _at_view(calibration: Calibration, view: int | str) -> tuple[Camera, Tensor | None, Tensor | None]:
    """The camera at the pose of a view, the covariance of both, and the noise of a pixel `(*B, 1)`, where known."""
    number = view_number(calibration, view)
    if not bool(calibration.used[..., number, :].any(-1).all()):
        raise ValueError(f"view: want one whose pose is known, got {view!r}, of which no corner was used")
    known = calibration.covariance.view(number) if calibration.has_covariance else None
    level = None if calibration.pixel_sigma is None else calibration.pixel_sigma.unsqueeze(-1)
    return calibration.cameras[..., number], known, level


def _expanded(pixel_sigma: float | Tensor | None, like: Tensor) -> Tensor:
    """The standard deviation of each pixel `(*B, N)`, for points `(*B, N, 3)`."""
    sigma = torch.as_tensor(pixel_sigma, dtype=torch.float64, device=like.device)
    try:
        sigma = sigma.expand(like.shape[:-1])
    except RuntimeError:
        want, got = tuple(like.shape[:-1]), tuple(sigma.shape)
        raise ValueError(f"pixel_sigma: want a number or a shape that broadcasts to {want}, got {got}") from None
    if bool((sigma.detach() < 0).any()):
        raise ValueError("pixel_sigma: want standard deviations of at least 0, got negative ones")
    return sigma


def _projection_derivatives(
    points: Tensor, camera: Camera, parameters: Parametrisation, known: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Derivatives of the pixels by theta `(*B, N, 2, s + 6)` (bow excluded: 0) and by the point `(*B, N, 2, 3)`."""
    batch = points.shape[:-2]
    s = parameters.size
    shared = parameters.pack(camera).expand(*batch, s).reshape(-1, s)
    R, t = camera.R.expand(*batch, 3, 3).reshape(-1, 1, 3, 3), camera.t.expand(*batch, 3).reshape(-1, 1, 3)
    flat = points.reshape(len(shared), 1, -1, 3)
    bow = 0 if known is None else known.shape[-1] - s - 6

    def project(step: Tensor) -> Tensor:
        pose = moved((R, t), step[s : s + 6].expand(len(shared), 1, 6))
        return parameters.unpack(shared + step[:s], pose).project(flat + step[s + 6 :])[0].squeeze(1)

    zero = torch.zeros(s + 9, dtype=points.dtype, device=points.device)
    directions = torch.eye(s + 9, dtype=points.dtype, device=points.device)
    columns = [torch.func.jvp(project, (zero,), (direction,))[1] for direction in directions]
    J = torch.stack(columns, dim=-1).reshape(*points.shape[:-1], 2, s + 9)
    # A bow bends the board that was calibrated on, not what is measured.
    by_theta = torch.cat([J[..., :s], J.new_zeros(*J.shape[:-1], bow), J[..., s : s + 6]], dim=-1)
    return (by_theta if known is not None else by_theta[..., :0]), J[..., s + 6 :]


def _inverse2(matrix: Tensor) -> Tensor:
    """Inverses of `(..., 2, 2)`; 0 where there is none."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    determinant = a * d - b * c
    sound = determinant.abs() > 0
    adjugate = torch.stack([torch.stack([d, -b], dim=-1), torch.stack([-c, a], dim=-1)], dim=-2)
    return torch.where(sound[..., None, None], adjugate / torch.where(sound, determinant, 1.0)[..., None, None], 0.0)


def _block_diagonal(blocks: list[Tensor], batch: Sequence[int]) -> Tensor:
    size = sum(block.shape[-1] for block in blocks)
    rows, start = [], 0
    for block in blocks:
        block = block.expand(*batch, *block.shape[-2:])
        rows.append(torch.nn.functional.pad(block, (start, size - start - block.shape[-1])))
        start += block.shape[-1]
    return torch.cat(rows, dim=-2)


def _without(C: Tensor, unknown: Tensor) -> Tensor:
    """The covariance with infinite variances, and no covariances, where a coordinate `(..., r, 1)` is not known."""
    kept = torch.where(unknown | unknown.mT, 0.0, C)
    return kept + torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(C).squeeze(-1))


def _length(points: Tensor) -> Tensor:
    difference = points[1] - points[0]
    squared = difference.square().sum()
    apart = squared > 0
    return torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0)


def _angle(points: Tensor) -> Tensor:
    a, b = points[0] - points[1], points[2] - points[1]
    return torch.atan2(torch.linalg.cross(a, b).norm(), (a * b).sum())


def _area(points: Tensor) -> Tensor:
    around = torch.linalg.cross(points - points[:1], points.roll(-1, 0) - points[:1]).sum(0)
    return around.norm() / 2
