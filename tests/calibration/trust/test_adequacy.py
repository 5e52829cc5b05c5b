"""What the model leaves over is said in a sentence, with what to try; noise is passed over in silence."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard()
SIZE = (640, 480)
BROWN = dp.BrownConrady(torch.tensor([-0.25, 0.09, 0.0, 0.0, -0.01], dtype=D))
FISHEYE = dp.KannalaBrandt(torch.tensor([-0.01, 0.02, -0.01, 0.002], dtype=D))


def camera(f: float, lens: dp.BrownConrady | dp.KannalaBrandt | None) -> dp.Camera:
    return dp.Camera(torch.tensor([[f, 0, 330], [0, f, 230], [0, 0, 1]], dtype=D), distortion=lens, size=SIZE)


def seen(
    true: dp.Camera, problems: int, views: int = 13, points: Tensor = BOARD.points, noise: float = 0.2, **poses: Any
) -> dp.Views:
    drawn = [synthetic.random_cameras(true, BOARD, views, seed=seed, **poses) for seed in range(problems)]
    R, t = torch.stack([c.R for c in drawn]), torch.stack([c.t for c in drawn])
    pixels, visible = true[None, None].at(R, t).project(points)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1), dtype=D)
    return dp.Views(pixels, visible & true.in_image(pixels), size=SIZE)


def silent(calibration: dp.Calibration) -> bool:
    return not any(calibration.remarks)


@pytest.mark.parametrize("views", [3, 4, 13])
def test_noise_is_passed_over(views: int) -> None:
    assert silent(dp.calibrate(seen(camera(600, BROWN), 12, views), BOARD))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"loss": dp.Huber(0.3)}, {"objective": "plane"}, {"reject_outliers": True}])
def test_noise_of_many_is_passed_over(options: dict) -> None:
    found = dp.calibrate(seen(camera(600, BROWN), 100), BOARD, **options)
    assert sum(map(bool, found.remarks)) <= 1


def test_exact_corners_and_two_views_are_passed_over() -> None:
    assert silent(dp.calibrate(seen(camera(600, BROWN), 2, noise=0.0), BOARD))
    assert silent(dp.calibrate(seen(camera(600, BROWN), 4, 2, tilt=math.radians(50)), BOARD, throw=False))


@pytest.mark.parametrize(
    ("model", "advice"),
    [("none", "'brown5'"), ("brown4", "'brown8' or 'fisheye'"), ("brown5", "'brown8' or 'fisheye'")],
)
def test_another_lens_is_advised(model: str, advice: str) -> None:
    """RMS 0.9 to 1.5 px without a lens, 0.5 to 1.2 px with brown4, 0.31 to 0.4 px with brown5; noise alone 0.27 px."""
    truth = camera(600, BROWN) if model == "none" else camera(300, FISHEYE)
    found = dp.calibrate(seen(truth, 3, distance=(0.8, 2.0)), BOARD, model, throw=False)  # type: ignore[arg-type]
    told = [text for text, good in zip(found.remarks, found.converged.tolist(), strict=True) if good]
    assert told
    for text in told:
        assert "the residuals change smoothly with the distance from the principal point" in text
        assert advice in text
    for better in ("brown8", "fisheye"):
        again = dp.calibrate(seen(truth, 3, distance=(0.8, 2.0)), BOARD, better)  # type: ignore[arg-type]
        assert not any("the residuals change" in text for text in again.remarks)


def test_a_lens_far_from_the_cameras_has_not_converged() -> None:
    several = seen(camera(300, FISHEYE), 1, distance=(0.6, 2.0))
    views = dp.Views(several.pixels[0], several.visible[0], size=SIZE)
    found = dp.calibrate(views, BOARD, "none", throw=False)
    assert found.rms > 3
    with pytest.raises(
        dp.CalibrationError, match=r"the residuals, \d\.\d px .* as through another lens: try .*fisheye"
    ):
        dp.calibrate(views, BOARD, "none")


def test_a_held_lens_is_told_by_its_residuals() -> None:
    """Rejection takes the corners that show it most."""
    found = dp.calibrate(dp.example_views("left"), BOARD, fixed=("distortion",), reject_outliers=True)
    assert bool(found.converged)
    assert "let the lens's coefficients free" in found.message
    robust = dp.calibrate(dp.example_views("left"), BOARD, "none", loss=dp.Huber(0.5))
    assert "try distortion='brown5'" in robust.message


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_printed_board_is_told_from_the_lens(side: str) -> None:
    """Its corners lie 0.08 mm off the grid, the same way for both cameras; no lens explains that."""
    text = dp.calibrate(dp.example_views(side), BOARD).remarks[0]
    assert text.startswith("the residuals repeat on the board, whose corners lie 0.0")
    assert 0.06 < float(text.split("lie ")[1].split()[0]) < 0.09
    assert "lens" not in text


def test_the_boards_shape() -> None:
    draw = torch.Generator().manual_seed(0)
    rough = BOARD.points.clone()
    rough[:, :2] += 0.1 * torch.randn(54, 2, generator=draw, dtype=D)
    for text in dp.calibrate(seen(camera(600, BROWN), 3, points=rough), BOARD).remarks:
        assert 0.1 < float(text.split("lie ")[1].split()[0]) < 0.18  # 0.141, the root mean square in the plane
    bent = BOARD.points.clone()
    bent[:, 2] = 1.5 * (1 - ((bent[:, 0] - 100) / 100).square())
    views = seen(camera(600, BROWN), 3, points=bent)
    assert all("take shape='bow'" in text for text in dp.calibrate(views, BOARD).remarks)
    assert silent(dp.calibrate(views, BOARD, shape="bow"))


def test_a_board_that_is_not_flat() -> None:
    """A twist is no bow, and moves no corner within the plane."""
    twisted = BOARD.points.clone()
    x, y = (twisted[:, :2] / twisted[:, :2].amax(0) * 2 - 1).unbind(-1)
    twisted[:, 2] = 1.5 * x * y
    for text in dp.calibrate(seen(camera(600, BROWN), 3, points=twisted), BOARD).remarks:
        assert "off the target's plane: take shape='free'" in text
        far = float(text.split("lie ")[1].split()[0])
        assert far == pytest.approx(float(twisted[:, 2].square().mean().sqrt()), rel=0.3)


def test_corners_that_scatter() -> None:
    found = dp.calibrate(seen(camera(600, BROWN), 2, noise=2.0), BOARD)
    assert all(text.startswith("the corners scatter by 2.0 px in each coordinate") for text in found.remarks)


def test_what_is_said_is_in_message_and_summary() -> None:
    found = dp.calibrate(dp.example_views("left"), BOARD, "none")
    assert found.message == f"converged: no step lowers the error any more; {found.remarks[0]}"
    assert found.remarks[0] in found.summary().splitlines()
    assert found.summary().splitlines()[-1] == found.verdict


def test_skew_is_advised_where_it_is_missing() -> None:
    views = dp.example_views("left")
    skewed = dp.Views(views.pixels @ torch.tensor([[1.0, 0.005], [0, 1]], dtype=views.pixels.dtype).mT, size=views.size)
    assert "as through a K with skew" in dp.calibrate(skewed, BOARD).message
    assert "take skew=True" in dp.calibrate(skewed, BOARD).message
    assert "skew" not in dp.calibrate(skewed, BOARD, skew=True).message


@pytest.mark.parametrize("skew", [pytest.param(-30.0, marks=pytest.mark.slow), 30.0])
@pytest.mark.parametrize(("lens", "model"), [(None, "brown5"), (BROWN, "brown4"), (BROWN, "brown5")])
def test_much_skew_is_advised_too(lens: dp.BrownConrady | None, model: str, skew: float) -> None:
    """It leaves 0.6 to 1 px, part of which any lens would explain."""
    true = camera(600, lens)
    K = true.K.clone()
    K[0, 1] = skew
    for text in dp.calibrate(seen(dp.Camera(K, distortion=lens, size=SIZE), 3), BOARD, model).remarks:  # type: ignore[arg-type]
        assert "take skew=True" in text


@pytest.mark.parametrize("skew", [0.1, 0.2])
def test_very_much_skew_is_advised_where_the_fit_is_refused_for_it(skew: float) -> None:
    """At a fifth of the focal length it leaves 2.2 px, too much for a calibration."""
    found = dp.calibrate(dp.example_views("left"), BOARD)
    K = found.camera.K.clone()
    K[0, 1] = skew * K[0, 0]
    pixels, _ = dp.Camera(K, found.cameras.R, found.cameras.t, found.camera.distortion).project(BOARD.points)
    pixels = pixels - pixels.amin((0, 1)) + 20
    width, height = (pixels.amax((0, 1)) + 20).long().tolist()
    views = dp.Views(pixels, size=(width, height))
    assert "as through a K with skew" in dp.calibrate(views, BOARD, throw=False).message
    assert dp.calibrate(views, BOARD, skew=True).camera.K[0, 1] == pytest.approx(float(K[0, 1]), rel=1e-3)
