"""Synthetic photographs against their own truth: where corners fall, how bright the board is, what noise does."""

import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64


def test_setup_is_the_papers() -> None:
    setup = dp.paper_setup()
    assert len(setup.names) == 15
    assert setup.cameras.batch_shape == (15,)
    center = setup.board.points.mean(dim=0)
    distance = (setup.test.center - center).norm(dim=-1)
    torch.testing.assert_close(distance, torch.tensor([400.0, 600, 800, 500, 500], dtype=D))
    slant = (setup.test.center - center)[:, 2] / distance
    torch.testing.assert_close(slant.arccos().rad2deg(), torch.tensor([0.0, 0, 0, 45, 45], dtype=D), atol=1e-5, rtol=0)
    pixels, valid = setup.cameras.project(setup.board.outline)
    assert valid.all()
    assert ((pixels > 0) & (pixels < torch.tensor([639.0, 479], dtype=D))).all()


@pytest.mark.parametrize("distortion", [None, (-0.2, 0.05, 0.001, 0.001, 0.0)])
def test_detected_corners_are_where_they_were_rendered(distortion: tuple[float, ...] | None) -> None:
    lens = None if distortion is None else dp.BrownConrady(torch.tensor(distortion, dtype=D))
    setup = dp.paper_setup(lens)
    images = [synthetic.photograph(setup.fit[i], setup.board, seed=i).numpy() for i in (0, 1, 5)]
    views = dp.detect(images, setup.board)
    want, _ = setup.fit[[0, 1, 5]].project(setup.board.points)
    error = views.pixels - want
    assert error.norm(dim=-1).max() < 0.35
    assert error.square().mean().sqrt() < 0.1
    assert error.mean(dim=1).abs().max() < 0.05  # half a pixel of wrong convention would show here


def test_brightness_and_noise() -> None:
    setup = dp.paper_setup()
    camera = setup.test[0]
    clean = synthetic.photograph(camera, setup.board, noise=0.0, blur_px=0.0, vignetting=0.0)
    assert clean.dtype == torch.uint8
    assert clean.shape == (480, 640)
    assert clean[0, 0].item() == round(synthetic.TABLE * 255)
    inside = torch.tensor(
        [[12.5, 12.5, 0], [12.5, 37.5, 0], [-37.5, 50, 0]], dtype=D
    )  # square (0, 0), the next, margin
    u, v = camera.project(inside)[0].round().long().unbind(-1)
    assert clean[v, u].tolist() == [round(g * 255) for g in (synthetic.BLACK, synthetic.WHITE, synthetic.WHITE)]
    noisy = synthetic.photograph(camera, setup.board, noise=0.02, blur_px=0.0, vignetting=0.0, seed=1)
    assert torch.equal(
        noisy, synthetic.photograph(camera, setup.board, noise=0.02, blur_px=0.0, vignetting=0.0, seed=1)
    )
    table = noisy[:10].double() / 255
    assert table.std().item() == pytest.approx(0.02, rel=0.05)
    blurred = synthetic.photograph(camera, setup.board, noise=0.0, vignetting=0.0)
    assert blurred.int().diff().abs().max() < 0.7 * clean.int().diff().abs().max()


def test_the_corners_of_the_image_are_darker() -> None:
    setup = dp.paper_setup()
    even, shaded = (synthetic.photograph(setup.test[0], setup.board, noise=0.0, vignetting=v) for v in (0.0, 1.0))
    offset = torch.tensor([[0.0, 0]], dtype=D) - setup.test.K[0, :2, 2]
    angle = (offset / 701).norm().atan()
    assert shaded[0, 0] / 255 == pytest.approx(synthetic.TABLE * float(angle.cos() ** 4), abs=0.004)
    assert shaded[238, 322] == even[238, 322]


@pytest.mark.parametrize("axes", ["opencv", "paper"])
def test_a_texture_shows_the_board_in_its_frame(axes: str) -> None:
    board = dp.Chessboard(columns=4, rows=3, square=10.0, axes=axes)
    image, extent, (origin, s, t) = synthetic.board_texture(board, texels=4)
    assert (origin == 0).all()
    texel = (extent[2] - extent[0]) / image.shape[2]
    assert texel == (extent[3] - extent[1]) / image.shape[1] == 2.5
    for k, corner in enumerate(board.points.to(s)):  # four squares meet there, two of them black
        column, row = (round(float(corner @ axis) / texel + 12) for axis in (s, t))
        around = image[0, row - 1 : row + 1, column - 1 : column + 1]
        even, odd = (synthetic.BLACK, synthetic.WHITE)[:: 1 if (k // 4 + k % 4) % 2 == 0 else -1]
        torch.testing.assert_close(around, torch.tensor([[even, odd], [odd, even]]))


def test_batches_of_photographs() -> None:
    setup = dp.paper_setup()
    small = setup.test[:2].resized((64, 48))
    images = synthetic.photograph(small, setup.board, noise=0.0)
    assert images.shape == (2, 48, 64)
    assert torch.equal(images[1], synthetic.photograph(small[1], setup.board, noise=0.0))


def test_corner_views_hide_what_the_image_does_not_show() -> None:
    setup = dp.paper_setup()
    narrow = setup.test.cropped(0.0, 0.0, 320, 480)
    views = synthetic.corner_views(narrow, setup.board, noise_px=0.0)
    assert torch.equal(views.visible, (setup.test.project(setup.board.points)[0][..., 0] <= 319.5))
    assert 0 < views.visible.double().mean() < 1
    noisy = synthetic.corner_views(setup.fit, setup.board, noise_px=0.3)
    error = noisy.pixels - setup.fit.project(setup.board.points)[0]
    assert error.std().item() == pytest.approx(0.3, rel=0.1)


def test_errors() -> None:
    setup = dp.paper_setup()
    camera = dp.Camera(setup.fit.K[0])
    with pytest.raises(ValueError, match="camera: want a size"):
        synthetic.photograph(camera, setup.board)
    with pytest.raises(ValueError, match="vignetting: want a number from 0 to 1, got 2.0"):
        synthetic.photograph(setup.fit[0], setup.board, vignetting=2.0)
    with pytest.raises(ValueError, match="texels: want at least 1"):
        synthetic.board_texture(setup.board, 0)
    with pytest.raises(ValueError, match="batch of views"):
        synthetic.corner_views(camera, setup.board)


def test_blur_of_next_to_nothing() -> None:
    """So little that its square is 0."""
    setup = dp.paper_setup()
    sharp, same = (synthetic.photograph(setup.fit[0], setup.board, blur_px=blur) for blur in (0.0, 5e-324))
    assert torch.equal(sharp, same)


@pytest.mark.parametrize("blur_px", [12.0, 50.0])
def test_blur_wider_than_the_image(blur_px: float) -> None:
    setup = dp.paper_setup()
    small = setup.test[0].resized((64, 48))
    image = synthetic.photograph(small, setup.board, blur_px=blur_px, noise=0.0, vignetting=0.0)
    assert image.shape == (48, 64)
    assert int(image.max()) - int(image.min()) < 160


def test_a_board_shows_its_face_where_a_lens_sees_behind_itself() -> None:
    """Off the axis by 100 degrees and more a board that is turned like the camera would show its back."""
    lens = dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=torch.float64))
    K = torch.tensor([[300.0, 0.0, 640.0], [0.0, 300.0, 480.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    wide = dp.Camera(K, distortion=lens, size=(1280, 960))
    for board in (dp.Chessboard(), dp.Chessboard(axes="paper"), dp.CharucoBoard(8, 6, 25.0, 18.0, "5X5_100")):
        cameras = dp.synthetic.random_cameras(wide, board, 40, seed=3)
        middle = cameras.R @ board.points.mean(0) + cameras.t
        into = 1.0 if not isinstance(board, dp.Chessboard) or board.axes != "paper" else -1.0
        assert bool(((into * cameras.R[..., 2] * middle).sum(-1) > 0).all())
        assert bool((middle[:, 2] < 0).any())  # some of them behind the camera
