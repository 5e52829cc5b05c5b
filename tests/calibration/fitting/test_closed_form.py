"""The closed-form starts against the cameras that made the views: exact where the views are, and one by one alike."""

import pytest
import torch
from kornia.geometry.homography import find_homography_dlt
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.fitting import closed_form

D = torch.float64
BOARD = dp.Chessboard()
MIDDLE = torch.tensor([320.0, 240.0], dtype=D)


def cameras(f: tuple[float, float], c: tuple[float, float] = (320.0, 240.0), seed: int = 0) -> dp.Camera:
    K = torch.tensor([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]], dtype=D)
    return synthetic.random_cameras(dp.Camera(K, size=(640, 480)), BOARD, 6, seed=seed)


def homographies(pixels: Tensor) -> Tensor:
    """Of views `(P, V, N, 2)` that show every corner."""
    return closed_form.homographies(BOARD.points, pixels, torch.ones_like(pixels[..., 0], dtype=torch.bool))


def test_homographies_of_exact_views_and_of_parts_of_them() -> None:
    exact = cameras((600.0, 640.0))
    seen = exact.project(BOARD.points)[0].unsqueeze(0)
    board = torch.nn.functional.pad(BOARD.points[:, :2] - BOARD.points[:, :2].mean(0), (0, 1), value=1.0)
    few = torch.zeros(1, len(seen[0]), len(BOARD), dtype=torch.bool)
    few[..., [0, 8, 45, 53]] = True
    some = torch.rand(few.shape) > 0.6
    for used in (torch.ones_like(few), some, few):
        H = closed_form.homographies(BOARD.points, torch.where(used.unsqueeze(-1), seen, torch.nan), used)
        mapped = board @ H.mT
        torch.testing.assert_close(mapped[..., :2] / mapped[..., 2:], seen, rtol=0, atol=1e-7)
        assert (H[..., 2, 2] == 1).all()
    # A view gives the same to the bit beside one that misses corners.
    mixed = torch.cat([torch.ones_like(few[:, :1]), some[:, 1:]], dim=1)
    assert torch.equal(closed_form.homographies(BOARD.points, seen, mixed)[:, 0], homographies(seen[:, :1])[:, 0])
    line = torch.arange(len(BOARD)) < BOARD.columns
    assert not closed_form.homographies(BOARD.points, seen, line.expand_as(few)).isfinite().any()


def test_homographies_are_those_of_the_normal_equations() -> None:
    seen = cameras((600.0, 640.0)).project(BOARD.points)[0]
    seen = (seen + 0.2 * torch.randn(seen.shape, dtype=D))[:, :20]
    board = BOARD.points[:20, :2]
    H = closed_form.homographies(BOARD.points[:20], seen.unsqueeze(0), torch.ones(1, len(seen), 20) > 0)[0]
    want = find_homography_dlt((board - board.mean(0)).expand_as(seen), seen)
    corners = torch.nn.functional.pad(board - board.mean(0), (0, 1), value=1.0)
    for one, other in zip(H, want, strict=True):
        a, b = corners @ one.mT, corners @ other.mT
        torch.testing.assert_close(a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:], rtol=0, atol=0.05)


def test_focal_lengths_of_exact_views_whatever_else_is_in_the_batch() -> None:
    f = torch.tensor([[600.0, 640.0], [900.0, 700.0], [450.0, 460.0]], dtype=D)
    seen = torch.stack(
        [cameras((float(a), float(b)), seed=seed).project(BOARD.points)[0] for seed, (a, b) in enumerate(f)]
    )
    enough = torch.ones(seen.shape[:2], dtype=torch.bool)
    middle = MIDDLE.expand(3, 2)
    found = closed_form.focal_lengths(homographies(seen), middle, 640.0, enough, False)
    torch.testing.assert_close(found, f, rtol=1e-6, atol=0)
    for p in range(3):
        one = slice(p, p + 1)
        alone = closed_form.focal_lengths(homographies(seen[one]), middle[one], 640.0, enough[one], False)
        torch.testing.assert_close(alone, found[one], rtol=1e-9, atol=0)


def test_one_focal_length_for_both_axes() -> None:
    seen = cameras((700.0, 700.0)).project(BOARD.points)[0].unsqueeze(0)
    enough = torch.ones(seen.shape[:2], dtype=torch.bool)
    found = closed_form.focal_lengths(homographies(seen), MIDDLE.expand(1, 2), 640.0, enough, True)
    torch.testing.assert_close(found, torch.tensor([[700.0, 700.0]], dtype=D), rtol=1e-6, atol=0)


def test_the_full_system_finds_the_principal_point_too() -> None:
    seen = cameras((600.0, 640.0), c=(250.0, 300.0)).project(BOARD.points)[0].unsqueeze(0)
    enough = torch.ones(seen.shape[:2], dtype=torch.bool)
    f, c, solved = closed_form.intrinsics(homographies(seen), MIDDLE.expand(1, 2), 640.0, enough)
    assert bool(solved.all())
    torch.testing.assert_close(f, torch.tensor([[600.0, 640.0]], dtype=D), rtol=1e-6, atol=0)
    torch.testing.assert_close(c, torch.tensor([[250.0, 300.0]], dtype=D), rtol=0, atol=1e-3)


def test_the_division_model_is_recognised() -> None:
    straight = cameras((600.0, 640.0)).project(BOARD.points)[0].unsqueeze(0)
    radius = 400.0
    for lam in (-0.25, -0.1):
        centred = straight - MIDDLE
        r = centred.norm(dim=-1, keepdim=True) / radius  # of r_d / (1 + lam r_d^2) = r the root that is near r
        distorted = (1 - (1 - 4 * lam * r * r).sqrt()) / (2 * lam * r)
        seen = MIDDLE + centred / r * distorted
        back = closed_form.without_division(seen, MIDDLE.expand(1, 2), torch.tensor([lam], dtype=D), radius)
        torch.testing.assert_close(back, straight)
        used = torch.ones_like(seen[..., 0], dtype=torch.bool)
        found, _ = closed_form.division(BOARD.points, seen, used, MIDDLE.expand(1, 2), radius)
        assert abs(float(found) - lam) < 0.005  # measured: .0007 and .0022


def test_poses_of_exact_homographies_and_of_none() -> None:
    made = cameras((600.0, 640.0))
    xy = dp.Camera(torch.eye(3, dtype=D), made.R, made.t).project(BOARD.points)[0].unsqueeze(0)
    H = homographies(xy)
    R, t = closed_form.poses(H, BOARD.points)
    torch.testing.assert_close(R[0], made.R.expand(6, 3, 3), rtol=0, atol=1e-7)
    torch.testing.assert_close(t[0], made.t.expand(6, 3), rtol=1e-7, atol=1e-4)
    # Without a usable homography the board faces the camera on its axis, ten times its half extent away.
    R, t = closed_form.poses(torch.full_like(H[:, :1], torch.nan), BOARD.points)
    middle = BOARD.points.mean(0)
    extent = (BOARD.points - middle).abs().amax()
    torch.testing.assert_close(R[0, 0], torch.eye(3, dtype=D))
    torch.testing.assert_close((R @ middle + t)[0, 0], 10 * extent * torch.tensor([0.0, 0.0, 1.0], dtype=D))


def test_boards_that_face_the_camera_are_found_upright() -> None:
    """Turned within the image, before the camera or seen from behind, with corners hidden: exact."""
    angles = torch.tensor([0.0, 0.7, 2.5, -1.2], dtype=D)
    c, s, zero, one = angles.cos(), angles.sin(), torch.zeros(4, dtype=D), torch.ones(4, dtype=D)
    front = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3))
    behind = front @ torch.tensor([1.0, -1, -1], dtype=D).diag()
    R = torch.stack([front, behind])
    t = torch.tensor([[30.0, -80, 700], [-200.0, 90, 2000]], dtype=D).unsqueeze(1).expand(2, 4, 3)
    seen = BOARD.points @ R.mT + t.unsqueeze(-2)
    used = torch.rand(2, 4, len(BOARD.points), generator=torch.Generator().manual_seed(0)) < 0.7
    xy = torch.where(used.unsqueeze(-1), seen[..., :2] / seen[..., 2:], torch.nan)
    found = closed_form.upright_poses(BOARD.points, xy, used)
    torch.testing.assert_close(found[0], R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found[1], t, rtol=1e-12, atol=1e-9)


def test_few_views_bring_their_homographies_along() -> None:
    """Interpolated over lambda, they are those that the views give once undistorted."""
    straight = cameras((600.0, 640.0)).project(BOARD.points)[0][:4].unsqueeze(0)
    radius = 400.0
    for lam in (-0.25, -0.15, -0.05):
        centred = straight - MIDDLE
        r = centred.norm(dim=-1, keepdim=True) / radius
        seen = MIDDLE + centred / r * (1 - (1 - 4 * lam * r * r).sqrt()) / (2 * lam * r)
        used = torch.ones_like(seen[..., 0], dtype=torch.bool)
        found, H = closed_form.division(BOARD.points, seen, used, MIDDLE.expand(1, 2), radius)
        back = closed_form.without_division(seen, MIDDLE.expand(1, 2), found, radius)
        assert H is not None
        mapped = torch.nn.functional.pad(BOARD.points[:, :2] - BOARD.points[:, :2].mean(0), (0, 1), value=1.0) @ H.mT
        off = (mapped[..., :2] / mapped[..., 2:] - back).norm(dim=-1)
        assert float(off.amax()) < 0.1  # px; measured: .027, .065 and .018


def test_a_board_that_would_reach_behind_the_camera_is_moved_before_it() -> None:
    middle, tilt = BOARD.points.mean(0), torch.tensor(1.4, dtype=D)
    R = dp.rotation_from_euler(tilt, torch.zeros_like(tilt), torch.zeros_like(tilt))
    t = torch.tensor([5.0, -3, 20], dtype=D)
    H = torch.cat([R[:, :2], t.unsqueeze(-1)], dim=-1).expand(1, 1, 3, 3)  # the board's centre is at t
    found_R, found_t = closed_form.poses(H, BOARD.points)
    torch.testing.assert_close(found_R[0, 0], R)
    placed = BOARD.points @ R.mT + found_t[0, 0]
    torch.testing.assert_close(placed.mean(0)[:2], t[:2])
    assert float(placed[:, 2].amin()) == pytest.approx(0.2 * float((BOARD.points - middle).abs().amax()))


def test_principal_point_of_exact_homographies() -> None:
    """Whatever the focal length, from three views or more; in units of any size."""
    K = torch.tensor([[700.0, 0, 900], [0, 700, -150], [0, 0, 1]], dtype=torch.float64)
    R = dp.rotation_from_euler(
        *torch.tensor([[0.4, -0.3, 0.2, 0.1], [0.2, 0.35, -0.4, 0.3], [0.1, 0.9, 2.0, 3.0]]).double()
    )
    t = torch.tensor([[10.0, 5, 500], [-20, 8, 600], [30, -9, 450], [1, 2, 700]], dtype=torch.float64)
    H = K @ torch.stack([R[..., 0], R[..., 1], t], dim=-1)
    middle = torch.tensor([[319.5, 239.5]], dtype=torch.float64)
    found = closed_form.principal_point(H.unsqueeze(0), middle, 640.0, torch.ones(1, 4, dtype=torch.bool))
    torch.testing.assert_close(found, K[:2, 2].unsqueeze(0), atol=1e-6, rtol=0)


def test_rays_of_an_equidistant_image() -> None:
    """A pixel at r focal lengths is seen at the angle r from the axis: at tan r on a plane ahead."""
    focal, middle = torch.tensor([300.0], dtype=torch.float64), torch.tensor([[320.0, 240.0]], dtype=torch.float64)
    angle = torch.tensor([0.0, 1e-12, 0.3, 0.9, 1.2], dtype=torch.float64)
    direction = torch.tensor([0.6, -0.8], dtype=torch.float64)
    pixels = (middle + focal * angle.unsqueeze(-1) * direction)[None, None]
    rays, inside = closed_form.equidistant_rays(pixels, middle, focal)
    assert bool(inside.all())
    torch.testing.assert_close(rays[0, 0], angle.tan().unsqueeze(-1) * direction, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("tied", [False, True])
def test_views_without_enough_corners_say_nothing_of_the_focal_length(tied: bool) -> None:
    K = torch.tensor([[700.0, 0, 320], [0, 650, 240], [0, 0, 1]], dtype=torch.float64)
    angles = torch.tensor([[0.4, -0.3, 0.2, 0.1], [0.2, 0.35, -0.4, 0.3], [0.1, 0.9, 2.0, 3.0]], dtype=torch.float64)
    R = dp.rotation_from_euler(*angles)
    t = torch.tensor([[10.0, 5, 500], [-20, 8, 600], [30, -9, 450], [1, 2, 700]], dtype=torch.float64)
    H = (K @ torch.stack([R[..., 0], R[..., 1], t], dim=-1)).unsqueeze(0)
    enough, middle = torch.tensor([[True, True, False, True]]), K[:2, 2].unsqueeze(0)
    whole = closed_form.focal_lengths(H, middle, 640.0, enough, tied)
    without = closed_form.focal_lengths(H[:, [0, 1, 3]], middle, 640.0, enough[:, [0, 1, 3]], tied)
    torch.testing.assert_close(whole, without)
    if not tied:
        torch.testing.assert_close(whole, torch.tensor([[700.0, 650.0]], dtype=torch.float64))
