"""`detect`: where corners are found, in which order, in which kinds of photographs, and what it says if none are."""

import functools
import os
import warnings

import cv2
import numpy as np
import pytest
import torch

from diffproj.targets import detection, finders
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import BoardNotFoundError, BoardNotFoundWarning, detect
from diffproj.targets.search import Pattern

BOARD = Chessboard(columns=9, rows=6)
SIZE = (400, 300)
DARK, LIGHT = 30.0, 220.0


# ------------------------------------------------------------------------------------- photographs with known corners


@functools.lru_cache(maxsize=64)
def _rendered(columns, rows, quadrilateral, size, dark, light):
    """A photograph of a board whose first, top right, last and bottom left inner corners lie at given pixels.

    Each pixel is the mean of 4 x 4 samples; the first square is dark, the margin light. Returns the image before
    rounding, and the corners.
    """
    far = np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(far, np.array(quadrilateral, dtype=np.float32))
    width, height = size
    offsets = (np.arange(4) + 0.5) / 4 - 0.5
    u = (np.arange(width)[:, None] + offsets).ravel()
    v = (np.arange(height)[:, None] + offsets).ravel()
    pixels = np.stack([*np.meshgrid(u, v), np.ones((v.size, u.size))])
    x, y, w = np.tensordot(np.linalg.inv(H), pixels, axes=1)
    x, y = x / w, y / w
    is_dark = (np.floor(x) + np.floor(y)) % 2 == 0
    is_dark &= (x > -1) & (x < columns) & (y > -1) & (y < rows)
    image = np.where(is_dark, dark, light).reshape(height, 4, width, 4).mean(axis=(1, 3))
    grid = np.stack([*np.meshgrid(np.arange(columns), np.arange(rows)), np.ones((rows, columns))])
    u, v, w = np.tensordot(H, grid, axes=1)
    return image, np.stack([u / w, v / w], axis=-1).reshape(-1, 2)


def photograph(
    board=BOARD, quadrilateral=((70, 60), (330, 50), (340, 240), (60, 250)), size=SIZE, dark=DARK, light=LIGHT
):
    """A grey 8-bit photograph with a little blur and noise, and its true corners `(N, 2)`."""
    image, corners = _rendered(board.columns, board.rows, quadrilateral, size, dark, light)
    noise = np.random.default_rng(0).normal(0, 1.5, image.shape)
    image = np.rint(cv2.GaussianBlur(image, (0, 0), 0.7) + noise)
    return image.clip(0, 255).astype(np.uint8), corners.copy()


def turned(image, corners, quarters):
    """The photograph turned counter-clockwise by quarter turns, and where its corners come to lie."""
    for _ in range(quarters):
        corners = np.stack([corners[:, 1], image.shape[1] - 1 - corners[:, 0]], axis=1)
        image = np.rot90(image)
    return np.ascontiguousarray(image), corners


def farthest(views, corners):
    """The largest distance in px between the corners of the only view and the true ones, number by number."""
    assert len(views) == 1
    return float(np.linalg.norm(views.pixels[0].numpy() - corners, axis=1).max())


# ------------------------------------------------------------------------------------------------------ where

QUADRILATERALS = {
    "from above": ((70, 60), (330, 60), (330, 222.5), (70, 222.5)),
    "tilted about x": ((120, 60), (280, 60), (360, 250), (40, 250)),
    "tilted about y": ((60, 40), (330, 100), (330, 200), (60, 260)),
    "turned": ((240, 30), (350, 190), (200, 260), (80, 130)),
    "small": ((150, 120), (247, 130), (241, 190), (146, 182)),
}


@pytest.mark.parametrize("pose", QUADRILATERALS)
def test_corners_are_where_they_are(pose):
    """Mean error below 0.1 px, none above 0.2: integer coordinates at pixel centres, from near to far squares."""
    image, corners = photograph(quadrilateral=QUADRILATERALS[pose])
    views = detect(image, BOARD)
    assert views.dtype == torch.float64
    assert views.size == SIZE
    assert views.visible.all()
    error = np.linalg.norm(views.pixels[0].numpy() - corners, axis=1)
    assert error.mean() < 0.1
    assert error.max() < 0.2


# ------------------------------------------------------------------------------------------------------- in order


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(9, 6), (6, 9), (4, 3), (8, 5)])
def test_odd_boards_keep_every_number(size, quarters):
    """Where columns + rows is odd, a corner keeps its number however the board is turned."""
    board = Chessboard(*size)
    image, corners = turned(*photograph(board, quadrilateral=((90, 50), (330, 60), (320, 250), (80, 240))), quarters)
    assert farthest(detect(image, board), corners) < 0.3


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(8, 6), (7, 5)])
def test_even_boards_start_near_the_top_left(size, quarters):
    """Such a board looks the same upside down: of its two orders, the one that starts nearer to the top left."""
    board = Chessboard(*size)
    image, corners = turned(*photograph(board), quarters)
    if np.linalg.norm(corners[0]) > np.linalg.norm(corners[-1]):
        corners = corners[::-1]
    assert farthest(detect(image, board), corners) < 0.3


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
@pytest.mark.parametrize("columns", [3, 4, 6])
def test_square_boards(columns, quarters):
    """4 x 4: all four turns look alike, so rows run to the right and the first corner is at the top left. 3 x 3 shows
    dark squares in two opposite corners only, 6 x 6 in all four."""
    board = Chessboard(columns, columns)
    image, truth = turned(*photograph(board, quadrilateral=((100, 40), (300, 50), (290, 250), (90, 240))), quarters)
    grid = truth.reshape(columns, columns, 2)
    found = detect(image, board).pixels[0].numpy()
    turns = [np.rot90(grid, k) for k in range(4)]
    starts_dark = [True, columns % 2 == 0, True, columns % 2 == 0]
    allowed = [turn for turn, dark in zip(turns, starts_dark, strict=True) if dark]
    expected = min(allowed, key=lambda turn: np.linalg.norm(turn[0, 0])).reshape(-1, 2)
    assert np.linalg.norm(found - expected, axis=1).max() < 0.3


REORDERED = {
    "as found": lambda grid: grid,
    "from the other end": lambda grid: grid[::-1, ::-1],
    "rows mirrored": lambda grid: grid[:, ::-1],
    "columns mirrored": lambda grid: grid[::-1],
}


@pytest.mark.parametrize("order", REORDERED)
def test_whatever_the_search_returns(monkeypatch, order):
    image, corners = photograph()
    reordered = REORDERED[order](corners.reshape(6, 9, 2))
    monkeypatch.setattr(finders, "find_pattern", lambda image, board: Pattern(reordered))
    assert farthest(detect(image, BOARD), corners) < 0.2


@pytest.mark.parametrize("order", REORDERED)
@pytest.mark.parametrize("transposed", [False, True])
def test_whatever_the_search_returns_on_a_square_board(monkeypatch, order, transposed):
    board = Chessboard(4, 4)
    image, corners = photograph(board)
    grid = REORDERED[order](corners.reshape(4, 4, 2))
    reordered = np.ascontiguousarray(grid.swapaxes(0, 1) if transposed else grid)
    monkeypatch.setattr(finders, "find_pattern", lambda image, board: Pattern(reordered))
    assert farthest(detect(image, board), corners) < 0.2


@pytest.mark.parametrize("quarters", [0, 2])
def test_order_under_uneven_light(quarters):
    """Light that falls off so far that dark squares at one end are lighter than light ones at the other."""
    image, corners = photograph(dark=90.0, light=250.0)
    image = (image * np.linspace(0.25, 1.0, image.shape[1])).astype(np.uint8)
    image, corners = turned(image, corners, quarters)
    assert farthest(detect(image, BOARD), corners) < 0.5


# --------------------------------------------------------------------------------------- photographs of every kind


def coloured(image):
    """The image in BGR: a strong tint that leaves light and dark apart."""
    return np.clip(image[..., None] * np.array([0.5, 0.9, 1.0]), 0, 255).astype(np.uint8)


KINDS = {
    "(H, W, 1)": lambda image: image[..., None],
    "BGR": coloured,
    "BGRA": lambda image: np.concatenate([coloured(image), np.full((*image.shape, 1), 128, np.uint8)], axis=2),
    "16 bits": lambda image: image.astype(np.uint16) * 257,
    "16 bits, 12 used": lambda image: image.astype(np.uint16) * 16,
    "16 bits, with a sign": lambda image: image.astype(np.int16) - 300,
    "16 bits, BGRA": lambda image: np.concatenate(
        [coloured(image).astype(np.uint16) * 16, np.full((*image.shape, 1), 65535, np.uint16)], axis=2
    ),
    "float32": lambda image: image.astype(np.float32) / 255,
    "float64": lambda image: image / 255,
    "float16": lambda image: (image / 255).astype(np.float16),
    "upside down view": lambda image: np.ascontiguousarray(image[::-1])[::-1],
    "tensor (H, W)": lambda image: torch.tensor(image),
    "tensor (1, H, W)": lambda image: torch.tensor(image)[None].float() / 255,
    "tensor RGB": lambda image: torch.tensor(coloured(image)[..., ::-1].copy()).permute(2, 0, 1) / 255,
    "tensor RGB uint8": lambda image: torch.tensor(coloured(image)[..., ::-1].copy()).permute(2, 0, 1),
    "tensor RGBA": lambda image: torch.cat([torch.tensor(image).expand(3, -1, -1) / 255, torch.ones(1, *image.shape)]),
    "tensor bfloat16": lambda image: (torch.tensor(image)[None] / 255).bfloat16(),
    "tensor with gradient": lambda image: (torch.tensor(image)[None] / 255.0).requires_grad_(),
    "tensor (B, C, H, W)": lambda image: torch.tensor(image)[None, None],
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_image(kind):
    """All give the corners of the plain grey image: the very same where no grey value changed, and to what a window
    that is one pixel larger or smaller makes of it where one did."""
    image, _ = photograph()
    plain = detect(image, BOARD).pixels[0].numpy()
    views = detect(KINDS[kind](image), BOARD)
    assert views.names == ("image 1",)
    assert views.size == SIZE
    changed = any(word in kind for word in ("BGR", "RGB", "16"))
    assert farthest(views, plain) < (0.06 if changed else 2e-3)


def test_colours_are_taken_in_their_order():
    """Squares that differ in red alone: grey values of OpenCV's weights, BGR in arrays and RGB in tensors."""
    image, _ = photograph()
    red = np.full((*image.shape, 3), 90, np.uint8)
    red[..., 2] = image
    from_array = detection.grey(detection.listed(red)[0])
    assert np.abs(from_array - (0.299 * image + 0.701 * 90)).max() <= 1
    tensor = torch.tensor(red[..., ::-1].copy()).permute(2, 0, 1)
    assert np.array_equal(detection.grey(detection.listed(tensor)[0]), from_array)


def test_one_hot_pixel_does_not_blind():
    image, corners = photograph()
    raw = (image // 3).astype(np.uint16)  # all of it within half a step of 255 / 65535
    raw[3, 5] = 65535
    assert farthest(detect(raw, BOARD), corners) < 0.2


def test_sixteen_bits_are_not_thrown_away():
    """The corners come from all bits, not from the 8 that the detector sees."""
    fine = detection.grey(detection.listed((photograph()[0].astype(np.uint16) << 8) + 77)[0])
    assert fine.dtype == np.float32
    narrow = np.linspace(1000, 1100, SIZE[0] * SIZE[1]).reshape(SIZE[::-1]).astype(np.uint16)
    scaled = detection.grey(detection.listed(narrow)[0])
    assert scaled.min() == 0
    assert scaled.max() == 255
    flat = detection.grey(detection.listed(np.full((5, 5), 1000, np.uint16))[0])
    assert (flat == 0).all()


def test_images_are_not_written():
    image, _ = photograph()
    image.setflags(write=False)
    original = image.copy()
    detect([image, image[..., None]], BOARD)
    assert np.array_equal(image, original)


# --------------------------------------------------------------------------------------------------------- files


@pytest.fixture
def folder(tmp_path):
    """`b2.png`, `b10.png` and `b1.PNG`, each turned by another angle, and a file that is no photograph."""
    image, corners = photograph(quadrilateral=((90, 50), (290, 60), (280, 230), (80, 220)), size=(380, 380))
    for quarters, name in enumerate(["b1.PNG", "b2.png", "b10.png"]):
        assert cv2.imwrite(str(tmp_path / name), turned(image, corners, quarters)[0])
    (tmp_path / "notes.txt").write_text("no photograph")
    return tmp_path


ALL = ("b1.PNG", "b2.png", "b10.png")


@pytest.mark.parametrize(
    ("chosen", "names"),
    [
        (lambda folder: folder, ALL),
        (str, ALL),
        (lambda folder: folder / "b10.png", ("b10.png",)),
        (lambda folder: str(folder / "b1*"), ("b1.PNG", "b10.png")),
        (lambda folder: [folder / "b10.png", str(folder / "b2.png")], ("b10.png", "b2.png")),
        (lambda folder: (folder / name for name in ALL), ALL),
        (lambda folder: [cv2.imread(str(folder / "b2.png")), folder / "b1.PNG"], ("image 1", "b1.PNG")),
    ],
)
def test_ways_to_name_files(folder, chosen, names):
    """A folder and a pattern in natural order, a list in its own; each file is its own turn of the board."""
    views = detect(chosen(folder), BOARD)
    assert views.names == names
    assert views.size == (380, 380)
    _, corners = photograph(quadrilateral=((90, 50), (290, 60), (280, 230), (80, 220)), size=(380, 380))
    for name, view in zip(names, views, strict=True):
        quarters = {"b1.PNG": 0, "b2.png": 1, "b10.png": 2, "image 1": 1}[name]
        assert farthest(view, turned(np.zeros((380, 380)), corners, quarters)[1]) < 0.2


@pytest.mark.parametrize("suffix", ["png", "jpg", "tiff", "bmp"])
def test_files_give_what_arrays_give(tmp_path, suffix):
    image, _ = photograph()
    assert cv2.imwrite(str(tmp_path / f"board.{suffix}"), image)
    plain = detect(image, BOARD).pixels[0].numpy()
    assert farthest(detect(tmp_path, BOARD), plain) < (0.05 if suffix == "jpg" else 1e-9)


def test_files_of_16_bits_and_with_colours(tmp_path):
    image, _ = photograph()
    deep = image.astype(np.uint16) * 16
    assert cv2.imwrite(str(tmp_path / "deep.png"), deep)
    assert cv2.imwrite(str(tmp_path / "tinted.png"), KINDS["BGRA"](image))
    deep_view, tinted_view = detect(tmp_path, BOARD)
    assert farthest(deep_view, detect(deep, BOARD).pixels[0].numpy()) < 1e-9
    assert farthest(tinted_view, detect(coloured(image), BOARD).pixels[0].numpy()) < 0.06


def test_a_name_outside_ascii(tmp_path):
    path = tmp_path / "Schachbrett (größer) 棋盘.png"
    path.write_bytes(cv2.imencode(".png", photograph()[0])[1].tobytes())
    assert detect(path, BOARD).names == (path.name,)
    bracketed = tmp_path / "a[1].png"
    path.rename(bracketed)
    assert detect(str(bracketed), BOARD).names == ("a[1].png",)


def test_hidden_files_and_folders_are_no_photographs(folder):
    (folder / "._b1.PNG").write_bytes(b"what macOS keeps of b1.PNG")
    (folder / "album.png").mkdir()
    assert detect(folder, BOARD).names == ALL
    assert detect(str(folder / "*b10.*"), BOARD).names == ("b10.png",)


def with_orientation(jpeg, orientation):
    """The bytes of a JPEG file with an EXIF segment that holds nothing but an orientation."""
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01" + bytes([0, orientation, 0, 0]) + b"\0\0\0\0"
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:]


def test_pixels_are_those_of_the_sensor_whichever_way_up_the_camera_was_held(tmp_path):
    """One lens has one principal point: files that differ in their EXIF orientation alone give the same corners."""
    image, corners = photograph()
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    for orientation in (1, 3, 6):
        (tmp_path / f"{orientation}.jpg").write_bytes(with_orientation(jpeg, orientation))
    views = detect(tmp_path, BOARD)
    assert views.size == SIZE
    for view in views:
        assert farthest(view, corners) < 0.1
    upright = detect(tmp_path / "3.jpg", BOARD, orientation="upright")
    assert farthest(upright, turned(image, corners, 2)[1]) < 0.1
    assert detect(tmp_path / "6.jpg", BOARD, orientation="upright").size == SIZE[::-1]
    with pytest.raises(ValueError, match="orientation: want 'sensor' or 'upright', got 'exif'"):
        detect(tmp_path, BOARD, orientation="exif")


def test_photographs_that_were_turned_are_named_as_that():
    image, _ = photograph()
    with pytest.raises(
        ValueError, match=r"400 x 300 px in image 1 and 300 x 400 px in image 2; some were turned after"
    ):
        detect([image, np.rot90(image)], BOARD)


def test_sizes_that_differ_are_told_by_groups():
    image, _ = photograph()
    small = image[:, 1:]
    message = (
        r"one size, got 400 x 300 px in image 1, image 3, image 4 and 1 more and 399 x 300 px in image 2; .* those of "
        "400 x 300 px"
    )
    with pytest.raises(ValueError, match=message):
        detect([image, small, image, image, image], BOARD)


def test_a_video_gives_sharp_frames_that_differ(tmp_path):
    """A board that stands still, then jumps; every third frame is sharp, and some show no board."""
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    image, corners = photograph()
    for number in range(90):
        shown = np.roll(image, 20 if number >= 45 else 0, axis=1)
        shown = shown if number % 3 == 1 else cv2.GaussianBlur(shown, (0, 0), 3)
        writer.write(cv2.cvtColor(np.full_like(image, 128) if number < 6 else shown, cv2.COLOR_GRAY2BGR))
    writer.release()
    views = detect(path, BOARD)
    assert len(views) == 2
    assert all(int(name.removeprefix("walk.avi frame ")) % 3 == 1 for name in views.names)
    assert np.linalg.norm(views.pixels[0].numpy() - corners, axis=1).max() < 0.2
    assert np.linalg.norm(views.pixels[1].numpy() - corners - (20, 0), axis=1).max() < 0.2
    with pytest.warns(BoardNotFoundWarning, match="frame 0: found no board"):
        strided = detect(path, BOARD, frames=30)
    assert strided.names == ("walk.avi frame 30", "walk.avi frame 60")
    (tmp_path / "broken.mp4").write_bytes(b"text")
    with pytest.raises(ValueError, match=r"broken\.mp4: want a video"):
        detect(tmp_path / "broken.mp4", BOARD)
    with pytest.raises(ValueError, match="frames: want a whole number from 1 on, got 0"):
        detect(path, BOARD, frames=0)


# ------------------------------------------------------------------------------------------- progress and misses


def test_progress():
    image, _ = photograph()
    calls = []
    with pytest.warns(BoardNotFoundWarning):
        detect([image, np.zeros_like(image), image], BOARD, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_a_photograph_without_a_board_is_skipped_and_named(tmp_path):
    image, _ = photograph()
    empty = tmp_path / "empty.png"
    assert cv2.imwrite(str(empty), np.full_like(image, 128))
    with pytest.warns(BoardNotFoundWarning) as caught:
        views = detect([image, empty, np.zeros_like(image), image], BOARD)
    assert views.names == ("image 1", "image 4")
    assert [str(warning.message).split(": ")[0] for warning in caught] == [str(empty), "image 3"]
    assert "9 x 6 inner corners" in str(caught[0].message)
    assert {warning.category for warning in caught} == {BoardNotFoundWarning}


def test_many_photographs_without_a_board_are_named_together():
    """A camera of a rig does not see the board in most of its photographs; one that shows another board is by itself."""
    image, _ = photograph()
    other, _ = photograph(Chessboard(7, 5))
    with pytest.warns(BoardNotFoundWarning) as caught:
        views = detect([image, *[np.zeros_like(image)] * 6, other], BOARD)
    assert views.names == ("image 1",)
    assert [str(warning.message) for warning in caught] == [
        "image 2, image 3, image 4 and 3 more: found no board with 9 x 6 inner corners; photographs skipped",
        "image 8: found no board with 9 x 6 inner corners, but a pattern with 7 x 5; photograph skipped",
    ]


def test_no_board_anywhere():
    """One error that says what to check, and no warnings before it."""
    image, _ = photograph()
    with pytest.raises(
        BoardNotFoundError, match=r"10 x 7 .* image 1, image 2, image 3 and 1 more\. .* Check .* squares"
    ):
        detect([image] * 4, Chessboard(10, 7))
    assert issubclass(BoardNotFoundError, ValueError)


# --------------------------------------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (np.zeros((300, 400, 2), np.uint8), ValueError, r"image 1: want an array \(H, W\).*got shape \(300, 400, 2\)"),
        (np.zeros((3, 300, 400), np.uint8), ValueError, "image 1: want an array"),
        (np.zeros(400, np.uint8), ValueError, "image 1: want an array"),
        (np.zeros((0, 400), np.uint8), ValueError, "image 1: want an array"),
        (torch.zeros(300, 400, 3), ValueError, r"image 1: want .*got a tensor of shape \(300, 400, 3\)"),
        (torch.zeros(1, 0, 400), ValueError, "image 1: want"),
        (np.zeros((300, 400), np.int32), TypeError, "image 1: want uint8, integers of 16 bits, or floats, got int32"),
        (np.zeros((300, 400), np.int8), TypeError, "image 1: want uint8, integers of 16 bits, or floats, got int8"),
        (np.zeros((300, 400), bool), TypeError, "image 1: want uint8, integers of 16 bits"),
        (np.full((300, 400), 200.0), ValueError, "image 1: want floats from 0 to 1, got 200 to 200"),
        (np.full((300, 400), -0.1), ValueError, "image 1: want floats from 0 to 1"),
        (np.full((300, 400), np.nan), ValueError, "image 1: want floats from 0 to 1, got nan"),
    ],
)
def test_images_that_are_none(image, error, message):
    with pytest.raises(error, match=message):
        detect([image], BOARD)


@pytest.mark.parametrize("photographs", [42, [42], [[1, 2]], None])
def test_things_that_are_no_photographs(photographs):
    with pytest.raises(TypeError, match="photographs"):
        detect(photographs, BOARD)


@pytest.mark.parametrize("photographs", [[], torch.zeros(0, 1, 300, 400)])
def test_an_empty_list(photographs):
    with pytest.raises(ValueError, match="photographs: want at least one, got none"):
        detect(photographs, BOARD)


def test_an_empty_folder_and_an_empty_pattern(tmp_path):
    with pytest.raises(ValueError, match="photographs: want at least one, got none in"):
        detect(tmp_path, BOARD)
    with pytest.raises(ValueError, match=r"got none in .*left\*\.jpg"):
        detect(f"{tmp_path}/left*.jpg", BOARD)


def test_bad_files_are_named(tmp_path, monkeypatch):
    """A missing file stops the run before the first photograph is searched, a broken one when its turn comes."""
    image, _ = photograph()
    good, broken, empty = tmp_path / "good.png", tmp_path / "broken.png", tmp_path / "empty.png"
    assert cv2.imwrite(str(good), image)
    broken.write_bytes(b"this is text")
    empty.touch()
    with monkeypatch.context() as patch:
        patch.setattr(finders, "find_pattern", lambda *_: pytest.fail("searched before all files were looked for"))
        with pytest.raises(FileNotFoundError, match=r"no such file: .*missing\.jpg"):
            detect([good, tmp_path / "missing.jpg"], BOARD)
    with pytest.raises(ValueError, match=r"broken\.png: want an image, got 12 bytes that OpenCV cannot read"):
        detect([good, broken], BOARD)
    broken.with_suffix(".jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(99))  # as phones rename them
    with pytest.raises(ValueError, match=r"broken\.jpg: want an image, got a HEIC photograph, .*: convert to JPEG"):
        detect([good, broken.with_suffix(".jpg")], BOARD)
    with pytest.raises(ValueError, match=r"empty\.png: want an image, got 0 bytes"):
        detect([good, empty], BOARD)
    with pytest.raises(FileNotFoundError, match="no such file"):
        detect([good, tmp_path], BOARD)
    with pytest.raises(ValueError, match=r"one size, got 400 x 300 px in .*good\.png and 399 x 300 px in image 2"):
        detect([good, image[:, 1:]], BOARD)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may read every file")
def test_a_file_that_may_not_be_read(tmp_path):
    path = tmp_path / "locked.png"
    path.touch(mode=0o000)
    with pytest.raises(PermissionError, match="locked"):
        detect(path, BOARD)


def test_boards_that_cannot_be_searched():
    image, _ = photograph()
    with pytest.raises(ValueError, match=r"target: want at least 3 x 3 inner corners .*, got 9 x 2"):
        detect(image, Chessboard(9, 2))
    with pytest.raises(TypeError, match="board"):
        detect(image, (9, 6))
    with pytest.raises(TypeError, match="progress"):
        detect(image, BOARD, progress=True)


@pytest.mark.plain  # checks of types at run time stand between caller and function
def test_warnings_point_at_the_caller():
    image, _ = photograph()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        detect([image, np.zeros_like(image)], BOARD)
    assert [warning.filename for warning in caught] == [__file__]
