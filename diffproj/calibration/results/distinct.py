"""Views that show the board alike, as a video of a board at rest gives them, and what they count together.

Copies of a view bring no new information. Neither do views that are nearly alike: what noise they average away is small
beside what they have in common, the errors of the lens model, of the board's shape and of the detector. So each view
counts one over the number of views that show the board as it does, itself among them: together they count as one, in
any order, and a board that moves slowly counts about once for each place where it can be told from before.

Noise moves corners independently, motion moves neighbours together. So the displacement between two views u and v is
measured by the mean over neighbouring corners a, b of

    (a_u - a_v) . (b_u - b_v) = a_u . b_u + a_v . b_v - a_u . b_v - b_u . a_v

which noise of any size and single wrong corners leave near zero, and which is a product of matrices for all pairs of
views at once.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.numerics import spread_evenly

ALIKE_PX = 2.0
"""Displacement between two views, in pixels, below which they show the board alike. (Of 13 bundled views the closest
two are 15 px apart, of 1000 random ones 9 px.)"""
ALIKE_PART = 0.05
"""The same relative to the RMS distance of the board's corners from their centroid on the image."""
COMMON = 0.25
"""Part of a view's corners that another must share to be compared with it."""
COMPARISONS, FEWEST = 20_000_000, 16
"""Corners times pairs of views up to which all corners are compared; of more views fewer are, but at least so many."""
NEIGHBOURS = 3
"""Neighbours of each corner that it is compared along with, so that some are left where corners are hidden."""
MARKER = 11
"""Corners of a board up to which none are neighbours, for a turn moves them apart: each is compared by itself."""
FIRST = 8
"""Corners, with one neighbour each, that are compared first; in most sets they tell all views from each other."""
ONE_VIEW_PX = 10.0
"""Displacement up to which all views of a camera tell no more about it than one does."""
SENTENCES = 3
"""Places with several views that a summary tells one by one."""
ROWS = 1000
"""Views that are compared with all others at a time, for the sake of memory."""


def alike(
    points: Float[Tensor, "n 3"], pixels: Float[Tensor, "p v n 2"], used: Bool[Tensor, "p v n"]
) -> Bool[Tensor, "p v v"]:
    """Which views of each camera show the board alike; on the diagonal, those with a corner that is used.

    Args:
        points: the board's.
        pixels: finite where used.
        used: which corners count.
    """
    products = _Products(points, pixels, used, max(FEWEST, COMPARISONS // used.shape[1] ** 2), NEIGHBOURS)
    count = used.sum(-1).clamp(min=1)
    seen = torch.where(used.unsqueeze(-1), pixels, 0.0)
    offset = torch.where(used.unsqueeze(-1), pixels - (seen.sum(-2) / count.unsqueeze(-1)).unsqueeze(-2), 0.0)
    limit = (ALIKE_PART**2 * offset.square().sum((-2, -1)) / count).clamp(max=ALIKE_PX**2)
    corners = products.mask.sum(-1)
    blocks = []
    for rows in products.rows():
        common = products.common(rows)
        lowest = torch.minimum(limit[:, rows].unsqueeze(-1), limit.unsqueeze(-2))
        enough = COMMON * torch.minimum(corners[:, rows].unsqueeze(-1), corners.unsqueeze(-2))
        blocks.append((products.moved(rows) < lowest * common) & (common >= enough) & (common > 0))
    same = torch.cat(blocks, dim=1)
    same.diagonal(dim1=-2, dim2=-1).copy_(used.any(-1))
    return same


def shares(
    points: Float[Tensor, "n 3"], pixels: Float[Tensor, "p v n 2"], used: Bool[Tensor, "p v n"]
) -> Float[Tensor, "p v"] | None:
    """How much each view counts, 1 over the number of those that show the board alike; `None` where all count fully."""
    products = _Products(points, pixels, used, FIRST, 1)
    doubtful = torch.cat([products.any_below(rows, ALIKE_PX**2) for rows in products.rows()], dim=-1)
    if not bool(doubtful.any()):
        return None
    p, v = (doubtful.any(axis).nonzero().flatten() for axis in (1, 0))
    p = p.unsqueeze(-1)
    number = alike(points, pixels[p, v], used[p, v]).sum(-1)
    if not bool((number > 1).any()):
        return None
    return torch.ones_like(pixels[..., 0, 0]).index_put((p, v), number.clamp(min=1).to(pixels).reciprocal())


def described(same: Bool[Tensor, "v v"], names: tuple[str, ...]) -> str:
    """What `alike` says of one camera, in a sentence."""
    same = same.cpu()
    if len(set(names)) < len(names):
        names = tuple(f"view {number + 1}" for number in range(len(names)))
    left, parts = same.diagonal().clone(), []
    for view in range(len(names)):
        others = (same[view] & left).nonzero().flatten().tolist() if bool(left[view]) else []
        left[others] = False
        others = [other for other in others if other != view]
        if others:
            parts.append(f"{_listed(others, names)} show{'s' * (len(others) == 1)} the board as {names[view]} does")
    number = same.sum(-1)[same.diagonal()].to(torch.float64)
    rest = len(parts) - SENTENCES
    more = f"; {rest} more group{'s' * (rest > 1)} of views alike" if rest > 0 else ""
    return f"{'; '.join(parts[:SENTENCES])}{more}: {len(number)} views count as {float(number.reciprocal().sum()):.3g}"


def _listed(views: list[int], names: tuple[str, ...]) -> str:
    """Views by name: the first and the last of a row, or the first few."""
    if len(views) > 2 and views[-1] - views[0] == len(views) - 1:
        first, last = names[views[0]], names[views[-1]]
        numbered = first.startswith("view ") and last.startswith("view ")
        return f"views {first[5:]} to {last[5:]}" if numbered else f"{first} to {last}"
    few = ", ".join(names[view] for view in views[:4])
    return few if len(views) <= 4 else f"{few} and {len(views) - 4} more"


def one_view(
    points: Float[Tensor, "n 3"], pixels: Float[Tensor, "p v n 2"], used: Bool[Tensor, "p v n"]
) -> Bool[Tensor, " p"]:
    """Of which cameras no two views differ by more than a few pixels, or there is but one."""
    if bool(used.all()):  # mostly the middles tell: that spares the rest
        middle = pixels.mean(-2)
        far = (middle - middle[:, :1]).abs().amax((-2, -1)) > 3 * ONE_VIEW_PX
        if bool(far.all()):
            return ~far
    products = _Products(points, pixels, used, FEWEST, NEIGHBOURS)
    most = used.sum(-1).argmax(-1)
    problems = torch.arange(len(used), device=used.device)
    left, mask = (whole[problems, most].unsqueeze(1) for whole in (products.left, products.mask))
    moved, common = left @ products.right.mT, mask @ products.mask.mT
    unused = ~used.any(-1)
    itself = torch.nn.functional.one_hot(most, used.shape[1]) > 0
    near = (moved < (2 * ONE_VIEW_PX) ** 2 * common).squeeze(1) | itself | unused
    one = near.all(-1)
    if bool((one & ((~unused).sum(-1) > 1)).any()):  # none is far from one of them: are the others from each other?
        for rows in products.rows():
            near = products.moved(rows) <= ONE_VIEW_PX**2 * products.common(rows)
            one = one & near.flatten(1).all(-1)
    return one


class _Products:
    """Sums over the neighbouring corners that both of two views show, for all pairs of views."""

    def __init__(self, points: Tensor, pixels: Tensor, used: Tensor, corners: int, neighbours: int) -> None:
        seen = used.flatten(0, 1).any(0).nonzero().flatten()
        N = len(seen)
        corner = neighbour = seen
        if N > MARKER:
            some = spread_evenly(N, min(N, corners), points.device)
            apart = torch.cdist(points[seen[some]], points[seen])
            apart[torch.arange(len(some), device=some.device), some] = torch.inf
            corner = seen[some].repeat_interleave(neighbours)
            neighbour = seen[apart.topk(neighbours, largest=False).indices.flatten()]
        both = used[..., corner] & used[..., neighbour]
        self.mask = both.to(pixels)
        origin = pixels[:, :1, :1]  # near the others: squares of coordinates would cancel
        a, b = (torch.where(both.unsqueeze(-1), pixels[..., of, :] - origin, 0.0) for of in (corner, neighbour))
        own = (a * b).sum(-1)
        a, b = a.flatten(-2), b.flatten(-2)
        self.left, self.right = torch.cat([own, self.mask, a, b], dim=-1), torch.cat([self.mask, own, -b, -a], dim=-1)

    def rows(self) -> list[slice]:
        """Blocks of views."""
        return [slice(start, start + ROWS) for start in range(0, self.mask.shape[1], ROWS)]

    def moved(self, rows: slice) -> Tensor:
        """Sums of the displacements' products `(P, rows, V)`."""
        return self.left[:, rows] @ self.right.mT

    def common(self, rows: slice) -> Tensor:
        """How many there are `(P, rows, V)`."""
        return self.mask[:, rows] @ self.mask.mT

    def any_below(self, rows: slice, limit: float) -> Tensor:
        """Whether the mean product with any other view is below a limit `(P, rows)`; in as few steps as there are."""
        left = torch.cat([self.left[:, rows], self.mask[:, rows]], dim=-1)
        moved = left @ torch.cat([self.right, -limit * self.mask], dim=-1).mT
        moved.diagonal(rows.start, dim1=-2, dim2=-1).fill_(torch.inf)
        return moved.amin(-1) <= 0  # 0 where they have no corners in common: more have to be looked at
