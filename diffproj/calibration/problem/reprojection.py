"""The calibration's least-squares problem: residuals on the image, with all derivatives in closed form.

For each of P cameras with V views of N board points, a panel `(P, V, s + 7, 2, N)` whose rows are, each with its two
components over the points (and in memory one after the other, which is twice as fast for many views),

    f_x f_y c_x c_y | lens coefficients | skew | bow_x bow_y | omega (3) | tau (3) | residual

derivatives of the residual `projected - seen` in pixels, and the residual itself. With `q = R X`, `X_cam = q + t` and
`J = d(uv) / d(X_cam)`, the pose moves by `R <- exp(omega) R`, `t <- t + tau`, so that its rows are

    by tau: J        by omega: q x J        by bow: (third column of R) . J  times  1 - xi^2 or 1 - eta^2

Free points have no rows, for the residuals of one point depend on its own displacement alone: see `shape.py`.

The order of the parameters is that of `parametrisation.py`; `bow.py` says what xi and eta are.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.least_squares.solver import LocalState
from diffproj.calibration.problem import shape
from diffproj.calibration.problem.bow import bow_shape
from diffproj.calibration.problem.lens_derivatives import DERIVATIVES, Place
from diffproj.calibration.problem.parametrisation import INTRINSICS, POSE, Parametrisation, moved
from diffproj.lens.models import MODELS, LensModel

KEPT = ("_panel", "_place", "_by_focal", "_by_turn")
"""What is kept from call to call: the panel and views of it, a hundred numbers for each corner."""


@dataclass(eq=False)
class Reprojection:
    """The residuals on the image, as a problem of `diffproj.calibration.least_squares.solver`.

    Attributes:
        points: the board's points `(N, 3)`, flat.
        pixels: `(P, V, N, 2)`, finite.
        used: which of them count `(P, V, N)`; a corner that counts must be in front of a perspective camera.
        lens: the lens that is fitted.
        bow: whether the board's bow is among the shared parameters.
        skew: whether the skew of K is.
        whitening: what the residuals and their derivatives are multiplied by `(P, V, N, 2, 2)`; `None` for 1.
        free: whether the displacements of all points are.
    """

    points: Tensor
    pixels: Tensor
    used: Tensor
    lens: LensModel
    bow: bool = False
    skew: bool = False
    whitening: Tensor | None = None
    free: bool = False
    parameters: Parametrisation = field(init=False, repr=False)
    _plane_points: Tensor = field(init=False, repr=False)
    _bow_shape: Tensor = field(init=False, repr=False)
    _seen: Tensor = field(init=False, repr=False)
    _unused: Tensor | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.parameters = Parametrisation(self.lens, self.bow, self.skew, self.pixels.shape[2] if self.free else 0)
        self._plane_points = self.points.mT.contiguous()
        self._bow_shape = bow_shape(self.points)
        self._seen = self.pixels.mT.contiguous()
        self._unused = None if bool(self.used.all()) else ~self.used

    @cached_property
    def _panel(self) -> Tensor:
        P, V, N, _ = self.pixels.shape
        rows = self.pixels.new_empty(self.parameters.few + POSE + 1, P, V, 2, N)
        rows[: len(INTRINSICS)] = 0.0
        rows[2, :, :, 0] = rows[3, :, :, 1] = self.used.to(rows)  # by c_x, c_y
        if self.skew:
            rows[self.parameters.lens_end] = 0.0
        return rows.permute(1, 2, 0, 3, 4)

    @cached_property
    def _place(self) -> Place:
        """The panel's rows of the lens and of the translation."""
        return Place(self._panel[:, :, len(INTRINSICS) : self.parameters.lens_end], self._panel[:, :, -4:-1])

    @cached_property
    def _by_focal(self) -> Tensor:
        """Of the panel, u by f_x and v by f_y `(P, V, 2, N)`."""
        return self._panel[:, :, :2].diagonal(dim1=2, dim2=3).movedim(-1, 2)

    @cached_property
    def _by_turn(self) -> tuple[Tensor, ...]:
        """Of the panel, the rows of the rotation `(P, V, 2, N)`."""
        return self._panel[:, :, -7:-4].unbind(2)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in KEPT}

    def forget(self) -> None:
        """Let go of the panel, which is kept from call to call; the next makes it anew."""
        self.__dict__ = self.__getstate__()

    def part(self, which: Tensor) -> "Reprojection":
        """The problems of some of the cameras `(n,)`."""
        whitening = None if self.whitening is None else self.whitening[which]
        return replace(self, pixels=self.pixels[which], used=self.used[which], whitening=whitening)

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:
        """The panel; what it holds is overwritten by the next call."""
        return self.linearise_at(self.rotated(shared, local[0]), shared, local)

    def linearise_at(self, q: Tensor, shared: Tensor, local: LocalState) -> Tensor:
        """The panel at turned points `q = R X (P, V, 3, N)`, which may differ from view to view."""
        R, t = local
        model, last = MODELS[self.lens], self.parameters.lens_end
        panel, by_axis = self._panel, self._place.by_axis
        X_cam = q + t.unsqueeze(-1)
        if self._unused is not None:  # what does not count is on the axis, where the lens does nothing
            X_cam.masked_fill_(self._unused.unsqueeze(2), 0.0)[:, :, 2].masked_fill_(self._unused, 1.0)
        if model.perspective:
            X_cam[:, :, 2].clamp_(min=0)  # behind the camera there is no cost: what follows is not finite
        f, c = shared[:, None, :2, None], shared[:, None, 2:4, None]
        distorted = DERIVATIVES[model.kind](shared[:, len(INTRINSICS) : last], f, X_cam, self._place)
        self._by_focal.copy_(distorted)
        residual = panel[:, :, -1]
        torch.sub(c, self._seen, out=residual)
        residual.addcmul_(f, distorted)
        if self._unused is not None:
            residual.masked_fill_(self._unused.unsqueeze(2), 0.0)
            self._place.by_point.masked_fill_(self._unused[:, :, None, None], 0.0)
        if self.skew:  # u = f_x x + skew y + c_x, with (x, y) distorted
            skew = shared[:, last, None, None]
            shear = (skew / shared[:, 1, None, None]).unsqueeze(2)
            for part in (self._place.by_point, self._place.by_coefficient):
                part[:, :, :, 0].addcmul_(shear, part[:, :, :, 1])
            panel[:, :, last, 0] = distorted[:, :, 1]
            residual[:, :, 0].addcmul_(skew, distorted[:, :, 1])
        if self.bow:
            normal = (R[..., 2, None, None] * self._place.by_point).sum(2)
            for row in range(2):
                torch.mul(normal, self._bow_shape[row], out=panel[:, :, last + self.skew + row])
        across = q.unsqueeze(3).unbind(2)
        for axis, row in enumerate(self._by_turn):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            torch.mul(across[a], by_axis[b], out=row)
            row.addcmul_(across[b], by_axis[a], value=-1)
        if self.whitening is None:
            return panel
        return torch.einsum("pvnij,pvrjn->pvrin", self.whitening, panel)  # a new tensor: the panel keeps constant rows

    def rotated(self, shared: Tensor, R: Tensor) -> Tensor:
        """`R X` for the points of the (bowed or free) target, `(P, V, 3, N)`."""
        if self.free:
            moves = shared[:, self.parameters.few :].unflatten(-1, (-1, 3)).mT
            return R @ (self._plane_points + moves).unsqueeze(1)
        if not self.bow:
            return R @ self._plane_points
        points = self._plane_points.expand(len(shared), 1, -1, -1).clone()
        points[:, 0, 2] += (shared[:, -2:, None] * self._bow_shape).sum(1)
        return R @ points

    def bordered(
        self, panel: Tensor, local: LocalState, U: Tensor, E: Tensor, g: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The blocks of the normal equations with those of free points, from a weighted panel."""
        if not self.free:
            return U, E, g
        return shape.bordered(U, E, g, panel, self.by_displacement(panel, local))

    def by_displacement(self, panel: Tensor, local: LocalState) -> Tensor:
        """Derivatives of each corner's residual by the displacement of its point `(P, V, 3, 2, N)`."""
        return shape.by_displacement(panel[:, :, -4:-1], local[0])

    def every_row(self, panel: Tensor, local: LocalState) -> Tensor:
        """The panel with rows for the displacements of free points, too `(P, V, s + 7, 2, N)`: large."""
        return shape.dense(panel, self.by_displacement(panel, local), self.parameters.few) if self.free else panel

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Poses moved by steps `(P, V, 6)`."""
        return moved(local, step)
