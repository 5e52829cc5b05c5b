"""The joint covariance of a calibration, of intrinsics, lens and all poses, stored in blocks.

Let `U, E_v, W_v` be the blocks of the normal equations at the minimum (see `least_squares/solver.py`), and `M` the
covariance of the scores, the gradients of the residuals' cost. To first order, the errors of the parameters are

    dx   = -S^-1 sum u_v              u_v = g_v - F_v h_v     F_v = E_v W_v^-1     S = U - sum E_v W_v^-1 E_v^T
    dz_v = -W_v^-1 h_v - F_v^T dx

so that a few small blocks per view give any entry of the full covariance, which for a thousand views would have 36
million. Two forms:

* M is a variance times the normal matrix, for least squares the residual variance
  `sigma^2 = sum w |e|^2 / (2 n - parameters)`;
* M is another matrix, as for the plane objective: the sandwich.

What these variances and matrices are for each kind of fit, `trust/uncertainty.py` says.

A prior counts as a measurement with the prior's covariance.

A parameter that the corners do not determine has infinite variance, and covariance 0 with all others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import instance, position
from diffproj._core.copying import Copied
from diffproj._core.numerics import broadcast_batches
from diffproj._core.shown import Shown, counted, number
from diffproj.calibration.least_squares.eliminated import inverse, reduced
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.problem.shape import AXES, names_of
from diffproj.calibration.results.fields import mask, tensor


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(Copied, Shown):
    """Joint covariance of shared parameters and poses, for batch shape `*B`.

    A pose is perturbed by `R <- exp(omega) R`, `t <- t + tau`: its six coordinates are omega in radians (about the
    camera's axes) and tau in world units. Far from the world's origin a small turn is a large shift, and the two
    nearly cancel; `about_middle` has poses that turn about the target instead.

    Attributes:
        names: of the s shared parameters: `f_x f_y c_x c_y`, then those of the lens and of the target's shape.
        shared: their covariance `(*B, s, s)`; rows of fixed parameters are 0.
        undetermined: which shared parameters the corners do not determine `(*B, s)`.
        undetermined_views: which poses they do not determine `(*B, V)`.
        dispersion: how many times larger the variances are than they would be if all corners erred independently of
            each other `(*B,)`, at least 1: how much more the views contradict each other than such corners would. The
            square root divides a deviation for a comparison with tools that do not look for it; not where focal lengths
            differ from view to view, nor that of a rig whose cameras see all corners of a view off together
            (`RigCalibration.covariance`).
        middle: the middle of the target `(3,)` in the world; `None` stands for the world's origin.
    """

    names: tuple[str, ...]
    shared: Float[Tensor, "*batch s s"]
    undetermined: Bool[Tensor, "*batch s"]
    undetermined_views: Bool[Tensor, "*batch v"]
    dispersion: Float[Tensor, "*batch"]
    _follow: Tensor  # F_v^T (*B, V, 6, s): minus the derivative of the pose by the shared parameters
    _mixed: Tensor  # Cov(W_v^-1 h_v, dx), (*B, V, 6, s)
    _alone: Tensor  # Cov(W_v^-1 h_v), (*B, V, 6, 6); poses turn about the middle in these three
    middle: Float[Tensor, "3"] | None = None
    _arm: Tensor | None = None  # R_v middle (*B, V, 3), from the world's origin to the middle along the camera's axes
    _common: Tensor | None = None  # what moves all poses besides, by errors of variance 1 (*B, V, 6, e); part of _alone

    @property
    def about_middle(self) -> "Covariance":
        """The same of poses that turn about the middle of the target: `t + R middle <- t + R middle + tau`."""
        return replace(self, middle=None, _arm=None)

    @property
    def deviations(self) -> dict[str, Float[Tensor, "*batch"]]:
        """The standard deviation of each shared parameter, by name."""
        spread = self.shared.diagonal(dim1=-2, dim2=-1).sqrt()
        return dict(zip(self.names, spread.unbind(-1), strict=True))

    @property
    def points(self) -> Float[Tensor, "*batch coordinates coordinates"]:
        """That of the coordinates of all points of a target whose points were free, x y z of each in turn `(3 N, 3 N)`.

        Empty where their places were known.
        """
        first = next((place for place, name in enumerate(self.names) if name == names_of(1)[0]), len(self.names))
        last = first
        while last < len(self.names) and self.names[last][:1] in AXES and "." not in self.names[last]:
            last += 1  # behind them stand the other cameras of a rig
        return self.shared[..., first:last, first:last]

    def _facts(self) -> list[str]:
        return [
            counted(self.shared.shape[:-2], "camera"),
            f"{len(self.names)} shared parameters",
            f"{self.undetermined_views.shape[-1]} poses",
            f"dispersion {number(self.dispersion)}",
        ]

    def _columns(self) -> dict[str, list[Any]]:
        texts = [number(deviation, ".4g") for deviation in self.deviations.values()]
        return {"parameter": list(self.names), "standard deviation": texts}

    def between(self, view: int, other: int) -> Float[Tensor, "*batch 6 6"]:
        """The cross-covariance of the poses of two views; the covariance of the pose where they are the same."""
        view, other = self._number("view", view), self._number("other", other)
        F, G = self._follow[..., view, :, :], self._follow[..., other, :, :]
        Q, P = self._mixed[..., view, :, :], self._mixed[..., other, :, :]
        blocks = F @ zero_where_infinite(self.shared) @ G.mT - Q @ G.mT - F @ P.mT
        same = view == other
        if same:
            blocks = blocks + self._alone[..., view, :, :]
        elif self._common is not None:
            blocks = blocks + self._common[..., view, :, :] @ self._common[..., other, :, :].mT
        blocks = self._turns[..., view, :, :] @ blocks @ self._turns[..., other, :, :].mT
        unknown = (self.undetermined_views[..., view] | self.undetermined_views[..., other])[..., None, None]
        infinite = torch.diag_embed(torch.full_like(blocks[..., 0], torch.inf))
        return torch.where(unknown, infinite if same else torch.zeros_like(blocks), blocks)

    @property
    def poses(self) -> Float[Tensor, "*batch v 6 6"]:
        """The covariance of every pose `(*B, V, 6, 6)`; infinite on the diagonal where it is not determined."""
        F, Q = self._follow, self._mixed
        shared = zero_where_infinite(self.shared).unsqueeze(-3)
        blocks = F @ shared @ F.mT - Q @ F.mT - F @ Q.mT + self._alone
        blocks = self._turns @ blocks @ self._turns.mT
        infinite = torch.diag_embed(torch.full_like(blocks[..., 0], torch.inf))
        return torch.where(self.undetermined_views[..., None, None], infinite, blocks)

    def cross(self, view: int) -> Float[Tensor, "*batch 6 s"]:
        """The cross-covariance of a pose (rows) and the shared parameters (columns)."""
        view = self._number("view", view)
        cross = self._mixed[..., view, :, :] - self._follow[..., view, :, :] @ zero_where_infinite(self.shared)
        return torch.where(self.undetermined_views[..., view, None, None], 0.0, self._turns[..., view, :, :] @ cross)

    def view(self, view: int) -> Float[Tensor, "*batch sp sp"]:
        """The joint covariance of the shared parameters and the pose of one view, `(*B, s + 6, s + 6)`."""
        cross, pose = self.cross(view), self.between(view, view)
        return torch.cat([torch.cat([self.shared, cross.mT], dim=-1), torch.cat([cross, pose], dim=-1)], dim=-2)

    def following(self, known: "Covariance") -> "Covariance":
        """The covariance of these poses together with shared parameters from another calibration, `known`.

        The noise of both is assumed independent; the bow of the other calibration's board is dropped.
        """
        instance("known", known, Covariance, "a dp.Covariance")
        s = self.shared.shape[-1]
        if known.names[:s] != self.names:
            raise ValueError(
                f"known: want a covariance of {', '.join(self.names)}, got one of {', '.join(known.names)}"
            )
        broadcast_batches(covariance=self.shared.shape[:-2], known=known.shared.shape[:-2])
        shared, undetermined = known.shared[..., :s, :s], known.undetermined[..., :s]
        batch = self.shared.shape[:-2]
        shared, undetermined = shared.expand(*batch, s, s), undetermined.expand(*batch, s)
        return replace(self, shared=shared, undetermined=undetermined)

    def full(self) -> Float[Tensor, "*batch all all"]:
        """The full covariance `(*B, s + 6 V, s + 6 V)`: shared parameters, then the poses in order.

        Infinite variances are on the diagonal only. Memory is quadratic in the number of views.
        """
        V = self._alone.shape[-3]
        F, Q = self._follow.flatten(-3, -2), self._mixed.flatten(-3, -2)
        known = self.undetermined_views.repeat_interleave(6, dim=-1).logical_not().to(F.dtype)
        poses = F @ zero_where_infinite(self.shared) @ F.mT - Q @ F.mT - F @ Q.mT
        alone = self._alone
        if self._common is not None:
            poses = poses + self._common.flatten(-3, -2) @ self._common.flatten(-3, -2).mT
            alone = alone - self._common @ self._common.mT
        poses = poses + torch.stack(
            [torch.nn.functional.pad(alone[..., v, :, :], (6 * v, 6 * (V - 1 - v))) for v in range(V)], dim=-3
        ).flatten(-3, -2)
        cross = Q - F @ zero_where_infinite(self.shared)
        turn = torch.zeros_like(poses)
        for v in range(V):
            turn[..., 6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = self._turns[..., v, :, :]
        poses, cross = turn @ poses @ turn.mT, turn @ cross * known.unsqueeze(-1)
        poses = poses * known.unsqueeze(-1) * known.unsqueeze(-2)
        poses = poses + torch.diag_embed(torch.where(known > 0, 0.0, torch.inf))
        return torch.cat([torch.cat([self.shared, cross.mT], dim=-1), torch.cat([cross, poses], dim=-1)], dim=-2)

    def to_fields(self) -> dict[str, Any]:
        """Everything in it as plain lists, for a file. An infinite variance is 0 here; the masks tell where."""
        tensors = {
            "dispersion": self.dispersion,
            "shared": torch.where(self.shared.isfinite(), self.shared, 0.0),
            "follow": self._follow,
            "mixed": self._mixed,
            "alone": self._alone,
            "undetermined": self.undetermined,
            "undetermined_views": self.undetermined_views,
        }
        if self.middle is not None and self._arm is not None:
            tensors |= {"middle": self.middle, "arm": self._arm}
        if self._common is not None:
            tensors["common"] = self._common
        return {"names": list(self.names), **{key: tensor.tolist() for key, tensor in tensors.items()}}

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> "Covariance":
        """The covariance that `to_fields` gave, in float64.

        Raises:
            KeyError: a field is missing.
            ValueError: a field holds something other than numbers, shapes do not fit each other, or a variance is
                negative.

        Example:
            >>> import diffproj as dp
            >>> covariance = dp.calibrate(dp.example_views("left"), dp.Chessboard()).covariance
            >>> torch.equal(dp.Covariance.from_fields(covariance.to_fields()).full(), covariance.full())
            True
        """
        names = fields["names"]
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise ValueError("names: want a list of texts, got something else")
        count = len(names)
        undetermined_views = mask(fields, "undetermined_views")
        *batch, views = undetermined_views.shape
        undetermined = mask(fields, "undetermined", (*batch, count))
        shared = tensor(fields, "shared", (*batch, count, count), gaps=True)
        follow, mixed = (tensor(fields, name, (*batch, views, 6, count), gaps=True) for name in ("follow", "mixed"))
        alone = tensor(fields, "alone", (*batch, views, 6, 6), gaps=True)
        for name, block in (("shared", shared), ("alone", alone)):
            if bool((block.diagonal(dim1=-2, dim2=-1) < 0).any()):
                raise ValueError(f"{name}: want variances of at least 0, got a negative one")
        dispersion = torch.ones_like(shared[..., 0, 0])  # a file of an earlier version has none
        if "dispersion" in fields:
            dispersion = tensor(fields, "dispersion", tuple(batch), least=0, gaps=True)
        middle = []
        if "middle" in fields or "arm" in fields:
            middle = [tensor(fields, "middle", (3,)), tensor(fields, "arm", (*batch, views, 3))]
        common = fields.get("common")
        if common is not None:
            common = tensor(fields, "common", (*batch, views, 6, None), gaps=True)
        infinite = torch.diag_embed(torch.where(undetermined, torch.inf, 0.0).to(shared))
        known = undetermined, undetermined_views, dispersion
        found = cls(tuple(names), shared + infinite, *known, follow, mixed, alone, *middle)
        return replace(found, _common=common)

    @property
    def has_gaps(self) -> Bool[Tensor, "*batch"]:
        """Whether anything in it is not a number `(*B,)`, as of a camera that did not converge."""
        blocks = (self._follow, self._mixed, self._alone)
        gaps = self.shared.isnan().flatten(-2).any(-1) | self.dispersion.isnan()
        return gaps | torch.stack([block.isnan().flatten(-3).any(-1) for block in blocks]).any(0)

    def _number(self, name: str, view: int) -> int:
        return position(name, view, self._alone.shape[-3], "views")

    @property
    def _turns(self) -> Tensor:
        """From poses that turn about the middle to those about the world's origin `(*B, V, 6, 6)`.

        The translation from the origin is `t = t_middle - R middle`, so that `tau = tau_middle + (R middle) x omega`.
        """
        turns = torch.eye(6, dtype=self._alone.dtype, device=self._alone.device).expand(self._alone.shape)
        if self._arm is None:
            return turns
        x, y, z = self._arm.unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
        return turns + torch.nn.functional.pad(cross, (0, 3, 3, 0))


def zero_where_infinite(covariance: Tensor) -> Tensor:
    """The same with 0 where it is infinite."""
    return torch.where(covariance.isinf(), 0.0, covariance)


def _without_negative(covariance: Tensor) -> Tensor:
    """The same with 0 for variances that rounding made negative, as of what is held across the axes."""
    return covariance - torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1).clamp(max=0))


class Scores(NamedTuple):
    """Covariance of the scores per view: shared-shared `(P, V, s, s)`, shared-local, local-local."""

    U: Tensor
    E: Tensor
    W: Tensor


def covariance(
    equations: Equations,
    names: Sequence[str],
    variance: Tensor,
    *,
    basis: Tensor | None = None,
    precision: Tensor | None = None,
    scores: Scores | None = None,
    dispersion: Tensor | None = None,
    shares: Tensor | None = None,
    frame: Tensor | None = None,
    printed: Tensor | None = None,
    unseen: Tensor | None = None,
) -> Covariance:
    """The covariance of P calibrations, from their normal equations.

    Args:
        equations: undamped, at the minimum, with the prior's precision included in U.
        names: of the s shared parameters.
        variance: of a residual component, `(P,)`; not used with `scores`.
        basis: of the free directions of the shared parameters `(P, s, q)`; all if left out.
        precision: the prior's `(P, s, s)`.
        scores: covariance of the scores, for the sandwich form.
        dispersion: factor on the covariance of the scores `(P,)`; 1 if left out.
        shares: how much each view counts `(P, V)`; 1 if left out. U holds them, the blocks of the views do not.
        frame: that part of U which is no measurement but a choice, of the frame of free points `(P, s, s)`.
        printed: that part of U which says how well the target was printed, in the unit of the weights `(P, s, s)`.
        unseen: shared parameters that nothing tells `(P, s)`, held by the frame.
    """
    dispersion = torch.ones_like(equations.U[:, 0, 0]) if dispersion is None else dispersion
    phi = dispersion[:, None, None]
    S, F, inverse_W, unknown_views = reduced(equations, basis, shares)
    size = equations.U.diagonal(dim1=-2, dim2=-1)
    if basis is not None:
        T = basis.mT
        size = (T @ equations.U @ basis).diagonal(dim1=-2, dim2=-1)
        precision, frame = (None if part is None else T @ part @ basis for part in (precision, frame))
        printed = None if printed is None else T @ printed @ basis
        if scores is not None:
            scores = Scores(T.unsqueeze(1) @ scores.U @ basis.unsqueeze(1), T.unsqueeze(1) @ scores.E, scores.W)
    share = torch.ones_like(F[..., :1, :1]) if shares is None else shares[..., None, None]
    inverse_S, unknown = inverse(S, size)
    prior = torch.zeros_like(S) if precision is None else precision
    if scores is None:
        v = variance[:, None, None] * phi
        middle = v * (S - prior) + prior
        if frame is not None and printed is not None:
            middle = middle - v * (frame + printed) + variance[:, None, None] * printed
        mixed = torch.zeros_like(F.mT)
        alone = v.unsqueeze(1) * inverse_W
    else:
        scores = Scores(*(phi.unsqueeze(1) * block for block in scores))
        leaning = F @ scores.E.mT
        middle = (share * (scores.U - leaning - leaning.mT + F @ scores.W @ F.mT)).sum(1) + prior
        mixed = inverse_W @ (scores.E.mT - scores.W @ F.mT) @ inverse_S.unsqueeze(1)
        alone = inverse_W @ scores.W @ inverse_W
    shared = inverse_S @ middle @ inverse_S
    follow = F.mT
    if basis is not None:
        # Sensitivity to all shared parameters, fixed ones included, to propagate their known errors (`following`).
        follow = inverse_W @ equations.E.mT
        shared, mixed = _without_negative(basis @ shared @ basis.mT), mixed @ basis.mT.unsqueeze(1)
        unknown = (basis.abs() @ unknown.to(basis).unsqueeze(-1)).squeeze(-1) > 0
        unseen = None if unseen is None else unseen & (basis != 0).any(-1)
    unknown = unknown if unseen is None else unknown | unseen
    shared = (shared + shared.mT) / 2
    shared = torch.where(unknown.unsqueeze(-1) | unknown.unsqueeze(-2), 0.0, shared)
    shared = shared + torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(shared))
    return Covariance(tuple(names), shared, unknown, unknown_views, dispersion, follow, mixed, (alone + alone.mT) / 2)


def points_turned(covariance: Covariance, turn: Float[Tensor, "3 3"], few: int) -> Covariance:
    """The same with the coordinates of free points, behind `few` other parameters, along other axes `turn x`.

    Those of a point count as undetermined together, or not at all.
    """
    s = covariance.shared.shape[-1]
    if s == few:
        return covariance
    J = torch.block_diag(torch.eye(few, dtype=turn.dtype, device=turn.device), *[turn] * ((s - few) // 3))
    infinite = torch.diag_embed(torch.where(covariance.undetermined, torch.inf, 0.0).to(covariance.shared))
    shared = _without_negative(J @ zero_where_infinite(covariance.shared) @ J.mT) + infinite
    return replace(covariance, shared=shared, _follow=covariance._follow @ J.mT, _mixed=covariance._mixed @ J.mT)


def reshaped(covariance: Covariance, batch: Sequence[int]) -> Covariance:
    """The covariance of `(P, ...)` problems with the batch shape `*B` in the place of P."""
    parts = {
        name: getattr(covariance, name).unflatten(0, batch) if batch else getattr(covariance, name).squeeze(0)
        for name in ("shared", "undetermined", "undetermined_views", "dispersion", "_follow", "_mixed", "_alone")
    }
    return Covariance(covariance.names, **parts)
