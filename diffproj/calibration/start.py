"""The solver's starting point: from a camera that is known roughly, or from nothing but the size of the image."""

import math

import torch
from torch import Tensor

from diffproj.calibration import closed_form
from diffproj.calibration.data import Data
from diffproj.calibration.fit import normal_tensors
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.geometry.camera import Camera
from diffproj.geometry.intrinsics import check_no_skew
from diffproj.lens.models import MODELS, LensModel


def from_camera(camera: Camera, data: Data, bow: bool) -> tuple[Tensor, tuple[Tensor, Tensor], LensModel]:
    """Shared parameters and poses to start from."""
    parameters = Parametrisation.of(camera, bow)
    if None not in (camera.size, data.views.size) and camera.size != data.views.size:
        raise ValueError(
            f"camera: want the size of the photographs, {data.views.size}, got {camera.size}; see resized()"
        )
    camera = camera.detach().to(data.points.device, data.points.dtype)
    check_no_skew(camera.K)
    posed = len(camera.batch_shape) == len(data.batch) + 1
    intrinsics = camera[..., 0] if posed else camera
    try:
        if posed:
            camera = camera.at(camera.R.expand(*data.batch, len(data.views), 3, 3), camera.t)
        shared = parameters.pack(intrinsics).expand(*data.batch, -1).reshape(-1, parameters.size)
    except (RuntimeError, ValueError):
        shape = tuple(camera.batch_shape)
        raise ValueError(
            f"camera: want a batch shape that broadcasts to {tuple(data.batch)} or is {(*data.batch, len(data.views))} "
            f"with the poses to start from, got {shape}"
        ) from None
    if posed:
        return (
            shared,
            (camera.R.reshape(-1, len(data.views), 3, 3), camera.t.reshape(-1, len(data.views), 3)),
            parameters.lens,
        )
    upright = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(*data.used.shape[:2], 3, 3)
    views = parameters.unpack(shared, (upright, torch.zeros_like(upright[..., 0])))
    direction, valid = views.directions(data.pixels)
    ahead = valid & (direction[..., 2] > 0.25 * direction.norm(dim=-1))
    xy = direction[..., :2] / torch.where(ahead, direction[..., 2], 1.0).unsqueeze(-1)
    H = closed_form.homographies(data.points, xy, data.used & ahead)
    return shared, closed_form.poses(H, data.points), parameters.lens


def from_nothing(
    data: Data, model: LensModel, size: tuple[int, int], tied: bool, bow: bool
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Shared parameters and poses to start from, with nothing known but the size of the image."""
    with torch.inference_mode():
        middle = data.pixels.new_tensor([(size[0] - 1) / 2, (size[1] - 1) / 2]).expand(len(data.pixels), 2)
        rest = middle.new_zeros(len(middle), MODELS[model].count + 2 * bow)
        if model == "fisheye":
            found = _fisheye(data, middle, rest, float(max(size)), bow)
        else:
            found = _perspective(data, middle, rest, size, tied, model != "none")
    return normal_tensors(found)


def _perspective(
    data: Data, middle: Tensor, rest: Tensor, size: tuple[int, int], tied: bool, bent: bool
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Straighten the image with a lens of one number, then Zhang's equations."""
    radius = 0.5 * math.hypot(*size)
    lam, H = torch.zeros_like(middle[:, 0]), None
    if bent:
        lam, H = closed_form.division(data.points, data.pixels, data.used, middle, radius)
    if H is None:
        straight = closed_form.without_division(data.pixels, middle, lam, radius) if bent else data.pixels
        H = closed_form.homographies(data.points, straight, data.used)
    f = closed_form.focal_lengths(H, middle, float(max(size)), data.used.any(-1), tied)
    upper = (H[..., :2, :] - middle[:, None, :, None] * H[..., 2:, :]) / f[:, None, :, None]
    pose = closed_form.poses(torch.cat([upper, H[..., 2:, :]], dim=-2), data.points)
    if bent:
        # distorted = centred (1 + lambda |distorted|^2) = centred (1 + k1 r^2 + 2 k1^2 r^4 + ...)
        k1 = lam * (f.mean(-1) / radius).square()
        rest = torch.cat([k1.unsqueeze(-1), 2 * k1.square().unsqueeze(-1), rest[:, 2:]], dim=-1)
    return torch.cat([f, middle, rest], dim=-1), pose


def _fisheye(
    data: Data, middle: Tensor, rest: Tensor, longer: float, bow: bool
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Of equidistant lenses with several focal lengths, the one whose poses explain the corners best."""
    problem = data.task("fisheye", bow=bow).problem
    tries = []
    for scale in closed_form.FISHEYE_SCALE:
        f = middle.new_full((len(middle), 1), scale * longer / torch.pi)
        xy, inside = closed_form.equidistant_rays(data.pixels, middle, f[:, 0])
        pose = closed_form.poses(closed_form.homographies(data.points, xy, data.used & inside), data.points)
        shared = torch.cat([f, f, middle, rest], dim=-1)
        cost = problem.linearise(shared, pose)[:, :, -1].square().sum((1, 2, 3))
        tries.append((torch.where(cost.isfinite(), cost, torch.inf), shared, *pose))
    costs, *starts = (torch.stack(parts) for parts in zip(*tries, strict=True))
    best = costs.argmin(0), torch.arange(len(middle), device=middle.device)
    shared, R, t = (candidates[best] for candidates in starts)
    return shared, (R, t)
