"""Warped images: `Camera.warped` and `PlaneProjector(pixels, warp)` with the matrices of Kornia's augmentations."""

import pytest
import torch
from kornia import augmentation
from kornia.geometry.transform import get_perspective_transform

import diffproj as dp

D = torch.float64
AFFINE = {
    "flip": (lambda: augmentation.RandomHorizontalFlip(p=1.0), None),
    "turn": (lambda: augmentation.RandomRotation(40.0, p=1.0), None),
    "affine": (lambda: augmentation.RandomAffine(30.0, (0.1, 0.1), (0.8, 1.2), 10.0, p=1.0), None),
    "not always": (lambda: augmentation.RandomAffine(30.0, (0.1, 0.1), p=0.5), None),
    "crop": (lambda: augmentation.RandomResizedCrop((120, 200), p=1.0), (200, 120)),
    "resize": (lambda: augmentation.Resize((300, 500)), (500, 300)),
    "several": (
        lambda: augmentation.AugmentationSequential(
            augmentation.RandomVerticalFlip(p=1.0), augmentation.RandomRotation(20.0, p=1.0)
        ),
        None,
    ),
}


def where_it_is(count: int) -> torch.Tensor:
    """Images whose first two channels are the pixels' own coordinates and whose third is 1."""
    row, column = torch.meshgrid(torch.arange(480, dtype=D), torch.arange(640, dtype=D), indexing="ij")
    return torch.stack([column, row, torch.ones_like(row)]).expand(count, 3, 480, 640)


def corners(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Some pixels of warped images `(B, N, 2)`, inside of what they show, and the pixels that were there before."""
    height, width = image.shape[-2:]
    picked = [(part[2] > 1 - 1e-6)[5 : height - 5, 5 : width - 5].nonzero()[::997].flip(-1) + 5 for part in image]
    count = min(map(len, picked))
    after = torch.stack([part[:count] for part in picked])
    before = torch.stack([part[:2, p[:, 1], p[:, 0]].T for part, p in zip(image, after, strict=True)])
    return after.to(D), before


@pytest.mark.parametrize("name", AFFINE)
@pytest.mark.parametrize("behind_lens", [False, True])
def test_augmented_pixels_land_where_they_did(
    name: str, behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera
) -> None:
    make, size = AFFINE[name]
    augment = make()
    image = augment(where_it_is(3))
    after, before = corners(image)
    camera = lens_camera if behind_lens else camera
    warped = camera.warped(augment.transform_matrix, size)
    assert warped.batch_shape == (3,)
    assert warped.size == (size or camera.size)
    # Kornia samples in float64 here but for its grids: a few millionths of a pixel.
    want, seen = dp.back_project(before, camera, dp.Plane.z(0.0))
    points, valid = dp.back_project(after, warped, dp.Plane.z(0.0))
    assert after.shape[1] > 20
    assert torch.equal(valid, seen)
    torch.testing.assert_close(points[valid], want[seen], rtol=1e-5, atol=2e-3)
    again, _ = dp.PlaneProjector(camera, dp.Plane.z(0.0), ("focal",))(after, augment.transform_matrix)
    torch.testing.assert_close(again, points, rtol=1e-10, atol=1e-10)


def test_a_perspective_augmentation_turns_a_pinhole(camera: dp.Camera) -> None:
    augment = augmentation.RandomPerspective(0.4, p=1.0)
    after, before = corners(augment(where_it_is(4)))
    warped = camera.warped(augment.transform_matrix)
    want, _ = dp.back_project(before, camera, dp.Plane.z(0.0))
    points, valid = dp.back_project(after, warped, dp.Plane.z(0.0))
    assert valid.all()
    torch.testing.assert_close(points, want, rtol=1e-5, atol=2e-3)
    torch.testing.assert_close(warped.center, camera.center.expand(4, 3))
    torch.testing.assert_close(warped.R @ warped.R.mT, torch.eye(3, dtype=D).expand(4, 3, 3))
    assert (torch.linalg.det(warped.R) > 0).all()


@pytest.mark.parametrize("factor", [1.0, -3.0])
def test_the_matrix_counts_up_to_its_factor(factor: float, camera: dp.Camera, pixels: torch.Tensor) -> None:
    source = torch.tensor([[[0.0, 0], [639, 0], [639, 479], [0, 479]]], dtype=D)
    H = get_perspective_transform(source, source + 40 * torch.rand(1, 4, 2, dtype=D))[0]
    points, _ = dp.back_project(pixels, camera, dp.Plane.z(0.0))
    homogeneous = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ H.T
    got, valid = camera.warped(factor * H).project(points)
    assert valid.all()
    torch.testing.assert_close(got, homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-10, atol=1e-9)


def test_large_shifts_in_float32_and_a_far_principal_point(camera: dp.Camera, pixels: torch.Tensor) -> None:
    single = camera.to(torch.float32)
    for scale, shift in ((1.0, -1500.0), (0.1, -300.0)):
        matrix = torch.tensor([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
        torch.testing.assert_close(single.warped(matrix).K[0, 2], scale * single.K[0, 2] + shift)
    K = torch.tensor([[2000.0, 0, 1920], [0, 2000, 1080], [0, 0, 1]], dtype=D)
    part = dp.Camera(K, camera.R, camera.t, size=(3840, 2160)).cropped(2320, 0, 640, 480)
    H = torch.tensor([[1.0, 0, 0], [0, 1, 0], [3e-3, 0, 1]], dtype=D)  # the principal point, u = -400, lies behind
    points, _ = dp.back_project(pixels, part, dp.Plane.z(0.0))
    homogeneous = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ H.T
    got, valid = part.warped(H).project(points)
    assert valid.all()
    torch.testing.assert_close(got, homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-9, atol=1e-8)


def test_what_resizing_and_cropping_do_is_a_warp(lens_camera: dp.Camera) -> None:
    half = torch.tensor([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], dtype=D)
    torch.testing.assert_close(lens_camera.warped(half).K, lens_camera.resized((320, 240)).K)
    shift = torch.tensor([[1.0, 0, -10], [0, 1, -20], [0, 0, 1]], dtype=D)
    torch.testing.assert_close(lens_camera.warped(shift).K, lens_camera.cropped(10, 20, 100, 100).K)
    assert torch.equal(lens_camera.warped(shift).R, lens_camera.R)


def test_an_augmented_photograph_has_the_same_top_view(lens_camera: dp.Camera) -> None:
    coarse = torch.rand(1, 3, 24, 32, dtype=D)
    image = torch.nn.functional.interpolate(coarse, size=(480, 640), mode="bicubic")
    augment = augmentation.RandomAffine(20.0, (0.05, 0.05), (0.9, 1.1), p=1.0)
    center, _ = dp.back_project(torch.tensor([[320.0, 240]], dtype=D), lens_camera, dp.Plane.z(0.0))
    x, y = center[0, :2].tolist()
    extent = (x - 60, y - 60, x + 60, y + 60)
    want, seen = dp.rectify(image, lens_camera, dp.Plane.z(0.0), extent, 1.0)
    got, valid = dp.rectify(augment(image), lens_camera.warped(augment.transform_matrix), dp.Plane.z(0.0), extent, 1.0)
    assert seen.all()
    assert valid.all()
    assert (got - want).abs().mean() < 0.005
    off, _ = dp.rectify(augment(image), lens_camera, dp.Plane.z(0.0), extent, 1.0)
    assert (off - want).abs().mean() > 0.05


def test_gradients_are_finite_differences(camera: dp.Camera, pixels: torch.Tensor) -> None:
    H = torch.eye(3, dtype=D) + 1e-4 * torch.rand(2, 3, 3, dtype=D)

    def points(H: torch.Tensor, K: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
        warped = dp.Camera.unchecked(K, R, camera.t, None, None).warped(H)
        return dp.back_project(pixels[:5], warped, dp.Plane.z(0.0))[0]

    inputs = [part.clone().requires_grad_() for part in (H, camera.K, camera.R)]
    assert torch.autograd.gradcheck(points, inputs, eps=1e-7, atol=1e-3, rtol=1e-4)


def test_vmap_over_matrices(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    matrices = torch.eye(3, dtype=D).repeat(4, 1, 1)
    matrices[:, :2] += 0.01 * torch.randn(4, 2, 3, dtype=D)
    one = torch.func.vmap(lambda H: dp.back_project(pixels, lens_camera.warped(H), dp.Plane.z(0.0))[0])(matrices)
    together, _ = dp.back_project(pixels, lens_camera.warped(matrices), dp.Plane.z(0.0))
    torch.testing.assert_close(one, together, rtol=1e-10, atol=1e-10)


@pytest.mark.plain
def test_bad_input_is_refused_by_name(camera: dp.Camera, lens_camera: dp.Camera) -> None:
    eye = torch.eye(3, dtype=D)
    projective = eye + torch.tensor([[0.0, 0, 0], [0, 0, 0], [1e-4, 0, 0]], dtype=D)
    cases = [
        (TypeError, "matrix: want torch.float64 as camera has, got torch.float32", camera, eye.float()),
        (TypeError, "matrix: want a tensor, an array or numbers, got None", camera, None),
        (ValueError, r"matrix: want shape \(\*B, 3, 3\)", camera, eye[:2]),
        (ValueError, "matrix: want an invertible one", camera, eye - eye[0]),
        (ValueError, "matrix: want finite values", camera, eye * torch.nan),
        (ValueError, "matrix: want an affine one .* for a camera with a lens", lens_camera, projective),
    ]
    for kind, message, given, matrix in cases:
        with pytest.raises(kind, match=message):
            given.warped(matrix)
