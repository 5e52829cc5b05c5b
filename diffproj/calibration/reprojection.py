"""The calibration's least-squares problem: residuals on the image, with all derivatives in closed form.

For each of P cameras with V views of N board points, a panel `(P, V, s + 7, 2, N)` whose rows are, each with its two
components over the points,

    f_x f_y c_x c_y | lens coefficients | bow_x bow_y | omega (3) | tau (3) | residual

derivatives of the residual `projected - seen` in pixels, and the residual itself. With `q = R X`, `X_cam = q + t` and
`J = d(uv) / d(X_cam)`, the pose moves by `R <- exp(omega) R`, `t <- t + tau`, so that its rows are

    by tau: J        by omega: q x J        by bow: (third column of R) . J  times  1 - xi^2 or 1 - eta^2

A bowed board is the paraboloid `z = z_0 + bow_x (1 - xi^2) + bow_y (1 - eta^2)`, with xi and eta from -1 to 1 over the
board's extent along x and y: the bows are what the board's centre stands off its edges, in world units.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from diffproj.calibration.lens_derivatives import brown_conrady, fisheye, pinhole
from diffproj.calibration.solver import LocalState
from diffproj.geometry.cayley import turned
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt

LensModel = Literal["none", "brown4", "brown5", "brown8", "brown12", "brown14", "fisheye"]
"""The lenses that can be fitted: none, Brown-Conrady by its number of coefficients, Kannala-Brandt."""

COEFFICIENTS: dict[LensModel, int] = {
    "none": 0,
    "brown4": 4,
    "brown5": 5,
    "brown8": 8,
    "brown12": 12,
    "brown14": 14,
    "fisheye": 4,
}
COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
POSE = 6
"""Tangent coordinates of a pose: omega in radians, tau in world units."""


def shared_names(lens: LensModel, bow: bool) -> tuple[str, ...]:
    """The names of the shared parameters in their order."""
    coefficients = ("k1", "k2", "k3", "k4") if lens == "fisheye" else COEFFICIENT_NAMES[: COEFFICIENTS[lens]]
    return ("f_x", "f_y", "c_x", "c_y", *coefficients, *(("bow_x", "bow_y") if bow else ()))


def lens_model(lens: object) -> LensModel:
    """Which of the models a camera's lens is.

    Raises:
        TypeError: none of them.
    """
    if lens is None:
        return "none"
    if isinstance(lens, KannalaBrandt):
        return "fisheye"
    if isinstance(lens, BrownConrady):
        return next(name for name, k in COEFFICIENTS.items() if k == lens.coefficients.shape[-1] and "brown" in name)
    raise TypeError(f"camera: want a pinhole, dp.BrownConrady or dp.KannalaBrandt lens, got {type(lens).__name__}")


def make_lens(model: LensModel, coefficients: Tensor) -> BrownConrady | KannalaBrandt | None:
    """The lens of that model with coefficients `(*B, k)`."""
    if model == "none":
        return None
    return (KannalaBrandt if model == "fisheye" else BrownConrady)(coefficients)


def bow_shape(points: Tensor) -> Tensor:
    """`1 - xi^2` and `1 - eta^2` at the board's points `(N, 3)`, as `(2, N)`."""
    along = points[:, :2].mT
    low, high = along.amin(-1, keepdim=True), along.amax(-1, keepdim=True)
    half = (high - low).clamp(min=torch.finfo(points.dtype).tiny) / 2
    return 1 - ((along - (low + high) / 2) / half).square()


def moved(local: LocalState, step: Tensor) -> LocalState:
    """Poses `(R, t)` moved by `R <- exp(omega) R`, `t <- t + tau`, to second order in the step `(*, 6)`."""
    R, t = local
    return turned(R, step[..., :3]), t + step[..., 3:]


@dataclass(eq=False)
class Reprojection:
    """The residuals on the image, as a problem of `diffproj.calibration.solver`.

    Attributes:
        points: the board's points `(N, 3)`, flat.
        pixels: `(P, V, N, 2)`, finite.
        used: which of them count `(P, V, N)`; a corner that counts must be in front of a perspective camera.
        lens: the lens that is fitted.
        bow: whether the board's bow is among the shared parameters.
    """

    points: Tensor
    pixels: Tensor
    used: Tensor
    lens: LensModel
    bow: bool = False
    _panel: Tensor = field(init=False, repr=False)
    _plane_points: Tensor = field(init=False, repr=False)
    _bow_shape: Tensor = field(init=False, repr=False)
    _seen: Tensor = field(init=False, repr=False)
    _unused: Tensor | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        P, V, N, _ = self.pixels.shape
        self.shared_size = 4 + COEFFICIENTS[self.lens] + 2 * self.bow
        self._panel = self.pixels.new_zeros(P, V, self.shared_size + POSE + 1, 2, N)
        self._panel[:, :, 2, 0], self._panel[:, :, 3, 1] = 1.0, 1.0  # by c_x, c_y
        self._plane_points = self.points.mT.contiguous()
        self._bow_shape = bow_shape(self.points)
        self._seen = self.pixels.mT.contiguous()
        self._unused = None if bool(self.used.all()) else ~self.used

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:
        """The panel; what it holds is overwritten by the next call."""
        return self.linearise_at(self.rotated(shared, local[0]), shared, local)

    def linearise_at(self, q: Tensor, shared: Tensor, local: LocalState) -> Tensor:
        """The panel at turned points `q = R X (P, V, 3, N)`, which may differ from view to view."""
        R, t = local
        count = COEFFICIENTS[self.lens]
        panel, by_tau = self._panel, self._panel[:, :, -4:-1]
        by_coefficient = panel[:, :, 4 : 4 + count]
        X_cam = q + t.unsqueeze(-1)
        if self.lens != "fisheye":
            z = X_cam[:, :, 2]
            if self._unused is not None:
                z.masked_fill_(self._unused, 1.0)
            z.clamp_(min=0)  # behind the camera there is no cost: what follows is not finite
        elif self._unused is not None:
            X_cam[:, :, 2].masked_fill_(self._unused, 1.0)
        coefficients = shared[:, 4 : 4 + count]
        if self.lens == "none":
            distorted = pinhole(X_cam, by_tau)
        elif self.lens == "fisheye":
            distorted = fisheye(coefficients, X_cam, by_coefficient, by_tau)
        else:
            distorted = brown_conrady(coefficients, X_cam, by_coefficient, by_tau)
        f, c = shared[:, None, :2, None], shared[:, None, 2:4, None]
        panel[:, :, 0, 0], panel[:, :, 1, 1] = distorted[:, :, 0], distorted[:, :, 1]
        by_tau *= f.unsqueeze(2)
        if count:
            by_coefficient *= f.unsqueeze(2)
        if self.bow:
            normal = (R[..., 2, None, None] * by_tau).sum(2)
            for row in range(2):
                torch.mul(normal, self._bow_shape[row], out=panel[:, :, 4 + count + row])
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            row = panel[:, :, axis - 7]
            torch.mul(q[:, :, a, None], by_tau[:, :, b], out=row)
            row.addcmul_(q[:, :, b, None], by_tau[:, :, a], value=-1)
        torch.sub(torch.addcmul(c, f, distorted), self._seen, out=panel[:, :, -1])
        if self._unused is not None:
            panel.masked_fill_(self._unused[:, :, None, None], 0.0)
        return panel

    def rotated(self, shared: Tensor, R: Tensor) -> Tensor:
        """`R X` for the (bowed) board's points, `(P, V, 3, N)`."""
        if not self.bow:
            return R @ self._plane_points
        points = self._plane_points.expand(len(shared), 1, -1, -1).clone()
        points[:, 0, 2] += (shared[:, -2:, None] * self._bow_shape).sum(1)
        return R @ points

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Poses moved by tangent vectors `(P, V, 6)`."""
        return moved(local, step)
