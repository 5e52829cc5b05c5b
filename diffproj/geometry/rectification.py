"""Metric top views of a plane, and the way back: `rectify` an image, `render` a texture.

A top view is an image of a plane in world units. Its column j and row i are at the plane's own coordinates (s, t),

    s = s_min + (j + 1/2) resolution        t = t_min + (i + 1/2) resolution        X = origin + s axis_s + t axis_t

A pixel covers a square, so that areas and edges keep their places at any resolution. Every pixel of the target image
is mapped to the source image through the camera, lens included. Where its footprint there is larger than a pixel, it is
supersampled, by at most 8 x 8 bilinear samples, against aliasing. Both are differentiable in image and camera.
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import grid_sample

from diffproj._core.numerics import check_tensor
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.grid import inside, pixel_grid
from diffproj.geometry.plane import Plane

LookUp = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Maps an offset within the target's pixels, from 0 to 1, to positions in the source `(*B, N, 2)` and `valid`."""
MAX_SUPERSAMPLING = 8
"""Maximum number of samples along each side of a pixel."""


def plane_axes(plane: Plane) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Default axes of top views: `(origin, axis_s, axis_t)`, the axes orthonormal.

    On a plane of constant z they are the world's: the point `(0, 0, z)`, x and y. On another plane `axis_s` is the
    projection of the world's x (of y, where the normal is within 26 degrees of x), `axis_t` completes
    `axis_s x axis_t = n` for the normal n turned to positive z, and the origin is the point closest to the world's.

    Args:
        plane: of batch shape `*B`.

    Example:
        >>> origin, s, t = plane_axes(Plane(torch.tensor([0.0, 0.0, 2.0]), torch.tensor(6.0)))
        >>> origin.tolist(), s.tolist(), t.tolist()
        ([0.0, 0.0, 3.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    """
    length = plane.normal.norm(dim=-1, keepdim=True)
    n = plane.normal / length
    origin = n * (plane.offset.unsqueeze(-1) / length)
    n = torch.where(n[..., 2:] < 0, -n, n)
    x, y = (torch.zeros_like(n).index_fill(-1, torch.tensor(i, device=n.device), 1.0) for i in range(2))
    near = torch.where(n[..., :1].abs() > 0.9, y, x)
    s = near - (near * n).sum(-1, keepdim=True) * n
    s = s / s.norm(dim=-1, keepdim=True)
    return origin, s, torch.linalg.cross(n, s)


def rectify(
    image: Float[Tensor, "*batch c h w"],
    camera: Camera | PinholeCamera,
    plane: Plane,
    extent: Sequence[float],
    resolution: float,
    axes: tuple[Tensor, Tensor, Tensor] | None = None,
) -> tuple[Float[Tensor, "*out c rows columns"], Bool[Tensor, "*out rows columns"]]:
    """The metric top view of a plane.

    Args:
        image: `(*B, C, H, W)`, floating point.
        camera: with its pose, of batch shape `*B`; the image is taken to be its full image.
        plane: of batch shape `*B`.
        extent: `(s_min, t_min, s_max, t_max)` in world units, along the plane's axes.
        resolution: world units per pixel of the top view.
        axes: `(origin, axis_s, axis_t)`, each `(*B, 3)`; those of `plane_axes` if left out.

    Returns:
        The top view `(*B, C, rows, columns)`, 0 where not valid; and `valid (*B, rows, columns)`: at least half of the
        pixel's samples are in the image.

    Raises:
        TypeError: the image is no floating-point tensor.
        ValueError: an empty extent, a resolution that is not positive, or shapes that do not fit.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
        >>> camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), size=(640, 480))
        >>> top, valid = rectify(torch.rand(3, 480, 640), camera, dp.Plane.z(0.0), (-100, -50, 100, 50), 2.0)
        >>> top.shape, bool(valid.all())
        (torch.Size([3, 50, 100]), True)
    """
    image, camera = _checked_image(image), as_camera(camera)
    rows, columns = _shape(extent, resolution)
    plane = plane.like(camera.K)
    origin, along_s, along_t = axes or plane_axes(plane)
    H, W = image.shape[-2:]
    low = camera.K.new_tensor([extent[0], extent[1]])

    def look_up(offset: Tensor) -> tuple[Tensor, Tensor]:
        s, t = ((pixel_grid(rows, columns, camera.K) + offset) * resolution + low).reshape(-1, 2).unbind(-1)
        points = (
            origin.unsqueeze(-2) + s.unsqueeze(-1) * along_s.unsqueeze(-2) + t.unsqueeze(-1) * along_t.unsqueeze(-2)
        )
        return camera.project(points)

    return _resampled(image, look_up, (rows, columns), (W, H), camera.K)


def render(
    texture: Float[Tensor, "*batch c rows columns"],
    camera: Camera | PinholeCamera,
    plane: Plane,
    extent: Sequence[float],
    size: tuple[int, int] | None = None,
    axes: tuple[Tensor, Tensor, Tensor] | None = None,
) -> tuple[Float[Tensor, "*out c h w"], Bool[Tensor, "*out h w"]]:
    """Render a plane's texture into a camera's image: the inverse of `rectify`.

    Args:
        texture: `(*B, C, rows, columns)`, floating point, filling the extent.
        camera: with its pose, of batch shape `*B`.
        plane: of batch shape `*B`.
        extent: `(s_min, t_min, s_max, t_max)` in world units, along the plane's axes.
        size: `(width, height)` of the image; the camera's if left out.
        axes: `(origin, axis_s, axis_t)`, each `(*B, 3)`; those of `plane_axes` if left out.

    Returns:
        The image `(*B, C, H, W)`, 0 where not valid; and `valid (*B, H, W)`: at least half of the pixel's samples are
        on the texture.

    Raises:
        TypeError: the texture is no floating-point tensor.
        ValueError: an empty extent, no size, or shapes that do not fit.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
        >>> camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), size=(640, 480))
        >>> image, valid = render(torch.ones(1, 50, 100), camera, dp.Plane.z(0.0), (-100, -50, 100, 50))
        >>> image.shape, int(valid.sum())  # 200 x 100 world units at 2 per pixel
        (torch.Size([1, 480, 640]), 5000)
    """
    texture, camera = _checked_image(texture), as_camera(camera)
    size = size or camera.size
    if size is None:
        raise ValueError("size: want (width, height), got None, and the camera has none")
    _shape(extent, 1.0)
    plane = plane.like(camera.K)
    origin, along_s, along_t = axes or plane_axes(plane)
    width, height = size
    rows, columns = texture.shape[-2:]
    low = camera.K.new_tensor([extent[0], extent[1]])
    unit = camera.K.new_tensor([(extent[2] - extent[0]) / columns, (extent[3] - extent[1]) / rows])

    def look_up(offset: Tensor) -> tuple[Tensor, Tensor]:
        pixels = (pixel_grid(height, width, camera.K) + offset - 0.5).reshape(-1, 2)
        points, valid = back_project(pixels, camera, plane)
        off = points - origin.unsqueeze(-2)
        st = torch.stack([(off * along_s.unsqueeze(-2)).sum(-1), (off * along_t.unsqueeze(-2)).sum(-1)], dim=-1)
        return (st - low) / unit - 0.5, valid

    return _resampled(texture, look_up, (height, width), (columns, rows), camera.K)


def _resampled(
    source: Tensor, look_up: LookUp, shape: tuple[int, int], size: tuple[int, int], like: Tensor
) -> tuple[Tensor, Tensor]:
    """Resample a source, of `(width, height)` `size`, to a target of `(rows, columns)` `shape`, with supersampling."""
    n = _supersampling(look_up, shape, size, like)
    steps = ((torch.arange(n, dtype=like.dtype, device=like.device) + 0.5) / n).tolist()
    total, counts = torch.zeros((), dtype=source.dtype, device=source.device), torch.zeros((), device=source.device)
    for down in steps:
        for right in steps:
            sampled, seen = _sampled(source, *look_up(like.new_tensor([right, down])), shape, size)
            total, counts = total + sampled, counts + seen
    covered = counts >= 0.5 * n * n
    mean = total / counts.clamp(min=1).unsqueeze(-3).to(total)
    return torch.where(covered.unsqueeze(-3), mean, 0.0), covered


def _supersampling(look_up: LookUp, shape: tuple[int, int], size: tuple[int, int], like: Tensor) -> int:
    """Samples per side: the side of the target pixels' footprint in the source, 90th percentile, at most 8."""
    with torch.no_grad():
        places, valid = look_up(like.new_tensor([0.5, 0.5]))
        shown = (valid & inside(places, size)).unflatten(-1, shape)
        places = places.unflatten(-2, shape)
        footprint = 1.0
        for axis in (-1, -2):
            step = places.diff(dim=axis - 1).norm(dim=-1)
            count = shown.shape[axis] - 1
            step = step[shown.narrow(axis, 0, count) & shown.narrow(axis, 1, count)]
            if len(step):
                footprint = max(footprint, float(step[:: 1 + len(step) // 100_000].quantile(0.9)))
    return min(MAX_SUPERSAMPLING, math.ceil(footprint - 0.25))


def _sampled(
    source: Tensor, places: Tensor, valid: Tensor, shape: tuple[int, int], size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Bilinear samples `(*B, C, rows, columns)` of the source at `places`, and which are inside it."""
    seen = valid & inside(places, size)
    last = places.new_tensor([max(size[0] - 1, 1), max(size[1] - 1, 1)])
    grid = torch.where(seen.unsqueeze(-1), places, 0.0) * 2 / last - 1
    batch = torch.broadcast_shapes(source.shape[:-3], grid.shape[:-2])
    source, grid = source.expand(*batch, *source.shape[-3:]), grid.expand(*batch, *grid.shape[-2:])
    flat = grid.reshape(-1, *shape, 2).to(source)
    sampled = grid_sample(source.reshape(-1, *source.shape[-3:]), flat, padding_mode="border", align_corners=True)
    sampled = sampled.reshape(*batch, *sampled.shape[1:])
    seen = seen.expand(*batch, seen.shape[-1]).unflatten(-1, shape)
    return torch.where(seen.unsqueeze(-3), sampled, 0.0), seen


def _shape(extent: Sequence[float], resolution: float) -> tuple[int, int]:
    s_min, t_min, s_max, t_max = extent
    if not (s_max > s_min and t_max > t_min):
        raise ValueError(f"extent: want (s_min, t_min, s_max, t_max) with room between, got {tuple(extent)}")
    if not resolution > 0:
        raise ValueError(f"resolution: want world units per pixel, above 0, got {resolution}")
    return max(1, round((t_max - t_min) / resolution)), max(1, round((s_max - s_min) / resolution))


def _checked_image(image: Tensor) -> Tensor:
    return check_tensor("image", image, "C", "H", "W")
