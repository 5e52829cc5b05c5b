"""Find a circle grid in a photograph: dark ellipses, or light ones, that lie on a lattice, counted as its circles."""

import itertools
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.ellipses import Ellipses, dark_ellipses, fit_ellipses
from diffproj.targets.repeated import Taken, largest
from diffproj.targets.surface import Limits, off_surface

WHOLE, FULL = 0.75, 0.5
"""Shares of all circles, and of those along each side, that a board must show, as chessboards do."""

OFF = 0.3
"""How far off the place where a step leads a circle may be, relative to the step."""

ALIKE = 2.2
"""Most ratio of the sizes of neighbouring circles."""

SEEDS = 12
"""Circles from which a lattice is begun."""

MISFIT, VAGUE = 0.25, 0.20
"""Misfit, and standard deviation in px, from which a circle is not taken."""

ORDINARY, UNUSUAL = 0.12, 2.5
"""Misfit up to which any circle is taken, and the same relative to the view's median, whichever is larger."""

LIMITS = Limits(deviations=4.0, loose=0.01, least=0.15)
"""How far off its neighbours' surface a circle may lie: glare and the edge of a shadow draw a middle aside, and misfit
little. Of 800 circles in plain light none was farther."""

WORSE, FAINTER, VAGUER = 1.15, 0.85, 1.4
"""What is left over, the contrast and the standard deviation, relative to the view's median, beyond which a circle is
held to its neighbours tightly: it is in another light than they."""

DROWNED, CUT = 0.45, 0.2
"""Contrast relative to the median below which a circle is not taken where glare cuts off so many of its pixels."""

TIGHT = Limits(deviations=4.0, loose=0.002, least=0.04)
"""How far off such a circle may lie."""

ROUNDS = 6
"""Most rounds in which circles that lie off are hidden, those farthest off first: they draw the others' surface."""

LONGEST = 1600
"""Longer side in px of the copy in which circles are sought first."""

BESIDE = 2.1
"""How far from a circle those lie that tell the scale there, in distances between nearest ones."""

_BASES = [
    basis
    for entries in itertools.product((-1, 0, 1), repeat=4)
    if round(np.linalg.det(basis := np.array(entries).reshape(2, 2))) == 1
]
"""Bases of a lattice of whole numbers: seen at a slant, its nearest points need not be those along rows and columns."""


class Circles(NamedTuple):
    """A circle grid in a photograph.

    Attributes:
        taken: the middles of the circles' images.
        diameter: of the circles, as their images and the distances between these tell it, in world units.
        diameter_px: the same in px.
    """

    taken: Taken
    diameter: float
    diameter_px: float


def find_circles(image: Shaped[np.ndarray, "h w"], grey: UInt8[np.ndarray, "h w"], board: CircleGrid) -> Circles | None:
    """The middles of the circles' images in px, in the board's order; None where it is not there.

    They may be light on dark as well. Of orders that look alike, the one whose first circle is nearest the image's top
    left.

    Args:
        image: `(H, W)`, uint8 or float32.
        grey: the same in 8 bits.
        board: the grid.
    """
    for small in _copies(grey):
        scale = float(np.mean(np.array(grey.shape) / small.shape))
        for shown, whole in ((small, image), (255 - small, 255 - image)):
            found = dark_ellipses(shown)
            ellipses = Ellipses((found.centres + 0.5) * scale - 0.5, found.axes / scale)
            if len(ellipses.centres) < WHOLE * len(board):
                continue
            refined = [_refined(whole, ellipses, numbers, board) for numbers in _numbered(ellipses, board)]
            boards = [one for one in refined if one is not None]
            taken = largest([middles for middles, _ in boards])
            if taken is not None:
                return Circles(taken, *next(sizes for middles, sizes in boards if middles is taken.points))
    return None


def _copies(grey: UInt8[np.ndarray, "h w"]) -> Iterator[UInt8[np.ndarray, "_h _w"]]:
    """The image at sizes to search: first at most `LONGEST` px, then itself, then half of the first."""
    factor = min(1.0, LONGEST / max(grey.shape))
    first = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    yield first
    if factor < 1:
        yield grey
    yield cv2.resize(first, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _numbered(ellipses: Ellipses, board: CircleGrid) -> Iterator[Int[np.ndarray, " n"]]:
    """Which ellipse is which circle, -1 for none, for each board that they show, each in places of its own."""
    places = board.places
    steps = _lattice_places(board)
    taken: set[int] = set()
    for cells in _lattices(ellipses):
        if len(cells) < WHOLE * len(board) or not taken.isdisjoint(cells.values()):
            continue
        candidates = []
        nodes, which = np.array(list(cells)), np.array(list(cells.values()))
        for basis in _BASES:
            put = nodes @ basis.T
            votes = Counter(map(tuple, (steps[None] - put[:, None]).reshape(-1, 2).tolist()))
            for shift, count in votes.most_common(2):
                if count >= WHOLE * len(board):
                    candidates.append((count, basis, shift))
        most = max((count for count, *_ in candidates), default=0)
        orders = []
        for count, basis, shift in candidates:
            if count < most:
                continue
            there = {tuple(node): int(k) for node, k in zip((nodes @ basis.T + shift).tolist(), which, strict=True)}
            order = np.array([there.get(tuple(place), -1) for place in steps.tolist()])
            seen = np.where(order[:, None] >= 0, ellipses.centres[order], np.nan)
            if _whole(order >= 0, board) and not _goes_on(there, board) and _fits(places, seen):
                orders.append((float(np.linalg.norm(_first(places, seen))), order))
        # With a side's circles hidden, an asymmetric grid may look like itself turned: then nobody knows which it is.
        if orders and all(_alike(order, orders[0][1], board) for _, order in orders):
            taken.update(cells.values())
            yield min(orders, key=lambda pair: pair[0])[1]


def _alike(order: Int[np.ndarray, " n"], other: Int[np.ndarray, " n"], board: CircleGrid) -> bool:
    """Whether one order is the other after a turn that leaves the board as it is."""
    grid = order.reshape(board.shape)
    turns = (np.rot90(grid, 4 // board.turns * k).reshape(-1) for k in range(board.turns))
    return any(bool((turned == other).all()) for turned in turns)


def _lattice_places(board: CircleGrid) -> Int[np.ndarray, "n 2"]:
    """The circles' places in the lattice of all nearest neighbours: an asymmetric grid's lies across."""
    x, y = board.places.T
    return np.stack([(x + y) // 2, (y - x) // 2], axis=-1) if board.asymmetric else board.places


def _lattices(ellipses: Ellipses) -> list[dict[tuple[int, int], int]]:
    """The ellipses as cells of lattices, from several starts; the largest first."""
    centres = ellipses.centres
    size = np.linalg.det(ellipses.axes) ** -0.5
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    ratio = size[:, None] / size[None]
    apart = np.where((ratio < ALIKE) & (ratio > 1 / ALIKE), apart, np.inf)
    middle = np.argsort(np.linalg.norm(centres - np.median(centres, axis=0), axis=-1))
    found: list[dict[tuple[int, int], int]] = []
    for seed in middle[np.linspace(0, len(middle) - 1, min(SEEDS, len(middle))).astype(int)]:
        if any(int(seed) in cells.values() for cells in found if len(cells) > 8):
            continue
        nearest = [k for k in np.argsort(apart[seed])[:6] if np.isfinite(apart[seed, k])]
        for one, other in itertools.combinations(nearest[:5], 2):
            first, second = centres[one] - centres[seed], centres[other] - centres[seed]
            cross = first[0] * second[1] - first[1] * second[0]
            if abs(cross) < 0.4 * np.linalg.norm(first) * np.linalg.norm(second):
                continue
            if cross < 0:
                first, second = second, first
            cells = _grown(centres, size, int(seed), first, second)
            if len(cells) > 3:
                found.append(cells)
                break
    return sorted(found, key=len, reverse=True)


def _grown(
    centres: Float[np.ndarray, "n 2"],
    size: Float[np.ndarray, " n"],
    seed: int,
    first: Float[np.ndarray, "2"],
    second: Float[np.ndarray, "2"],
) -> dict[tuple[int, int], int]:
    """The cells of a lattice that one circle and two steps begin; steps change from cell to cell as they are found."""
    cells = {(0, 0): seed}
    steps = {(0, 0): (first, second)}
    taken = {seed}
    edge = [(0, 0)]
    while edge:
        cell = edge.pop(0)
        here = centres[cells[cell]]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            beside = (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))
            if beside in cells:
                continue
            step = sign * steps[cell][axis]
            distance = np.linalg.norm(centres - (here + step), axis=-1)
            k = int(distance.argmin())
            if k in taken or distance[k] > OFF * np.linalg.norm(step):
                continue
            if not 1 / ALIKE < size[k] / size[cells[cell]] < ALIKE:
                continue
            new = list(steps[cell])
            new[axis] = sign * (centres[k] - here)
            cells[beside], steps[beside] = k, (new[0], new[1])
            taken.add(k)
            edge.append(beside)
    return cells


def _whole(seen: Shaped[np.ndarray, " n"], board: CircleGrid) -> bool:
    """Whether enough of the board is there, and enough of each side."""
    grid = seen.reshape(board.shape)
    sides = grid[0], grid[-1], grid[:, 0], grid[:, -1]
    return bool(seen.mean() >= WHOLE and min(part.mean() for part in sides) >= FULL)


def _goes_on(there: dict[tuple[int, int], int], board: CircleGrid) -> bool:
    """Whether most of a line of circles just outside the board is there, so that it is another board."""
    x, y = board.places.T
    inside = {tuple(place) for place in _lattice_places(board).tolist()}
    extra = [node for node in there if node not in inside]
    if board.asymmetric:
        extra = [(a - b, a + b) for a, b in extra]
    columns, rows = Counter(a for a, _ in extra), Counter(b for _, b in extra)
    beside = [columns[int(x.min()) - 1], columns[int(x.max()) + 1], rows[int(y.min()) - 1], rows[int(y.max()) + 1]]
    along = [len(set(y.tolist()))] * 2 + [len(set(x.tolist()))] * 2
    share = 2 if board.asymmetric else 1
    return any(count >= FULL * length / share for count, length in zip(beside, along, strict=True))


def _fits(places: Int[np.ndarray, "n 2"], seen: Float[np.ndarray, "n 2"]) -> bool:
    """Whether a board seen through some lens looks so: the circles lie near a map of second degree, not mirrored."""
    good = np.isfinite(seen[:, 0])
    x, y = ((places - places.mean(axis=0)) / np.ptp(places, axis=0).max())[good].T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=-1)
    if len(x) < 2 * basis.shape[1]:
        basis = basis[:, :3]
    solution, *_ = np.linalg.lstsq(basis, seen[good], rcond=None)
    off = np.linalg.norm(basis @ solution - seen[good], axis=-1)
    linear = solution[1:3]
    step = np.sqrt(abs(np.linalg.det(linear))) / np.ptp(places, axis=0).max()
    return bool(np.linalg.det(linear) > 0 and np.median(off) < 0.15 * step)


def _first(places: Int[np.ndarray, "n 2"], seen: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Where the first circle is, or about where it would be if it is hidden."""
    if np.isfinite(seen[0, 0]):
        return seen[0]
    good = np.isfinite(seen[:, 0])
    basis = np.column_stack([places[good], np.ones(good.sum())])
    return np.append(places[0], 1) @ np.linalg.lstsq(basis, seen[good], rcond=None)[0]


def _refined(
    image: Shaped[np.ndarray, "h w"], ellipses: Ellipses, numbers: Int[np.ndarray, " n"], board: CircleGrid
) -> tuple[Float[np.ndarray, "n 2"], tuple[float, float]] | None:
    """The circles' middles to a hundredth of a pixel; those that do not look like circles, or lie off, are hidden.

    And the diameter that their images have, in world units and in px.
    """
    there = np.flatnonzero(numbers >= 0)
    start = ellipses.only(numbers[there])
    apart = np.linalg.norm(start.centres[:, None] - start.centres[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    major = 1 / np.linalg.eigvalsh(start.axes)[:, 0]
    nearest = apart.argmin(axis=1)
    room = apart.min(axis=1) - 1.15 * major[nearest] - 1
    fit = fit_ellipses(image, start, room)
    dark = fit.contrast
    worst = min(MISFIT, max(ORDINARY, UNUSUAL * float(np.median(fit.misfit))))
    good = (fit.misfit < worst) & (fit.sigma < VAGUE) & (dark > 0.2 * np.median(dark)) & (dark > 2)
    good &= (dark > DROWNED * np.median(dark)) | (fit.cut < CUT)
    good &= np.linalg.norm(fit.ellipses.centres - start.centres, axis=-1) < 0.3 * major + 1
    height, width = image.shape
    reach = np.sqrt(np.linalg.inv(fit.ellipses.axes @ fit.ellipses.axes).diagonal(axis1=1, axis2=2)) + 1
    low, high = fit.ellipses.centres - reach, fit.ellipses.centres + reach
    good &= ((low >= 0) & (high <= np.array([width, height]) - 1)).all(axis=-1)
    known, doubted = np.full((len(board), 2), np.nan), np.zeros(len(board), dtype=bool)
    known[there[good]] = fit.ellipses.centres[good]
    if good.any():
        left, usual = fit.misfit * dark, fit.sigma * np.sqrt(major)
        doubted[there] = (left > WORSE * np.median(left[good])) | (dark < FAINTER * np.median(dark[good]))
        doubted[there] |= usual > VAGUER * np.median(usual[good])
    seen = np.isfinite(known[:, 0])
    for _ in range(ROUNDS):
        places = board.places * board.spacing
        (off, loose), (_, tight) = (off_surface(places, known, seen, board.apart, k) for k in (LIMITS, TIGHT))
        excess = np.where(seen, off / np.where(doubted, tight, loose), 0.0)
        if not (excess > 1).any():
            break
        seen &= excess <= max(1.0, 0.5 * excess.max())
    known[~seen] = np.nan
    if not _whole(seen, board):
        return None
    axes = np.full((len(board), 2, 2), np.nan)
    axes[there] = fit.ellipses.axes
    return known, _diameter(known, axes, board)


def _diameter(
    known: Float[np.ndarray, "n 2"], axes: Float[np.ndarray, "n 2 2"], board: CircleGrid
) -> tuple[float, float]:
    """The circles' diameter in world units and in px: the area of their images, and of a world unit between them."""
    places = board.places * board.spacing
    seen = np.flatnonzero(np.isfinite(known[:, 0]))
    area = 1 / np.linalg.det(axes[seen])  # of an ellipse, over pi
    scale = np.full(len(seen), np.nan)
    for i, k in enumerate(seen):
        near = seen[np.linalg.norm(places[seen] - places[k], axis=-1) < BESIDE * board.apart]
        across, off = places[near] - places[k], known[near] - known[k]
        if np.linalg.matrix_rank(across) == across.shape[1]:
            scale[i] = abs(np.linalg.det(np.linalg.lstsq(across, off, rcond=None)[0]))
    return float(2 * np.sqrt(np.nanmedian(area / scale))), float(2 * np.sqrt(np.median(area)))
