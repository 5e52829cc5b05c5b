"""One calibration out of many: all that a calibration of its own holds."""

import copy
import io
import pickle

import pytest
import torch

import diffproj as dp

D = torch.float64


@pytest.fixture(scope="module")
def pair() -> dp.Views:
    """Two cameras of nine views each."""
    sides = [dp.example_views(side)[:9] for side in ("left", "right")]
    return dp.Views(torch.stack([side.pixels for side in sides]), size=sides[0].size)


@pytest.fixture(scope="module")
def both(pair: dp.Views) -> dp.Calibration:
    return dp.calibrate(pair, dp.Chessboard())


@pytest.fixture(scope="module")
def alone(pair: dp.Views) -> dp.Calibration:
    return dp.calibrate(dp.Views(pair.pixels[1], size=pair.size), dp.Chessboard())


def test_one_of_many_is_what_it_would_be_alone(both: dp.Calibration, alone: dp.Calibration) -> None:
    one = both[1]
    assert one.summary() == alone.summary()
    assert one.verdict == alone.verdict
    assert one.message == alone.message
    assert one.findings == alone.findings
    torch.testing.assert_close(one.shared, alone.shared)
    torch.testing.assert_close(one.cameras.t, alone.cameras.t)
    torch.testing.assert_close(one.covariance.shared, alone.covariance.shared, rtol=1e-4, atol=0)
    for view, other in ((2, 2), (0, 5)):
        mine, its = one.covariance.between(view, other), alone.covariance.between(view, other)
        torch.testing.assert_close(mine, its, rtol=1e-3, atol=float(its.abs().max()) * 1e-6)
    torch.testing.assert_close(one.alternatives.t, alone.alternatives.t, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(one.view_rms, alone.view_rms)
    torch.testing.assert_close(one.positions.deviations, alone.positions.deviations, rtol=1e-4, atol=0)


def test_one_of_many_measures_as_alone(both: dp.Calibration, alone: dp.Calibration) -> None:
    pixels = torch.tensor([[300.0, 200.0], [350.0, 260.0]], dtype=D)
    mine, its = (dp.measure(pixels, one, dp.Plane.z(0.0), view=3, pixel_sigma=0.1) for one in (both[1], alone))
    torch.testing.assert_close(mine.points, its.points)
    torch.testing.assert_close(mine.covariance, its.covariance, rtol=1e-4, atol=1e-12)


def test_views_located_with_one_of_many(both: dp.Calibration, alone: dp.Calibration, pair: dp.Views) -> None:
    views = dp.Views(pair.pixels[1, 5:], size=pair.size)
    mine, its = (dp.locate(views, dp.Chessboard(), one) for one in (both[1], alone))
    torch.testing.assert_close(mine.mismatch.ratio, its.mismatch.ratio, rtol=1e-4, atol=0)
    with pytest.warns(UserWarning, match="exceed the calibration's"):  # camera 0 is another one
        many = dp.locate(pair, dp.Chessboard(), alone)
    assert many[1].doubts == dp.locate(dp.Views(pair.pixels[1], size=pair.size), dp.Chessboard(), alone).doubts
    assert many[0].mismatch.doubtful.tolist() == many.mismatch.doubtful[0].tolist()
    torch.testing.assert_close(many[0].region, many.region.expand(2, -1)[0])


@pytest.mark.parametrize(
    ("index", "which"),
    [(slice(0, 1), [0]), ([1, 0], [1, 0]), (torch.tensor([False, True]), [1]), (-1, [1]), (..., [0, 1])],
)
def test_some_of_many(both: dp.Calibration, index: object, which: list[int]) -> None:
    some = both[index]
    assert some.views.batch_shape == some.camera.batch_shape == some.rms.shape
    assert some.rms.flatten().tolist() == both.rms[which].tolist()
    assert list(some.findings) == [both.findings[i] for i in which]
    assert some.covariance.shared.reshape(-1, 9, 9).tolist() == both.covariance.shared[which].tolist()
    assert some.cameras.batch_shape == (*some.rms.shape, 9)


def test_many_are_gone_through_one_by_one(both: dp.Calibration) -> None:
    assert [float(one.rms) for one in both] == both.rms.tolist()


def test_of_several_axes(both: dp.Calibration, pair: dp.Views) -> None:
    grid = dp.calibrate(dp.Views(pair.pixels.unsqueeze(1).expand(2, 2, 9, 54, 2), size=pair.size), dp.Chessboard())
    torch.testing.assert_close(grid[1, 0].shared, both[1].shared)
    assert grid[1].rms.shape == (2,)
    assert grid[..., 0].findings == (grid.findings[0], grid.findings[2])
    assert grid[..., 0].cameras.batch_shape == (2, 9)


def test_failures_keep_their_causes(pair: dp.Views) -> None:
    pixels = pair.pixels.clone()
    pixels[1] = pixels[1, :1]  # nine times the same view
    found = dp.calibrate(dp.Views(pixels, size=pair.size), dp.Chessboard(), throw=False)
    assert found.converged.tolist() == [True, False]
    assert found.message.endswith(found[1].message)
    assert found[0].verdict.startswith("Good")


def test_a_bow_and_rejected_corners_go_along(pair: dp.Views) -> None:
    found = dp.calibrate(pair, dp.Chessboard(), shape="bow", loss=dp.Huber(0.5))
    assert found[1].bow.tolist() == found.bow[1].tolist()
    assert found[1].shape == "bow"
    torch.testing.assert_close(found[1].points, found.points[1])
    torch.testing.assert_close(found[1].points_deviation, found.points_deviation[1])


def test_copies_and_files_of_one(both: dp.Calibration) -> None:
    one = both[1]
    kept = io.BytesIO()
    pickle.dump(one, kept)
    kept.seek(0)
    for again in (copy.deepcopy(both[1]), pickle.load(kept)):  # noqa: S301  # written above
        assert again.summary() == one.summary()
    assert dp.Calibration.from_fields(one.to_fields(), one.camera).summary() == one.summary()


def test_gradients_reach_the_corners_of_that_camera_alone(both: dp.Calibration, pair: dp.Views) -> None:
    pixels = pair.pixels.clone().requires_grad_()
    found = dp.refine(dp.Views(pixels, size=pair.size), dp.Chessboard(), both.camera, differentiable=True)
    found[1].camera.K[0, 0].backward()
    assert pixels.grad is not None
    assert float(pixels.grad[0].abs().max()) == 0
    assert float(pixels.grad[1].abs().max()) > 0


def test_wrong_choices(both: dp.Calibration, alone: dp.Calibration) -> None:
    with pytest.raises(IndexError, match="index: want one that fits the batch shape"):
        both[2]
    with pytest.raises(IndexError, match="index: want numbers that are known"):
        both[torch.zeros(2, dtype=torch.long, device="meta")]
    with pytest.raises(TypeError, match="index: want numbers"):
        both["left"]
    with pytest.raises(TypeError, match=r"index: want many calibrations to choose from, got one"):
        alone[0]
    with pytest.raises(TypeError, match=r"calibration: want many calibrations to choose from, got one"):
        list(alone)


def test_one_after_the_other(both: dp.Calibration) -> None:
    assert [one.rms.item() for one in both] == both.rms.tolist()
