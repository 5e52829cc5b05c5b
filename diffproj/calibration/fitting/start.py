"""The solver's starting point: from a camera that is known roughly, or from nothing but the size of the image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffproj.calibration.fitting import closed_form, given
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import normal_tensors
from diffproj.calibration.fitting.space_poses import space_poses
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import posed
from diffproj.calibration.problem.parametrisation import Parametrisation, Pose
from diffproj.geometry.camera import Camera
from diffproj.lens.models import MODELS, LensModel, model_of


def from_camera(
    camera: Camera, data: Data, bow: bool, skew: bool = False, with_poses: bool = True
) -> tuple[Tensor, Pose, Parametrisation]:
    """Shared parameters and poses to start from, and which parameters they are.

    A camera whose image is turned is replaced by the one that is turned itself, and sees the same. Gradients flow from
    the shared parameters to the camera; poses carry none.

    Args:
        camera: where its batch shape broadcasts to the views' `*B`, it gives intrinsics alone; where it broadcasts to
            `(*B, V)` instead, poses too, and the intrinsics are those of its first view.
        data: the views.
        bow: whether the board's bow is among the parameters.
        skew: whether the skew is, even where K has none.
        with_poses: whether the camera may bring poses.

    Raises:
        TypeError: the lens is of another package.
        ValueError: sizes or shapes do not fit, the image is turned against a tilted sensor, or values that are needed
            are not a camera's.
    """
    model_of(camera.distortion)
    if camera.K.is_meta:
        raise ValueError("camera: want one with values, got one on the meta device")
    given.check_size(camera.size, data.views.size)
    camera = camera.to(data.points.device, data.points.dtype)
    batch, V = tuple(data.batch), len(data.views)
    posed = not broadcasts(camera.batch_shape, batch)
    if posed and not (with_poses and broadcasts(camera.batch_shape, (*batch, V))):
        ways = f", or to {(*batch, V)} with the poses to start from" if with_poses else ""
        remedy = "" if with_poses else "; index it, or take calibration.camera"
        raise ValueError(
            f"camera: want a batch shape that broadcasts to {batch}{ways}, got {tuple(camera.batch_shape)}{remedy}"
        )
    intrinsics = camera[..., 0] if posed else camera
    given.check_finite(intrinsics.K)
    if bool((camera.K[..., 1, 0] != 0).any()) or bool((camera.K[..., [0, 1], [0, 1]] < 0).all(-1).any()):
        camera = camera.upright()
        intrinsics = camera[..., 0] if posed else camera
    parameters = Parametrisation.of(intrinsics, bow, skew)
    shared = parameters.pack(intrinsics).expand(*batch, -1).reshape(-1, parameters.size)
    camera, held = camera.detach(), shared.detach()
    given.check_resolution(held[:, 2:4], data.pixels, data.used, camera.size, data.views.size)
    if posed:
        R, t = camera.R.expand(*batch, V, 3, 3), camera.t.expand(*batch, V, 3)
        # A view without enough corners takes no part: its pose may be anything.
        idle = ~data.used.any(-1).reshape(*batch, V, 1)
        R = torch.where(idle.unsqueeze(-1), torch.eye(3, dtype=R.dtype, device=R.device), R)
        t = torch.where(idle, t.new_tensor([0.0, 0, 1]), t)
        given.check_poses(R, t, data.views.names)
        R, t = R.reshape(-1, V, 3, 3), t.reshape(-1, V, 3)
        return shared, data.frame.pose(R, t), parameters
    task = data.task(parameters.lens, bow=parameters.bow, skew=parameters.skew)
    poses = candidate_poses(task, held)
    return shared, poses[0] if len(poses) == 1 else best_pose(task, held, poses), parameters


def poses_from_camera(task: Task, shared: Tensor) -> list[Pose]:
    """Poses `(P, V, ...)` that may explain the corners, from shared parameters `(P, s)`: each is worth a solver's run.

    A plane has two, each the mirror image of the other at the line of sight; points in space may have more.
    """
    poses = candidate_poses(task, shared)
    R, t = poses[0]
    return [*poses, closed_form.other_pose(R, t, task.points)]


def candidate_poses(task: Task, shared: Tensor) -> list[Pose]:
    """The pose of each view by its corners' rays; of points in space several."""
    upright = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(*task.used.shape[:2], 3, 3)
    views = task.parameters.unpack(shared, (upright, torch.zeros_like(upright[..., 0])))
    direction, valid = views.directions(task.pixels)
    if task.solid:
        return space_poses(task.points, direction, task.used & valid)
    perspective = MODELS[task.lens].perspective
    return [closed_form.poses_along(task.points, direction, task.used & valid, perspective)]


def best_pose(task: Task, shared: Tensor, poses: Sequence[Pose]) -> Pose:
    """Of several poses `(P, V, ...)` of each view the one that ends lowest, with the shared parameters held."""
    p, v = task.used.any(-1).nonzero(as_tuple=True)
    best = tuple(z.clone() for z in poses[0])
    if len(p) == 0:
        return best
    with torch.inference_mode():
        refined, costs = posed(task, shared, poses, p, v)
        lowest = costs.nan_to_num(torch.inf, torch.inf).argmin(0)
        chosen = [z[lowest, torch.arange(len(p), device=p.device)] for z in refined]
        best = tuple(z.index_put((p, v), new) for z, new in zip(best, chosen, strict=True))
    return normal_tensors(best)


def broadcasts(shape: Sequence[int], to: Sequence[int]) -> bool:
    """Whether a tensor of that shape expands to the other."""
    if len(shape) > len(to):
        return False
    return all(mine in (1, theirs) for mine, theirs in zip(reversed(shape), reversed(to), strict=False))


@dataclass(frozen=True, eq=False)
class Straightened:
    """Corners as a first estimate of the lens straightens them, for starts at any focal length.

    Attributes:
        model: the lens that is to be fitted.
        seen: the corners `(P, V, N, 2)` in px.
        middle: the middle of the image `(P, 2)`, which stands for the principal point.
        lam: the lens as the one number `(P,)` of the division model; 0 for a fisheye, which is taken as equidistant.
        size: `(width, height)` of the image.
        aspect: `f_y / f_x` `(P,)`.
    """

    model: LensModel
    seen: Tensor
    middle: Tensor
    lam: Tensor
    size: tuple[int, int]
    aspect: Tensor

    @property
    def longer(self) -> float:
        """The image's longer side in px."""
        return float(max(self.size))

    @property
    def radius(self) -> float:
        """Half the image's diagonal in px, the unit of `lam`."""
        return 0.5 * math.hypot(*self.size)

    @property
    def lens(self) -> LensModel:
        """The lens that the straightened corners are seen through."""
        return "none" if MODELS[self.model].perspective else "fisheye"

    @property
    def pixels(self) -> Tensor:
        """The straightened corners `(P, V, N, 2)` in px; of a fisheye, as they are."""
        return closed_form.without_division(self.seen, self.middle, self.lam, self.radius)

    def part(self, which: Tensor) -> "Straightened":
        """That of some of the cameras `(n,)`."""
        cut = {name: getattr(self, name)[which] for name in ("seen", "middle", "lam", "aspect")}
        return replace(self, **cut)

    def without_lens(self) -> "Straightened":
        """The same with no lens estimated."""
        return replace(self, lam=torch.zeros_like(self.lam))

    def around(self, middle: Tensor) -> "Straightened":
        """The same with no lens estimated, and with other principal points `(P, 2)`."""
        return replace(self.without_lens(), middle=middle)

    def elsewhere(self, task: Task) -> "Straightened":
        """The same with no lens estimated, and with principal point and ratio of focal lengths by Zhang's equations."""
        H = closed_form.homographies(task.points, self.seen, task.used)
        seen = task.used.any(-1)
        f, middle, found = closed_form.intrinsics(H, self.middle, self.longer, seen)
        square = closed_form.principal_point(H, self.middle, self.longer, seen)
        middle = torch.where(found.unsqueeze(-1), middle, square)
        return replace(self.without_lens(), middle=middle, aspect=f[:, 1] / f[:, 0])

    def rays(self, f: Tensor) -> tuple[Tensor, Tensor]:
        """Points `(P, V, N, 2)` of the normalised plane at focal lengths `(P,)`, and which are not too far out."""
        if self.lens == "fisheye":
            return closed_form.equidistant_rays(self.seen, self.middle, f)
        f = torch.stack([f, f * self.aspect], dim=-1)
        xy = (self.pixels - self.middle[:, None, None]) / f[:, None, None]
        return xy, torch.ones_like(xy[..., 0], dtype=torch.bool)

    def held(self, f: Tensor) -> Tensor:
        """Shared parameters of `lens` at focal lengths `(P, 2)` or `(P,)`: the camera of the straightened corners."""
        f = f if f.ndim == 2 else torch.stack([f, f * self.aspect], dim=-1)
        return torch.cat([f, self.middle, f.new_zeros(len(f), MODELS[self.lens].count)], dim=-1)

    def shared(self, f: Tensor, size: int) -> Tensor:
        """Shared parameters `(P, size)` of the model, to start from, at focal lengths `(P, 2)` or `(P,)`."""
        held = self.held(f)
        start = torch.nn.functional.pad(held, (0, size - held.shape[-1]))
        if MODELS[self.model].count and self.lens == "none":
            # distorted = centred (1 + lambda |distorted|^2) = centred (1 + k1 r^2 + 2 k1^2 r^4 + ...)
            k1 = self.lam * (held[:, :2].mean(-1) / self.radius).square()
            start[:, 4], start[:, 5] = k1, 2 * k1.square()
        return start


def from_nothing(
    data: Data, size: tuple[int, int], tied: bool, parameters: Parametrisation
) -> tuple[Tensor, Pose, Straightened]:
    """Shared parameters and poses to start from, with nothing known but the size of the image."""
    with torch.inference_mode():
        middle = data.pixels.new_tensor([(size[0] - 1) / 2, (size[1] - 1) / 2]).expand(len(data.pixels), 2)
        zero = torch.zeros_like(middle[:, 0])
        straight = Straightened(parameters.lens, data.pixels, middle, zero, size, zero + 1)
        count = parameters.size
        if straight.lens == "fisheye":
            shared, pose = _fisheye(data, straight, parameters)
        else:
            shared, pose, straight = _perspective(data, straight, count, tied)
    return (*normal_tensors((shared, pose)), straight)


def _perspective(data: Data, straight: Straightened, count: int, tied: bool) -> tuple[Tensor, Pose, Straightened]:
    """Straighten the image with a lens of one number, then Zhang's equations."""
    middle, H = straight.middle, None
    if MODELS[straight.model].count:
        lam, H = closed_form.division(data.points, data.pixels, data.used, middle, straight.radius)
        straight = replace(straight, lam=lam)
    if H is None:
        H = closed_form.homographies(data.points, straight.pixels, data.used)
    f = closed_form.focal_lengths(H, middle, straight.longer, data.used.any(-1), tied)
    upper = (H[..., :2, :] - middle[:, None, :, None] * H[..., 2:, :]) / f[:, None, :, None]
    pose = closed_form.poses(torch.cat([upper, H[..., 2:, :]], dim=-2), data.points)
    return straight.shared(f, count), pose, straight


def _fisheye(data: Data, straight: Straightened, parameters: Parametrisation) -> tuple[Tensor, Pose]:
    """Of equidistant lenses with several focal lengths, the one whose poses explain the corners best."""
    problem = data.task("fisheye", bow=parameters.bow, skew=parameters.skew).problem
    tries = []
    for scale in closed_form.FISHEYE_SCALE:
        f = straight.middle.new_full((len(straight.middle),), scale * straight.longer / torch.pi)
        xy, inside = straight.rays(f)
        pose = closed_form.poses(closed_form.homographies(data.points, xy, data.used & inside), data.points)
        shared = straight.shared(f, parameters.size)
        cost = problem.linearise(shared, pose)[:, :, -1].square().sum((1, 2, 3))
        tries.append((torch.where(cost.isfinite(), cost, torch.inf), shared, *pose))
    costs, *starts = (torch.stack(parts) for parts in zip(*tries, strict=True))
    best = costs.argmin(0), torch.arange(len(costs[0]), device=costs.device)
    shared, R, t = (candidates[best] for candidates in starts)
    return shared, (R, t)
