"""Find a board of square markers in a photograph: which of its corners are seen, and where, to a hundredth of a pixel.

OpenCV finds markers. Those that stand to each other as on the board say where its corners are; each corner is fitted
with the print around it, and from corners that fit, those whose markers were not read are found as well.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.charuco import CharucoBoard
from diffproj.targets.codes import contradicted
from diffproj.targets.corner_fit import Fitted
from diffproj.targets.dictionaries import dictionary_named
from diffproj.targets.pattern_fit import LARGEST, SMALLEST, Patches, fit_patches, patches_of
from diffproj.targets.repeated import Taken, largest
from diffproj.targets.surface import Limits, off_surface

MISFIT = 0.30
"""Misfit from which a corner is not taken: covered ones, and those of another number, leave more."""

ORDINARY, UNUSUAL = 0.12, 2.5
"""Misfit up to which any corner is taken, and the same relative to the view's median, whichever is larger: corners that
something covers in part, or whose light an edge of shadow parts, leave more than their fellows."""

LIMITS = Limits(deviations=6.0, loose=0.015, least=0.2)
"""How far off its neighbours' surface a corner may lie."""

FAINT = 0.15
"""Least contrast, relative to the median of the view: glare drowns the rest."""

VAGUE = 0.20
"""Standard deviation in px from which a corner is not taken."""

NEAR = 2.3
"""Distance between markers, in pitches, up to which they vouch for each other."""

AGREED = 0.35
"""How far off a marker may be from where another puts it, in pitches."""

RIVALS = 0.3
"""Share of markers that stand amid those that agree, and elsewhere on the board, from which none is believed."""

FEWEST = 6
"""Corners that a view must show, on at least two rows and two columns; all of a board that has no more."""

ENOUGH = 8
"""Markers that agree from which no other copy of the image is searched: corners lead to the rest of the board."""

BEYOND = 2.6
"""How far around a corner the print is known to its fit, relative to what is looked at: at a slant and blurred, lines
from farther away reach into it."""

WIDEST = 2400
"""Longer side in px from which markers are sought in a smaller copy first."""


MarkedBoard = AprilGrid | CharucoBoard
"""Boards with markers."""


class Marker(NamedTuple):
    """A marker that was read.

    Attributes:
        number: its number.
        quad: `(4, 2)` px, its corners.
        board: `(4, 2)`, where the print has them.
        affine: `(2, 3)`, px from places on the print.
    """

    number: int
    quad: Float[np.ndarray, "4 2"]
    board: Float[np.ndarray, "4 2"]
    affine: Float[np.ndarray, "2 3"]


def find_marked(image: Shaped[np.ndarray, "h w"], grey: UInt8[np.ndarray, "h w"], board: MarkedBoard) -> Taken | None:
    """The board's corners; None where too little of it is seen.

    Args:
        image: `(H, W)`, uint8 or float32.
        grey: the same in 8 bits.
        board: the board.
    """
    for border in board.borders:
        agreeing = _agreeing(grey, board, border)
        if agreeing:
            search = _Search(image, board, border)
            found = [corners for markers in agreeing if (corners := search.corners(markers)) is not None]
            taken = largest([corners for corners in found if not contradicted(image, board, border, corners)])
            if taken is not None:
                return taken
    return None


def not_found(
    image: Shaped[np.ndarray, "h w"],
    board: MarkedBoard,
    known: Float[np.ndarray, "n 2"],
    which: Bool[np.ndarray, " n"],
) -> int:
    """How many of some corners should be well in view, as those that were found say, and were not found."""
    where, room = known.copy(), np.full((len(known), 1), np.inf)
    seen = np.isfinite(known[:, 0])
    # From those that were found to their neighbours, and so on.
    while not seen.all():
        there, jacobians = _predicted(board.corners, board.corners[seen], where[seen], board.pitch, first=False)
        new = np.isfinite(there[:, 0]) & ~seen
        if not new.any():
            break
        where[new], seen = there[new], seen | new
        room[new] = board.reach * np.linalg.norm(jacobians[new], axis=1).max(axis=-1, keepdims=True)
    inside = np.all((where > room) & (where < np.array(image.shape[::-1]) - 1 - room), axis=-1)
    return int((inside & which).sum())


class _Search:
    """The corners of one board in one image."""

    def __init__(self, image: Shaped[np.ndarray, "h w"], board: MarkedBoard, border: int) -> None:
        self.image, self.board = image, board
        self.places = board.corners
        self.patches = patches_of(board._artwork_with(border), self.places, BEYOND * board.reach)

    def corners(self, markers: list[Marker]) -> Float[np.ndarray, "n 2"] | None:
        """All corners that can be told, from markers that agree."""
        known = np.full(self.places.shape, np.nan)
        good, misfit = np.zeros(len(known), dtype=bool), np.full(len(known), np.inf)
        sources = np.concatenate([one.board for one in markers]), np.concatenate([one.quad for one in markers])
        tried = np.zeros(len(known), dtype=bool)
        for round_ in range(8):
            todo = np.flatnonzero(~good & ~tried) if round_ == 0 else np.flatnonzero(~good)
            start, jacobians = _predicted(self.places[todo], *sources, self.board.pitch, first=round_ == 0)
            there = np.isfinite(start).all(axis=-1)
            todo, start, jacobians = todo[there], start[there], jacobians[there]
            found = self._fitted(todo, start, jacobians)
            if found is None:
                break
            before = int(good.sum())
            good[todo] = found.good
            known[todo] = np.where(found.good[:, None], found.corners, np.nan)
            misfit[todo] = found.misfit
            good &= misfit < max(ORDINARY, UNUSUAL * float(np.median(misfit[good]))) if good.any() else False
            good = self._smooth(known, good)
            known[~good] = np.nan
            if int(good.sum()) <= before or good.sum() < 4:
                break
            sources = self.places[good], known[good]
        rows, columns = (len(np.unique(np.round(self.places[good, axis], 9))) for axis in (1, 0))
        if good.sum() < min(FEWEST, len(known)) or min(rows, columns) < 2:
            return None
        return known

    def _fitted(self, which: np.ndarray, start: np.ndarray, jacobians: np.ndarray) -> "_Tried | None":
        height, width = self.image.shape
        scale = np.linalg.norm(jacobians, axis=1).min(axis=-1)
        inside = ((start > 1) & (start < [width - 2, height - 2])).all(axis=-1) & (scale * self.board.apart > 4)
        if not inside.any():
            return None
        radius = np.clip(scale[inside] * self.board.reach, SMALLEST, LARGEST)
        part = which[inside]
        patches = Patches(*(each[part] for each in self.patches))
        fit = fit_patches(self.image, start[inside], jacobians[inside], patches, radius)
        good, misfit = np.zeros(len(which), dtype=bool), np.full(len(which), np.inf)
        corners = np.full((len(which), 2), np.nan)
        good[inside] = self._taken(fit, start[inside], scale[inside])
        corners[inside], misfit[inside] = fit.corners, fit.misfit
        return _Tried(corners, good, misfit)

    def _taken(self, fit: Fitted, start: np.ndarray, scale: np.ndarray) -> np.ndarray:
        dark = -fit.contrast
        usual = float(np.median(dark[fit.misfit < MISFIT])) if (fit.misfit < MISFIT).any() else 1.0
        height, width = self.image.shape
        good = (fit.misfit < MISFIT) & (dark > FAINT * usual) & (dark > 2) & (fit.sigma < VAGUE)
        good &= np.linalg.norm(fit.corners - start, axis=-1) < 0.3 * scale * self.board.apart
        return good & ((fit.corners >= 1) & (fit.corners <= [width - 2, height - 2])).all(axis=-1)

    def _smooth(self, known: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Those that lie where their neighbours put them."""
        good = good.copy()
        for _ in range(3):
            off, limit = off_surface(self.places, known, good, self.board.pitch, LIMITS)
            wrong = good & (off > limit)
            if not wrong.any():
                break
            good &= ~wrong
        return good


class _Tried(NamedTuple):
    corners: Float[np.ndarray, "n 2"]
    good: Shaped[np.ndarray, " n"]
    misfit: Float[np.ndarray, " n"]


def _agreeing(grey: UInt8[np.ndarray, "h w"], board: MarkedBoard, border: int) -> list[list[Marker]]:
    """The largest set of markers that stand to each other as on the board, from the copy that shows most.

    And the next largest, of markers in other places: of a second board. Each has two or more, unless the board has one.
    """
    best: list[Marker] = []
    others: list[Marker] = []
    for small in _copies(grey):
        found = _read(small, grey, board, border)
        agreed = _consistent(found, board)
        if len(agreed) > len(best):
            best, others = agreed, _consistent(_elsewhere(found, agreed), board)
        if len(best) >= min(ENOUGH, 0.5 * len(board.markers)):
            break
    return [markers for markers in (best, others) if markers]


def _elsewhere(found: list[Marker], taken: list[Marker]) -> list[Marker]:
    """The markers that were not read where one was that is taken."""
    places, sides = np.stack([one.quad.mean(axis=0) for one in taken]), [_side(one) for one in taken]
    off = [np.linalg.norm(places - one.quad.mean(axis=0), axis=-1) / np.minimum(sides, _side(one)) for one in found]
    return [one for one, apart in zip(found, off, strict=True) if apart.min() > 0.5]


def _side(marker: Marker) -> float:
    """The mean length in px of a marker's sides."""
    return float(np.linalg.norm(marker.quad - np.roll(marker.quad, 1, axis=0), axis=-1).mean())


def _copies(grey: UInt8[np.ndarray, "h w"]) -> Iterator[UInt8[np.ndarray, "_h _w"]]:
    """The image at sizes to search: half of its own first where it is large; its own; twice that where it is not."""
    longest = max(grey.shape)
    if longest > WIDEST:
        yield cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    yield grey
    if longest <= WIDEST:
        yield cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)


def _read(
    small: UInt8[np.ndarray, "_h _w"], grey: UInt8[np.ndarray, "h w"], board: MarkedBoard, border: int
) -> list[Marker]:
    """The board's markers that OpenCV reads in a copy, in px of the image."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    parameters.minMarkerPerimeterRate = 0.015
    parameters.minDistanceToBorder = 1
    quads, numbers, _ = cv2.aruco.ArucoDetector(dictionary_named(board.dictionary), parameters).detectMarkers(small)
    scale = np.array(grey.shape[::-1]) / small.shape[::-1]
    markers, found = board.markers, []
    for read, quad in zip([] if numbers is None else np.ravel(numbers), quads, strict=True):
        number = int(read)
        if number in markers:
            corners = (quad.reshape(4, 2).astype(np.float64) + 0.5) * scale - 0.5
            design = np.column_stack([markers[number], np.ones(4)])
            affine = np.linalg.lstsq(design, corners, rcond=None)[0].T
            if np.linalg.det(affine[:, :2]) > 0:
                found.append(Marker(number, corners, markers[number], affine))
    return found


def _consistent(found: list[Marker], board: MarkedBoard) -> list[Marker]:
    """The largest set of markers in which each is where a neighbour puts it, and puts that where it is.

    Of a board of one marker that one, which has no neighbours.
    """
    pitch, fewest = board.pitch, min(2, len(board.markers))
    if len(found) < fewest:
        return []
    places = np.stack([one.board.mean(axis=0) for one in found])
    seen = np.stack([one.quad.mean(axis=0) for one in found])
    affine = np.stack([one.affine for one in found])
    put = affine[:, None, :, :2] @ places[None, :, :, None]
    put = put[..., 0] + affine[:, None, :, 2]
    size = np.sqrt(np.abs(np.linalg.det(affine[:, :, :2]))) * pitch
    off = np.linalg.norm(put - seen[None], axis=-1)
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1) / pitch
    near = (distance < NEAR) & (distance > 0)
    agree = near & (off < AGREED * np.maximum(distance, 1) * np.minimum(size[:, None], size[None]))
    agree &= agree.T
    left, best = set(range(len(found))), set()
    while left:
        group, edge = set(), {left.pop()}
        while edge:
            one = edge.pop()
            group.add(one)
            edge |= {int(k) for k in np.flatnonzero(agree[one])} & left
            left -= edge
        if len({found[k].number for k in group}) > len({found[k].number for k in best}):
            best = group
    members = sorted(best)
    if len({found[k].number for k in members}) < fewest:
        return []
    # Markers amid the group that stand elsewhere on the board: it is another board that has some places in common.
    apart = np.linalg.norm(seen[:, None] - seen[None, members], axis=-1) / size[None, members]
    rivals = [k for k in range(len(found)) if k not in best and apart[k].min() < NEAR]
    if len(rivals) > RIVALS * len(members):
        return []
    votes = agree[:, members].sum(axis=1)
    chosen: dict[int, int] = {}
    for k in sorted(members, key=lambda k: -votes[k]):
        chosen.setdefault(found[k].number, k)
    return [found[k] for k in sorted(chosen.values())]


def _predicted(
    places: Float[np.ndarray, "n 2"],
    board: Float[np.ndarray, "m 2"],
    seen: Float[np.ndarray, "m 2"],
    pitch: float,
    first: bool,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Where the nearest points of the board put others, and px for world units there; NaN where none is near.

    A homography through the nearest points, of markers at first and of corners later, weighted by their distance.
    """
    start, jacobians = np.full(places.shape, np.nan), np.zeros((len(places), 2, 2))
    count = min(16 if first else 12, len(board))
    for i, place in enumerate(places):
        distance = np.linalg.norm(board - place, axis=-1) / pitch
        nearest = np.argpartition(distance, count - 1)[:count]
        if distance[nearest].min() > (1.0 if first else 1.6):
            continue
        nearest = nearest[distance[nearest] < 3.2]
        if len(nearest) < 4 or np.linalg.matrix_rank(board[nearest] - board[nearest].mean(axis=0), tol=0.1 * pitch) < 2:
            continue
        weight = 1 / (0.3 + distance[nearest])
        x, y = ((board[nearest] - place) / pitch).T
        u, v = (seen[nearest] - seen[nearest].mean(axis=0)).T
        one, none = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate(
            [
                np.stack([x, y, one, none, none, none, -u * x, -u * y], axis=1) * weight[:, None],
                np.stack([none, none, none, x, y, one, -v * x, -v * y], axis=1) * weight[:, None],
            ]
        )
        # The perspective is held near none: few points near each other hardly tell it.
        spread = float(np.hypot(u, v).mean()) + 1e-9
        held = np.zeros((2, 8))
        held[0, 6] = held[1, 7] = spread * 0.3
        h = np.linalg.lstsq(np.concatenate([rows, held]), np.concatenate([u * weight, v * weight, [0, 0]]), rcond=None)[
            0
        ]
        start[i] = h[[2, 5]] + seen[nearest].mean(axis=0)
        jacobians[i] = [h[:2] - h[2] * h[6:], h[3:5] - h[5] * h[6:]]
    jacobians /= pitch
    turned = np.linalg.det(jacobians) <= 0
    start[turned] = np.nan
    return start, jacobians
