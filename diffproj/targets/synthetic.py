"""Synthetic photographs of targets, and their points, with ground truth.

A photograph is the printed target, `board_texture`, rendered by `diffproj.render`, which back-projects every pixel onto
the board. Vignetting and Gaussian blur model the optics, Gaussian noise the sensor.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from kornia.filters import gaussian_blur2d
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import checked_seed, number, numbers, whole_number
from diffproj._core.numerics import transform
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.euler import rotation_from_euler
from diffproj.geometry.grid import pixel_grid
from diffproj.geometry.intrinsics import pixel_to_normalized
from diffproj.geometry.plane import Plane
from diffproj.geometry.rectification import render
from diffproj.targets.boards import Board, as_printed
from diffproj.targets.views import Views

BLACK, WHITE, TABLE = 0.12, 0.88, 0.55
"""Grey values of the printed squares, the paper and the table under the board, in 0..1."""


class Texture(NamedTuple):
    """The texture of a plane, with the arguments that `diffproj.render` takes.

    Attributes:
        image: grey values `(1, rows, columns)` in 0..1.
        extent: `(s_min, t_min, s_max, t_max)` in world units.
        axes: `(origin, axis_s, axis_t)`, each `(3,)`.
    """

    image: Float[Tensor, "1 rows columns"]
    extent: tuple[float, float, float, float]
    axes: tuple[Tensor, Tensor, Tensor]


def board_texture(board: Board, texels: int = 32) -> Texture:
    """The texture of a printed target on z = 0, s to the right and t down, as it stands upright.

    The print has a white margin, and the paper a margin of table, each as wide as a square, a tag, or the distance
    between two circles.

    Args:
        board: any target that is printed: a `Chessboard` in either frame, a `CharucoBoard`, an `AprilGrid`.
        texels: per side of a square or a tag, or for the distance between two circles; a chessboard's edges are between
            texels.

    Raises:
        TypeError: it is no board, or texels no whole number.
        ValueError: fewer than 1 texel, or more than 10,000.

    Example:
        >>> import diffproj as dp
        >>> texture = board_texture(dp.Chessboard(columns=4, rows=3, square=10.0), texels=2)
        >>> texture.image.shape, texture.extent
        (torch.Size([1, 16, 18]), (-30.0, -30.0, 60.0, 50.0))
    """
    as_printed(board)
    texels = whole_number("texels", texels, "at least 1 along a square", least=1, most=10_000)
    art, side = board.artwork, board.side
    step = side / texels
    width, height = (math.ceil(length / step - 1e-6) for length in art.size)
    shape = height + 4 * texels, width + 4 * texels
    dark = torch.from_numpy(art.darkness((-2 * side, -2 * side), step, shape)).float()
    grey = torch.full(shape, TABLE, dtype=torch.float32, device="cpu")
    paper = slice(texels, -texels), slice(texels, -texels)
    grey[paper] = WHITE + (BLACK - WHITE) * dark[paper]
    origin, right, down = art.axes
    left, top = float(origin @ right) - 2 * side, float(origin @ down) - 2 * side
    extent = (left, top, left + step * shape[1], top + step * shape[0])
    right, down = (torch.from_numpy(part).float() for part in (right, down))
    return Texture(grey[None], extent, (torch.zeros_like(right), right, down))


def photograph(
    camera: Camera | PinholeCamera,
    board: Board,
    *,
    blur_px: float = 0.7,
    noise: float = 4 / 255,
    vignetting: float = 0.3,
    seed: int = 0,
) -> UInt8[Tensor, "*batch h w"]:
    """Render grey photographs of a board at z = 0.

    Args:
        camera: with an image size, of any batch shape `*B`.
        board: the board, with a white margin of one square.
        blur_px: standard deviation of the Gaussian blur in pixels; 0 for none.
        noise: standard deviation of the sensor noise, relative to the full range of grey values.
        vignetting: strength of natural vignetting: 1 for the cosine-fourth law, 0 for none.
        seed: of the noise.

    Returns:
        Images `(*B, H, W)`.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: the camera has no size, or an argument is out of its range.

    Example:
        >>> import diffproj as dp
        >>> setup = dp.paper_setup()
        >>> photograph(setup.test[0], setup.board).shape
        torch.Size([480, 640])
    """
    camera, board = _sized(camera), as_printed(board)
    blur_px = number("blur_px", blur_px, "a number from 0 to 1000 px", least=0, most=1000)
    noise = number("noise", noise, "a part of the grey values' range of at least 0", least=0)
    vignetting = number("vignetting", vignetting, "a number from 0 to 1", least=0, most=1)
    generator = _generator(seed)
    cameras = [camera] if not camera.batch_shape else [camera[i] for i in _indices(camera.batch_shape)]
    images = []
    for single in cameras:
        # float32 is accurate to 1e-6 of the scene, a thousandth of a pixel.
        single = single.detach().to("cpu", torch.float32)
        texture = board_texture(board, _texels(single, board))
        shown, seen = render(texture.image, single, Plane.z(0.0), texture.extent, axes=texture.axes)
        image = torch.where(seen, shown[0], TABLE) * (1 - vignetting * (1 - _falloff(single)))
        if reach := round(4 * blur_px):
            border = "reflect" if reach < min(image.shape) else "replicate"  # a reflection is no larger than the image
            kernel, sigma = (2 * reach + 1, 2 * reach + 1), image.new_tensor([[blur_px, blur_px]])
            image = gaussian_blur2d(image[None, None], kernel, sigma, border)[0, 0]
        image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype, device="cpu")
        images.append((image.clamp(0, 1) * 255).round().to(torch.uint8))
    width, height = camera.size or (0, 0)
    if not images:
        return torch.zeros(*camera.batch_shape, height, width, dtype=torch.uint8, device="cpu")
    return torch.stack(images).reshape(*camera.batch_shape, height, width)


def corner_views(camera: Camera | PinholeCamera, board: Board, *, noise_px: float = 0.2, seed: int = 0) -> Views:
    """Project the board's corners into cameras of batch shape `(*B, V)`, with Gaussian noise on each coordinate.

    Args:
        camera: the true cameras.
        board: the board.
        noise_px: standard deviation of the noise in pixels.
        seed: of the noise.

    Returns:
        Views `(*B, V, N, 2)`; corners outside the image, or without a valid projection, are marked as not visible.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: the camera has no batch axis, or negative noise.

    Example:
        >>> import diffproj as dp
        >>> setup = dp.paper_setup()
        >>> corner_views(setup.fit, setup.board).pixels.shape
        torch.Size([10, 54, 2])
    """
    camera, board = as_camera(camera), as_printed(board)
    noise_px = number("noise_px", noise_px, "a standard deviation of at least 0 px", least=0)
    if not camera.batch_shape:
        raise ValueError("camera: want a batch of views (V,), got a single camera; camera.at(R, t) makes one")
    pixels, visible = camera.project(board.points.to(camera.K))
    noise = torch.randn(pixels.shape, generator=_generator(seed), dtype=pixels.dtype, device="cpu")
    pixels = pixels + noise_px * noise.to(pixels.device)
    if camera.size is not None:
        visible = visible & camera.in_image(pixels)
    return Views(pixels, visible, size=camera.size)


def random_cameras(
    camera: Camera | PinholeCamera,
    board: Board,
    views: int,
    *,
    tilt: float = math.radians(40),
    distance: tuple[float, float] = (1.5, 3.0),
    seed: int = 0,
) -> Camera:
    """The camera at random poses with the whole board in view, its face towards the camera, of batch shape `(*B, V)`.

    Args:
        camera: of batch shape `*B`, with an image size; its pose is ignored.
        board: the board, in either frame.
        views: V.
        tilt: limit of the board's rotations about x, y and z, which are uniform within +- this, in radians.
        distance: of the board's centre from the camera, uniform between these multiples of its longer side.
        seed: of the random draws.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: the camera has no size, or too few of the drawn poses have the whole board in view, or an argument
            is out of its range.

    Example:
        >>> import diffproj as dp
        >>> setup = dp.paper_setup()
        >>> random_cameras(setup.fit[0], setup.board, 20).batch_shape
        torch.Size([20])
    """
    camera, board = _sized(camera), as_printed(board)
    views = whole_number("views", views, "a number of views from 1 to 100,000", least=1, most=100_000)
    tilt = number("tilt", tilt, "an angle of at least 0 radians", least=0)
    want = "(nearest, farthest) in sides of the board, above 0"
    distance = numbers("distance", distance, want, 2)  # type: ignore[assignment]
    if min(distance) <= 0:
        raise ValueError(f"distance: want {want}, got {distance}")
    generator = _generator(seed)
    points = board.points.to(camera.dtype)
    middle, extent = points.mean(dim=0), float((points.amax(dim=0) - points.amin(dim=0)).amax())
    _, right, down = (torch.from_numpy(part).to(camera.dtype) for part in board.artwork.axes)
    away = torch.linalg.cross(right, down)
    upright = torch.stack([right, down, away])
    here = camera.to("cpu")  # as the draws, so that a seed gives the same poses on every device
    singles = [here] if not camera.batch_shape else [here[i] for i in _indices(camera.batch_shape)]
    rotations, shifts = [], []
    for single in singles:
        R, t = upright.new_zeros(0, 3, 3), upright.new_zeros(0, 3)
        for _ in range(100):
            count = 8 * views
            draw = torch.rand(count, 6, generator=generator, dtype=camera.dtype, device="cpu")
            turned = rotation_from_euler(*((2 * draw[:, :3] - 1) * tilt).unbind(-1)) @ upright
            depth = (distance[0] + (distance[1] - distance[0]) * draw[:, 3]) * extent
            # The board's centre is uniform over the image.
            width, height = single.size or (0, 0)
            where = draw[:, 4:] * torch.tensor([width - 1.0, height - 1.0], dtype=camera.dtype, device="cpu")
            direction, valid = single.without_pose().directions(where)
            direction = direction / direction.norm(dim=-1, keepdim=True)
            shift = direction * depth.unsqueeze(-1) - turned @ middle
            pixels, seen = single.at(turned, shift).project(points)
            last = torch.tensor([width - 1.0, height - 1.0], dtype=camera.dtype, device="cpu")
            face = (turned @ away * (direction * depth.unsqueeze(-1))).sum(-1) > 0  # not its back, as far off the axis
            whole = valid & face & (seen & (pixels >= 0).all(-1) & (pixels <= last).all(-1)).all(-1)
            R, t = torch.cat([R, turned[whole]]), torch.cat([t, shift[whole]])
            if len(R) >= views:
                break
        else:
            raise ValueError(
                f"distance: want poses from which the whole board is in view, got {len(R)} of {views} views from "
                f"{100 * 8 * views} poses drawn at {distance[0]:g} to {distance[1]:g} sides of the board; a larger "
                "distance, a smaller tilt, or a camera with a wider view gives more"
            )
        rotations.append(R[:views])
        shifts.append(t[:views])
    R = torch.cat([upright.new_zeros(0, 3, 3), *rotations]).reshape(*camera.batch_shape, views, 3, 3)
    t = torch.cat([upright.new_zeros(0, 3), *shifts]).reshape(*camera.batch_shape, views, 3)
    return (camera if not camera.batch_shape else camera[..., None]).at(R.to(camera.device), t.to(camera.device))


def _sized(camera: Camera | PinholeCamera) -> Camera:
    """A camera that knows its size."""
    camera = as_camera(camera)
    if camera.size is None:
        raise ValueError("camera: want a size, got None; give Camera(..., size=(width, height))")
    if camera.K.is_meta:
        raise ValueError("camera: want one with values, got one on the device meta")
    return camera


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(checked_seed(seed))


def _texels(camera: Camera, board: Board) -> int:
    """Texels per side: about two per pixel where the board's image is largest, from 8 to 256."""
    points = board.points.to(camera.dtype)
    pixels, valid = camera.project(points)
    pixels = torch.where(valid.unsqueeze(-1), pixels, torch.nan).reshape(*board.shape, 2)
    points = points.reshape(*board.shape, 3)
    scale = torch.cat([(pixels.diff(dim=k).norm(dim=-1) / points.diff(dim=k).norm(dim=-1)).flatten() for k in (0, 1)])
    largest = scale[scale.isfinite()]
    return min(256, max(8, math.ceil(2 * board.side * float(largest.amax())))) if len(largest) else 8


def _falloff(camera: Camera) -> Float[Tensor, "h w"]:
    """Natural vignetting: the cosine-fourth law, `1 / (1 + r^2)^2`."""
    width, height = camera.size or (0, 0)
    pixels = pixel_grid(height, width, camera.K).reshape(-1, 2)
    xy = transform(pixel_to_normalized(camera.K), pixels - camera.K[:2, 2])
    return (1 + xy.square().sum(-1)).reshape(height, width) ** -2


def _indices(shape: torch.Size) -> list[tuple[int, ...]]:
    return [tuple(index) for index in torch.cartesian_prod(*map(torch.arange, shape)).reshape(-1, len(shape)).tolist()]
