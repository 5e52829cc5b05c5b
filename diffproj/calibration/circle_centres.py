"""The middle of a circle's image is not the image of its centre: by how much, and calibrating with that known.

A camera sees a circle at a slant as an ellipse, bent by the lens, whose middle lies on the near side of the centre's
image (Heikkilä and Silvén, 1997). How far depends on camera and pose, which is what is sought: the fit is
repeated with the middles moved by what the fit before says, until they stay. Of a minimum that carries gradients so
does the correction, which is a hundredth of what the corners do: one fit before the last holds it to a ten-thousandth.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.target import Target
from diffproj.targets.views import Views

ROUNDS = 6
"""Most fits. Two settle nearly all, three the largest circles."""

SETTLED = 1e-3
"""Change of a correction in px below which no other fit is made: far below the accuracy of a middle."""

ALONG = 24
"""Points of a circle whose images say where its ellipse is."""


def with_true_centres(fit: Callable[[Views], Calibration], views: Views, target: Target) -> Calibration:
    """A fit; of circles, one to where their centres are seen, which `Calibration.views` holds then.

    Args:
        fit: makes a calibration from views.
        views: as detected: of circles, the middles of their images.
        target: what the views show.
    """
    found = fit(views)
    if not isinstance(target, CircleGrid):
        return found
    shift = torch.zeros_like(views.pixels)
    for _ in range(ROUNDS):
        before, shift = shift, _shift(found, target).to(shift)
        change = (shift - before).norm(dim=-1)[views.visible]
        if not bool((change > SETTLED).any()):
            break
        found = fit(Views.unchecked(views.pixels - shift, views.visible, views.names, views.size, views.told))
    return found


def _shift(found: Calibration, target: CircleGrid) -> Float[Tensor, "*batch v n 2"]:
    """The middles minus the centres' images in px, with their graph; zero where there is no camera to tell."""
    shift = middle_minus_centre(found.cameras, target)
    known = found.converged[..., None, None] & found.used.any(-1, keepdim=True)
    return torch.where(known.unsqueeze(-1), shift, 0.0)


def middle_minus_centre(camera: Camera, target: CircleGrid) -> Float[Tensor, "*batch n 2"]:
    """How far the middle of each circle's image lies from its centre's image, in px; zero where not all is seen.

    Without a lens, the image is an ellipse, and its middle is exact. A lens bends it a little; the ellipse is then the
    one that suits its outline best, which is what is fitted in a photograph.

    Args:
        camera: at its poses, batch shape `*B`.
        target: the circles.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], dtype=torch.float64)
        >>> R = dp.rotation_from_euler(*torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64))
        >>> camera = dp.Camera(K, R, torch.tensor([-20.0, -10, 150], dtype=torch.float64), size=(640, 480))
        >>> shift = middle_minus_centre(camera, dp.CircleGrid(3, 2, spacing=20.0, diameter=15.0))
        >>> [round(v, 2) for v in shift[0].tolist()]
        [-0.08, -0.78]
    """
    points = target.points.to(camera.K)
    angle = torch.arange(ALONG, dtype=points.dtype, device=points.device) * (2 * math.pi / ALONG)
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1) * (target.diameter / 2)
    outline, outline_seen = camera.project((points[:, None] + circle).flatten(0, 1))
    centre, seen = camera.project(points)
    outline = outline.unflatten(-2, (len(points), ALONG)) - centre.unsqueeze(-2)
    seen = seen & outline_seen.unflatten(-1, (len(points), ALONG)).all(-1)
    size = outline.norm(dim=-1).mean(-1)[..., None, None].clamp_min(1e-9)
    x, y = torch.where(seen[..., None, None], outline / size, torch.stack([angle.cos(), angle.sin()], -1)).unbind(-1)
    conic = torch.stack([x * x, x * y, y * y, x, y], dim=-1)
    a, b, c, d, e = torch.linalg.lstsq(conic, torch.ones_like(x).unsqueeze(-1)).solution.squeeze(-1).unbind(-1)
    determinant = 4 * a * c - b * b
    good = (seen & (determinant > 0)).unsqueeze(-1)
    determinant = torch.where(good, determinant.unsqueeze(-1), 1.0)
    middle = torch.stack([b * e - 2 * c * d, b * d - 2 * a * e], dim=-1) / determinant
    return torch.where(good, middle * size.squeeze(-1), 0.0)
