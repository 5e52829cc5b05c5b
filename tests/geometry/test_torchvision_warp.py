"""`dp.torchvision_warp` against images that torchvision itself has moved."""

import importlib.util
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from kornia import augmentation
from torch import Tensor
from torch.utils.data import default_collate

import diffproj as dp

if importlib.util.find_spec("torchvision") is None:
    pytest.skip("needs torchvision", allow_module_level=True)
try:
    from torchvision.transforms import InterpolationMode, v2
except RuntimeError:  # built for another PyTorch: without its compiled operators, which no transform calls
    for name in ("nms", "qnms"):
        torch.library.define(f"torchvision::{name}", "(Tensor boxes, Tensor scores, float threshold) -> Tensor")
    from torchvision.transforms import InterpolationMode, v2

D = torch.float64
LINEAR = InterpolationMode.BILINEAR
SIZE = (161, 120)
EXACT: dict[str, Callable[[], Any]] = {
    "horizontal flip": lambda: v2.RandomHorizontalFlip(1.0),
    "vertical flip": lambda: v2.RandomVerticalFlip(1.0),
    "random crop": lambda: v2.RandomCrop((50, 60)),
    "random crop, padded": lambda: v2.RandomCrop((150, 190), padding=(3, 4), pad_if_needed=True),
    "centre crop": lambda: v2.CenterCrop((51, 60)),
    "centre crop, taller": lambda: v2.CenterCrop((131, 60)),
    "centre crop, larger": lambda: v2.CenterCrop((131, 200)),
    "centre crop, square": lambda: v2.CenterCrop(73),
    "pad by one": lambda: v2.Pad(7),
    "pad by two": lambda: v2.Pad((3, 4)),
    "pad by four": lambda: v2.Pad([3, 4, 5, 6], padding_mode="constant"),
    "zoom out": lambda: v2.RandomZoomOut(p=1.0),
    "affine": lambda: v2.RandomAffine(40, (0.1, 0.2), (0.7, 1.3), (-10, 10, -20, 20), interpolation=LINEAR),
    "affine about a point": lambda: v2.RandomAffine(40, None, None, 10, interpolation=LINEAR, center=(20, 30)),
    "turn": lambda: v2.RandomRotation(60, interpolation=LINEAR),
    "turn about a point": lambda: v2.RandomRotation(60, interpolation=LINEAR, center=(20, 30)),
    "turn, whole": lambda: v2.RandomRotation(60, interpolation=LINEAR, expand=True),
    "turn about a point, whole": lambda: v2.RandomRotation((33, 33), LINEAR, expand=True, center=(20, 30)),
    "quarter turn, whole": lambda: v2.RandomRotation((90, 90), expand=True),
    "half turn": lambda: v2.RandomRotation((180, 180)),
    "perspective": lambda: v2.RandomPerspective(0.4, 1.0),
    "choice": lambda: v2.RandomChoice([v2.RandomHorizontalFlip(1.0), v2.RandomRotation(20, LINEAR)]),
    "what colours alone": lambda: v2.Compose([v2.GaussianBlur(3, 0.01), v2.ToDtype(D)]),
}
RESIZED: dict[str, Callable[[], Any]] = {
    "resize": lambda: v2.Resize((60, 90), antialias=False),
    "resize the shorter side": lambda: v2.Resize(77, antialias=False),
    "resize the longer side": lambda: v2.Resize(None, max_size=110, antialias=False),
    "enlarge": lambda: v2.Resize((240, 320), antialias=False),
    "random resized crop": lambda: v2.RandomResizedCrop((64, 80), antialias=False),
    "shortest side": lambda: v2.RandomShortestSize(80, antialias=False),
    "random size": lambda: v2.RandomResize(60, 100, antialias=False),
    "jitter of scale": lambda: v2.ScaleJitter((100, 100), antialias=False),
    "pipeline": lambda: v2.Compose(
        [
            v2.RandomResizedCrop((90, 100), antialias=False),
            v2.RandomHorizontalFlip(),
            v2.RandomRotation(20, LINEAR),
            v2.RandomApply([v2.RandomPerspective(0.2, 1.0)]),
        ]
    ),
}


def where_it_is() -> Tensor:
    """An image whose first two channels are the pixels' own coordinates, and whose third is 1."""
    width, height = SIZE
    row, column = torch.meshgrid(torch.arange(height, dtype=D), torch.arange(width, dtype=D), indexing="ij")
    return torch.stack([column, row, torch.ones_like(row)])


def off(image: Tensor, warp: Tensor) -> tuple[Tensor, Tensor]:
    """By how many pixels the matrix misses where each pixel of the image came from, and where that was."""
    shown = image[2] > 1 - 1e-9
    before, after = image[:2, shown].T, shown.nonzero().flip(-1)
    moved = torch.nn.functional.pad(before, (0, 1), value=1.0) @ warp.mT
    return (moved[:, :2] / moved[:, 2:] - after).abs().amax(-1), before


@pytest.mark.parametrize("name", EXACT)
def test_pixels_land_where_torchvision_puts_them(name: str) -> None:
    image, warp = EXACT[name]()(where_it_is(), dp.torchvision_warp(SIZE, D))
    assert warp.image_size == (image.shape[-1], image.shape[-2])
    miss, _ = off(image, warp)
    assert len(miss) > 1000
    assert float(miss.max()) < 1e-9


@pytest.mark.parametrize("name", RESIZED)
def test_resized_pixels_too(name: str) -> None:
    image, warp = RESIZED[name]()(where_it_is(), dp.torchvision_warp(SIZE, D))
    assert warp.image_size == (image.shape[-1], image.shape[-2])
    miss, before = off(image, warp)
    width, height = SIZE  # at the border the samples are those of the outermost pixels
    inner = (before > 1).all(-1) & (before[:, 0] < width - 2) & (before[:, 1] < height - 2)
    if name == "pipeline":  # as inside an image
        inner &= miss < float(miss.quantile(0.9))
    assert int(inner.sum()) > 1000
    assert float(miss[inner].max()) < 1e-9


def test_a_resize_is_that_of_the_camera_and_not_kornias(lens_camera: dp.Camera) -> None:
    (warp,) = v2.Resize((240, 320))([dp.torchvision_warp((640, 480), D)])
    torch.testing.assert_close(lens_camera.warped(warp, warp.image_size).K, lens_camera.resized((320, 240)).K)
    theirs = augmentation.Resize((240, 320))
    theirs(torch.zeros(1, 1, 480, 640))
    corner = theirs.transform_matrix[0, :2, 2].to(D) - warp[:2, 2]
    torch.testing.assert_close(corner, torch.full((2,), 0.25, dtype=D), rtol=0, atol=1e-5)


def test_a_projector_follows_an_augmented_image(lens_camera: dp.Camera) -> None:
    augment = v2.Compose([v2.RandomResizedCrop((240, 320), antialias=False), v2.RandomRotation(20, LINEAR)])
    projector = dp.PlaneProjector(lens_camera, dp.Plane.z(0.0))
    pixels = torch.tensor([[300.0, 200], [330, 250]], dtype=D)
    want, _ = projector(pixels)
    samples = [augment(torch.zeros(1, 480, 640), dp.torchvision_warp((640, 480), D)) for _ in range(3)]
    images, warps = default_collate(samples)
    assert images.shape == (3, 1, 240, 320)
    assert type(warps) is Tensor
    moved = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ warps.mT
    points, valid = projector(moved[..., :2], warp=warps)
    assert valid.all()
    torch.testing.assert_close(points, want.expand(3, -1, -1), rtol=1e-9, atol=1e-9)
    assert dp.collate(samples)[1].shape == (3, 3, 3)


def test_a_chain_in_float32_is_right_to_rounding() -> None:
    transforms = [v2.RandomRotation((30, 30)), v2.Pad(1000), v2.Resize((700, 900)), v2.CenterCrop(300)]
    single, double = (dp.torchvision_warp((4000, 3000), kind) for kind in (torch.float32, D))
    for transform in transforms:
        (single,), (double,) = transform([single]), transform([double])
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double.as_subclass(Tensor), rtol=1e-6, atol=1e-3)


def test_it_is_kept_by_copies_and_pickles() -> None:
    (warp,) = v2.CenterCrop((30, 40))([dp.torchvision_warp(SIZE)])
    read = pickle.loads(pickle.dumps(warp))  # noqa: S301
    for again in (read, warp.to(D), warp.clone(), warp.detach()):
        assert again.image_size == (40, 30)
        assert torch.equal(again.to(warp.dtype), warp)
    assert "image_size=(40, 30)" in repr(warp)
    assert type(warp @ warp) is Tensor


@pytest.mark.parametrize("transform", [v2.ElasticTransform(), v2.FiveCrop(20), v2.TenCrop(20)], ids=repr)
def test_what_no_matrix_tells_is_refused(transform: Any) -> None:
    with pytest.raises(ValueError, match="torchvision_warp: want transforms that a matrix tells"):
        transform(torch.zeros(1, 40, 40), dp.torchvision_warp((40, 40)))


@pytest.mark.plain
def test_bad_input_is_refused_by_name() -> None:
    for size, dtype, kind, message in (
        (None, D, TypeError, "size: want"),
        ((0, 3), D, ValueError, "size: want"),
        ((4, 3), torch.int64, TypeError, "dtype: want"),
        ((4, 3), "float32", TypeError, "dtype: want"),
    ):
        with pytest.raises(kind, match=message):
            dp.torchvision_warp(size, dtype)  # type: ignore[arg-type]


def test_a_batch_of_one_sample() -> None:
    batch = dp.collate([{"camera": dp.Camera(torch.eye(3)), "number": 3}])
    assert batch["camera"].batch_shape == (1,)
    assert batch["number"].tolist() == [3]
