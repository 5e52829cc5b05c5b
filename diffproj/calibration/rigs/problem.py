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
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.least_squares.solver import LocalState
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation, Pose, moved
from diffproj.calibration.problem.reprojection import Reprojection
from diffproj.calibration.problem.shape import by_displacement
from diffproj.calibration.rigs.knowledge import RigKnowledge, joined_knowledge
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.views import RigViews
from diffproj.geometry.cayley import cross_matrix, turn_rate, turned


@dataclass(eq=False)
class Group:
    """The views of all cameras of one lens model, one after the other, of one rig or of many side by side.

    Attributes:
        parameters: the shared unknowns, alike in all rigs.
        members: the numbers of the cameras.
        moments: how many a rig has.
        points: the target's `(N, 3)`.
        rig, camera, moment: the numbers of each view's `(n,)`.
        number: of the view among those of its camera `(n,)`.
        pixels: `(n, N, 2)`; used `(n, N)`; weights `(n, N)` or `None`.
    """

    parameters: RigParameters
    members: tuple[int, ...]
    moments: int
    points: Tensor
    rig: Tensor
    camera: Tensor
    moment: Tensor
    number: Tensor
    pixels: Tensor
    used: Tensor
    weights: Tensor | None

    def __post_init__(self) -> None:
        parameters, kind = self.parameters, self.kind
        self.size = kind.size + 2 * parameters.bow  # shared unknowns in a view, but for its camera's pose and points
        self.reprojection = Reprojection(
            self.points,
            self.pixels.unsqueeze(1),
            self.used.unsqueeze(1),
            kind.lens,
            bow=parameters.bow,
            skew=kind.skew,
            free=parameters.points > 0,
        )
        columns = [parameters.columns_of_views(c) for c in self.members]
        self.by_camera = torch.tensor(columns, device=self.camera.device)
        place = torch.zeros(len(parameters.cameras), dtype=torch.long, device=self.camera.device)
        place[list(self.members)] = torch.arange(len(self.members), device=self.camera.device)
        member = place[self.camera]
        self.columns = self.by_camera[member]
        # Where a view's camera, its member and its moment stand among those of all rigs.
        self.stand = self.rig * len(parameters.cameras) + self.camera
        self.slot = self.rig * len(self.members) + member
        self.at = self.rig * self.moments + self.moment

    @classmethod
    def of(cls, views: RigViews, cameras: Sequence[int], parameters: RigParameters, used: Sequence[Tensor]) -> "Group":
        """Those of one rig, of views in which corners are used."""
        numbers = {c: used[c].any(-1).nonzero().flatten() for c in cameras}
        data = {c: views.data[views.names[c]] for c in cameras}
        camera = torch.cat([torch.full_like(rows, c) for c, rows in numbers.items()])
        weights = None
        if any(one.weights is not None for one in data.values()):
            ones = {c: torch.ones_like(one.pixels[0, :, :, 0]) for c, one in data.items()}
            given = {c: ones[c] if (w := one.weights) is None else w[0] for c, one in data.items()}
            weights = torch.cat([given[c][rows] for c, rows in numbers.items()])
        return cls(
            parameters,
            tuple(cameras),
            len(views.moments),
            views.points,
            torch.zeros_like(camera),
            camera,
            torch.cat([views.where[views.names[c]][rows] for c, rows in numbers.items()]),
            torch.cat(list(numbers.values())),
            torch.cat([data[c].pixels[0, rows] for c, rows in numbers.items()]),
            torch.cat([used[c][rows] for c, rows in numbers.items()]),
            weights,
        )

    @staticmethod
    def joined(groups: Mapping[int, "Group"], moments: int) -> "Group":
        """Those of many rigs, by the rig's number, which have up to so many moments."""
        one, weights = next(iter(groups.values())), None
        if any(group.weights is not None for group in groups.values()):
            weights = torch.cat(
                [torch.ones_like(g.pixels[..., 0]) if g.weights is None else g.weights for g in groups.values()]
            )
        rig = torch.cat([group.rig + number for number, group in groups.items()])
        names = "camera", "moment", "number", "pixels", "used"
        parts = {name: torch.cat([getattr(group, name) for group in groups.values()]) for name in names}
        return replace(one, moments=moments, rig=rig, weights=weights, **parts)

    def part(self, which: Tensor) -> "Group":
        """Those of some of the rigs `(n,)`, which are numbered anew."""
        number = torch.full((int(self.rig.max()) + 1,), -1, device=which.device).scatter(
            0, which, torch.arange(len(which), device=which.device)
        )
        kept = number[self.rig] >= 0
        names = "camera", "moment", "number", "pixels", "used", "weights"
        parts = {name: None if (whole := getattr(self, name)) is None else whole[kept] for name in names}
        return replace(self, rig=number[self.rig[kept]], **parts)

    @property
    def kind(self) -> Parametrisation:
        """The parameters of each of its cameras."""
        return self.parameters.kinds[self.members[0]]


class RigProblem:
    """The residuals of all views, as a problem of `least_squares/solver.py` that adds up its own equations.

    Of one rig, or of P that are alike in their parameters, side by side: then moments are counted up to those of the
    rig that has most.

    Attributes:
        parameters: the shared unknowns.
        base: the cameras' rotations `(P, C, 3, 3)` that the shared unknowns count from.
        groups: the views, by lens model.
        moments: how many a rig has.
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
        self.parameters, self.base, self.moments, self.known = parameters, base.unsqueeze(0), len(views.moments), known
        self.groups = [
            Group.of(views, cameras, parameters, every)
            for cameras in parameters.alike.values()
            if any(bool(every[c].any()) for c in cameras)
        ]
        self._poses = torch.tensor(parameters.poses, device=base.device)

    def _with(self, **parts: Any) -> "RigProblem":
        other = object.__new__(RigProblem)
        other.__dict__.update(self.__dict__ | parts)
        return other

    @staticmethod
    def joined(problems: Sequence["RigProblem"]) -> "RigProblem":
        """Those of many rigs that are alike."""
        one = problems[0]
        if len(problems) == 1:
            return one
        moments = max(problem.moments for problem in problems)
        by_lens: dict[tuple[int, ...], dict[int, Group]] = {}
        for number, problem in enumerate(problems):
            for group in problem.groups:
                by_lens.setdefault(group.members, {})[number] = group
        return one._with(
            base=torch.cat([problem.base for problem in problems]),
            moments=moments,
            groups=[Group.joined(groups, moments) for groups in by_lens.values()],
            known=joined_knowledge([problem.known for problem in problems if problem.known is not None]),
        )

    def part(self, which: Tensor) -> "RigProblem":
        """Some of the rigs `(n,)`."""
        groups = [group.part(which) for group in self.groups]
        known = None if self.known is None else self.known.part(which)
        return self._with(base=self.base[which], groups=[group for group in groups if len(group.rig)], known=known)

    def rebased(self, base: Tensor) -> "RigProblem":
        """The same with shared unknowns that count from other rotations."""
        return self._with(base=base)

    def places(self, shared: Tensor) -> Pose:
        """Rotations `(P, C, 3, 3)` and translations `(P, C, 3)` of the cameras in the rigs, for unknowns `(P, s)`."""
        steps = self._steps(shared)
        return turned(self.base, steps[..., :3]), steps[..., 3:]

    def cameras(self, shared: Tensor) -> Pose:
        """Those of one rig, `(C, 3, 3)` and `(C, 3)`."""
        R, t = self.places(shared)
        return R[0], t[0]

    def view_poses(self, group: Group, shared: Tensor, local: LocalState) -> Pose:
        """The target as each view of a group sees it: `(n, 3, 3)` and `(n, 3)`."""
        R_c, t_c = (part.flatten(0, 1)[group.stand] for part in self.places(shared))
        R_m, t_m = (part.flatten(0, 1)[group.at] for part in local)
        return R_c @ R_m, (R_c @ t_m.unsqueeze(-1)).squeeze(-1) + t_c

    def panel(self, group: Group, shared: Tensor, local: LocalState) -> Tensor:
        """Derivatives by intrinsics and by the pose of the view, and residuals `(n, s_g + 7, 2, N)`."""
        R, t = self.view_poses(group, shared, local)
        own = shared[group.rig.unsqueeze(-1), group.columns[:, : group.size]]
        if self.parameters.points:
            own = torch.cat([own, shared[group.rig, self.parameters.few :]], dim=-1)
        return group.reprojection.linearise(own, (R.unsqueeze(1), t.unsqueeze(1))).squeeze(1)

    def residuals(self, shared: Tensor, local: LocalState) -> list[Tensor]:
        """Projected minus seen corners `(n, 2, N)` of each group."""
        return [self.panel(group, shared, local)[:, -1].clone() for group in self.groups]

    def forget(self) -> None:
        """Let go of what is kept from call to call, of which a result has no need."""
        for group in self.groups:
            group.reprojection.forget()

    def retract(self, local: LocalState, step: Tensor) -> LocalState:
        """Poses moved by steps `(1, M, 6)`."""
        return moved(local, step)

    def equations(self, shared: Tensor, local: LocalState, loss: Loss | None) -> tuple[Tensor, Equations]:
        """The cost `(P,)` and the normal equations at a point, with what is known beforehand."""
        cost, equations = self.totals(shared, local, loss)
        if self.known is None:
            return cost, equations
        off, rows = self.known.rows(shared, *self.places(shared))
        U, g = equations.U + rows.mT @ rows, equations.g + (rows.mT @ off.unsqueeze(-1)).squeeze(-1)
        return cost + off.square().sum(-1) / 2, equations._replace(U=U, g=g)

    def precision(self, shared: Tensor) -> Tensor | None:
        """What is known beforehand as a precision `(P, s, s)`, in the unit of the weights; `None` where nothing is."""
        if self.known is None:
            return None
        _, rows = self.known.rows(shared, *self.places(shared))
        return rows.mT @ rows

    def totals(
        self,
        shared: Tensor,
        local: LocalState,
        loss: Loss | None,
        scale: Tensor | None = None,
        by_moment: bool = False,
    ) -> tuple[Tensor, Equations]:
        """Those of the corners, with the share of each camera `(C,)` scaled, and U and g by moment `(1, M, ...)`.

        Or with that of each camera at each moment, `(C, M)`.

        Scaled, or by moment, they are those of one rig.
        """
        s, M, P, new = self.parameters.size, self.moments, len(shared), shared.new_zeros
        blocks = M if by_moment else P
        U, g = new(blocks, s + POSE, s + POSE), new(blocks, s + POSE)
        E, W, h, c = new(P * M, s + POSE, POSE), new(P * M, POSE, POSE), new(P * M, POSE), new(P * M)
        robust = None if loss is None else new(P * M)
        for group in self.groups:
            panel = self.panel(group, shared, local)
            if group.weights is not None or loss is not None or scale is not None:
                squared = panel[:, -1].square().sum(1)
                weights = torch.ones_like(squared) if group.weights is None else group.weights
                if scale is not None:
                    own_scale = scale[group.camera] if scale.ndim == 1 else scale[group.camera, group.at]
                    weights = weights * own_scale.unsqueeze(-1)
                if loss is not None and robust is not None:
                    robust.index_add_(0, group.at, (weights * loss.value(squared)).sum(-1) / 2)
                    weights = weights * loss.weight(squared)
                panel = panel * weights.sqrt()[:, None, None]
            rows = panel.flatten(-2)
            k = group.size
            by_own, residual = self._by_cameras(group, rows @ rows.mT, shared, local)
            own, b = slice(0, k + POSE), k + POSE
            # The views of a camera add to its own block of U. A view is alone with its camera in its moment's E, but
            # for a bow, which all share.
            adds = self.parameters.bow
            if by_moment:
                at, where = group.at, group.columns
                U.index_put_((at[:, None, None], where.unsqueeze(-1), where.unsqueeze(-2)), by_own[:, own, own], adds)
                g.index_put_((at.unsqueeze(-1), where), residual[:, own], adds)
            else:
                where, count = group.by_camera, P * len(group.members)
                sums = new(count, b, b).index_add_(0, group.slot, by_own[:, own, own])
                pulls = new(count, b).index_add_(0, group.slot, residual[:, own])
                rig = torch.arange(P, device=U.device)[:, None, None]
                U.index_put_((rig.unsqueeze(-1), where.unsqueeze(-1), where.unsqueeze(-2)), _by_rig(sums, P), True)
                g.index_put_((rig, where), _by_rig(pulls, P), accumulate=True)
            E.index_put_((group.at.unsqueeze(-1), group.columns), by_own[:, own, b:], adds)
            if self.parameters.points:
                self._add_points(group, panel, shared, local, (U, E, g), by_moment)
            W.index_add_(0, group.at, by_own[:, b:, b:])
            h.index_add_(0, group.at, residual[:, b:-1])
            c.index_add_(0, group.at, residual[:, -1] / 2)
        cost = _by_rig(c if robust is None else robust, P).sum(-1)
        if by_moment:
            U, g = U.unsqueeze(0), g.unsqueeze(0)
        E, W, h, c = (_by_rig(x, P) for x in (E, W, h, c))
        return cost, Equations(U[..., :s, :s], E[..., :s, :], W, g[..., :s], h, c)

    def _add_points(
        self,
        group: Group,
        panel: Tensor,
        shared: Tensor,
        local: LocalState,
        sums: tuple[Tensor, Tensor, Tensor],
        by_moment: bool,
    ) -> None:
        """Add the displacements' part of a group's views, from their weighted panel, to U, E and g.

        Only a point's own residuals depend on its displacement: its block of U is of 3 x 3 blocks.
        """
        U, E, g = sums
        k, few, N, P = group.size, self.parameters.few, self.parameters.points, len(shared)
        R, _ = self.view_poses(group, shared, local)
        by_point = by_displacement(panel[:, None, -4:-1], R.unsqueeze(1))[:, 0]  # (n, 3, 2, N)
        cross = torch.einsum("nrkp,njkp->nrpj", panel, by_point).flatten(-2)  # (n, k + 7, 3 N)
        D = self.composition(group, shared, local)
        rows = torch.cat([cross[:, :k], D.mT @ cross[:, k:-1]], dim=1)  # intrinsics, camera, moment
        blocks = torch.einsum("nikp,njkp->npij", by_point, by_point)
        by_own, b, at, place = rows[:, : k + POSE], k + POSE, group.at if by_moment else group.rig, slice(few, -POSE)
        number = torch.arange(N, device=U.device)
        columns = torch.arange(few, few + 3 * N, device=U.device)
        E[:, place].index_add_(0, group.at, rows[:, b:].mT)
        if by_moment:
            one, where = at[:, None, None], group.columns
        else:
            count = P * len(group.members)
            by_own = _by_rig(by_own.new_zeros(count, b, 3 * N).index_add_(0, group.slot, by_own), P)
            one, where = torch.arange(P, device=U.device)[:, None, None, None], group.by_camera
        U.index_put_((one, where.unsqueeze(-1), columns), by_own, accumulate=True)
        U.index_put_((one, columns.unsqueeze(-1), where.unsqueeze(-2)), by_own.mT, accumulate=True)
        g[:, place].index_add_(0, at, cross[:, -1])
        inside = U[:, place, place].unflatten(-1, (N, 3)).unflatten(-3, (N, 3))  # (P or M, N, 3, N, 3)
        sums_of = torch.zeros_like(inside[:, :, :, 0]).index_add_(0, at, blocks)
        inside[..., number, :, number, :] += sums_of.transpose(0, 1)

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
        R, _ = self.places(shared)
        R_c, J = (part.flatten(0, 1)[group.stand] for part in (R, turn_rate(self._steps(shared)[..., :3])))
        arm = (R_c @ local[1].flatten(0, 1)[group.at].unsqueeze(-1)).squeeze(-1)
        D = R.new_zeros(len(arm), POSE, 2 * POSE)
        D[:, :3, :3], D[:, 3:, :3] = J, -cross_matrix(arm) @ J
        D[:, 3:, 3:6] = torch.eye(3, dtype=R.dtype, device=R.device)
        D[:, :3, 6:9], D[:, 3:, 9:] = R_c, R_c
        return D

    def _steps(self, shared: Tensor) -> Tensor:
        """The unknowns of the cameras' poses `(P, C, 6)`, 0 for the first."""
        return torch.nn.functional.pad(shared, (0, POSE))[:, self._poses]


def _by_rig(of_all: Tensor, rigs: int) -> Tensor:
    """Of so many rigs, one after the other, with an axis of its own for the rigs."""
    return of_all.unflatten(0, (rigs, len(of_all) // rigs))
