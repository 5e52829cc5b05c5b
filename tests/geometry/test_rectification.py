"""Metric top views and rendered textures."""

import os

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

import diffproj as dp
from diffproj import synthetic

D = torch.float64
PHOTOS = os.environ.get("DIFFPROJ_PHOTOS")
EXTENT = (-20.0, -20.0, 220.0, 140.0)


def smooth(rows: int, columns: int, channels: int = 1) -> torch.Tensor:
    """A texture without anything finer than ten pixels."""
    coarse = torch.rand(1, channels, rows // 10, columns // 10, dtype=D)
    return interpolate(coarse, size=(rows, columns), mode="bicubic")[0]


def above(lens: dp.Lens | None = None) -> dp.Camera:
    """A camera that sees the whole extent at a slant."""
    K = torch.tensor([[700.0, 0, 319.5], [0, 700, 239.5], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([0.3, -0.2, 0.1], dtype=D))
    return dp.Camera(K, R, torch.tensor([-100.0, -60, 450], dtype=D), lens, (640, 480))


def test_a_texture_comes_back(lens: dp.BrownConrady) -> None:
    texture = smooth(200, 300, channels=3)
    for camera in (above(), above(lens)):
        image, shown = dp.render(texture, camera, dp.Plane.z(0.0), EXTENT)
        assert image.shape == (3, 480, 640)
        assert 0.2 < shown.double().mean() < 0.9
        back, valid = dp.rectify(image, camera, dp.Plane.z(0.0), EXTENT, 0.8)
        assert back.shape == texture.shape
        inner = torch.zeros_like(valid)
        inner[5:-5, 5:-5] = True  # the rim mixes with what is not texture
        assert valid[inner].all()
        assert (back - texture)[:, inner].abs().mean() < 0.01


def test_places_are_the_projections(lens: dp.BrownConrady) -> None:
    camera = above(lens)
    row, column = torch.meshgrid(torch.arange(480, dtype=D), torch.arange(640, dtype=D), indexing="ij")
    image = torch.stack([column, row])  # an image that shows where it is
    top, valid = dp.rectify(image, camera, dp.Plane.z(0.0), EXTENT, 2.0)
    s, t = torch.meshgrid(torch.arange(-19, 220, 2, dtype=D), torch.arange(-19, 140, 2, dtype=D), indexing="xy")
    pixels, seen = camera.project(torch.stack([s, t, 0 * s], dim=-1).reshape(-1, 3))
    inside = seen & ((pixels >= 1) & (pixels <= torch.tensor([638.0, 478]))).all(-1)
    want = pixels.T.reshape(2, *top.shape[1:])
    # A pixel is the mean of samples about its middle: the same up to the lens's and the perspective's second order.
    assert (top - want)[:, inside.reshape(top.shape[1:])].abs().max() < 0.02
    assert torch.equal(valid, valid & seen.reshape(valid.shape))


def test_coarse_views_do_not_alias() -> None:
    stripes = (torch.arange(640, dtype=D) % 2).expand(1, 480, 640)  # every other column is white
    K = torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, t=torch.tensor([0.0, 0, 500], dtype=D), size=(640, 480))
    top, valid = dp.rectify(stripes, camera, dp.Plane.z(0.0), (-300, -200, 300, 200), 4.0)
    assert valid.all()
    assert (top - 0.5).abs().max() < 0.15


def facing(width: int, height: int) -> dp.Camera:
    """A camera straight above the plane's origin, in the middle of whose image a pixel covers a world unit."""
    K = torch.tensor([[500.0, 0, (width - 1) / 2], [0, 500, (height - 1) / 2], [0, 0, 1]], dtype=D)
    return dp.Camera(K, t=torch.tensor([0.0, 0, 500], dtype=D), size=(width, height))


@pytest.mark.parametrize("side", [2, 3, 5, 8, 10, 13, 20, 33, 40, 64, 80, 100])
def test_a_pixel_of_a_coarse_view_is_the_mean_of_what_it_covers(side: int) -> None:
    """Whole pixels of noise and of stripes of every period from 2 to 10: their mean, exactly."""
    columns = 600 // side
    period = torch.arange(2, 11)[:, None]
    stripes = (torch.arange(side * columns) % period < period / 2).to(D)[:, None].expand(-1, 2 * side, -1)
    image = torch.cat([stripes, torch.rand(1, 2 * side, side * columns, dtype=D)])
    half = side * columns / 2
    camera = facing(side * columns, 2 * side)
    top, valid = dp.rectify(image, camera, dp.Plane.z(0.0), (-half, -side, half, side), side)
    assert valid.all()
    want = torch.nn.functional.avg_pool2d(image, side)
    assert top.shape == want.shape
    assert (top - want).abs().max() < 1e-9


@pytest.mark.parametrize(("side", "share"), [(1.5, 0.18), (2.5, 0.1), (7.9, 0.02), (20.5, 0.005), (70.6, 0.005)])
def test_a_pixel_of_a_coarse_view_that_cuts_pixels(side: float, share: float) -> None:
    """Off the mean of white noise under each pixel by at most that share of its spread; as measured, and a bit more."""
    count = int(700 // side)
    image, half = torch.rand(1, 800, 800, dtype=D), side * count / 2
    top, _ = dp.rectify(image, facing(800, 800), dp.Plane.z(0.0), (-half, -half, half, half), side)
    edges = 400 - half + side * torch.arange(count + 1, dtype=D)
    pixel = torch.arange(800)
    cover = torch.minimum(edges[1:, None], pixel + 1.0) - torch.maximum(edges[:-1, None], pixel + 0.0)
    cover = cover.clamp(min=0) / side
    want = cover @ image[0] @ cover.T
    assert (top[0] - want).square().mean().sqrt() < share * want.std()


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_views_of_a_single_row_or_column_do_not_alias(shape: tuple[int, int]) -> None:
    rows, columns = shape
    image = torch.rand(1, 40 * rows, 40 * columns, dtype=D)
    extent = (-20 * columns, -20 * rows, 20 * columns, 20 * rows)
    top, valid = dp.rectify(image, facing(40 * columns, 40 * rows), dp.Plane.z(0.0), extent, 40.0)
    assert valid.all()
    assert (top - torch.nn.functional.avg_pool2d(image, 40)).abs().max() < 1e-9


def test_footprints_are_measured_along_each_side() -> None:
    """Pixels 40 px wide and 1 px high take the mean over their width only."""
    image = torch.rand(1, 60, 400, dtype=D)
    flat = torch.tensor([[500.0, 0, 199.5], [0, 500 / 40, 29.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(flat, t=torch.tensor([0.0, 0, 500], dtype=D), size=(400, 60))
    top, _ = dp.rectify(image, camera, dp.Plane.z(0.0), (-200, -1200, 200, 1200), 40.0)
    want = torch.nn.functional.avg_pool2d(image, (1, 40))
    assert (top - want).abs().max() < 1e-9


@pytest.mark.parametrize("resolution", [20.0, 7.0, 3.3, 300.0])
def test_the_way_back_at_an_extent_that_is_no_multiple_of_the_resolution(resolution: float) -> None:
    """Both fill the extent: where the top view says that a place is, `render` puts it."""
    extent = (-101.0, -58.0, 108.0, 63.0)
    column = torch.arange(640, dtype=D).expand(1, 480, 640)
    row = torch.arange(480, dtype=D)[:, None].expand(1, 480, 640)
    camera = facing(640, 480)
    s, t = column - 319.5, row - 239.5  # the image shows where it is
    top, valid = dp.rectify(torch.cat([s, t]), camera, dp.Plane.z(0.0), extent, resolution)
    assert valid.all()
    rows, columns = top.shape[-2:]
    assert (rows, columns) == (max(1, round(121 / resolution)), max(1, round(209 / resolution)))
    want_s = -101 + (torch.arange(columns, dtype=D) + 0.5) * 209 / columns
    want_t = -58 + (torch.arange(rows, dtype=D) + 0.5) * 121 / rows
    assert (top[0] - want_s).abs().max() < 0.03 * resolution
    assert (top[1] - want_t[:, None]).abs().max() < 0.03 * resolution
    if rows > 1:
        back, shown = dp.render(top, camera, dp.Plane.z(0.0), extent)
        inner = (s[0] > want_s[0]) & (s[0] < want_s[-1]) & (t[0] > want_t[0]) & (t[0] < want_t[-1])
        assert shown[inner].all()
        assert (back - torch.cat([s, t]))[:, inner].abs().max() < 0.06 * resolution


def test_outside_of_the_image_is_not_valid() -> None:
    image = torch.ones(1, 480, 640, dtype=D)
    top, valid = dp.rectify(image, above(), dp.Plane.z(0.0), (-3000, -3000, 3000, 3000), 20.0)
    assert valid.any()
    assert not valid[0, 0]
    assert (top[:, ~valid] == 0).all()
    assert (top[:, valid] > 0.4).all()


def test_axes_of_an_oblique_plane() -> None:
    plane = dp.Plane(
        torch.tensor([[0.3, -0.2, 2.0], [5.0, 0.1, 0.3], [0.1, 0.2, -1.0]], dtype=D),
        torch.tensor([3.0, 7, -2], dtype=D),
    )
    origin, s, t = dp.plane_axes(plane)
    torch.testing.assert_close((plane.normal * origin).sum(-1), plane.offset)
    n = plane.normal / plane.normal.norm(dim=-1, keepdim=True)
    for axis in (s, t):
        torch.testing.assert_close((axis * n).sum(-1), torch.zeros(3, dtype=D), rtol=0, atol=1e-14)
        torch.testing.assert_close(axis.norm(dim=-1), torch.ones(3, dtype=D))
    assert (torch.linalg.cross(s, t)[:, 2] > 0).all()
    texture = smooth(60, 80)
    slanted = dp.Plane(torch.tensor([0.2, -0.1, 1.0], dtype=D), torch.tensor(5.0, dtype=D))
    image, _ = dp.render(texture, above(), slanted, (20, 10, 180, 130))
    back, valid = dp.rectify(image, above(), slanted, (20, 10, 180, 130), 2.0)
    assert (back - texture)[:, 3:-3, 3:-3].abs().mean() < 0.02
    assert valid[3:-3, 3:-3].all()


def test_gradients_to_image_and_camera(lens: dp.BrownConrady) -> None:
    texture = smooth(40, 60)
    small = above(lens).resized((64, 48))

    def view(texture: torch.Tensor, K: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        image, _ = dp.render(texture, dp.Camera(K, small.R, t, lens, small.size), dp.Plane.z(0.0), EXTENT)
        return image[:, 10:38:5, 15:50:5]

    arguments = [part.clone().requires_grad_() for part in (texture, small.K, small.t)]
    image = view(*arguments)
    weights = torch.rand_like(image)
    gradients = torch.autograd.grad((image * weights).sum(), arguments)
    for i, step in enumerate((1e-4, 1e-5, 1e-5)):
        direction = torch.rand_like(arguments[i])
        if i == 1:
            direction = direction * torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=D)
        sides = []
        for sign in (1, -1):
            moved = [argument.detach() for argument in arguments]
            moved[i] = moved[i] + sign * step * direction
            sides.append((view(*moved) * weights).sum())
        finite = (sides[0] - sides[1]) / (2 * step)
        torch.testing.assert_close((gradients[i] * direction).sum(), finite, rtol=1e-4, atol=1e-6)


def test_a_plane_and_axes_for_each_image() -> None:
    heights, places = torch.tensor([0.0, 40.0], dtype=D), torch.tensor([[30.0, 20, 0], [90, 60, 40]], dtype=D)
    x, y = torch.eye(3, dtype=D)[:2].expand(2, 2, 3).unbind(1)
    extent = (-40.0, -30.0, 40.0, 30.0)
    texture = smooth(30, 40)
    images, shown = dp.render(texture, above(), dp.Plane.z(heights), extent, axes=(places, x, y))
    tops, _ = dp.rectify(images, above(), dp.Plane.z(heights), extent, 2.0, axes=(places, x, y))
    assert images.shape == (2, 1, 480, 640)
    for i in range(2):
        axes = places[i], x[i], y[i]
        image, seen = dp.render(texture, above(), dp.Plane.z(float(heights[i])), extent, axes=axes)
        torch.testing.assert_close(images[i], image)
        assert torch.equal(shown[i], seen)
        torch.testing.assert_close(tops[i, :, 2:-2, 2:-2], texture[:, 2:-2, 2:-2], rtol=0, atol=0.1)
    for shared in ((places, x[0], y), (places, x[0], y[0]), (places, x, y[0])):  # what is the same is given once
        some, _ = dp.render(texture, above(), dp.Plane.z(heights), extent, axes=shared)
        assert torch.equal(some, images)


def test_batches_and_kornia_cameras() -> None:
    images = torch.rand(2, 3, 480, 640)
    cameras = dp.Camera(above().K, above().R, torch.stack([above().t, above().t + 20]), size=(640, 480)).to(
        torch.float32
    )
    top, valid = dp.rectify(images, cameras, dp.Plane.z(0.0), EXTENT, 4.0)
    assert top.shape == (2, 3, 40, 60)
    for i in range(2):
        single, seen = dp.rectify(images[i], cameras[i], dp.Plane.z(0.0), EXTENT, 4.0)
        torch.testing.assert_close(single, top[i])
        assert torch.equal(seen, valid[i])
    pinhole, _ = dp.rectify(images, cameras.to_kornia(), dp.Plane.z(0.0), EXTENT, 4.0)
    torch.testing.assert_close(pinhole, top)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu(lens: dp.BrownConrady) -> None:
    texture, camera = smooth(60, 80), above(lens)
    image, shown = dp.render(texture, camera, dp.Plane.z(0.0), EXTENT)
    top, valid = dp.rectify(image, camera, dp.Plane.z(0.0), EXTENT, 4.0)
    image_there, shown_there = dp.render(texture.cuda(), camera.to("cuda"), dp.Plane.z(0.0), EXTENT)
    top_there, valid_there = dp.rectify(image_there, camera.to("cuda"), dp.Plane.z(0.0), EXTENT, 4.0)
    torch.testing.assert_close(image_there.cpu(), image)
    torch.testing.assert_close(top_there.cpu(), top)
    assert torch.equal(shown_there.cpu(), shown)
    assert torch.equal(valid_there.cpu(), valid)


def squares(top: torch.Tensor, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Sides of the board's squares and cosines of their angles, detected in a top view."""
    grey = (top[0] * 255).to(torch.uint8).numpy()
    found, corners = cv2.findChessboardCorners(grey, (9, 6))
    assert found
    half = round(0.3 * 25 / resolution / 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    corners = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop).reshape(6, 9, 2) * resolution
    along, down = np.diff(corners, axis=1), np.diff(corners, axis=0)
    sides = np.concatenate([np.linalg.norm(along, axis=-1).ravel(), np.linalg.norm(down, axis=-1).ravel()])
    a, d = along[:-1], down[:, :-1]
    return sides, (a * d).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(d, axis=-1)


@pytest.mark.skipif(PHOTOS is None, reason="DIFFPROJ_PHOTOS names no folder with the photographs")
def test_squares_of_a_photograph_are_square() -> None:
    views, board = dp.example_views("left"), dp.Chessboard()
    calibration = dp.calibrate(views, board)
    sides, cosines = [], []
    for i in (2, 3, 5, 7, 11):
        grey = cv2.imread(f"{PHOTOS}/{views.names[i]}", cv2.IMREAD_GRAYSCALE)
        image = torch.from_numpy(grey)[None].float() / 255
        camera = calibration.cameras[i].to(torch.float32)
        top, _ = dp.rectify(image, camera, dp.Plane.z(0.0), (-40, -40, 240, 165), 0.25)
        side, cosine = squares(top, 0.25)
        sides.append(side)
        cosines.append(cosine.ravel())
    assert abs(np.concatenate(sides).mean() - 25) < 0.02
    assert np.concatenate(sides).std() < 0.15
    assert np.abs(np.concatenate(cosines).mean()) < 1e-3


def test_squares_of_a_rendered_photograph_are_square() -> None:
    setup = dp.paper_setup()
    image = synthetic.photograph(setup.test[3], setup.board)[None].float() / 255
    # The paper's x runs down the board: its axes are given, so that the top view is upright.
    z = torch.zeros(3)
    axes = z, torch.tensor([0.0, 1, 0]), torch.tensor([1.0, 0, 0])
    camera = setup.test[3].to(torch.float32)
    top, _ = dp.rectify(image, camera, dp.Plane.z(0.0), (-50, -50, 250, 175), 0.5, axes)
    side, cosine = squares(top, 0.5)
    assert abs(side.mean() - 25) < 0.02
    assert side.std() < 0.15
    assert np.abs(cosine).max() < 0.02


@pytest.mark.plain
def test_bad_input_is_refused_by_name() -> None:
    image, z = torch.rand(1, 48, 64, dtype=D), dp.Plane.z(0.0)
    bare = dp.Camera(above().K, above().R, above().t)
    cases = [
        (TypeError, "image: want a floating-point tensor", lambda: dp.rectify(image.int(), above(), z, EXTENT, 1.0)),
        *(
            (ValueError, "extent: want finite", lambda extent=extent: dp.rectify(image, above(), z, extent, 1.0))
            for extent in ((0, 0, 0, 1), (0, 0, 1), (0, 0, 1, float("inf")), (0, 0, float("nan"), 1))
        ),
        (ValueError, "extent: want finite", lambda: dp.render(image, above(), z, (0, 0, 1))),
        (ValueError, "resolution: want", lambda: dp.rectify(image, above(), z, EXTENT, float("nan"))),
        (ValueError, "texture: want shape", lambda: dp.render(image[0], above(), z, EXTENT)),
        (
            ValueError,
            r"batch shapes do not broadcast: image \(3,\), camera \(2,\), plane \(\)",
            lambda: dp.rectify(image.expand(3, 1, 48, 64), above().expand(2), z, EXTENT, 1.0),
        ),
        (ValueError, "resolution: want", lambda: dp.rectify(image, above(), z, EXTENT, 0.0)),
        (ValueError, "size: want", lambda: dp.render(image, bare, z, EXTENT)),
        (TypeError, "camera: want dp.Camera", lambda: dp.render(image, None, z, EXTENT)),
    ]
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def _pair() -> tuple[torch.Tensor, dp.Camera]:
    """Two images, one from 300 and one from 1000 above the plane."""
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    R = dp.rotation_from_euler(*torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64))
    t = torch.tensor([[0.0, 0, 300], [0, 0, 1000]], dtype=torch.float64)
    image = torch.rand(2, 1, 480, 640, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return image, dp.Camera(K, R, t, size=(640, 480))


def test_an_image_does_not_depend_on_its_batch_mates() -> None:
    image, cameras = _pair()
    extent = (-150, -150, 150, 150)
    both, seen = dp.rectify(image, cameras, dp.Plane.z(0.0), extent, 4.0)
    texture = torch.rand(2, 1, 600, 600, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rendered, shown = dp.render(texture, cameras, dp.Plane.z(0.0), extent)
    for b in range(2):
        alone, valid = dp.rectify(image[b], cameras[b], dp.Plane.z(0.0), extent, 4.0)
        torch.testing.assert_close(both[b], alone, rtol=0, atol=1e-12)
        assert torch.equal(seen[b], valid)
        alone, valid = dp.render(texture[b], cameras[b], dp.Plane.z(0.0), extent)
        torch.testing.assert_close(rendered[b], alone, rtol=0, atol=1e-12)
        assert torch.equal(shown[b], valid)
    one_image, _ = dp.rectify(image[0], cameras, dp.Plane.z(0.0), extent, 4.0)  # seen by both
    torch.testing.assert_close(one_image[0], both[0], rtol=0, atol=1e-12)
    many = image.expand(3, 2, 1, 480, 640)
    torch.testing.assert_close(dp.rectify(many, cameras, dp.Plane.z(0.0), extent, 4.0)[0][1], both, rtol=0, atol=1e-12)


def test_a_view_changes_without_a_jump_as_the_camera_moves() -> None:
    image, cameras = _pair()
    extent, steps = (-60.0, -50.0, 60.0, 50.0), 300
    heights = torch.linspace(420, 560, steps, dtype=torch.float64)  # the footprint passes from 3 to 2 pixels
    t = torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], dim=-1)
    views, valid = dp.rectify(image[0], cameras[0].at(cameras.R[0], t), dp.Plane.z(0.0), extent, 2.5)
    assert valid.all()
    change = views.diff(dim=0).abs().mean((-1, -2, -3))
    assert float(change.max()) < 3 * float(change.median())  # 30 times with numbers of samples that jump


def test_slopes_where_two_numbers_of_samples_meet() -> None:
    """The gradient by the camera agrees with finite differences there, the weights of both results included."""
    image, cameras = _pair()
    smooth = torch.nn.functional.avg_pool2d(image[:1], 9, 1, 4)[0]

    def value(height: torch.Tensor) -> torch.Tensor:
        t = torch.stack([torch.zeros_like(height), torch.zeros_like(height), height])
        view, _ = dp.rectify(smooth, cameras[0].at(cameras.R[0], t), dp.Plane.z(0.0), (-60, -50, 60, 50), 2.5)
        return (view * torch.linspace(0, 1, view.shape[-1], dtype=view.dtype)).sum()

    for z in (425.0, 445.0, 500.0, 555.0):
        height = torch.tensor(z, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(value(height), height)
        step = 1e-4
        difference = (value(height.detach() + step) - value(height.detach() - step)) / (2 * step)
        torch.testing.assert_close(slope, difference, rtol=2e-2, atol=1e-3)


def test_samples_that_are_said() -> None:
    image, cameras = _pair()
    extent = (-150, -150, 150, 150)
    top, valid = dp.rectify(image, cameras, dp.Plane.z(0.0), extent, 4.0, samples=1)
    s = -148 + 4 * torch.arange(75, dtype=torch.float64)
    cells = torch.stack([*torch.meshgrid(s, s, indexing="xy"), torch.zeros(75, 75, dtype=torch.float64)], dim=-1)
    pixels, _ = cameras.project(cells.reshape(1, -1, 3).expand(2, -1, -1))
    grid = (pixels * 2 / torch.tensor([639.0, 479], dtype=torch.float64) - 1).reshape(2, 75, 75, 2)
    want = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=True)
    torch.testing.assert_close(
        torch.where(valid.unsqueeze(1), top - want, 0.0), torch.zeros_like(top), rtol=0, atol=1e-12
    )
    assert valid.float().mean() > 0.5
    two = dp.rectify(image, cameras, dp.Plane.z(0.0), extent, 4.0, samples=(2, 1))[0]
    assert not torch.equal(two, top)
    for wrong in (0, 129, (1, 0)):
        with pytest.raises(ValueError, match="samples: want a number of samples from 1 to 128"):
            dp.rectify(image, cameras, dp.Plane.z(0.0), extent, 4.0, samples=wrong)


def test_an_image_of_another_size_than_the_camera_is_refused() -> None:
    image, cameras = _pair()
    features = torch.nn.functional.avg_pool2d(image, 8)
    extent = (-100, -100, 100, 100)
    with pytest.raises(ValueError, match=r"image: want 640 x 480 px as the camera has, got 80 x 60; camera.resized"):
        dp.rectify(features, cameras, dp.Plane.z(0.0), extent, 4.0)
    top, valid = dp.rectify(features, cameras.resized((80, 60)), dp.Plane.z(0.0), extent, 20.0)
    full, too = dp.rectify(image, cameras, dp.Plane.z(0.0), extent, 20.0)
    both = valid & too
    assert both.float().mean() > 0.5
    assert float((top - full).abs()[both.unsqueeze(1)].mean()) < 0.02


def two_extents() -> tuple[torch.Tensor, torch.Tensor, dp.Camera]:
    """Images of a camera at two poses, and extents of different sizes."""
    camera = dp.stack([above(), above().shifted(torch.tensor([15.0, -10, 0], dtype=D))])
    extents = torch.tensor([[-20.0, -20, 220, 140], [10, 5, 90, 65]], dtype=D)
    return torch.stack([smooth(480, 640), smooth(480, 640)]), extents, camera


@pytest.mark.parametrize("north_up", [False, True])
def test_extents_of_different_sizes_fill_a_size_that_is_said(north_up: bool) -> None:
    images, extents, camera = two_extents()
    top, valid = dp.rectify(images, camera, dp.Plane.z(0.0), extents, size=(60, 40), north_up=north_up)
    assert top.shape == (2, 1, 40, 60)
    for i, extent in enumerate(extents.tolist()):
        want, seen = dp.rectify(images[i], camera[i], dp.Plane.z(0.0), extent, size=(60, 40), north_up=north_up)
        torch.testing.assert_close(top[i], want, rtol=0, atol=1e-9)
        assert torch.equal(valid[i], seen)
        again, _ = dp.rectify(images[i], camera[i], dp.Plane.z(0.0), extent, (4.0, 80 / 60)[i], north_up=north_up)
        if i == 0:  # 240 x 160 at 4: the same pixels
            torch.testing.assert_close(again, want, rtol=0, atol=1e-9)
    back, shown = dp.render(top, camera, dp.Plane.z(0.0), extents, north_up=north_up)
    for i, extent in enumerate(extents.tolist()):
        want, seen = dp.render(top[i], camera[i], dp.Plane.z(0.0), extent, north_up=north_up)
        torch.testing.assert_close(back[i], want, rtol=0, atol=1e-9)
        assert torch.equal(shown[i], seen)


@pytest.mark.plain
def test_a_resolution_or_a_size() -> None:
    images, extents, camera = two_extents()
    for given, message in (
        ({}, "resolution: want it, or the size .* got neither"),
        ({"resolution": 2.0, "size": (60, 40)}, "got both"),
        ({"resolution": 2.0}, "extent: want extents of one size, .* with size="),
        ({"size": (0, 40)}, "size: want a positive"),
        ({"size": (10**6, 10**6)}, "size: want one that fits into memory"),
    ):
        with pytest.raises(ValueError, match=message):
            dp.rectify(images, camera, dp.Plane.z(0.0), extents, **given)
    with pytest.raises(ValueError, match="extent: want finite"):
        dp.rectify(images, camera, dp.Plane.z(0.0), extents.flip(-1), size=(60, 40))
