"""Rational lenses in a rig: what had to be held near a poorer lens on its own is not let go there."""

import torch

import diffproj as dp

D = torch.float64
BOARD = dp.Chessboard()
LENS = dp.BrownConrady(torch.tensor([0.45, -2.5, 4e-4, -2e-4, 1.5, 0.33, -2.35, 1.43], dtype=D))
NAMES = ("k4", "k5", "k6")


def test_a_lens_that_was_held_on_its_own_is_held_in_the_rig() -> None:
    """Let go, the terms nearly cancel without a fold: k1 -15.5 and k4 -15.6, and c_x 2.9 deviations off (of others 9)."""
    K = torch.tensor([[750.0, 0, 640], [0, 752, 355], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([0.02, 0.15, -0.01], dtype=D))
    one = dp.Camera(K, torch.eye(3, dtype=D), torch.zeros(3, dtype=D), LENS, size=(1280, 720))
    cameras = {"one": one, "two": one.at(R, torch.tensor([-200.0, 4, 3], dtype=D))}
    middle = torch.tensor([[750.0, 0, 280], [0, 752, 160], [0, 0, 1]], dtype=D)
    part = dp.Camera(middle, distortion=LENS, size=(560, 320))
    boards = dp.synthetic.random_cameras(part, BOARD, 12, distance=(2.0, 5.0), seed=9)
    points = BOARD.points.to(D) @ boards.R.mT + boards.t.unsqueeze(-2)
    generator, views = torch.Generator().manual_seed(9), {}
    for name, camera in cameras.items():
        exact = camera.project(points.flatten(0, 1))[0].unflatten(0, (12, 54))
        noisy = exact + 0.2 * torch.randn(exact.shape, generator=generator, dtype=D)
        views[name] = dp.Views(noisy, camera.in_image(noisy), size=camera.size)
    rig = dp.calibrate_rig(views, BOARD, "brown8")
    alone = dp.calibrate(views["one"], BOARD, "brown8")
    assert "held near those of a poorer lens" in alone.remarks[0]
    kept, found = (camera.distortion for camera in (alone.camera, rig.cameras["one"]))
    assert isinstance(kept, dp.BrownConrady)
    assert isinstance(found, dp.BrownConrady)
    torch.testing.assert_close(found.coefficients[5:], kept.coefficients[5:], rtol=1e-6, atol=1e-6)
    assert any("k4, k5 and k6 of one are held as on its own" in remark for remark in rig.remarks)
    assert all(float(rig["one"].covariance.deviations[term]) == 0 for term in NAMES)
    off = rig.cameras["one"].K[0, 2] - cameras["one"].K[0, 2]
    assert abs(float(off)) < 2.5 * float(rig["one"].covariance.deviations["c_x"])
