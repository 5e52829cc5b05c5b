"""`CalibrationPrior`: the cost that the calibration itself would give."""

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

import diffproj as dp

D = torch.float64


def test_prior_is_the_calibrations_own_cost() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    prior = dp.CalibrationPrior(calibration, view=2)
    start = calibration.cameras[2]
    assert float(prior(start)) == 0
    projector = dp.PlaneProjector(start, dp.Plane.z(0.0), ("focal", "principal_point", "distortion", "pose"))
    C = calibration.covariance.view(2)
    off = torch.linalg.cholesky(C) @ torch.randn(len(C), dtype=D) * 0.03
    K = start.K + torch.tensor([[off[0], 0, off[2]], [0, off[1], off[3]], [0, 0, 0]], dtype=D)
    R = axis_angle_to_rotation_matrix(off[None, 9:12])[0] @ start.R
    lens = dp.BrownConrady(start.distortion.coefficients + off[4:9])
    want = 0.5 * off @ torch.linalg.solve(C, off)
    got = prior(dp.Camera(K, R, start.t + off[12:], lens))
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)
    gradients = torch.autograd.grad(prior(projector.camera), list(projector.parameters()), allow_unused=True)
    assert all(g is not None and g.abs().max() < 1e-6 for g in gradients)
    assert float(dp.CalibrationPrior(calibration)(calibration.camera)) == 0


def shifted(camera: dp.Camera, **off: float) -> dp.Camera:
    """The camera with some of its intrinsics changed, in pixels."""
    K = camera.K.clone()
    for name, (row, column) in {"f_x": (0, 0), "f_y": (1, 1), "c_x": (0, 2), "c_y": (1, 2)}.items():
        K[..., row, column] += off.get(name, 0.0)
    return dp.Camera(K, camera.R, camera.t, camera.distortion)


@pytest.mark.parametrize("view", [None, 2])
@pytest.mark.parametrize("options", [{}, {"shape": "bow"}, {"loss": dp.Huber(0.3)}])
def test_tied_focal_lengths_count_once_and_their_ratio_not_at_all(options: dict, view: int | None) -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard(), tied_focal=True, **options)
    camera = calibration.camera if view is None else calibration.cameras[view]
    prior = dp.CalibrationPrior(calibration, view)
    C = calibration.covariance.shared if view is None else calibration.covariance.view(view)
    rows = [i for i in range(len(C)) if i != 1 and not 9 <= i < len(calibration.covariance.names)]  # no f_y, no bow
    free = C[rows][:, rows]
    off = torch.linalg.cholesky(free) @ torch.randn(len(free), dtype=D)
    off[3:] = 0.0  # focal lengths and principal point
    ratio = float(camera.K[1, 1] / camera.K[0, 0])
    got = prior(shifted(camera, f_x=float(off[0]), f_y=ratio * float(off[0]), c_x=float(off[1]), c_y=float(off[2])))
    torch.testing.assert_close(got, 0.5 * off @ torch.linalg.solve(free, off), rtol=1e-6, atol=0)
    # f_x and f_y in their standard deviations: the sum counts, the difference does not.
    C_f = C[0, 0] ** 0.5, C[1, 1] ** 0.5
    assert prior(shifted(camera, f_x=float(C_f[0]), f_y=-float(C_f[1]))).abs() < 1e-6
    one = prior(shifted(camera, f_x=float(C_f[0])))
    torch.testing.assert_close(one, prior(shifted(camera, f_x=float(C_f[0]) / 2, f_y=float(C_f[1]) / 2)))
    assert one > 0.1


def test_what_was_fixed_does_not_count() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard(), "brown4", fixed=("principal_point",))
    prior = dp.CalibrationPrior(calibration, view=0)
    start = calibration.cameras[0]
    assert float(prior(shifted(start, c_x=50.0, c_y=-50.0))) == 0
    assert float(prior(shifted(start, f_x=50.0))) > 1


def test_it_stays_in_float64_whatever_the_network() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard(), "brown8")
    network = torch.nn.ModuleDict({"linear": torch.nn.Linear(2, 2), "prior": dp.CalibrationPrior(calibration, view=1)})
    start = calibration.cameras[1]
    moved = start.at(start.R, start.t * 1.001)
    want = network["prior"](moved)
    for convert in (network.half, network.bfloat16, network.float):
        convert()
        assert network["linear"].weight.dtype != D
        assert torch.equal(network["prior"](moved), want)
        assert network["prior"](moved.to(torch.float32)).dtype == D


def test_a_camera_of_another_image_is_told() -> None:
    """Half as large, the focal length was 280 px off without a word, and pulled there."""
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    prior, camera = dp.CalibrationPrior(calibration, view=0), calibration.cameras[0]
    for other in (camera.resized((320, 240)), camera.cropped(20, 20, 600, 440)):
        with pytest.warns(
            UserWarning, match="image has 640 x 480 px, and the camera's .*: where it was resized or cro"
        ):
            assert prior(other) > 1e4
    assert float(prior(dp.Camera(camera.K, camera.R, camera.t, camera.distortion))) == 0  # of no size


def test_another_lens_model_is_refused() -> None:
    prior = dp.CalibrationPrior(dp.calibrate(dp.example_views("left"), dp.Chessboard(), "brown4"))
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
    for lens, name in ((None, "none"), (dp.KannalaBrandt(torch.zeros(4, dtype=D)), "fisheye")):
        with pytest.raises(ValueError, match=f"camera: want the calibration's lens model 'brown4', got '{name}'"):
            prior(dp.Camera(K, distortion=lens))
