"""Views that show the board alike count once; one view tells no more than the focal length."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.results.distinct import ALIKE_PX, SENTENCES, alike, described, one_view, shares

D = torch.float64
VIEWS = dp.example_views("left")
BOARD = dp.Chessboard()
POINTS = BOARD.points.to(D)
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "weights": {"weights": torch.tensor(25.0)},
    "huber": {"loss": dp.Huber(0.3)},
    "plane": {"objective": "plane"},
    "robust plane": {"objective": "plane", "loss": dp.Huber(0.3)},
    "bow": {"shape": "bow"},
    "rejecting": {"reject_outliers": 3.0},
    "prior": {"priors": {"k3": 0.02}, "weights": torch.tensor(60.0)},
}


def noisy(views: dp.Views, sigma: float, seed: int = 0) -> dp.Views:
    generator = torch.Generator().manual_seed(seed)
    noise = sigma * torch.randn(views.pixels.shape, generator=generator, dtype=D)
    return dp.Views(views.pixels + noise, views.visible, size=views.size)


def same_cameras(one: dp.Calibration, other: dp.Calibration, part: float = 1e-4) -> None:
    """Parameters within a part of their deviations, deviations within it."""
    for at, (name, deviation) in enumerate(one.covariance.deviations.items()):
        assert abs(one.shared[at] - other.shared[at]) < part * deviation, name
        assert abs(other.covariance.deviations[name] / deviation - 1) < part, name


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_copies_change_nothing(options: dict[str, Any]) -> None:
    copied = [0, 0, 0, 1, 2, 3, 4, 5, 5, 6, 7, 8, 9, 10, 11, 12, 12]
    one, more = dp.calibrate(VIEWS, BOARD, **options), dp.calibrate(VIEWS[copied], BOARD, **options)
    same_cameras(one, more)
    assert one.shares is None
    assert more.shares is not None
    assert more.shares.tolist() == [1 / copied.count(view) for view in copied]
    # A copy's pose is as sure as the view's.
    size = one.covariance.view(0).diagonal().sqrt()
    error = (more.covariance.view(2) - one.covariance.view(0)) / size / size[:, None]
    assert error.abs().amax() < 1e-3
    if "loss" not in options:
        assert abs(more.pixel_sigma / one.pixel_sigma - 1) < 1e-6  # type: ignore[operator]


def test_order_and_batch_change_nothing() -> None:
    index = [3, 3, 3, 5, 5, 7, 8, 1, 0, 12]
    first = dp.calibrate(noisy(VIEWS[index], 0.2), BOARD)
    turned = dp.calibrate(noisy(VIEWS[index], 0.2)[list(range(9, -1, -1))], BOARD)
    same_cameras(first, turned, 1e-5)
    plain, copies = VIEWS[[3, 4, 5, 7, 8, 1, 0, 12, 2, 6]], VIEWS[index]
    both = dp.calibrate(dp.Views(torch.stack([plain.pixels, copies.pixels]), size=VIEWS.size), BOARD)
    for camera, views in enumerate((plain, copies)):
        alone = dp.calibrate(views, BOARD)
        torch.testing.assert_close(both.shared[camera], alone.shared, rtol=1e-7, atol=1e-7)
        size = alone.covariance.shared.diagonal().sqrt()
        assert ((both.covariance.shared[camera] - alone.covariance.shared) / size / size[:, None]).abs().amax() < 1e-5


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.5, 1.0])
def test_a_board_at_rest_counts_once(sigma: float) -> None:
    """Twenty frames each of four places: as sure as four views with their noise."""
    video = noisy(VIEWS[[i for i in (0, 3, 6, 9) for _ in range(20)]], sigma)
    found = dp.calibrate(video, BOARD, "brown4")
    single = dp.calibrate(noisy(VIEWS[[0, 3, 6, 9]], sigma, seed=1), BOARD, "brown4")
    assert found.shares is not None
    torch.testing.assert_close(found.shares, torch.full((80,), 0.05, dtype=D), rtol=1e-12, atol=0)
    ratio = found.covariance.deviations["f_x"] / single.covariance.deviations["f_x"]
    assert 0.6 < ratio < 1.6
    level = (sigma**2 + 0.13**2) ** 0.5
    assert abs(found.pixel_sigma / level - 1) < 0.15  # type: ignore[operator]


def test_a_slow_motion_counts_by_its_places() -> None:
    """A board that moves 0.4 px a frame over 300 frames: a view alike is at most 2 px away."""
    cameras = VIEWS.pixels[:3]
    drift = 0.4 * torch.arange(300, dtype=D)[:, None, None] * torch.tensor([0.8, 0.6], dtype=D)
    slow = cameras[0] * 0.8 + drift
    share = shares(POINTS, torch.cat([cameras[1:], slow])[None], torch.ones(1, 302, 54, dtype=torch.bool))
    assert share is not None
    assert share[0, :2].tolist() == [1.0, 1.0]
    places = float(share[0, 2:].sum())
    assert abs(places - 300 * 0.4 / (2 * ALIKE_PX)) < 5


@pytest.mark.parametrize("views", [13, 100, 1500])
def test_alike_is_what_the_obvious_formula_gives(views: int) -> None:
    generator = torch.Generator().manual_seed(views)
    which = torch.randint(0, 13, (views,), generator=generator)
    pixels = VIEWS.pixels[which] + 0.1 * torch.randn(views, 54, 2, generator=generator, dtype=D)
    used = torch.rand(views, 54, generator=generator) < 0.9
    found = alike(POINTS, pixels[None], used[None])[0]
    want = which == which[:, None]
    assert not bool((found & ~want).any())
    assert (~found & want).sum() <= 1e-4 * want.sum()  # many views are compared by 16 corners, of which some are hidden


def test_random_views_are_distinct() -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    truth = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 1000)
    seen = synthetic.corner_views(truth, BOARD)
    assert shares(POINTS, seen.pixels[None], seen.visible[None]) is None
    for side in ("left", "right"):
        bundled = dp.example_views(side)
        assert shares(POINTS, bundled.pixels[None], bundled.visible[None]) is None


def test_hidden_corners() -> None:
    half = torch.zeros(2, 54, dtype=torch.bool)
    half[0, 30:], half[1, :10] = True, True  # 20 of 30 and of 44 corners in common
    pixels = VIEWS.pixels[[3, 3, 5]]
    used = torch.cat([~half, torch.ones(1, 54, dtype=torch.bool)])
    found = alike(POINTS, pixels[None], used[None])[0]
    assert found.tolist() == [[True, True, False], [True, True, False], [False, False, True]]
    used[2] = False
    assert not bool(alike(POINTS, pixels[None], used[None])[0, 2, 2])
    used[0, 12:] = False  # 2 of 12: they cannot be compared
    assert not bool(alike(POINTS, pixels[None], used[None])[0, 0, 1])


def test_the_summary_names_them() -> None:
    frames = noisy(VIEWS[[3] * 20 + [5] * 3 + [8, 9, 10]], 0.1)
    summary = dp.calibrate(frames, BOARD, "brown4").summary()
    assert (
        "views 2 to 20 show the board as view 1 does; view 22, view 23 show the board as view 21 does: "
        "26 views count as 5" in summary
    )
    assert "count as" not in dp.calibrate(VIEWS, BOARD).summary()
    known = dp.calibrate(VIEWS, BOARD)
    assert "count as" not in dp.locate(frames, BOARD, known).summary()  # each pose is found by itself


def test_it_is_saved(tmp_path: Any) -> None:
    found = dp.calibrate(VIEWS[[0, 0, *range(1, 13)]], BOARD)
    dp.save_camera(tmp_path / "camera.json", found)
    again = dp.load_calibration(tmp_path / "camera.json")
    assert torch.equal(again.shares, found.shares)
    assert again.summary() == found.summary()


def test_gradients_of_the_optimum_share_too() -> None:
    """Moving all copies of a view together moves the optimum as moving the view does."""
    camera = dp.calibrate(VIEWS, BOARD).camera

    def gradient(index: list[int]) -> tuple[Tensor, ...]:
        pixels, points = VIEWS.pixels.clone().requires_grad_(), POINTS.clone().requires_grad_()

        class Target:
            def __init__(self) -> None:
                self.points = points

        found = dp.refine(dp.Views(pixels[index], size=VIEWS.size), Target(), camera, differentiable=True)
        return torch.autograd.grad(found.shared[0] + found.cameras.t[-1, 2], (pixels, points))

    for one, copied in zip(gradient(list(range(13))), gradient([0, 0, 0, *range(1, 13)]), strict=True):
        torch.testing.assert_close(copied, one, rtol=1e-5, atol=1e-6 * float(one.abs().amax()))


# --------------------------------------------------------------------------------------------------------- one view


DRIFT = torch.linspace(-1.5, 1.5, 20, dtype=D)[:, None, None] * torch.tensor([1.0, 0.3], dtype=D)


@pytest.mark.parametrize(
    "pixels",
    [
        VIEWS.pixels[[3]],
        pytest.param(VIEWS.pixels[[3] * 20], marks=pytest.mark.slow),
        noisy(VIEWS[[3] * 20], 0.3).pixels,
        noisy(VIEWS[[8] * 5], 1.0).pixels,
        pytest.param(VIEWS.pixels[[3] * 20] + DRIFT, marks=pytest.mark.slow),
        VIEWS.pixels[[12] * 20] + 2 * DRIFT,
    ],
    ids=["one", "copies", "noise", "more noise", "drift", "more drift"],
)
@pytest.mark.parametrize("options", [{}, {"fixed": ("principal_point",)}, {"tied_focal": True}], ids=str)
def test_one_view_is_refused(pixels: Tensor, options: dict[str, Any]) -> None:
    with pytest.raises(dp.CalibrationError, match="one view"):
        dp.calibrate(dp.Views(pixels, size=VIEWS.size), BOARD, **options)


@pytest.mark.slow
def test_every_bundled_view_alone_is_refused_with_a_remedy() -> None:
    for side in ("left", "right"):
        for view in dp.example_views(side):
            with pytest.raises(dp.CalibrationError, match="add views"):
                dp.calibrate(view, BOARD)


def test_a_camera_of_a_batch_with_one_view_is_refused_alone() -> None:
    every = torch.stack([VIEWS.pixels, VIEWS.pixels[[3] * 13]])
    found = dp.calibrate(dp.Views(every, size=VIEWS.size), BOARD, throw=False)
    assert found.converged.tolist() == [True, False]
    assert "the views show the board alike" in found.message


@pytest.mark.parametrize(
    "options",
    [
        {"fixed": ("principal_point", "distortion")},
        {"fixed": ("principal_point", "distortion"), "tied_focal": True},
        {"priors": {"principal_point": 1.0, "distortion": 0.01}, "weights": torch.tensor(40.0)},
    ],
    ids=["both", "tied", "priors"],
)
def test_one_view_of_a_known_camera_gives_its_focal_length(options: dict[str, Any]) -> None:
    """The unevenness of the printed board shows: measured, up to 4.6 deviations off in 26 views, RMS 1.6 to 2.1."""
    off = []
    for side in ("left", "right"):
        views = dp.example_views(side)
        known = dp.calibrate(views, BOARD)
        for view in views:
            found = dp.refine(view, BOARD, known.camera, **options)
            off.append((found.shared[0] - known.shared[0]) / found.covariance.deviations["f_x"])
    assert torch.stack(off).abs().amax() < 4.9
    assert torch.stack(off).square().mean().sqrt() < 2.3


def test_copies_leave_that_as_it_is() -> None:
    known = dp.calibrate(VIEWS, BOARD).camera
    options: dict[str, Any] = {"fixed": ("principal_point", "distortion")}
    one, many = (dp.refine(VIEWS[index], BOARD, known, **options) for index in ([3], [3] * 20))
    torch.testing.assert_close(many.covariance.deviations["f_x"], one.covariance.deviations["f_x"], rtol=1e-6, atol=0)
    assert abs(many.pixel_sigma / one.pixel_sigma - 1) < 1e-9  # type: ignore[operator]


def test_few_views_are_no_one_view() -> None:
    seen = torch.ones(1, 2, 54, dtype=torch.bool)
    assert bool(one_view(POINTS, VIEWS.pixels[None, [3, 3]], seen))
    assert not bool(one_view(POINTS, VIEWS.pixels[None, [3, 5]], seen))
    seen[0, 1] = False
    assert bool(one_view(POINTS, VIEWS.pixels[None, [3, 5]], seen))


def test_wrong_corners_and_patterns_do_not_hide_them() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = noisy(VIEWS[[i for i in (0, 3, 6, 9) for _ in range(10)]], 0.2)
    wrong = torch.rand(frames.visible.shape, generator=generator) < 0.02
    dirty = frames.pixels + wrong.unsqueeze(-1) * (20 + 40 * torch.rand(40, 54, 1, generator=generator, dtype=D))
    share = shares(POINTS, dirty[None], frames.visible[None])
    assert share is not None
    assert (share < 0.13).sum() >= 38  # but where two neighbours are wrong, as in one of them
    every_other = (torch.arange(54) % 2 == 0).expand(1, 40, 54)
    share = shares(POINTS, frames.pixels[None], every_other)
    assert share is not None
    torch.testing.assert_close(share, torch.full((1, 40), 0.1, dtype=D), rtol=1e-12, atol=0)
    corners = torch.zeros(1, 40, 54, dtype=torch.bool)
    corners[..., [0, 8, 45, 53]] = True  # a turn of a marker moves its corners in four directions
    assert bool((alike(POINTS, frames.pixels[None], corners)[0].sum(-1) == 10).all())


def test_as_many_groups_as_are_told_leave_none_to_count() -> None:
    """Pairs of views alike: those beyond the first few are counted, where there are any."""
    for pairs in range(1, SENTENCES + 3):
        same = torch.block_diag(*[torch.ones(2, 2)] * pairs).bool()
        told = described(same, tuple(f"v{number}" for number in range(2 * pairs)))
        assert told.count("the board as") == min(pairs, SENTENCES)
        beyond = pairs - SENTENCES
        words = {1: "; 1 more group of views alike", 2: "; 2 more groups of views alike"}.get(beyond, "")
        assert ("more group" in told) == (beyond > 0)
        assert words in told
        assert f"{2 * pairs} views count as {pairs}" in told
