"""What a fit leaves over: tests of its residuals for what repeats in the image, and for what repeats on the board.

Were the model right, its residuals would be noise. So further unknowns are added, whose effect on the image is smooth,
and the reduction of the cost that they would bring, with all other unknowns free, is predicted by one Gauss-Newton
step: Rao's score test, as an F test. With `g` and `S` the gradient and the normal matrix of the added unknowns, all
others eliminated, the sum of squares would fall by `g^T S^-1 g`.

Where corners err together within each view, unknowns by the dozen take of that what they can. So what the views still
pull at the added unknowns after the step is compared with what independent corners would: if it is more, it is noise
that the views have in common, and the effect must stand out of that.

In the image two kinds of fields are added: radial ones, which another lens would explain; and any that are smooth. On
the board each point may move, alike in all views: a printed board is never quite the grid that it is taken for. This
test holds the poses, which can do nearly all that a stretched or slanted print does; so such a print has a test of its
own. Where the points' shape is significant an effect in the image counts only as far as it is left when that is taken
out, for a pattern that is seen over and over would pass for one of the image.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.problem.bow import bow_shape
from diffproj.calibration.problem.parametrisation import POSE

RADIAL_ORDERS = (3, 5, 7, 9, 11)
"""Chebyshev polynomials of the radius, odd so that the field is smooth in the middle."""
FIELD_ORDER = 4
"""Highest degree of the smooth fields' polynomials, in both coordinates together."""
FREE = 1e-7
"""Part of an added unknown's effect that must be left when all others are free; below, they can do the same."""
MOST = 0.5
"""Part of the sum of squares from which on an effect is none of chance however much views contradict each other: one
step, which is what it is judged by, does not do away with all of it then."""
BLOCK_VIEWS = 500
"""Views that are looked at side by side, for the memory's sake."""


class Excess(NamedTuple):
    """By how much the variance is larger for views that contradict each other `(n,)`, and its degrees of freedom."""

    excess: Tensor
    spare: Tensor


@dataclass(frozen=True)
class Effect:
    """What one kind of added unknowns would explain, for n cameras.

    Attributes:
        share: part of the residuals' sum of squares `(n,)`.
        least_share: the same, or less where the board's shape could explain a part of it.
        deviations: how improbable that is if the residuals are noise, as standard deviations of a normal variable.
        moved: by how much the shared parameters would move if these unknowns were free, to first order `(n, s)`;
            `None` where that is not known.
        strengths: what these unknowns themselves would be `(n, q)`; `None` likewise.
    """

    share: Tensor
    least_share: Tensor
    deviations: Tensor
    moved: Tensor | None = None
    strengths: Tensor | None = None

    def besides(self, apart: "Effect", where: Tensor) -> "Effect":
        """The lesser of this effect and of what is left of it when another is taken out, where there is one."""
        share = torch.where(where, self.least_share.minimum(apart.least_share), self.least_share)
        deviations = torch.where(where, self.deviations.minimum(apart.deviations), self.deviations)
        return replace(self, least_share=share, deviations=deviations)


@dataclass(frozen=True)
class Leftover:
    """What the residuals of n cameras hold besides noise.

    Attributes:
        radial: fields along the radius.
        smooth: smooth fields, the radial ones among them.
        skew: the skew of K alone; nothing where it is among the parameters.
        shape: points of the board moved, alike in all views.
        bow: the same by a paraboloid alone.
        print: the same by a stretch along x and a shear, as printers and wrong sides of squares make them.
        proportion: the same as a proportion of the board changes them, such as the distance of its tags; `None` for
            boards without one.
        focal: focal lengths that are held, relative to themselves; `None` where none is.
        ratio: the same of f_y alone, where its ratio to f_x is held.
        point: coordinates of the principal point that are held.
        moved: how far the points lie off the board within its plane, `(n,)`, RMS in world units, without the noise.
        lifted: how far they lie off that plane `(n,)`, likewise.
    """

    radial: Effect
    smooth: Effect
    skew: Effect
    shape: Effect
    bow: Effect
    print: Effect
    proportion: Effect | None
    focal: Effect | None
    ratio: Effect | None
    point: Effect | None
    moved: Tensor
    lifted: Tensor


def leftover(found: Fit, which: Tensor, shape_deviations: float, by_proportion: Tensor | None = None) -> Leftover:
    """Test the residuals of some cameras of a fit.

    Args:
        found: the fit.
        which: the cameras, `(n,)`, at least one.
        shape_deviations: from which on the board's shape counts as significant, and is taken out first.
        by_proportion: how the board's points move with its proportion `(N, 3)`, if it has one.
    """
    with torch.no_grad():
        length = max(1, BLOCK_VIEWS // found.task.used.shape[1])
        parts = [_Scores(found, rows).leftover(shape_deviations, by_proportion) for rows in which.split(length)]
        return parts[0] if len(parts) == 1 else _joined(parts)


class _Scores:
    """The residuals and derivatives of some cameras `(n,)`, weighted as the solver weights them."""

    def __init__(self, found: Fit, which: Tensor) -> None:
        task, solution = replace(found.task.part(which), objective="image"), found.solution
        self.task = task
        shared, poses = solution.shared.detach()[which], tuple(z.detach()[which] for z in solution.local)
        problem = task.problem
        panel = problem.every_row(problem.linearise(shared, poses), poses)
        squared = panel[:, :, -1].square().sum(2)
        weight = task.used.to(squared) if task.weights is None else torch.where(task.used, task.weights, 0.0)
        if task.loss is not None:
            weight = weight * task.loss.weight(squared)
        # Views that are alike count as one.
        share = torch.ones_like(weight[..., 0]) if task.shares is None else task.shares
        self.share = share * task.used.any(-1)
        self.root = (weight * share.unsqueeze(-1)).sqrt()[:, :, None, None]
        panel = panel * self.root
        s = len(task.names)
        self.shared, self.poses, self.residual = panel[:, :, :s], panel[:, :, s:-1], panel[:, :, -1]
        self.by_point = torch.einsum("pvikn,pvij->pvjkn", panel[:, :, -4:-1], poses[0])  # the board's, in its frame
        self.held = self._held(shared[:, :2])
        if task.basis is not None:
            self.shared = torch.einsum("psq,pvskn->pvqkn", task.basis, self.shared)
        told = share * (2 * task.used.sum(-1) - POSE * task.used.any(-1))
        self.count = told.sum(-1) - self.shared.shape[2]
        if task.restraint is not None:
            self.count = self.count + found.restrained[which]
        # Fields are those of the projected corners: of the seen ones they would know the noise.
        cameras = task.parameters.unpack(shared, poses)
        seen, valid = cameras.project(task.points)
        self.projected = torch.where(valid.unsqueeze(-1), seen, task.pixels)
        self.middle = shared[:, 2:4]

    def leftover(self, shape_deviations: float, by_proportion: Tensor | None) -> Leftover:
        explained, points, moves = self._moved_points()
        if self.task.free:  # they are where the residuals want them
            explained, points, moves = explained * 0, points * 0, moves * 0
        shape = effect(explained, points, _total(self.residual), self.count)
        rest = self.residual - torch.einsum("pvikn,pni->pvkn", self.by_point, moves)
        rings = self._radial()
        known = shape.deviations > shape_deviations

        def besides_shape(columns: Tensor) -> Effect:
            whole = self._added(columns, self.residual, self.count)
            apart = self._added(columns, rest, self.count - points, whole.share > MOST)
            return whole.besides(apart, known)

        radial, smooth = besides_shape(rings), besides_shape(torch.cat([rings, self._fields()], dim=2))
        skew = besides_shape(self._skew())
        bow = self._added(self._bow(), self.residual, self.count)
        uneven = self._added(self._uneven_print(), self.residual, self.count)
        proportion = None
        if by_proportion is not None and not self.task.free:
            proportion = self._added(self._moving(by_proportion), self.residual, self.count)
        focal, ratio, point = (None if columns is None else besides_shape(columns) for columns in self.held)
        moved, lifted = self._spread(moves)
        return Leftover(radial, smooth, skew, shape, bow, uneven, proportion, focal, ratio, point, moved, lifted)

    def _held(self, focal: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Derivatives by focal lengths, their ratio and the principal point, as far as they are held."""
        basis = self.task.basis
        if basis is None:
            return None, None, None
        f_held, c_held = (basis[:, :4] == 0).all(-1).all(0).split(2)
        relative = self.shared[:, :, :2] * focal[:, None, :, None, None]
        return (
            relative[:, :, f_held].sum(2, keepdim=True) if bool(f_held.any()) else None,
            relative[:, :, 1:] if bool((basis[:, 0] * basis[:, 1] != 0).any()) else None,
            self.shared[:, :, 2:4][:, :, c_held] if bool(c_held.any()) else None,
        )

    def _radial(self) -> Tensor:
        off = self.projected - self.middle[:, None, None]
        radius = off.norm(dim=-1, keepdim=True)
        outermost = torch.where(self.task.used.unsqueeze(-1), radius, 0.0).amax((1, 2), keepdim=True).clamp(min=1e-30)
        waves = _chebyshev((radius / outermost).clamp(max=1), max(RADIAL_ORDERS))
        return self._columns([off / radius.clamp(min=1e-30) * waves[order] for order in RADIAL_ORDERS])

    def _fields(self) -> Tensor:
        used = self.task.used.unsqueeze(-1)
        low = torch.where(used, self.projected, torch.inf).amin((1, 2))
        high = torch.where(used, self.projected, -torch.inf).amax((1, 2))
        middle, half = (low + high) / 2, (high - low).clamp(min=1e-30) / 2
        x, y = ((self.projected - middle[:, None, None]) / half[:, None, None]).clamp(-1, 1).unbind(-1)
        along, across = _chebyshev(x, FIELD_ORDER), _chebyshev(y, FIELD_ORDER)
        terms = [along[i] * across[j] for i in range(FIELD_ORDER + 1) for j in range(FIELD_ORDER + 1 - i)]
        nothing = torch.zeros_like(x)
        return self._columns(
            [torch.stack(pair, dim=-1) for term in terms for pair in ((term, nothing), (nothing, term))]
        )

    def _skew(self) -> Tensor:
        down = (self.projected - self.middle[:, None, None])[..., 1]
        return self._columns([torch.stack([down, torch.zeros_like(down)], dim=-1)])

    def _bow(self) -> Tensor:
        return self.by_point[:, :, 2:] * bow_shape(self.task.points)[:, None]

    def _uneven_print(self) -> Tensor:
        along = self.by_point[:, :, :1]
        x, y = self.task.points[:, :2].unbind(-1)
        return torch.cat([along * x, along * y], dim=2)

    def _moving(self, points: Tensor) -> Tensor:
        """As the board's points move all together by `(N, 3)`."""
        return torch.einsum("pvikn,ni->pvkn", self.by_point, points.to(self.by_point)).unsqueeze(2)

    def _columns(self, fields: list[Tensor]) -> Tensor:
        """Weighted derivatives `(n, V, q, 2, N)` by the strengths of fields `(n, V, N, 2)`."""
        return torch.stack(fields, dim=2).mT * self.root

    def _added(self, columns: Tensor, residual: Tensor, count: Tensor, sure: Tensor | None = None) -> Effect:
        """What added unknowns with derivatives `(n, V, q, 2, N)` would explain, all others free.

        Args:
            columns: these derivatives.
            residual: what is to be explained `(n, V, 2, N)`.
            count: its degrees of freedom `(n,)`.
            sure: cameras `(n,)` whose effect counts however much the views contradict each other; if left out, those
                where it explains more than `MOST` of the sum of squares.
        """
        first = self.shared.shape[2]
        rows = torch.cat([self.shared, columns, self.poses, residual.unsqueeze(2)], dim=2).flatten(-2)
        gram = rows @ rows.mT
        k = first + columns.shape[2]
        U, g = gram[..., :k, :k], gram[..., :k, -1:]
        E, W, h = gram[..., :k, k:-1], gram[..., k:-1, k:-1], gram[..., k:-1, -1:]
        unused = ~self.task.used.any(-1)[..., None, None] * torch.eye(POSE, dtype=W.dtype, device=W.device)
        F = torch.linalg.solve_ex((W + unused).mT, E.mT)[0].mT
        scale = U.sum(1).diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
        of_view, pull = (U - F @ E.mT) * (scale * scale.mT).unsqueeze(1), (g - F @ h) * scale.unsqueeze(1)
        S, g = of_view.sum(1), pull.sum(1)
        prior = self.task.whole_prior
        if prior is not None:
            precision = prior.whole
            if self.task.basis is not None:
                precision = self.task.basis.mT @ precision @ self.task.basis
            S = S + torch.nn.functional.pad(precision, (0, k - first, 0, k - first)) * scale * scale.mT
        follow = _inverse(S[:, :first, :first], 1e-13) @ S[:, :first, first:]
        X, y = S[:, first:, first:] - S[:, first:, :first] @ follow, g[:, first:] - follow.mT @ g[:, :first]
        size, turn = torch.linalg.eigh(X.nan_to_num(0.0, 0.0, 0.0))
        free = size > FREE
        along, size = (turn.mT @ y).squeeze(-1), torch.where(free, size, 1.0)
        explained = torch.where(free, along.square() / size, 0.0).sum(-1)
        # The residuals are `projected - seen`, so that the added unknowns step by -X^-1 y, and the others follow.
        step = turn @ torch.where(free, along / size, 0.0).unsqueeze(-1)
        moved = follow @ step
        whole = torch.cat([moved, -step], dim=1)
        left = pull + of_view @ whole.unsqueeze(1)
        left = (turn.mT.unsqueeze(1) @ (left[:, :, first:] - follow.mT.unsqueeze(1) @ left[:, :, :first])).squeeze(-1)
        left = torch.where(self.share > 0, 1 / self.share, 0.0).unsqueeze(-1) * left.square()
        between = torch.where(free, left.sum(1) / size, 0.0).sum(-1)
        unknowns, total = free.sum(-1), _total(residual)
        contradiction = self._contradiction(between, unknowns, total - explained, count)
        sure = explained > MOST * total if sure is None else sure
        contradiction = contradiction._replace(excess=torch.where(sure, 0.0, contradiction.excess))
        found = effect(explained, unknowns, total, count, contradiction)
        moved = (moved * scale[:, :first]).squeeze(-1)
        if self.task.basis is not None:
            moved = (self.task.basis @ moved.unsqueeze(-1)).squeeze(-1)
        return replace(found, moved=moved, strengths=-(step * scale[:, first:]).squeeze(-1))

    def _contradiction(self, left: Tensor, unknowns: Tensor, rest: Tensor, count: Tensor) -> Excess:
        """How much more the views contradict each other on added unknowns than independent corners would.

        Args:
            left: the squares of what the views still pull at these unknowns, over the pulls' curvature `(n,)`.
            unknowns: how many these are `(n,)`.
            rest: the sum of squares that is left with them `(n,)`, of `count - unknowns` degrees of freedom.
            count: degrees of freedom without them.
        """
        views = self.share.sum(-1)
        spare = (unknowns * (views - 1)).clamp(min=1)
        variance = rest / (count - unknowns).clamp(min=1)
        excess = (left * views / spare / variance.clamp(min=1e-300) - 1).clamp(min=0)
        return Excess(excess.pow(3) / (excess.square() + 2 / spare), spare)

    def _moved_points(self) -> tuple[Tensor, Tensor, Tensor]:
        """What points that move explain `(n,)`, how many unknowns that takes, and the moves `(n, N, 3)`.

        The views' poses, which can do a few of these moves, are held: the test is a little too strict.
        """
        A = torch.einsum("pvikn,pvjkn->pnij", self.by_point, self.by_point)
        h = torch.einsum("pvikn,pvkn->pni", self.by_point, self.residual)
        inverse = _inverse(A, 1e-6)
        moves = (inverse @ h.unsqueeze(-1)).squeeze(-1)
        return (moves * h).sum((1, 2)), 3 * self.task.used.any(1).sum(-1), moves

    def _spread(self, moves: Tensor) -> tuple[Tensor, Tensor]:
        """How far the points `(n, N, 3)` moved within the board's plane, and off it `(n,)`, RMS without the noise."""
        variance = _total(self.residual) / self.count.clamp(min=1)
        seen = self.task.used.any(1)
        spread = []
        for axes in (slice(0, 2), slice(2, 3)):
            by = self.by_point[:, :, axes]
            A = torch.einsum("pvikn,pvjkn->pnij", by, by)
            noise = _inverse(A, 1e-6).diagonal(dim1=-2, dim2=-1).sum(-1) * variance.unsqueeze(-1)
            excess = torch.where(seen, moves[..., axes].square().sum(-1) - noise, 0.0).sum(-1) / seen.sum(-1).clamp(
                min=1
            )
            spread.append(excess.clamp(min=0).sqrt())
        return spread[0], spread[1]


def _joined(parts: list[Leftover]) -> Leftover:
    def join(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            return torch.cat(values)
        if values[0] is None:
            return None
        kind = type(values[0])
        return kind(*(join([getattr(value, field.name) for value in values]) for field in fields(kind)))

    return join(parts)


def _total(residual: Tensor) -> Tensor:
    return residual.square().sum((1, 2, 3))


def _inverse(matrix: Tensor, least: float) -> Tensor:
    """The inverse of symmetric matrices without directions below a part of their largest eigenvalue."""
    size, turn = torch.linalg.eigh(matrix.nan_to_num(0.0, 0.0, 0.0))
    kept = size > least * size[..., -1:].clamp(min=1e-300)
    return turn @ (torch.where(kept, 1 / torch.where(kept, size, 1.0), 0.0).unsqueeze(-1) * turn.mT)


def _chebyshev(x: Tensor, order: int) -> list[Tensor]:
    waves = [torch.ones_like(x), x]
    while len(waves) <= order:
        waves.append(2 * x * waves[-1] - waves[-2])
    return waves


def effect(
    explained: Tensor, unknowns: Tensor, total: Tensor, count: Tensor, contradiction: Excess | None = None
) -> Effect:
    """The F test: `explained` of the sum of squares `total` by some unknowns, of `count` degrees of freedom.

    The variance is that of single corners, and larger by what views contradict each other, of fewer degrees of freedom
    then (Satterthwaite 1946). The statistic goes to standard deviations by the cube root that makes F nearly normal
    (Paulson 1942).
    """
    share = torch.where(total > 0, explained / total.clamp(min=1e-300), 0.0).clamp(0, 1 - 1e-12)
    one, two = unknowns.to(share).clamp(min=1), (count - unknowns).to(share)
    enough = (two >= 5) & (unknowns > 0)
    two = two.clamp(min=5)
    ratio = share / one / ((1 - share) / two)
    if contradiction is not None:
        excess, spare = contradiction
        ratio = ratio / (1 + excess)
        two = (1 + excess).square() / (1 / two + excess.square() / spare)
    return Effect(share, share, torch.where(enough, f_deviations(ratio, one, two), 0.0))


def f_deviations(ratio: Tensor, one: Tensor, two: Tensor) -> Tensor:
    """How improbable a ratio of two variances of that many degrees of freedom is, as deviations of a normal variable.

    By the cube root that makes Fisher's F nearly normal (Paulson 1942).
    """
    a, b = 2 / (9 * one), 2 / (9 * two)
    root = ratio ** (1 / 3)
    return ((1 - b) * root - (1 - a)) / (b * root.square() + a).sqrt()
