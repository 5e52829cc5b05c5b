"""Where corners are placed: errors against rendered truth, their own standard deviations, and corners that are hidden."""

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.targets import corners
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.corner_fit import fit_corners
from diffproj.targets.corners import predicted, refine_grid, spacing_of
from diffproj.targets.detection import BoardNotFoundError, detect
from diffproj.targets.synthetic import photograph

D = torch.float64
BOARD = Chessboard(5, 4, 1.0)


def cameras(side, count, board=BOARD, seed=0):
    """Cameras before a board of unit squares, each about `side` px."""
    size = (int(side * (board.columns + 5)), int(side * (board.rows + 5)))
    K = torch.tensor([[500.0, 0, (size[0] - 1) / 2], [0, 500.0, (size[1] - 1) / 2], [0, 0, 1]], dtype=D)
    draw = torch.rand(count, 5, generator=torch.Generator().manual_seed(seed), dtype=D)
    R = dp.rotation_from_euler(*((2 * draw[:, :3] - 1) * 0.4).unbind(-1))
    ahead = torch.tensor([0, 0, 500.0 / side], dtype=D)
    t = torch.cat([draw[:, 3:] - 0.5, torch.zeros(count, 1, dtype=D)], dim=-1) + ahead - R @ board.points.mean(0)
    return dp.Camera(K, size=size).at(R, t)


# Root mean square distances in px, measured 0.020 .028 .042 .12 / .015 .020 .032 .071 / ... ; a tenth to a half of what
# cv2.cornerSubPix reaches with the best window for each size.
ERRORS = {
    8: (0.03, 0.06),
    10: (0.026, 0.045),
    12: (0.024, 0.035),
    16: (0.02, 0.03),
    30: (0.016, 0.02),
    60: (0.014, 0.019),
}


@pytest.mark.parametrize("side", ERRORS)
def test_errors_against_rendered_truth(side):
    """Squares of 8 to 60 px, blur of 0.7 and 1.2 px, sensor noise of 4 in 255; the errors know their size."""
    posed = cameras(side, 6 if side < 30 else 2, seed=side)
    truth = posed.project(BOARD.points)[0].numpy()
    for blur, most in zip((0.7, 1.2), ERRORS[side], strict=True):
        squares, scores = [], []
        for image, corner in zip(photograph(posed, BOARD, blur_px=blur).numpy(), truth, strict=True):
            start = corner.reshape(4, 5, 2) + np.random.default_rng(0).normal(0, 0.03 * side, (4, 5, 2))
            found = refine_grid(image, start)
            assert found.visible.all()
            off = found.grid.reshape(-1, 2) - corner
            squares.append((off**2).sum(axis=-1))
            scores.append((off**2).mean(axis=-1) / found.sigma.ravel() ** 2)
        assert np.sqrt(np.mean(squares)) < most
        assert 0.8 < np.sqrt(np.mean(scores)) < 1.3


def test_the_derivatives_are_those_of_the_model():
    """A fit from a quarter of a pixel off lands on the corner of an image that is the model itself."""
    y, x = np.mgrid[:41, :41].astype(np.float64)
    u, v, one, two, blur = 20.3, 19.6, 0.2, 1.5, 1.3
    edges = [np.cos(a) * (y - v) - np.sin(a) * (x - u) for a in (one, two)]
    profiles = [torch.erf(torch.tensor(d / (2**0.5 * blur))).numpy() for d in edges]
    image = (120 + 80 * profiles[0] * profiles[1] + 0.3 * (x - u) - 0.2 * (y - v)).astype(np.float32)
    start, angles = np.array([[20.5, 19.4]]), np.array([[one + 0.05, two - 0.08]])
    found = fit_corners(image, start, angles, np.array([18.0]), 0.65)
    assert np.abs(found.corners - (u, v)).max() < 1e-4
    assert found.misfit[0] < 1e-4
    assert found.contrast[0] == pytest.approx(80, rel=1e-3)


def test_a_surface_of_third_degree_is_predicted_exactly_and_the_corner_itself_does_not_count():
    r, c = np.indices((6, 9)).astype(float)
    grid = np.stack([100 + 30 * c + r * c - 0.2 * c**3, 50 + 28 * r - 0.5 * r**2 * c], axis=-1)
    use = np.ones((6, 9), bool)
    assert np.abs(predicted(grid, use).grid - grid).max() < 0.05
    moved = grid.copy()
    moved[2, 4] += 7
    assert np.abs(predicted(moved, use).grid[2, 4] - grid[2, 4]).max() < 0.05
    use[0, 0] = use[3, 5] = False
    assert np.abs(predicted(np.where(use[..., None], grid, np.nan), use).grid - grid).max() < 0.2
    assert spacing_of(grid)[0, 0] == pytest.approx(np.linalg.norm(grid[0, 1] - grid[0, 0]), rel=0.1)


def covered(image, where, side, grey):
    """The photograph with a disc of one grey value before the board."""
    mask = np.zeros(image.shape, np.float32)
    cv2.circle(mask, tuple(round(float(x)) for x in where), int(0.45 * side), 1.0, -1, cv2.LINE_AA)
    mask = cv2.GaussianBlur(mask, (0, 0), 0.8)
    return np.clip(image * (1 - mask) + grey * mask, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("grey", [15, 120, 240])
@pytest.mark.parametrize("number", [0, 7, 30, 53])
def test_a_covered_corner_is_hidden_and_the_others_keep_their_numbers(number, grey):
    board = Chessboard(9, 6, 1.0)
    camera = cameras(24, 1, board, seed=3)[0]
    image, truth = photograph(camera, board).numpy(), camera.project(board.points)[0].numpy()
    views = detect(covered(image, truth[number], 24, grey), board)
    assert not views.visible[0, number]
    shown = views.visible[0].numpy()
    assert shown.sum() >= 49
    assert np.linalg.norm(views.pixels[0].numpy() - truth, axis=-1)[shown].max() < 0.3


def clipped(image, where, turn_deg, grey):
    """The photograph with a clip of 12 x 22 px before the board."""
    mask = np.zeros(image.shape, np.uint8)
    box = cv2.boxPoints((tuple(float(x) for x in where), (12.0, 22.0), turn_deg))
    cv2.fillConvexPoly(mask, np.round(box * 8).astype(int), 255, cv2.LINE_AA, 3)
    mask = cv2.GaussianBlur(mask, (0, 0), 1.0) / 255.0
    return np.clip(image * (1 - mask) + grey * mask, 0, 255).astype(np.uint8)


def test_a_half_covered_corner_is_hidden():
    """Its edge draws the fit aside by 0.8 to 1.1 px while it still looks like a fainter corner of a noisy view."""
    board = Chessboard(7, 5, 1.0)
    camera = cameras(14, 1, board, seed=3)[0]
    truth = camera.project(board.points)[0].numpy().reshape(5, 7, 2)
    image = photograph(camera, board, blur_px=1.5, noise=6 / 255).numpy()
    for grey, turn, offset in ((110, 25, (6, 6)), (110, 25, (-2, -2)), (110, 50, (-2, -6)), (200, 50, (-2, 2))):
        found = refine_grid(clipped(image, truth[2, 6] + offset, turn, grey), truth + 0.3)
        assert 1 <= (~found.visible).sum() <= 4
        assert np.linalg.norm(found.grid - truth, axis=-1)[found.visible].max() < 0.5


def test_a_corner_in_fainter_light_is_none_that_is_covered():
    """Seen steeply, the surface through its neighbours misses the outermost corner by several px."""
    board = Chessboard(7, 5, 1.0)
    steep = dp.rotation_from_euler(*torch.tensor((0.75, -0.6, 0.2), dtype=D))
    t = torch.tensor([0, 0, 6.5], dtype=D) - steep @ board.points.mean(0)
    K = torch.tensor([[340.0, 0, 299.5], [0, 340.0, 249.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, size=(600, 500)).at(steep, t)
    truth = camera.project(board.points)[0].numpy().reshape(5, 7, 2)
    image = photograph(camera, board, vignetting=1.0, noise=6 / 255).numpy()
    found = refine_grid(image, truth)
    assert found.visible.all()
    assert np.linalg.norm(found.grid - truth, axis=-1).max() < 0.15


def test_a_wrong_start_is_sought_again():
    """Two corners of the outermost column that a detector put ten pixels off come back."""
    board = Chessboard(9, 6, 1.0)
    camera = cameras(24, 1, board, seed=3)[0]
    image, truth = photograph(camera, board).numpy(), camera.project(board.points)[0].numpy().reshape(6, 9, 2)
    start = truth.copy()
    start[1:3, 8] += (-9.0, 5.0)
    start[5, 5] = np.nan
    found = refine_grid(image, start)
    assert found.visible.all()
    assert np.linalg.norm(found.grid - truth, axis=-1).max() < 0.1


def test_glare_hides():
    board = Chessboard(9, 6, 1.0)
    camera = cameras(24, 1, board, seed=3)[0]
    image, truth = photograph(camera, board).numpy().astype(float), camera.project(board.points)[0].numpy()
    row, column = np.indices(image.shape)
    far = (column - truth[22, 0]) ** 2 + (row - truth[22, 1]) ** 2
    views = detect(np.clip(image + 600 * np.exp(-far / (2 * 20.0**2)), 0, 255).astype(np.uint8), board)
    assert not views.visible[0, 22]
    shown = views.visible[0].numpy()
    assert np.linalg.norm(views.pixels[0].numpy() - truth, axis=-1)[shown].max() < 0.6


def test_a_corner_at_the_border_of_the_photograph():
    """Cut off by the photograph's border within its window: found or hidden, not wrong."""
    board = Chessboard(9, 6, 1.0)
    camera = cameras(24, 1, board, seed=3)[0]
    image, truth = photograph(camera, board).numpy(), camera.project(board.points)[0].numpy()
    first = int(truth[:, 0].min()) - 3
    views = detect(image[:, first:], board)
    shown = views.visible[0].numpy()
    assert shown.sum() >= 50
    assert np.linalg.norm(views.pixels[0].numpy() - (truth - (first, 0)), axis=-1)[shown].max() < 0.3


def test_few_corners_are_not_compared(monkeypatch):
    monkeypatch.setattr(corners, "FEWEST", 99)
    camera = cameras(20, 1)[0]
    truth = camera.project(BOARD.points)[0].numpy().reshape(4, 5, 2)
    assert refine_grid(photograph(camera, BOARD).numpy(), truth).visible.all()


def smeared(image, length, turn_deg):
    """The photograph with a camera that moved evenly by so many px while it was exposed."""
    way = length * np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))])
    moves = [np.float32([[1, 0, x], [0, 1, y]]) for x, y in np.linspace(-way / 2, way / 2, 8 * length)]
    size, shown = image.shape[::-1], image.astype(np.float32)
    moved = [cv2.warpAffine(shown, m, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for m in moves]
    return np.mean(moved, axis=0).astype(np.float32)


def defocused(image, radius):
    """The photograph with a lens that shows each point as a disc."""
    place = np.arange(-radius - 1, radius + 2)
    disc = np.clip(radius + 0.5 - np.hypot(place[:, None], place), 0, 1)
    return cv2.filter2D(image.astype(np.float32), -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)


def noisy(image, deviation):
    return (image + np.random.default_rng(0).normal(0, deviation, image.shape)).clip(0, 255).round().astype(np.uint8)


# Root mean square of a coordinate in px, measured 0.026 0.041 0.019; within a disc of 12 px 3.9 0.65 0.032.
BLURRED = {
    "moved by 22 px": (lambda image: smeared(image, 22, 30), 0.035),
    "out of focus by 12 px": (lambda image: defocused(image, 12), 0.05),
    "moved by 16 px": (lambda image: smeared(image, 16, 75), 0.025),
}


@pytest.mark.parametrize("blur", BLURRED)
def test_a_wide_blur_is_looked_at_as_a_whole(blur):
    """Within a disc narrower than the blur, a shift of the corner looks as a gradient of the light does."""
    smear, most = BLURRED[blur]
    camera = cameras(50, 1, seed=5)[0]
    truth = camera.project(BOARD.points)[0].numpy().reshape(4, 5, 2)
    image = noisy(smear(photograph(camera, BOARD, noise=0.0).numpy()), 2.5)
    found = refine_grid(image, truth + np.random.default_rng(0).normal(0, 1.5, truth.shape))
    assert found.visible.all()
    assert np.sqrt(((found.grid - truth) ** 2).mean()) < most


def test_an_enlarged_photograph_shows_its_corners_where_the_photograph_does():
    """Bicubic enlargement by 6; measured 0.015 px of the small one, within a disc of 12 px 0.26."""
    camera = cameras(16, 1, seed=5)[0]
    truth = camera.project(BOARD.points)[0].numpy().reshape(4, 5, 2)
    image = photograph(camera, BOARD, blur_px=1.0).numpy()
    large = cv2.resize(image, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    found = refine_grid(large, (truth + 0.5) * 6 - 0.5)
    assert found.visible.all()
    off = (found.grid + 0.5) / 6 - 0.5 - refine_grid(image, truth).grid
    assert np.linalg.norm(off, axis=-1).max() < 0.03


def test_no_corner_of_a_view_that_is_vague_throughout_is_taken_on_trust():
    """Moved by as much as its squares measure: corners 3 px off look like corners of a noisy view."""
    board = Chessboard(9, 6, 1.0)
    camera = cameras(20, 1, board, seed=3)[0]
    truth = camera.project(board.points)[0].numpy().reshape(6, 9, 2)
    sharp = photograph(camera, board, noise=0.0).numpy()
    blurred = noisy(smeared(sharp, 18, 40), 2.5)
    found = refine_grid(blurred, truth)
    assert found.vague
    assert not found.is_board()
    with pytest.raises(BoardNotFoundError, match="too blurred for its corners to be placed: take it in focus"):
        detect(blurred, board)
    found = refine_grid(noisy(sharp, 25), truth)
    assert found.is_board()
    assert not found.vague


def test_a_blurred_view_from_the_side_through_a_bending_lens_keeps_its_corners():
    """Their neighbours' surface misses corners along the board's sides by half a pixel, root mean square."""
    board = Chessboard(9, 6, 1.0)
    steep = dp.rotation_from_euler(*torch.tensor((0.95, 0.6, 0.3), dtype=D))
    t = torch.tensor([0, 0, 7.5], dtype=D) - steep @ board.points.mean(0)
    K = torch.tensor([[500.0, 0, 399.5], [0, 500.0, 299.5], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.3, 0.08, 0.0, 0.0, 0.0], dtype=D))
    camera = dp.Camera(K, distortion=lens, size=(800, 600)).at(steep, t)
    truth = camera.project(board.points)[0].numpy().reshape(6, 9, 2)
    image = noisy(smeared(photograph(camera, board, noise=0.0).numpy(), 12, 30), 2.5)
    found = refine_grid(image, truth)
    assert found.visible.all()
    assert np.linalg.norm(found.grid - truth, axis=-1).max() < 0.7
