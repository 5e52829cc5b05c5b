"""K with skew, held or fitted, and images that are turned, in `calibrate`, `refine`, `locate` and what builds on them.

Zhang's data of 1998 are not the project's own: the folder that DIFFPROJ_ZHANG names holds them as his page offers them,
`Model.txt` and `data1.txt` to `data5.txt`.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard(9, 6, 25.0)
K = torch.tensor([[533.0, 7.5, 330], [0, 540, 236], [0, 0, 1]], dtype=D)
LENSES: dict[str, dp.Lens | None] = {
    "none": None,
    "brown5": dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002], dtype=D)),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=D)),
}


def simulated(
    model: str = "brown5", noise_px: float = 0.0, K: torch.Tensor = K, views: int = 6, seed: int = 1
) -> tuple[dp.Camera, dp.Views]:
    truth = synthetic.random_cameras(dp.Camera(K, distortion=LENSES[model], size=(640, 480)), BOARD, views, seed=seed)
    return truth, synthetic.corner_views(truth, BOARD, noise_px=noise_px, seed=seed)


def project_plainly(K: np.ndarray, k: tuple[float, float], R: np.ndarray, t: np.ndarray, X: np.ndarray) -> np.ndarray:
    """The camera of Zhang's paper, equation by equation: skew, and two radial coefficients."""
    X_cam = X @ R.T + t
    x, y = X_cam[:, 0] / X_cam[:, 2], X_cam[:, 1] / X_cam[:, 2]
    factor = 1 + k[0] * (x**2 + y**2) + k[1] * (x**2 + y**2) ** 2
    return np.stack([K[0, 0] * x * factor + K[0, 1] * y * factor + K[0, 2], K[1, 1] * y * factor + K[1, 2]], -1)


# -------------------------------------------------------------------------------------------------- fitted and held


@pytest.mark.parametrize("objective", ["image", "plane"])
@pytest.mark.parametrize("model", LENSES)
def test_skew_is_found(model: str, objective: str) -> None:
    truth, views = simulated(model)
    found = dp.calibrate(views, BOARD, model, skew=True, objective=objective)
    torch.testing.assert_close(found.camera.K, truth.K[0], rtol=0, atol=1e-6)
    assert found.parameters.names[-1] == "skew"
    assert found.covariance.names == found.parameters.names
    rough = dp.Camera(torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=D), distortion=LENSES[model])
    again = dp.refine(views, BOARD, rough, skew=True, objective=objective)
    torch.testing.assert_close(again.camera.K, truth.K[0], rtol=0, atol=1e-6)


def test_skew_is_held_unless_it_is_asked_for() -> None:
    _, views = simulated(noise_px=0.2)
    without = dp.calibrate(views, BOARD)
    assert without.camera.K[0, 1] == 0
    assert "skew" not in without.parameters.names
    held = dp.refine(views, BOARD, dp.Camera(K, distortion=LENSES["brown5"]))
    assert held.camera.K[0, 1] == 7.5
    assert held.covariance.deviations["skew"] == 0
    fitted = dp.calibrate(views, BOARD, skew=True)
    also_held = dp.refine(views, BOARD, dp.Camera(K, distortion=LENSES["brown5"]), skew=True, fixed=("skew",))
    torch.testing.assert_close(also_held.shared, held.shared)
    assert fitted.rms < held.rms < without.rms
    known = dp.calibrate(views, BOARD, skew=True, priors={"skew": (7.5, 1e-6)})
    torch.testing.assert_close(known.shared, held.shared, rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match="fixed: want names from .* got 'skew'"):
        dp.calibrate(views, BOARD, fixed=("skew",))


def test_locate_with_skew() -> None:
    truth, views = simulated()
    located = dp.locate(views, BOARD, truth[0].without_pose())
    assert torch.equal(located.camera.K, K)
    torch.testing.assert_close(located.cameras.t, truth.t, rtol=0, atol=1e-8)
    torch.testing.assert_close(located.cameras.R, truth.R, rtol=0, atol=1e-10)
    rest = dp.locate(views, BOARD, dp.calibrate(simulated(noise_px=0.2)[1], BOARD, skew=True))
    assert rest.knows_intrinsics
    assert rest.covariance.deviations["skew"] > 0.1


def test_a_skew_that_ends_at_exactly_0_stays_a_parameter() -> None:
    square = torch.tensor([[533.0, 0, 330], [0, 540, 236], [0, 0, 1]], dtype=D)
    truth, views = simulated("none", K=square)
    found = dp.refine(views, BOARD, truth, skew=True, max_iterations=1, throw=False)
    found = dp.Calibration(**{**vars(found), "camera": truth[0].without_pose(), "cameras": truth})
    assert found.camera.K[0, 1] == 0
    assert len(found.shared) == len(found.covariance.names) == 5
    located = dp.locate(views, BOARD, found)
    measured = dp.measure(views.pixels[0, :3], located, dp.Plane.z(0.0), view=0, pixel_sigma=0.2)
    assert measured.covariance.isfinite().all()


def test_bow_and_batch_beside_it() -> None:
    _, views = simulated(noise_px=0.1)
    other = simulated(noise_px=0.1, seed=2, K=K - torch.tensor([[0.0, 15, 0], [0, 0, 0], [0, 0, 0]], dtype=D))[1]
    both = dp.Views(torch.stack([views.pixels, other.pixels]), size=views.size)
    batch = dp.calibrate(both, BOARD, skew=True, shape="bow")
    assert batch.parameters.names[-3:] == ("skew", "bow_x", "bow_y")
    for i in range(2):
        one = dp.calibrate(dp.Views(both.pixels[i], size=views.size), BOARD, skew=True, shape="bow")
        torch.testing.assert_close(batch.shared[i], one.shared, rtol=1e-6, atol=1e-6)
        assert abs(float(one.bow.abs().max())) < 1.0
    assert (batch.camera.K[:, 0, 1] - torch.tensor([7.5, -7.5], dtype=D)).abs().max() < 1.0
    dp.locate(both, BOARD, batch)


def test_gradients_through_the_minimum() -> None:
    truth, views = simulated("none", noise_px=0.2, views=3)

    def skew_of(pixels: torch.Tensor) -> torch.Tensor:
        return dp.refine(dp.Views(pixels, size=views.size), BOARD, truth, skew=True, differentiable=True).camera.K[0, 1]

    pixels = views.pixels.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(skew_of(pixels), pixels)
    direction = torch.randn_like(pixels)
    ahead, behind = (skew_of(views.pixels + sign * 1e-4 * direction) for sign in (1, -1))
    torch.testing.assert_close((gradient * direction).sum(), (ahead - behind) / 2e-4, rtol=1e-5, atol=1e-8)


# --------------------------------------------------------------------------------------------------- turned images


def turned_by(degrees: float) -> torch.Tensor:
    """The warp that turns a photograph of 640 x 480 px about its middle, into the middle of one of 1000 x 1000 px."""
    a = np.deg2rad(degrees)
    q = torch.tensor([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]], dtype=D)
    shift = 499.5 - q @ torch.tensor([319.5, 239.5], dtype=D)
    return torch.cat([torch.cat([q, shift[:, None]], -1), torch.tensor([[0.0, 0, 1]], dtype=D)])


@pytest.mark.parametrize("degrees", [90, 180, 270, 25])
@pytest.mark.parametrize("model", LENSES)
def test_turned_images_are_located_and_refined(model: str, degrees: int) -> None:
    truth, views = simulated(model)
    turn = turned_by(degrees)
    pixels = views.pixels @ turn[:2, :2].T + turn[:2, 2]
    turned, views = truth.warped(turn, size=(1000, 1000)), dp.Views(pixels, size=(1000, 1000))
    located = dp.locate(views, BOARD, turned[0])
    refined = dp.refine(views, BOARD, turned)
    for found in (located, refined):
        assert float(found.rms) < 1e-9
        assert found.camera.K[1, 0] == 0
        torch.testing.assert_close(found.cameras.project(BOARD.points)[0], pixels, rtol=0, atol=1e-8)
        torch.testing.assert_close(found.cameras.center, truth.center, rtol=0, atol=1e-6)


def test_mirrored_images_too() -> None:
    truth, views = simulated()
    flip = torch.tensor([[-1.0, 0, 639], [0, 1, 0], [0, 0, 1]], dtype=D)
    pixels = views.pixels @ flip[:2, :2].T + flip[:2, 2]
    located = dp.locate(dp.Views(pixels), BOARD, truth[0].without_pose().warped(flip))
    torch.testing.assert_close(located.cameras.t, truth.t, rtol=0, atol=1e-8)


# ------------------------------------------------------------------------------------------- what builds on a camera


def test_summary_and_file_hold_it(tmp_path: Path) -> None:
    found = dp.calibrate(simulated(noise_px=0.2)[1], BOARD, skew=True)
    assert f"skew            {float(found.camera.K[0, 1]):10.3f} ± 0." in found.summary()
    dp.save_camera(tmp_path / "camera.json", found)
    back = dp.load_calibration(tmp_path / "camera.json")
    assert back.parameters == found.parameters
    assert torch.equal(back.shared, found.shared)
    with pytest.raises(ValueError, match="K: want no skew"):
        dp.save_camera(tmp_path / "camera.yml", found)


def test_prior_of_a_calibration_with_skew() -> None:
    found = dp.calibrate(simulated(noise_px=0.2)[1], BOARD, skew=True)
    prior = dp.CalibrationPrior(found)
    moved = found.camera.K.clone()
    moved[0, 1] += 1.0
    deviation = float(found.covariance.deviations["skew"])
    camera = dp.Camera(moved, distortion=found.camera.distortion)
    assert float(prior(found.camera)) == 0
    assert float(prior(camera)) > 0.5 / deviation**2


@pytest.mark.filterwarnings("ignore:measure. pixel .* outside of the photograph")
@pytest.mark.parametrize("degrees", [0, 90, 25])
def test_error_bars_of_a_camera_alone_follow_its_whole_K(degrees: float) -> None:
    """Against the derivative of the back-projection, for K with skew and for a turned image."""
    camera = simulated()[0][0].warped(turned_by(degrees))
    pixels = camera.project(BOARD.points[[0, 8, 45]])[0]
    measured = dp.measure(pixels, camera, dp.Plane.z(0.0), pixel_sigma=0.5)
    J = torch.func.vmap(
        torch.func.jacfwd(lambda pixel: dp.back_project(pixel[None], camera, dp.Plane.z(0.0))[0][0]), in_dims=0
    )(pixels)
    torch.testing.assert_close(measured.covariance, 0.25 * J @ J.mT, rtol=1e-8, atol=1e-12)


def test_covariance_of_the_skew_against_sampling() -> None:
    """Standardised errors of 300 calibrations, of the parameters and of a length measured in a held view."""
    truth, _ = simulated("brown5", views=5)
    exact = truth.project(BOARD.points)[0]
    noise = 0.2 * torch.randn(300, *exact.shape, dtype=D, generator=torch.Generator().manual_seed(0))
    found = dp.calibrate(dp.Views(exact + noise, size=(640, 480)), BOARD, "brown4", skew=True)
    standard = (found.camera.K[:, 0, 1] - 7.5) / found.covariance.deviations["skew"]
    assert abs(float(standard.mean())) < 0.2
    assert 0.9 < float(standard.std()) < 1.1  # measured: 1.00
    clicks = exact[0, [0, 53]] + 0.2 * torch.randn(300, 2, 2, dtype=D, generator=torch.Generator().manual_seed(1))
    length = dp.measure(clicks, found, dp.Plane.z(0.0), view=0, pixel_sigma=0.2).lengths()
    off = (length.value[..., 0] - (BOARD.points[53] - BOARD.points[0]).norm()) / length.deviation[..., 0]
    assert 0.9 < float(off.std()) < 1.1


# ------------------------------------------------------------------------------------------------- Zhang's data


PUBLISHED = np.array([[832.5, 0.204494, 303.959], [0, 832.53, 206.585], [0, 0, 1]])
PUBLISHED_K = (-0.228601, 0.190353)
POSES = [  # of his first three views, in inches
    ([[0.992759, -0.026319, 0.117201], [0.0139247, 0.994339, 0.105341], [-0.11931, -0.102947, 0.987505]],
     [-3.84019, 3.65164, 12.791]),
    ([[0.997397, -0.00482564, 0.0719419], [0.0175608, 0.983971, -0.17746], [-0.0699324, 0.178262, 0.981495]],
     [-3.71693, 3.76928, 13.1974]),
    ([[0.915213, -0.0356648, 0.401389], [-0.00807547, 0.994252, 0.106756], [-0.402889, -0.100946, 0.909665]],
     [-2.94409, 3.77653, 14.2456]),
]  # fmt: skip


class Plain:
    """Any points, as a target."""

    def __init__(self, xy: np.ndarray) -> None:
        self.points = torch.nn.functional.pad(torch.tensor(xy, dtype=D), (0, 1))


def test_a_camera_as_zhang_published_it_comes_back() -> None:
    """Projected by his equations written out, with the skew that he found and a hundred times as much."""
    grid = np.stack(np.meshgrid(np.arange(16) * 0.45, -np.arange(16) * 0.45), -1).reshape(-1, 2)
    X = np.pad(grid, ((0, 0), (0, 1)))
    for factor in (1, 100):
        wanted = PUBLISHED * np.array([[1, factor, 1], [1, 1, 1], [1, 1, 1]])
        rotations = [np.linalg.svd(np.array(R)) for R, _ in POSES]
        seen = [
            project_plainly(wanted, PUBLISHED_K, U @ Vt, np.array(t), X)
            for (U, _, Vt), (_, t) in zip(rotations, POSES, strict=True)
        ]
        views = dp.Views(torch.tensor(np.stack(seen)), size=(640, 480))
        found = dp.calibrate(views, Plain(grid), "brown4", skew=True, fixed=("p1", "p2"))
        np.testing.assert_allclose(found.camera.K.numpy(), wanted, rtol=0, atol=1e-7)
        np.testing.assert_allclose(found.camera.distortion.coefficients[:2].numpy(), PUBLISHED_K, rtol=0, atol=1e-9)


@pytest.mark.skipif("DIFFPROJ_ZHANG" not in os.environ, reason="DIFFPROJ_ZHANG names no folder with Zhang's data")
def test_zhangs_data_come_back_to_his_published_digits() -> None:
    folder = Path(os.environ["DIFFPROJ_ZHANG"])
    target = Plain(np.loadtxt(folder / "Model.txt").reshape(-1, 2))
    seen = [np.loadtxt(folder / f"data{i}.txt").reshape(-1, 2) for i in range(1, 6)]
    views = dp.Views(torch.tensor(np.stack(seen)), size=(640, 480))
    found = dp.calibrate(views, target, "brown4", skew=True, fixed=("p1", "p2"))
    np.testing.assert_allclose(found.camera.K.numpy(), PUBLISHED, rtol=0, atol=6e-4)
    np.testing.assert_allclose(found.camera.distortion.coefficients[:2].numpy(), PUBLISHED_K, rtol=0, atol=2e-6)
    assert float(found.rms) == pytest.approx(0.33643, abs=5e-6)
    without = dp.calibrate(views, target, "brown4", fixed=("p1", "p2")).camera.K
    assert without[0, 0].item() == pytest.approx(832.207, abs=6e-4)
    assert without[1, 1].item() == pytest.approx(832.243, abs=6e-4)
