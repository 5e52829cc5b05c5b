"""A board that bends another way in each view is told from corners that scatter."""

import math

import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard()
SIZE = (640, 480)
CAMERA = dp.Camera(
    torch.tensor([[600, 0, 330], [0, 600, 230], [0, 0, 1]], dtype=D),
    distortion=dp.BrownConrady(torch.tensor([-0.25, 0.09, 0.0, 0.0, -0.01], dtype=D)),
    size=SIZE,
)
WORDS = "neighbours alike and each view another way"


def seen(seed: int, *, bend: float = 0.0, noise: float = 0.1, wrong: float = 0.0, board: dp.Chessboard = BOARD):
    """Thirteen views of a board that is a cylinder of its own in each, `bend` mm deep (RMS) at its ends."""
    draw = torch.Generator().manual_seed(seed)
    cameras = synthetic.random_cameras(CAMERA, board, 13, seed=seed)
    xy = board.points[:, :2] - board.points[:, :2].mean(0)
    angle = math.pi * torch.rand(13, 1, generator=draw, dtype=D)
    along = (xy[:, 0] * angle.cos() + xy[:, 1] * angle.sin()) / xy.abs().amax()
    points = board.points.repeat(13, 1, 1)
    points[..., 2] = bend * torch.randn(13, 1, generator=draw, dtype=D) * along.square()
    pixels = cameras.project(points)[0]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=draw, dtype=D)
    hit = torch.rand(pixels.shape[:-1], generator=draw) < 0.03
    pixels = pixels + wrong * hit.unsqueeze(-1) * torch.randn(pixels.shape, generator=draw, dtype=D)
    return dp.Views(pixels, CAMERA.in_image(pixels), size=SIZE)


def told(views: dp.Views, board: dp.Chessboard = BOARD, **options) -> str:
    return dp.calibrate(views, board, throw=False, **options).remarks[0]


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"loss": dp.Huber(1.0)}, marks=pytest.mark.slow),
        pytest.param({"shape": "bow"}, marks=pytest.mark.slow),
    ],
    ids=["", "huber", "bow"],
)
def test_a_board_that_bends(options):
    said = [told(seen(seed, bend=12.0), **options) for seed in range(6)]
    assert sum(WORDS in text for text in said) >= 5
    assert not any("look for blur" in text for text in said)


def test_the_verdict_says_what_to_do():
    verdict = str(dp.calibrate(seen(1, bend=12.0), BOARD, throw=False).verdict)
    assert verdict.startswith("Weak")
    assert "the corners of a view err together, as on a board that bends" in verdict
    assert "glued to glass or aluminium" in verdict
    assert "sharper photographs" not in verdict


@pytest.mark.slow
def test_corners_that_scatter_or_are_wrong_do_not_bend():
    assert all("look for blur" in told(seen(seed, noise=1.5)) for seed in range(4))
    assert all("look for blur" in told(seen(seed, wrong=10.0)) for seed in range(4))
    assert not any(WORDS in told(seen(seed, noise=1.5), loss=dp.Huber(1.0)) for seed in range(4))


def test_too_few_corners_for_the_question():
    """Nine corners have fewer coordinates than a bent board has unknowns."""
    small = dp.Chessboard(3, 3, 60.0)
    assert all(WORDS not in told(seen(seed, noise=1.5, board=small), small) for seed in range(3))


def of_zooms(zooms: torch.Tensor, seed: int) -> dp.Views:
    """Views by a camera of 3200 px whose focal length is another one in each."""
    K = torch.diag(torch.tensor([5.0, 5.0, 1.0], dtype=D)) @ CAMERA.K
    large = dp.Camera(K, distortion=CAMERA.distortion, size=(3200, 2400))
    where = synthetic.random_cameras(large, BOARD, len(zooms), seed=seed)
    K = K.repeat(len(zooms), 1, 1)
    K[:, 0, 0], K[:, 1, 1] = 3000 * zooms, 3000 * zooms
    pixels = dp.Camera(K, where.R, where.t, distortion=CAMERA.distortion, size=(3200, 2400)).project(BOARD.points)[0]
    draw = torch.Generator().manual_seed(seed)
    pixels = pixels + 0.1 * torch.randn(pixels.shape, generator=draw, dtype=D)
    return dp.Views(pixels, large.in_image(pixels), size=(3200, 2400))


def test_cameras_that_differ_are_no_board_that_bends():
    """They leave residuals that are smooth in each view, too."""
    for seed in range(3):
        draw = torch.Generator().manual_seed(seed)
        focus = told(of_zooms(1 + 0.04 * torch.randn(13, generator=draw, dtype=D), seed))
        two = told(of_zooms(torch.tensor([1.0, 1.05], dtype=D).repeat(7)[:13], seed))
        assert "the focal length differs" in focus or "want another camera" in focus
        assert "want another camera" in two
        assert WORDS not in focus + two


def test_a_focal_length_that_is_held_at_a_wrong_value_is_no_board_that_bends():
    views = of_zooms(torch.ones(13, dtype=D), 0)
    camera = dp.calibrate(views, BOARD).camera
    K = camera.K.clone()
    K[0, 0], K[1, 1] = 1.05 * K[0, 0], 1.05 * K[1, 1]
    held = dp.refine(views, BOARD, dp.Camera(K, distortion=camera.distortion, size=camera.size), fixed=("focal",))
    assert WORDS not in held.remarks[0]


def test_each_camera_of_a_batch_by_itself():
    both = [seen(2, bend=12.0), seen(2, noise=1.5)]
    batch = dp.Views(torch.stack([v.pixels for v in both]), torch.stack([v.visible for v in both]), size=SIZE)
    bends, scatters = dp.calibrate(batch, BOARD, throw=False).remarks
    assert WORDS in bends
    assert "look for blur" in scatters
