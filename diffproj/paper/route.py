"""The paper's own route from a pixel to a plane, equation by equation: the readable reference beside the kernel.

Siswantoro, Prabuwono and Abdullah (2013), Eq. 3-14. The pixel is first moved into the world as a point of the image
plane, then joined with the centre of projection to a line, then the line is intersected with the plane. Large numbers
are subtracted twice (`R^-1 (p_c - T)`, then `- O_c`), and the cancellation costs two digits: use it in float64, as the
reference that `back_project` is tested against.
"""

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import Array, number
from diffproj._core.numerics import broadcast_batches, check_same_kind, transform
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane, as_plane


def paper_route(
    pixels: Float[Tensor, "*#batch n 2"] | Array,
    camera: Camera | PinholeCamera,
    plane: Plane,
    focal_length: float = 1.0,
) -> Float[Tensor, "*#batch n 3"]:
    """Back-project pixels exactly as the paper does, which has neither a lens nor invalid rays.

    Args:
        pixels: `(*B, N, 2)`.
        camera: a pinhole camera without skew, of batch shape `*B`, or Kornia's `PinholeCamera`.
        plane: a plane of batch shape `*B`.
        focal_length: the paper's `f` in world units; with `s_x = f_x / f` and `s_y = f_y / f` it cancels.

    Returns:
        World points `(*B, N, 3)`; infinite or NaN where `n . v = 0`.

    Raises:
        TypeError: as `back_project`, or the focal length is no number.
        ValueError: as `back_project`, the camera has a lens, which the paper neglects, or the focal length is not
            positive.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> camera = Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=torch.float64))
        >>> paper_route(torch.tensor([[370.0, 240.0]], dtype=torch.float64), camera, Plane.z(0.0)).tolist()
        [[100.0, 0.0, 0.0]]
    """
    camera = as_camera(camera)
    if camera.distortion is not None:
        raise ValueError("camera: want a pinhole, for the paper neglects the lens; undistort the pixels first")
    plane = as_plane(plane).like(camera.K)
    check_same_kind(camera=camera.K, plane=plane.normal)
    pixels = camera._checked("pixels", pixels, 2)
    broadcast_batches(camera=camera.batch_shape, plane=plane.batch_shape, pixels=pixels.shape[:-2])
    focal_length = number("focal_length", focal_length, "a length in world units, above 0", above=0)
    n, d = plane.normal.unsqueeze(-2), plane.offset.unsqueeze(-1)
    R, T = camera.R, camera.t.unsqueeze(-2)
    f_x, f_y = camera.K[..., 0, 0, None], camera.K[..., 1, 1, None]
    c_x, c_y = camera.K[..., 0, 2, None], camera.K[..., 1, 2, None]
    f = torch.full_like(f_x, focal_length)
    s_x, s_y = f_x / f, f_y / f
    u, v = pixels.unbind(-1)

    O_c = -transform(R.mT, T)  # Eq. 3
    x_c = (u - c_x) / s_x  # Eq. 4
    y_c = (v - c_y) / s_y  # Eq. 5
    p_c = torch.stack(torch.broadcast_tensors(x_c, y_c, f), dim=-1)  # Eq. 6
    p_w = transform(R.mT, p_c - T)  # Eq. 7
    line = p_w - O_c  # Eq. 8
    t = (d - (n * O_c).sum(dim=-1)) / (n * line).sum(dim=-1)  # Eq. 10, 11
    return O_c + t.unsqueeze(-1) * line  # Eq. 9, 12-14
