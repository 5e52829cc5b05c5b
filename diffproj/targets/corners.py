"""Corners of a board in a photograph to a hundredth of a pixel, and which of them can be trusted."""

import functools
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped

from diffproj.targets.corner_fit import LARGEST, fit_corners

WINDOW = 0.30
"""Half the side of the window that brings a corner near its place, relative to the distance to its neighbour."""

SMALLEST_WINDOW = 2
"""Minimum half side in px: a smaller window contains too few gradients for a stable result."""

MISFIT, UNUSUAL = 0.05, 2.5
"""Misfit from which a corner is doubted, and the same relative to the view's median, whichever is larger. Of 4400
corners in public photographs none had more than 2.44 medians; half covered ones leave a third of the contrast."""

WORSE = 1.25
"""Misfit relative to the median, above a hundredth, from which a corner looks worse than the others."""

FAINT = 0.15
"""Least contrast, relative to the median of the view: glare drowns the rest."""

VAGUE, VAGUEST = 0.15, 0.5
"""Standard deviations in px from which a corner is doubted, unless its whole view is vague, and from which none is
taken: the corners of a vague view may be so far off their neighbours' surface, root mean square."""

WIDE, WIDEST, ROOM = 1 / 6, 1 / 3, 1.2
"""Blur relative to the largest disc's radius from which a wider one is asked for, and up to which the disc contains it;
and how much wider a disc the squares must have room for."""

LOOSE, TIGHT = (0.06, 0.15), (0.006, 0.1)
"""Distances from where neighbours put a corner from which it is doubted, for corners that look as good as the others
and for those that look worse: relative to the spacing, and in px, added to it."""

DEVIATIONS, WORSE_DEVIATIONS = 6.0, 5.0
"""The least such distances in terms of the view's median."""

FAINTER = 0.92
"""Contrast relative to that of the neighbours below which it is not the light that makes a corner faint."""

REACH, NARROW = 0.65, 0.4
"""Radius of the pixels that are fitted, relative to the spacing: for all corners, and for those beside other edges."""

FEWEST = 9
"""Corners below which nothing is known about their neighbours."""

_POWERS = [(i, j) for i in range(4) for j in range(4 - i)]
# What few neighbours leave open is held near zero: terms of higher degree more.
_RIDGE = np.diag([[1e-9, 1e-9, 1e-4, 1e-3][i + j] for i, j in _POWERS])
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 0.05)


class Corners(NamedTuple):
    """Refined corners.

    Attributes:
        grid: `(rows, columns, 2)` px; NaN where not visible.
        sigma: `(rows, columns)` px, standard deviation of a coordinate that the noise of the grey values implies. It
            tells doubtful corners, and is no weight in `calibrate`: on a real board it is a tenth of the residuals,
            which the print makes. With weights `1 / sigma^2` the RMS of the standardised residuals of the bundled
            photographs, by fifths of the corners from the surest on, goes from 1.22 to 0.78 and from 1.16 to 0.88
            instead of from 0.98 to 1.08 and from 0.89 to 1.15; only on rendered boards it is flatter, 0.96 to 1.05
            instead of 0.86 to 1.11.
        visible: `(rows, columns)`, false where something hides the corner.
        misfit: the median over the corners; above a third, it is no chessboard.
        begins_dark: whether the square between the first four corners is dark. Each visible corner by itself shows
            which of the squares around it are, and all of them agree: one that does not is hidden.
        vague: whether it looks like a board, and its corners stay so uncertain that too few are left.
    """

    grid: Float[np.ndarray, "rows columns 2"]
    sigma: Float[np.ndarray, "rows columns"]
    visible: Bool[np.ndarray, "rows columns"]
    misfit: float
    begins_dark: bool
    vague: bool = False

    def is_board(self) -> bool:
        """Whether enough of it proves to be a board: half of all corners, and half of those along each side."""
        sides = self.visible[0], self.visible[-1], self.visible[:, 0], self.visible[:, -1]
        return self.misfit < 0.35 and min(float(part.mean()) for part in (self.visible, *sides)) >= 0.5


def refine_grid(image: Shaped[np.ndarray, "h w"], rough: Float[np.ndarray, "rows columns 2"]) -> Corners:
    """Refine a board's corners, seek doubtful ones again where their neighbours put them, and hide those in vain.

    A corner is doubted where four alternating sectors do not explain the grey values around it, or where it lies off
    the smooth surface through its neighbours, of third degree in row and column, which no lens and no tilt fools.

    Within a disc that is hardly wider than the blur, a shift of the corner looks as a gradient of the light does. Where
    the blur asks for a wider disc, and the squares have room for it, corners are taken from a copy of half the size,
    whose pixels tell as much of such an image, and so on.

    Args:
        image: `(H, W)`, uint8 or float32.
        rough: `(rows, columns, 2)` px, to within a third of a square; NaN where a corner was not found.
    """
    known = np.isfinite(rough[..., 0])
    start = rough if known.all() else np.where(known[..., None], rough, predicted(rough, known).grid)
    found, blur = _refined(image, start, known)
    spacing, scale = spacing_of(start), 1
    while _is_wide(blur, room := REACH * spacing > ROOM * LARGEST * scale):
        contained = found.visible & (blur < WIDEST * LARGEST)
        scale *= 2
        image = _halved(image)
        wider, blur = _refined(image, (start + 0.5) / scale - 0.5, known)
        wider = wider._replace(grid=(wider.grid + 0.5) * scale - 0.5, sigma=wider.sigma * scale)
        # What a wider disc reaches, such as the board's edge seen steeply, may hide a corner that one before shows.
        found = _joined(np.where(wider.visible, room | ~found.visible, room & ~contained), wider, found)
    shown = _settled(found, _median(blur.ravel()) > WIDE * LARGEST)
    settled = found._replace(grid=np.where(shown[..., None], found.grid, np.nan), visible=shown)
    return settled._replace(vague=found.is_board() and not settled.is_board())


def _settled(found: Corners, blurred: bool) -> Bool[np.ndarray, "rows columns"]:
    """Which visible corners are known to `VAGUEST`; none of a view whose corners scatter by more.

    That is asked of views that are vague, or blurred wider than their squares have room for.

    The grey values' noise alone does not tell how far the corners of such a view stray, their neighbours do: by the
    surface through them on the board's plane, where a steep view is as smooth as any. Along the board's sides it misses
    even corners without error where a lens bends strongly.
    """
    shown = found.visible & (found.sigma < VAGUEST)
    if shown.sum() < FEWEST or not (blurred or _median(found.sigma[shown]) > VAGUE):
        return shown
    cells = np.indices(shown.shape)[::-1].transpose(1, 2, 0).astype(float)
    ahead, _ = cv2.findHomography(cells[shown], found.grid[shown])
    if ahead is None:
        return shown & False
    known = np.where(shown[..., None], found.grid, found.grid[shown].mean(axis=0))
    surface = predicted(cv2.perspectiveTransform(known, np.linalg.inv(ahead)), shown)
    there = cv2.perspectiveTransform(surface.grid, ahead)
    off = np.where(shown, _lengths(known - there), 0.0) / surface.spread
    inner = np.pad(shown[1:-1, 1:-1], 1)
    inner = inner if inner.sum() >= 4 else shown
    most = np.maximum(3 * VAGUEST, LOOSE[0] * spacing_of(there))
    settled = (np.minimum(off, most)[inner] ** 2).sum() < 2 * VAGUEST**2 * inner.sum()
    return shown & ~(inner & (off > most)) & bool(settled)


def _is_wide(blur: Float[np.ndarray, "rows columns"], room: Bool[np.ndarray, "rows columns"]) -> bool:
    """Whether the usual blur, where neighbours leave room for a wider disc than the largest, asks for one."""
    return bool(room.any()) and _median(blur[room]) > WIDE * LARGEST


def _joined(which: Bool[np.ndarray, "rows columns"], these: Corners, others: Corners) -> Corners:
    """Some corners of the one, and the rest of the others."""
    return these._replace(
        grid=np.where(which[..., None], these.grid, others.grid),
        sigma=np.where(which, these.sigma, others.sigma),
        visible=np.where(which, these.visible, others.visible),
        begins_dark=these.begins_dark if these.visible.any() else others.begins_dark,
    )


def _halved(image: Shaped[np.ndarray, "h w"]) -> Float32[np.ndarray, "_h _w"]:
    """The means of 2 x 2 pixels, unrounded; an odd last row or column is left out."""
    height, width = (side // 2 for side in image.shape)
    whole = image[: 2 * height, : 2 * width].astype(np.float32)
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def _refined(
    image: Shaped[np.ndarray, "h w"],
    start: Float[np.ndarray, "rows columns 2"],
    known: Bool[np.ndarray, "rows columns"],
) -> tuple[Corners, Float[np.ndarray, "rows columns"]]:
    """`refine_grid` in the image as it is, and the blur in px."""
    everywhere = np.ones_like(known)
    fit = _fitted(image, start, everywhere, REACH)
    good = _trusted(image, fit, known)
    for reach in (REACH, NARROW):
        if good.all() or good.sum() < FEWEST:
            break
        again = np.where(good[..., None], fit.grid, predicted(fit.grid, good).grid)
        tried = _fitted(image, again, ~good, reach)
        fit = _Fit(
            np.where(good[..., None], fit.grid, tried.grid),
            *(np.where(good, old, new) for old, new in zip(fit[1:], tried[1:], strict=True)),
        )
        good = _trusted(image, fit, everywhere)
    hidden = np.where(good[..., None], fit.grid, np.nan)
    begins_dark = bool((_alternated(fit.contrast)[good] > 0).any())
    return Corners(hidden, fit.sigma, good, _median(fit.misfit.ravel()), begins_dark), fit.blur


class _Fit(NamedTuple):
    """`Fitted` by row and column."""

    grid: Float[np.ndarray, "rows columns 2"]
    misfit: Float[np.ndarray, "rows columns"]
    contrast: Float[np.ndarray, "rows columns"]
    sigma: Float[np.ndarray, "rows columns"]
    blur: Float[np.ndarray, "rows columns"]


class Prediction(NamedTuple):
    """Where neighbours put corners.

    Attributes:
        grid: `(rows, columns, 2)` px.
        spread: `(rows, columns)`, standard deviation of corner minus prediction for neighbours with deviation 1.
    """

    grid: Float[np.ndarray, "rows columns 2"]
    spread: Float[np.ndarray, "rows columns"]


def predicted(
    grid: Float[np.ndarray, "rows columns 2"],
    use: Float[np.ndarray, "rows columns"] | Bool[np.ndarray, "rows columns"],
) -> Prediction:
    """Where each corner's neighbours put it: a surface of third degree through those at most two lines away.

    Near the board's sides, the neighbours are the corners of the nearest five lines. The corner itself does not count.

    Args:
        grid: corners; what is not used does not matter.
        use: weights of the corners from 0 to 1.
    """
    shape, weight = use.shape, use.astype(float)
    values = np.where(weight[..., None] > 0, grid, 0.0).reshape(-1, 2)
    near = _neighbourhoods(*shape)
    hat = near.hat if (weight == 1).all() else near.hat_of(weight)
    where = (hat[:, None] @ values[near.numbers])[:, 0]
    # A ridge draws the value to zero where neighbours are few; hat sums to 1 otherwise.
    total = hat.sum(axis=1)
    where = where / np.where(np.abs(total) > 0.5, total, 1.0)[:, None]
    spread = np.sqrt(1 + (hat**2).sum(axis=1))
    return Prediction(where.reshape(*shape, 2), spread.reshape(shape))


class _Neighbourhoods(NamedTuple):
    """Each corner's neighbours on a board, of which there are K.

    Attributes:
        numbers: `(N, K)`, which corners they are, row by row.
        basis: `(N, K, 10)`, powers of row and column up to the third degree at each.
        others: `(N, K)`, 0 for the corner itself, else 1.
        hat: `(N, K)`, what the surface's value at the corner takes from each, where all are used alike.
    """

    numbers: Int[np.ndarray, "n k"]
    basis: Float[np.ndarray, "n k 10"]
    others: Float[np.ndarray, "n k"]
    hat: Float[np.ndarray, "n k"]

    def hat_of(self, weight: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "n k"]:
        """What the surface's value at each corner takes from its neighbours, for weights of the corners."""
        weighted = self.basis * (weight.reshape(-1)[self.numbers] * self.others)[..., None]
        transposed = np.swapaxes(weighted, 1, 2)
        return (np.linalg.inv(transposed @ self.basis + _RIDGE)[:, :1] @ transposed)[:, 0]


@functools.lru_cache(maxsize=16)
def _neighbourhoods(rows: int, columns: int) -> _Neighbourhoods:
    near_r, near_c = _nearest_lines(rows), _nearest_lines(columns)
    r = np.broadcast_to(near_r[:, None, :, None], (rows, columns, near_r.shape[1], near_c.shape[1]))
    c = np.broadcast_to(near_c[None, :, None, :], r.shape)
    r, c = (part.reshape(rows * columns, -1) for part in (r, c))
    here_r, here_c = (axis.reshape(-1, 1) for axis in np.indices((rows, columns)))
    dr, dc = (r - here_r) / 2.0, (c - here_c) / 2.0
    basis = np.stack([dr**i * dc**j for i, j in _POWERS], axis=-1)
    found = _Neighbourhoods(r * columns + c, basis, ((dr != 0) | (dc != 0)).astype(float), np.empty((0, 0)))
    return found._replace(hat=found.hat_of(np.ones((rows, columns))))


def _nearest_lines(count: int) -> np.ndarray:
    """The numbers of the nearest five lines for each line, `(count, 5)`, or all where there are fewer."""
    width = min(5, count)
    first = (np.arange(count) - width // 2).clip(0, count - width)
    return first[:, None] + np.arange(width)


def _trusted(
    image: Shaped[np.ndarray, "h w"],
    fit: _Fit,
    known: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Which corners look like corners and lie where the others put them.

    One that looks as good as its fellows is held to its neighbours loosely, so that no lens fools the test: only
    another crossing looks as good. One that looks worse may be drawn aside by an edge nearby, and is held tightly.
    """
    grid, misfit, contrast, sigma, _ = fit
    usual = _median(misfit[known])
    contrast = _alternated(contrast)
    contrast /= _median(contrast[known]) or 1.0
    use = known & (misfit < max(MISFIT, UNUSUAL * usual)) & (contrast > FAINT)
    use &= sigma < np.maximum(VAGUE, 6 * _median(sigma[known]))
    use &= ((grid >= 1) & (grid <= np.array(image.shape[::-1]) - 2)).all(axis=-1)
    if use.sum() < FEWEST:
        return use
    # Noise alone misfits a corner in fainter light by more of its contrast. What covers one makes it alone fainter.
    light = np.maximum(contrast, FAINTER * cv2.medianBlur(contrast.astype(np.float32), 3))
    worse = np.where(use, misfit, 0.0) * np.minimum(light, 1.0) >= WORSE * usual + 0.01
    spacing = spacing_of(np.where(np.isfinite(grid), grid, 0.0))
    weight, off, limit = use.astype(float), np.zeros(use.shape), np.ones(use.shape)
    for _ in range(4):
        surface = predicted(grid, weight)
        off = np.where(use, _lengths(grid - surface.grid), 0.0) / surface.spread
        median = _median(off[use])
        loose = np.maximum(DEVIATIONS * median, LOOSE[0] * spacing + LOOSE[1])
        tight = np.maximum(WORSE_DEVIATIONS * median, TIGHT[0] * spacing + TIGHT[1])
        limit = np.where(worse, tight, loose)
        if (off[use] < 0.5 * limit[use]).all():
            break
        weight = use / (1 + (off / (0.5 * limit)) ** 4)
    return use & (off < limit)


def _alternated(contrast: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """The contrasts of a board's corners with one sign: dark and light change places from one corner to the next.

    Positive where the square between the first four corners is dark.
    """
    return contrast * (1 - 2 * (np.indices(contrast.shape).sum(axis=0) % 2))


def _fitted(
    image: Shaped[np.ndarray, "h w"],
    start: Float[np.ndarray, "rows columns 2"],
    which: Bool[np.ndarray, "rows columns"],
    reach: float,
) -> _Fit:
    """Some corners, from where they are to a pixel or two; the others stay."""
    spacing = spacing_of(start)[which]
    near = _brought_near(image, start[which], spacing)
    angles = np.stack([_directions(start)[which], _directions(start.swapaxes(0, 1)).T[which]], axis=-1)
    found = fit_corners(image, near, angles, spacing, reach)
    fit = _Fit(start.copy(), *(np.zeros(which.shape) for _ in range(4)))
    for whole, part in zip(fit, found, strict=True):
        whole[which] = part
    return fit


def _directions(grid: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns"]:
    """The angles of the rows at each corner, in radians."""
    steps = np.empty_like(grid)
    np.subtract(grid[:, 2:], grid[:, :-2], out=steps[:, 1:-1])
    np.subtract(grid[:, 1], grid[:, 0], out=steps[:, 0])
    np.subtract(grid[:, -1], grid[:, -2], out=steps[:, -1])
    return np.arctan2(steps[..., 1], steps[..., 0])


def _brought_near(
    image: Shaped[np.ndarray, "h w"], corners: Float[np.ndarray, "n 2"], spacing: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """Corners to a fraction of a pixel by `cv2.cornerSubPix`, each in a window of its own size."""
    half_sides = np.maximum(WINDOW * spacing, SMALLEST_WINDOW).astype(int)
    corners = corners.astype(np.float32)
    inside = ((corners >= 0) & (corners <= np.array(image.shape[::-1]) - 1)).all(axis=-1)
    for half_side in np.unique(half_sides[inside]):
        group = (half_sides == half_side) & inside
        window = (int(half_side), int(half_side))
        start = np.ascontiguousarray(corners[group]).reshape(-1, 1, 2)
        corners[group] = cv2.cornerSubPix(image, start, window, (-1, -1), _STOP).reshape(-1, 2)
    return corners.astype(np.float64)


def spacing_of(grid: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns"]:
    """The distance from each corner to the nearest of its neighbours along row and column, in px."""
    least = np.full(grid.shape[:2], np.inf)
    for part, step in ((least, _lengths(grid[1:] - grid[:-1])), (least.T, _lengths(grid[:, 1:] - grid[:, :-1]).T)):
        np.minimum(part[1:], step, out=part[1:])
        np.minimum(part[:-1], step, out=part[:-1])
    return least


def _lengths(steps: Float[np.ndarray, "_rows _columns 2"]) -> Float[np.ndarray, "_rows _columns"]:
    return np.sqrt(steps[..., 0] ** 2 + steps[..., 1] ** 2)


def _median(values: Float[np.ndarray, " n"]) -> float:
    """`np.median` of some, which spends most of its time on other questions."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    return float(np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].mean())
