"""The least-squares problem of a rig: C cameras, each seen by its own views, and one pose of the target a moment.

The cameras share the moments, the views of a camera its intrinsics and its pose in the rig:

    shared    f_x f_y c_x c_y | coefficients | skew | omega (3) | tau (3)     camera after camera; the first has no pose
              bow_x bow_y, or x_0 y_0 z_0 x_1 ...                             behind them, where the shape is fitted
    local     the pose of the target in the rig, one a moment

A view of camera c at moment m sees the target at `R = R_c R_m`, `t = R_c t_m + t_c`. Its residuals and their
derivatives by intrinsics and by its own pose are those of `reprojection.py`; the pose's derivatives by the two that it
is composed of follow from

    omega_v = J omega_c + R_c omega_m              tau_v = tau_c + R_c tau_m - [R_c t_m]x J omega_c

so that each view adds products of 16 rows or so to the normal equations, however many cameras there are: the rows of
other cameras are zeros, which nobody multiplies. `omega_c` counts from a rotation that stays while the solver runs;
J is the derivative of Cayley's map there, and the identity at 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffproj.calibration.losses import Loss
from diffproj.calibration.parametrisation import BOW, POSE, Parametrisation, Pose, moved
from diffproj.calibration.reprojection import Reprojection
from diffproj.calibration.rig_knowledge import RigKnowledge
from diffproj.calibration.rig_views import RigViews
from diffproj.calibration.shape import by_displacement, names_of
from diffproj.calibration.solver import Equations, LocalState
from diffproj.geometry.cayley import cross_matrix, turn_rate, turned

POSE_NAMES = ("omega_x", "omega_y", "omega_z", "tau_x", "tau_y", "tau_z")
"""How the pose of a camera moves in the rig, about and along the camera's axes."""


@dataclass(frozen=True)
class RigParameters:
    """The shared unknowns of a rig: which they are, and where they stand.

    Attributes:
        cameras: their names.
        kinds: the parameters of each.
        points: how many points of the target are free; 0 where their places are known.
        bow: whether the board's bow is among them.
    """

    cameras: tuple[str, ...]
    kinds: tuple[Parametrisation, ...]
    points: int = 0
    bow: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """`left.f_x`, ..., `right.tau_z`."""
        parts = []
        for number, (camera, kind) in enumerate(zip(self.cameras, self.kinds, strict=True)):
            own = kind.names if number == 0 else (*kind.names, *POSE_NAMES)
            parts += [f"{camera}.{name}" for name in own]
        return (*parts, *(BOW if self.bow else ()), *names_of(self.points))

    @property
    def size(self) -> int:
        """How many there are."""
        return self.few + 2 * self.bow + 3 * self.points

    @property
    def few(self) -> int:
        """How many there are without the target's shape."""
        return sum(kind.size + POSE for kind in self.kinds) - POSE

    def intrinsics(self, camera: int) -> slice:
        """Where those of a camera stand."""
        start = sum(kind.size + POSE for kind in self.kinds[:camera]) - POSE * (camera > 0)
        return slice(start, start + self.kinds[camera].size)

    def pose(self, camera: int) -> slice:
        """Where the pose of a camera stands; for the first behind the last, where nothing is."""
        if camera == 0:
            return slice(self.size, self.size + POSE)
        end = self.intrinsics(camera).stop
        return slice(end, end + POSE)

    def columns(self, camera: int) -> list[int]:
        """Those of intrinsics and pose of a camera."""
        own, pose = self.intrinsics(camera), self.pose(camera)
        return [*range(own.start, own.stop), *range(pose.start, pose.stop)]

    def columns_of_views(self, camera: int) -> list[int]:
        """Those that the views of a camera depend on, but for free points: intrinsics, the bow, and its pose."""
        own, bow = self.columns(camera), range(self.few, self.few + 2 * self.bow)
        return [*own[:-POSE], *bow, *own[-POSE:]]


class Group:
    """The views of all cameras of one lens model, one after the other.

    Attributes:
        camera: the number of each view's camera `(n,)`.
        moment: of its moment `(n,)`.
        number: of the view among those of its camera `(n,)`.
        size: how many shared unknowns there are in a view, but for its camera's pose and for free points.
        pixels: `(n, N, 2)`; used `(n, N)`; weights `(n, N)` or `None`.
    """

    def __init__(self, views: RigViews, cameras: Sequence[int], parameters: RigParameters, used: Sequence[Tensor]):
        kind = parameters.kinds[cameras[0]]
        numbers = {c: used[c].any(-1).nonzero().flatten() for c in cameras}
        data = {c: views.data[views.names[c]] for c in cameras}
        self.number = torch.cat(list(numbers.values()))
        self.camera = torch.cat([torch.full_like(rows, c) for c, rows in numbers.items()])
        self.moment = torch.cat([views.where[views.names[c]][rows] for c, rows in numbers.items()])
        self.pixels = torch.cat([data[c].pixels[0, rows] for c, rows in numbers.items()])
        self.used = torch.cat([used[c][rows] for c, rows in numbers.items()])
        self.weights = None
        if any(one.weights is not None for one in data.values()):
            ones = {c: torch.ones_like(one.pixels[0, :, :, 0]) for c, one in data.items()}
            given = {c: ones[c] if (w := one.weights) is None else w[0] for c, one in data.items()}
            self.weights = torch.cat([given[c][rows] for c, rows in numbers.items()])
        self.reprojection = Reprojection(
            views.points,
            self.pixels.unsqueeze(1),
            self.used.unsqueeze(1),
            kind.lens,
            bow=parameters.bow,
            skew=kind.skew,
            free=parameters.points > 0,
        )
        self.size = kind.size + 2 * parameters.bow
        columns = torch.zeros(len(parameters.cameras), self.size + POSE, dtype=torch.long, device=self.camera.device)
        for c in cameras:
            columns[c] = torch.tensor(parameters.columns_of_views(c), device=columns.device)
        self.columns = columns[self.camera]
        self.by_camera, self.members = columns[list(cameras)], list(cameras)
        self.slot = torch.searchsorted(torch.tensor(list(cameras), device=columns.device), self.camera)


class RigProblem:
    """The residuals of all views, as a problem of `diffproj.calibration.solver` that adds up its own equations.

    Attributes:
        parameters: the shared unknowns.
        base: the cameras' rotations `(C, 3, 3)` that the shared unknowns count from.
        groups: the views, by lens model.
        moments: how many.
        known: what is known of the cameras beforehand, if anything is.
    """

    def __init__(
        self,
        views: RigViews,
        parameters: RigParameters,
        base: Tensor,
        used: Mapping[str, Tensor] | None = None,
        known: RigKnowledge | None = None,
    ) -> None:
        every = [views.data[name].used[0] if used is None else used[name] for name in views.names]
        kinds: dict[Parametrisation, list[int]] = {}
        for c, kind in enumerate(parameters.kinds):
            if bool(every[c].any()):
                kinds.setdefault(kind, []).append(c)
        self.parameters, self.base, self.moments, self.known = parameters, base, len(views.moments), known
        self.groups = [Group(views, cameras, parameters, every) for cameras in kinds.values()]

    def rebased(self, base: Tensor) -> "RigProblem":
        """The same with shared unknowns that count from other rotations."""
        other = object.__new__(RigProblem)
        other.__dict__.update(self.__dict__ | {"base": base})
        return other

    def cameras(self, shared: Tensor) -> Pose:
        """Rotations `(C, 3, 3)` and translations `(C, 3)` of the cameras in the rig, for unknowns `(1, s)`."""
        steps = torch.stack([self._pose(shared[0], c) for c in range(len(self.base))])
        return turned(self.base, steps[:, :3]), steps[:, 3:]

    def view_poses(self, group: Group, shared: Tensor, local: LocalState) -> Pose:
        """The target as each view of a group sees it: `(n, 3, 3)` and `(n, 3)`."""
        R, t = self.cameras(shared)
        R_c, t_c = R[group.camera], t[group.camera]
        R_m, t_m = local[0][0, group.moment], local[1][0, group.moment]
        return R_c @ R_m, (R_c @ t_m.unsqueeze(-1)).squeeze(-1) + t_c

    def panel(self, group: Group, shared: Tensor, local: LocalState) -> Tensor:
        """Derivatives by intrinsics and by the pose of the view, and residuals `(n, s_g + 7, 2, N)`."""
        R, t = self.view_poses(group, shared, local)
        own = shared[0, group.columns[:, : group.size]]
        if self.parameters.points:
            own = torch.cat([own, shared[:, self.parameters.few :].expand(len(own), -1)], dim=-1)
        return group.reprojection.linearise(own, (R.unsqueeze(1), t.unsqueeze(1))).squeeze(1)

    def residuals(self, shared: Tensor, local: LocalState) -> list[Tensor]:
        """Projected minus seen corners `(n, 2, N)` of each group."""
        return [self.panel(group, shared, local)[:, -1].clone() for group in self.groups]

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Poses moved by steps `(1, M, 6)`."""
        return moved(local, step)

    def equations(self, shared: Tensor, local: LocalState, loss: Loss | None) -> tuple[Tensor, Equations]:
        """The cost `(1,)` and the normal equations at a point, with what is known beforehand."""
        cost, equations = self.totals(shared, local, loss)
        if self.known is None:
            return cost, equations
        off, rows = self.known.rows(shared[0], *self.cameras(shared))
        U, g = equations.U + rows.mT @ rows, equations.g + rows.mT @ off
        return cost + off.square().sum() / 2, equations._replace(U=U, g=g)

    def precision(self, shared: Tensor) -> Tensor | None:
        """What is known beforehand as a precision `(1, s, s)`, in the unit of the weights; `None` where nothing is."""
        if self.known is None:
            return None
        _, rows = self.known.rows(shared[0], *self.cameras(shared))
        return (rows.mT @ rows).unsqueeze(0)

    def totals(
        self,
        shared: Tensor,
        local: LocalState,
        loss: Loss | None,
        scale: Tensor | None = None,
        by_moment: bool = False,
    ) -> tuple[Tensor, Equations]:
        """Those of the corners, with the share of each camera `(C,)` scaled, and U and g by moment `(1, M, ...)`."""
        s, M, new = self.parameters.size, self.moments, shared.new_zeros
        U, g = new(s + POSE, s + POSE), new(s + POSE)
        if by_moment:
            U, g = new(M, s + POSE, s + POSE), new(M, s + POSE)
        E, W, h, c = new(M, s + POSE, POSE), new(M, POSE, POSE), new(M, POSE), new(M)
        cost = new(())
        for group in self.groups:
            panel = self.panel(group, shared, local)
            robust = None
            if group.weights is not None or loss is not None or scale is not None:
                squared = panel[:, -1].square().sum(1)
                weights = torch.ones_like(squared) if group.weights is None else group.weights
                if scale is not None:
                    weights = weights * scale[group.camera].unsqueeze(-1)
                if loss is not None:
                    robust = (weights * loss.value(squared)).sum() / 2
                    weights = weights * loss.weight(squared)
                panel = panel * weights.sqrt()[:, None, None]
            rows = panel.flatten(-2)
            k = group.size
            by_own, residual = self._by_cameras(group, rows @ rows.mT, shared, local)
            half = residual[:, -1] / 2
            cost = cost + (half.sum() if robust is None else robust)
            own, b = slice(0, k + POSE), k + POSE
            # The views of a camera add to its own block of U. A view is alone with its camera in its moment's E, but
            # for a bow, which all share.
            adds = self.parameters.bow
            if by_moment:
                at, where = group.moment, group.columns
                U.index_put_((at[:, None, None], where.unsqueeze(-1), where.unsqueeze(-2)), by_own[:, own, own], adds)
                g.index_put_((at.unsqueeze(-1), where), residual[:, own], adds)
            else:
                where, count = group.by_camera, len(group.members)
                sums = new(count, b, b).index_add_(0, group.slot, by_own[:, own, own])
                pulls = new(count, b).index_add_(0, group.slot, residual[:, own])
                U.index_put_((where.unsqueeze(-1), where.unsqueeze(-2)), sums, accumulate=True)
                g.index_put_((where,), pulls, accumulate=True)
            E.index_put_((group.moment.unsqueeze(-1), group.columns), by_own[:, own, b:], adds)
            if self.parameters.points:
                self._add_points(group, panel, shared, local, (U, E, g))
            W.index_add_(0, group.moment, by_own[:, b:, b:])
            h.index_add_(0, group.moment, residual[:, b:-1])
            c.index_add_(0, group.moment, half)
        one = (x.unsqueeze(0) for x in (U[..., :s, :s], E[:, :s], W, g[..., :s], h, c))
        return cost.unsqueeze(0), Equations(*one)

    def _add_points(
        self, group: Group, panel: Tensor, shared: Tensor, local: LocalState, sums: tuple[Tensor, Tensor, Tensor]
    ) -> None:
        """Add the displacements' part of a group's views, from their weighted panel, to U, E and g.

        Only a point's own residuals depend on its displacement: its block of U is of 3 x 3 blocks.
        """
        U, E, g = sums
        k, few, N = group.size, self.parameters.few, self.parameters.points
        R, _ = self.view_poses(group, shared, local)
        by_point = by_displacement(panel[:, None, -4:-1], R.unsqueeze(1))[:, 0]  # (n, 3, 2, N)
        cross = torch.einsum("nrkp,njkp->nrpj", panel, by_point).flatten(-2)  # (n, k + 7, 3 N)
        D = self.composition(group, shared, local)
        rows = torch.cat([cross[:, :k], D.mT @ cross[:, k:-1]], dim=1)  # intrinsics, camera, moment
        blocks = torch.einsum("nikp,njkp->npij", by_point, by_point)
        by_own, b, at, place = rows[:, : k + POSE], k + POSE, group.moment, slice(few, few + 3 * N)
        number = torch.arange(N, device=U.device)
        columns = torch.arange(few, few + 3 * N, device=U.device)
        E[:, place].index_add_(0, at, rows[:, b:].mT)
        if U.ndim == 3:
            U.index_put_((at[:, None, None], group.columns.unsqueeze(-1), columns), by_own, accumulate=True)
            U.index_put_((at[:, None, None], columns.unsqueeze(-1), group.columns.unsqueeze(1)), by_own.mT, True)
            g[:, place].index_add_(0, at, cross[:, -1])
            inside = U[:, place, place].unflatten(-1, (N, 3)).unflatten(-3, (N, 3))  # (M, N, 3, N, 3)
            sums_of = torch.zeros_like(inside[:, :, :, 0]).index_add_(0, at, blocks)
        else:
            total = by_own.new_zeros(len(group.members), b, 3 * N).index_add_(0, group.slot, by_own)
            where = group.by_camera
            U.index_put_((where.unsqueeze(-1), columns), total, accumulate=True)
            U.index_put_((columns.unsqueeze(-1), where.unsqueeze(1)), total.mT, accumulate=True)
            g[place] += cross[:, -1].sum(0)
            inside, sums_of = U[place, place].unflatten(-1, (N, 3)).unflatten(-3, (N, 3)), blocks.sum(0)
        inside[..., number, :, number, :] += sums_of if U.ndim == 2 else sums_of.transpose(0, 1)

    def _by_cameras(self, group: Group, gram: Tensor, shared: Tensor, local: LocalState) -> tuple[Tensor, Tensor]:
        """Products of the rows of views `(n, k + 7, k + 7)`, from the view's pose to the camera's and the moment's.

        Returns:
            `(n, k + 12, k + 12)` in the order intrinsics, camera, moment; and the products with the residual
            `(n, k + 13)`, the residual's own last.
        """
        k = group.size
        D = self.composition(group, shared, local)
        gram = torch.cat([gram[:, :, :k], gram[:, :, k:-1] @ D, gram[:, :, -1:]], dim=-1)
        gram = torch.cat([gram[:, :k], D.mT @ gram[:, k:-1], gram[:, -1:]], dim=-2)
        return gram[:, :-1, :-1], gram[:, -1]

    def composition(self, group: Group, shared: Tensor, local: LocalState) -> Tensor:
        """The derivative of each view's pose by the camera's and the moment's `(n, 6, 12)`."""
        R, _ = self.cameras(shared)
        turns = turn_rate(torch.stack([self._pose(shared[0], c)[:3] for c in range(len(self.base))]))
        R_c, J = R[group.camera], turns[group.camera]
        arm = (R_c @ local[1][0, group.moment].unsqueeze(-1)).squeeze(-1)
        D = R.new_zeros(len(arm), POSE, 2 * POSE)
        D[:, :3, :3], D[:, 3:, :3] = J, -cross_matrix(arm) @ J
        D[:, 3:, 3:6] = torch.eye(3, dtype=R.dtype, device=R.device)
        D[:, :3, 6:9], D[:, 3:, 9:] = R_c, R_c
        return D

    def _pose(self, x: Tensor, camera: int) -> Tensor:
        return x[self.parameters.pose(camera)] if camera else x.new_zeros(POSE)
