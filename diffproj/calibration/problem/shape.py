"""The shape of a target whose points are free: their block of the normal equations, their frame, and their prior.

A printed board is never quite the grid that it is taken for. With `shape="free"` each point n of the target has a
displacement `d_n (3,)` from its nominal place, in the target's frame, that all views share. With B the derivatives of a
residual by a corner's place in the camera, and R the view's rotation, the derivatives by the displacement are `B R`:
only residuals of the point itself depend on it. So its block of the normal equations is made of 3 x 3 blocks, and a
view has 6 x 3 more numbers for each point; no dense matrix of all residuals and points is ever formed.

**Frame.** Views do not tell where the points are as a whole, how they are turned, and how large they are: any
similarity of points and poses leaves the images alone. So the displacements hold none, in the sense of least squares:
with G the seven directions of a similarity at the nominal points, `G^T d = 0` ("inner constraints"). They enter as
a term `kappa |G^T d|^2` of the cost, which is 0 at the minimum whatever kappa is. Against seven coordinates that are
held, as OpenCV's `calibrateCameraRO` does, the minimum is the same; the points' deviations are the smallest that any
frame gives, and no three corners decide for the others. The unit of length is that of the nominal points: like the
side of a chessboard's square, their size as a whole counts as exact.

**Prior.** How well the target was printed, a standard deviation of each coordinate about its nominal place.

A point that fewer than two views show stays at its nominal place, and its variance is infinite.

**Landmarks** that were surveyed with an error of their own are free points, too: all views see such a landmark off in
the same way. Their covariances are the prior, and the survey says where they are as a whole, as surely as it does: no
frame is added. One of which nothing is seen has the covariance that it came with.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

AXES = ("x", "y", "z")
FEWEST_VIEWS = 2
"""Views that show a point, below which it stays where the target has it."""

HELD = 1e8
"""How many times as firmly as a view of it would a point that stays there is held."""


class Restraint(NamedTuple):
    """What holds the displacements `(P, 3 N)` besides the residuals, as precisions in the unit of the weights.

    Attributes:
        root: of the frame `(P, 3 N, 7)`, whose precision is `root root^T`: no measurement. `(P, 3 N, 0)` without one.
        alone: of points that too few views show `(P, 3 N)`: none either.
        printed: of how well each point was printed, or surveyed `(P, N, 3, 3)`.
        unknown: which displacements nothing tells `(P, 3 N)`.
    """

    root: Tensor
    alone: Tensor
    printed: Tensor
    unknown: Tensor

    @property
    def frame(self) -> Tensor:
        """What is no measurement `(P, 3 N, 3 N)`."""
        return self.root @ self.root.mT + torch.diag_embed(self.alone)

    @property
    def measured(self) -> Tensor:
        """What is one `(P, 3 N, 3 N)`."""
        return block_diagonal(self.printed)

    @property
    def precision(self) -> Tensor:
        """All of it together `(P, 3 N, 3 N)`."""
        return self.frame + self.measured


def block_diagonal(blocks: Float[Tensor, "p n 3 3"]) -> Float[Tensor, "p m m"]:
    """A matrix `(P, 3 N, 3 N)` of the blocks of N points; of none, an empty one."""
    P, N = blocks.shape[:2]
    whole = blocks.new_zeros(P, N, 3, N, 3)
    number = torch.arange(N, device=blocks.device)
    whole[:, number, :, number] = blocks.movedim(0, 1) if N else whole[:, number, :, number]
    return whole.flatten(3).flatten(1, 2)


def names_of(points: int) -> tuple[str, ...]:
    """Names of the displacements of that many points: `x_0 y_0 z_0 x_1 ...`."""
    return tuple(f"{axis}_{number}" for number in range(points) for axis in AXES)


def similarities(points: Float[Tensor, "n 3"], held: Bool[Tensor, "p n"]) -> Float[Tensor, "p m 7"]:
    """The seven directions in which a similarity moves the points that are not held, orthonormal, `(P, 3 N, 7)`."""
    free = (~held).to(points).unsqueeze(-1)
    middle = (free * points).sum(1, keepdim=True) / free.sum(1, keepdim=True).clamp(min=1)
    off = (points - middle) * free
    off = off / off.square().sum((1, 2), keepdim=True).sqrt().clamp(min=1e-300)
    axes = torch.eye(3, dtype=points.dtype, device=points.device)
    shifts = [axis * free for axis in axes]
    turns = [torch.linalg.cross(axis.expand_as(off), off) for axis in axes]
    directions = torch.stack([*shifts, *turns, off], dim=-1).flatten(1, 2)
    return torch.linalg.qr(directions)[0]


def restraint_of(
    points: Float[Tensor, "n 3"],
    pixels: Float[Tensor, "p v n 2"],
    used: Bool[Tensor, "p v n"],
    counts: Float[Tensor, "p v n"],
    printed: Float[Tensor, "p n 3 3"] | None,
    surveyed: bool = False,
) -> Restraint:
    """What fixes the frame of free points, and holds those that too few views show.

    Args:
        points: nominal `(N, 3)`.
        pixels: the corners `(P, V, N, 2)`.
        used: which count `(P, V, N)`.
        counts: how much they do `(P, V, N)`: weights times the views' shares.
        printed: precision of each point's displacement by the prior `(P, N, 3, 3)`, if there is one.
        surveyed: whether that says where the points are as a whole, too, so that no frame is to be fixed.
    """
    seen = used.sum(1)
    if printed is None:
        printed = points.new_zeros(*seen.shape, 3, 3)
    if surveyed:
        nothing = points.new_zeros(len(seen), points.numel())
        return Restraint(nothing[..., None][..., :0], nothing, printed, nothing > 0)
    held = seen < FEWEST_VIEWS
    # The image's scale, squared: the data's own precision, about, so that no direction is stiffer than another.
    count = torch.where(used, counts, 0.0).unsqueeze(-1)
    total = count.sum(2, keepdim=True).clamp(min=1e-300)
    spreads = []
    for places in (pixels, points.expand(*used.shape, 3)):
        middle = (count * places).sum(2, keepdim=True) / total
        spreads.append((count * (places - middle).square()).sum((2, 3)))
    shown = used.any(-1)
    scale = torch.where(shown, spreads[0] / spreads[1].clamp(min=1e-300), 0.0)
    mean = total[:, :, 0, 0] / used.sum(-1).clamp(min=1)
    kappa = (scale * mean * shown).sum(-1).clamp(min=1e-300)[:, None, None]
    G = similarities(points, held)
    alone = held.repeat_interleave(3, dim=-1) & (printed.diagonal(dim1=-2, dim2=-1).flatten(1) == 0)
    return Restraint(kappa.sqrt() * G, HELD * kappa.squeeze(-1) * alone, printed, alone)


def by_displacement(by_place: Float[Tensor, "p v 3 k n"], R: Float[Tensor, "p v 3 3"]) -> Float[Tensor, "p v 3 k n"]:
    """Derivatives of residuals by the displacements, from those by the corners' places in the camera's frame."""
    turned = R.mT @ by_place.flatten(-2)
    return turned.unflatten(-1, by_place.shape[-2:])


def bordered(
    U: Float[Tensor, "p s s"],
    E: Float[Tensor, "p v s l"],
    g: Float[Tensor, "p s"],
    panel: Float[Tensor, "p v r k n"],
    by_point: Float[Tensor, "p v 3 k n"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations with the displacements of N points behind the s other shared unknowns.

    Args:
        U: of the other unknowns `(P, s, s)`; see `least_squares/solver.py`.
        E: `(P, V, s, l)`.
        g: `(P, s)`.
        panel: weighted rows of the shared unknowns, the local ones and the residual, r = s + l + 1.
        by_point: weighted derivatives by the displacements, in the place of a point's own residuals.

    Returns:
        U `(P, s + 3 N, s + 3 N)`, E `(P, V, s + 3 N, l)` and g `(P, s + 3 N)`.
    """
    P, s, N = len(U), U.shape[-1], panel.shape[-1]
    total = s + 3 * N
    # (P, V, r, 3, N), component by component: a fifth of the time of an einsum
    cross = panel[:, :, :, None, 0] * by_point[:, :, None, :, 0]
    for k in range(1, panel.shape[3]):
        cross.addcmul_(panel[:, :, :, None, k], by_point[:, :, None, :, k])
    own = (by_point.unsqueeze(2) * by_point.unsqueeze(3)).sum(4).sum(1)  # (P, 3, 3, N)
    shared = cross[:, :, :s].sum(1).movedim(-1, 2).reshape(P, s, 3 * N)
    whole = U.new_zeros(P, total, total)
    whole[:, :s, :s], whole[:, :s, s:], whole[:, s:, :s] = U, shared, shared.mT
    number = torch.arange(N, device=U.device)
    blocks = whole[:, s:, s:].unflatten(-1, (N, 3)).unflatten(-3, (N, 3))  # (P, N, 3, N, 3)
    blocks[:, number, :, number] = own.movedim(-1, 0)
    local = cross[:, :, s:-1].movedim(2, -1).movedim(2, 3).flatten(2, 3)  # (P, V, 3 N, l)
    pull = cross[:, :, -1].sum(1).mT.flatten(1)
    return whole, torch.cat([E, local], dim=2), torch.cat([g, pull], dim=-1)


def dense(panel: Tensor, by_point: Tensor, s: int) -> Tensor:
    """The panel with a row for each displacement behind the s other shared unknowns `(P, V, r + 3 N, k, N)`.

    For what is computed once; its time and memory are quadratic in the number of points.
    """
    P, V, _, k, N = by_point.shape
    rows = by_point.new_zeros(P, V, N, 3, k, N)
    number = torch.arange(N, device=by_point.device)
    rows[:, :, number, :, :, number] = by_point.movedim(-1, 0)
    return torch.cat([panel[:, :, :s], rows.flatten(2, 3), panel[:, :, s:]], dim=2)
