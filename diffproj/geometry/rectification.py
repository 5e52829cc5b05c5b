"""Metric top views of a plane, and the way back: `rectify` an image, `render` a texture.

A top view is an image of a plane in world units. It fills its extent: column j and row i are at the plane's own
coordinates (s, t),

    s = s_min + (j + 1/2) (s_max - s_min) / columns     t = t_min + (i + 1/2) (t_max - t_min) / rows
    X = origin + s axis_s + t axis_t

With `north_up`, as maps have it, the first row is at the top instead: t falls from t_max as i grows.

A pixel covers a rectangle, a square where the extent is a whole multiple of the resolution, so that areas and edges
keep their places at any resolution. Every pixel of the target image is mapped to the source image through the camera,
lens included, and sampled there as `resampling.py` says. Both are differentiable in image and camera.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import Array, called, numbers, whole_number
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, entries, in_float64, linear
from diffproj.geometry.back_projection import PlaneMap, warn_if_rounded
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.extents import MOST_PIXELS, cells, shape_of, sides_of
from diffproj.geometry.grid import checked_size
from diffproj.geometry.plane import Plane, as_plane
from diffproj.geometry.resampling import MAX_SUPERSAMPLING, Chosen, LookUp, resampled

Axes = tuple[Tensor, Tensor, Tensor]
"""`(origin, axis_s, axis_t)` of a top view, each `(*B, 3)` in the world."""


def plane_axes(plane: Plane) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Default axes of top views: `(origin, axis_s, axis_t)`, the axes orthonormal.

    On a plane of constant z they are the world's: the point `(0, 0, z)`, x and y. On another plane `axis_s` is the
    projection of the world's x (of y, where the normal is within 26 degrees of x), `axis_t` completes
    `axis_s x axis_t = n` for the normal n turned to positive z, and the origin is the point closest to the world's.

    Args:
        plane: of batch shape `*B`.

    Raises:
        TypeError: it is no plane.

    Example:
        >>> origin, s, t = plane_axes(Plane(torch.tensor([0.0, 0.0, 2.0]), torch.tensor(6.0)))
        >>> origin.tolist(), s.tolist(), t.tolist()
        ([0.0, 0.0, 3.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    """
    n, distance = as_plane(plane).normalised()
    origin = n * distance.unsqueeze(-1)
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
    extent: Sequence[float] | Tensor | Array,
    resolution: float | None = None,
    axes: Axes | None = None,
    north_up: bool = False,
    samples: int | tuple[int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> tuple[Float[Tensor, "*out c rows columns"], Bool[Tensor, "*out rows columns"]]:
    """The metric top view of a plane.

    Args:
        image: `(*B, C, H, W)`, floating point.
        camera: with its pose, of batch shape `*B`; the image is its full image. `camera.resized((w, h))` is the camera
            of a feature map of fewer pixels.
        plane: of batch shape `*B`.
        extent: `(s_min, t_min, s_max, t_max)` in world units, along the plane's axes; `(*B, 4)` where each image has
            its own, with a resolution all equally large.
        resolution: world units per pixel of the top view. Where the extent is no whole multiple of it, the number of
            pixels is rounded, and they fill the extent.
        axes: `(origin, axis_s, axis_t)`, each `(*B, 3)`; those of `plane_axes` if left out.
        north_up: whether the first row is at t_max, as in maps; at t_min if not. `geotransform` goes with it.
        samples: how many samples a pixel takes along each side, or to the right and down; about as many as it covers
            pixels of the image, for each image by itself, if left out. Where it is said, nothing depends on values, as
            `torch.compile(fullgraph=True)` needs; 1 is fastest, and right where pixels are about equally large.
        size: `(width, height)` of the top view in pixels, in place of the resolution; extents of a compiled or
            exported graph's input need it.

    Returns:
        The top view `(*B, C, rows, columns)`, 0 where not valid; and `valid (*B, rows, columns)`: at least half of the
        pixel's samples are in the image.

    Raises:
        TypeError: the image is no floating-point tensor, or another argument is of the wrong kind.
        ValueError: an empty or infinite extent, a resolution that is not positive or too fine, no resolution and no
            size, or shapes or devices that do not fit.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
        >>> camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), size=(640, 480))
        >>> top, valid = rectify(torch.rand(3, 480, 640), camera, dp.Plane.z(0.0), (-100, -50, 100, 50), 2.0)
        >>> top.shape, bool(valid.all())
        (torch.Size([3, 50, 100]), True)
    """
    image, camera, plane, axes = _checked("image", image, camera, plane, axes)
    shape = shape_of(extent, resolution, size, camera.K)
    low, unit = cells(extent, shape, camera.K, north_up)
    shapes = {"plane": axes[0].shape[:-1], "extent": low.shape[:-1]}
    batch = broadcast_batches(image=image.shape[:-3], camera=camera.batch_shape, **shapes)
    _check_size(image, camera)
    warn_if_rounded(camera, plane)
    toward = _toward_cells(camera, axes, low, unit)

    def look_up_of(chosen: Chosen) -> LookUp:
        seen_by, matrix = camera, toward
        if chosen is not None:
            seen_by, matrix = camera.expand(*batch)[chosen], toward.expand(*batch, 3, 3)[chosen]

        def look_up(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            (u, v), valid = seen_by._pixels_along(linear(entries(matrix), [x, y, None]))
            return u, v, valid

        return look_up

    return resampled(image, look_up_of, shape, camera.K, _numbers(samples))


def _toward_cells(camera: Camera, axes: Axes, low: Tensor, unit: Tensor) -> Tensor:
    """The matrix `(*B, 3, 3)` from places `(x, y, 1)` in the top view, in its pixels, to directions of the camera."""
    origin, along_s, along_t = map(in_float64, axes)
    low, unit = in_float64(low).unsqueeze(-1), in_float64(unit).unsqueeze(-1)
    start = origin + low[..., 0, :] * along_s + low[..., 1, :] * along_t
    to_world = torch.stack(torch.broadcast_tensors(unit[..., 0, :] * along_s, unit[..., 1, :] * along_t, start), dim=-1)
    turned = (in_float64(camera.R).unsqueeze(-1) * to_world.unsqueeze(-3)).sum(-2)
    shift = torch.nn.functional.pad(in_float64(camera.t).unsqueeze(-1), (2, 0))
    return (turned + shift).to(camera.dtype)


def render(
    texture: Float[Tensor, "*batch c rows columns"],
    camera: Camera | PinholeCamera,
    plane: Plane,
    extent: Sequence[float] | Tensor | Array,
    size: tuple[int, int] | None = None,
    axes: Axes | None = None,
    north_up: bool = False,
    samples: int | tuple[int, int] | None = None,
) -> tuple[Float[Tensor, "*out c h w"], Bool[Tensor, "*out h w"]]:
    """Render a plane's texture into a camera's image: the inverse of `rectify`.

    Args:
        texture: `(*B, C, rows, columns)`, floating point, filling the extent.
        camera: with its pose, of batch shape `*B`.
        plane: of batch shape `*B`.
        extent: `(s_min, t_min, s_max, t_max)` in world units, along the plane's axes; `(*B, 4)` where each texture
            has its own.
        size: `(width, height)` of the image; the camera's if left out.
        axes: `(origin, axis_s, axis_t)`, each `(*B, 3)`; those of `plane_axes` if left out.
        north_up: whether the texture's first row is at t_max, as in maps; at t_min if not.
        samples: how many samples a pixel takes along each side, or to the right and down; about as many as it covers
            pixels of the texture, for each image by itself, if left out. Where it is said, nothing depends on values,
            as `torch.compile(fullgraph=True)` needs; 1 is fastest, and right where pixels are about equally large.

    Returns:
        The image `(*B, C, H, W)`, 0 where not valid; and `valid (*B, H, W)`: at least half of the pixel's samples are
        on the texture.

    Raises:
        TypeError: the texture is no floating-point tensor, or another argument is of the wrong kind.
        ValueError: an empty or infinite extent, no size, or shapes or devices that do not fit.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
        >>> camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000]), size=(640, 480))
        >>> image, valid = render(torch.ones(1, 50, 100), camera, dp.Plane.z(0.0), (-100, -50, 100, 50))
        >>> image.shape, int(valid.sum())  # 200 x 100 world units at 2 per pixel
        (torch.Size([1, 480, 640]), 5000)
    """
    texture, camera, plane, axes = _checked("texture", texture, camera, plane, axes)
    size = checked_size(size) or camera.size
    if size is None:
        raise ValueError("size: want (width, height), got None, and the camera has none")
    width, height = size
    if width * height > MOST_PIXELS:
        raise ValueError(f"size: want one that fits into memory, got {width} x {height} px")
    low, unit = cells(extent, texture.shape[-2:], camera.K, north_up)
    shapes = {"plane": plane.batch_shape, "axes": axes[0].shape[:-1], "extent": low.shape[:-1]}
    batch = broadcast_batches(texture=texture.shape[:-3], camera=camera.batch_shape, **shapes)

    def look_up_of(chosen: Chosen) -> LookUp:
        seen_by, on, vectors = camera, plane, [*axes, low, unit]
        if chosen is not None:
            seen_by, on = camera.expand(*batch)[chosen], plane.expand(*batch)[chosen]
            vectors = [vector.expand(*batch, vector.shape[-1])[chosen] for vector in vectors]
        start, s_axis, t_axis, corner, step = ([*vector.unsqueeze(-2).unbind(-1)] for vector in vectors)
        to_plane = PlaneMap.quietly(seen_by, on)

        def look_up(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            points, valid = to_plane(torch.stack([x - 0.5, y - 0.5], dim=-1))
            off = [part - first for part, first in zip(points.unbind(-1), start, strict=True)]
            u, v = (
                (sum(a * b for a, b in zip(off, axis, strict=True)) - corner[i]) / step[i] - 0.5
                for i, axis in enumerate((s_axis, t_axis))
            )
            return u, v, valid

        return look_up

    return resampled(texture, look_up_of, (height, width), camera.K, _numbers(samples))


def geotransform(
    extent: Sequence[float], resolution: float, origin: Sequence[float] = (0.0, 0.0)
) -> tuple[float, float, float, float, float, float]:
    """Where a top view of `rectify(..., north_up=True)` is on the map, as the six numbers that GDAL takes.

    They are `(x, dx, 0, y, 0, -dy)`: x and y of the outer corner of the first pixel, and the pixels' sides, so that
    column j and row i, counted from that corner, are at `x + j dx` and `y - i dy`. With rasterio,
    `Affine.from_gdal(*numbers)` is the transform.

    Args:
        extent: `(s_min, t_min, s_max, t_max)` as `rectify` took it, s to the east and t to the north.
        resolution: as `rectify` took it.
        origin: east and north of the world's origin on the map, where that is not the map's own: the offset that
            `camera.shifted` took off.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an empty or infinite extent, or a resolution that is not positive or too fine.

    Example:
        >>> geotransform((-20, 0, 20, 30), 0.5, origin=(642700, 8304290))
        (642680.0, 0.5, 0.0, 8304320.0, 0.0, -0.5)
    """
    rows, columns = shape_of(extent, resolution)
    east, north = numbers("origin", origin, "finite (east, north)", 2)
    width, height = sides_of(extent)
    s_min, _, _, t_max = (float(side) for side in extent)
    return east + s_min, width / columns, 0.0, north + t_max, 0.0, -height / rows


def _checked(
    name: str, image: Tensor, camera: Camera | PinholeCamera, plane: Plane, axes: Axes | None
) -> tuple[Tensor, Camera, Plane, Axes]:
    """The image or texture, camera, plane and axes, known to fit together.

    Raises:
        TypeError: one of them is of the wrong kind, or dtypes of camera, plane and axes differ.
        ValueError: shapes or devices do not fit.
    """
    if not isinstance(image, Tensor):
        raise TypeError(
            f"{name}: want a tensor (*B, C, H, W), got {called(image)}; kornia.utils.image_to_tensor(array) makes one "
            "of an image as OpenCV has it"
        )
    image, camera = check_tensor(name, image, "C", "H", "W"), as_camera(camera)
    if 0 in image.shape[-3:]:
        raise ValueError(f"{name}: want at least one channel and one pixel, got shape {tuple(image.shape)}")
    plane = as_plane(plane).like(camera.K)
    check_same_kind(camera=camera.K, plane=plane.normal)
    if image.device != camera.device:  # of another dtype it may be
        raise ValueError(f"{name}: want device {camera.device} as camera has, got {image.device}")
    shapes = {name: image.shape[:-3], "camera": camera.batch_shape, "plane": plane.batch_shape}
    if plane.is_per_point:
        raise ValueError("plane: want one plane for the whole image, got one for each point (Plane.per_point)")
    if axes is None:
        axes = plane_axes(plane)
    elif isinstance(axes, list | tuple) and len(axes) == 3:
        origin, along_s, along_t = (check_tensor("axes", axis, 3, like=camera.K) for axis in axes)
        axes = origin, along_s, along_t
        for axis in axes:
            check_same_kind(camera=camera.K, axes=axis)
            shapes["axes"] = broadcast_batches(axes=shapes.get("axes", ()), axis=axis.shape[:-1])
        origin, along_s, along_t = (axis.expand(*shapes["axes"], 3) for axis in axes)
        axes = origin, along_s, along_t
    else:
        raise TypeError(f"axes: want (origin, axis_s, axis_t) as plane_axes gives them, got {called(axes)}")
    broadcast_batches(**shapes)
    return image, camera, plane, axes


def _check_size(image: Tensor, camera: Camera) -> None:
    """An image of another size than the camera's is another image: content from somewhere else, or none."""
    height, width = image.shape[-2:]
    if camera.size not in (None, (width, height)):
        raise ValueError(
            f"image: want {camera.size[0]} x {camera.size[1]} px as the camera has, got {width} x {height}; "
            f"camera.resized(({width}, {height})) is the camera of the image or feature map at that size, and "
            "camera.warped(matrix, size=...) of one that was cut or turned"
        )


def _numbers(samples: int | tuple[int, int] | None) -> tuple[int, int] | None:
    """Of samples to the right and down."""
    if samples is None:
        return None
    want = f"a number of samples from 1 to {MAX_SUPERSAMPLING}, or two of them"
    both = samples if isinstance(samples, tuple | list) and len(samples) == 2 else (samples, samples)
    right, down = (whole_number("samples", one, want, least=1, most=MAX_SUPERSAMPLING) for one in both)
    return right, down
