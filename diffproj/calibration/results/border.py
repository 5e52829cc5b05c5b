"""How much of an image's border a camera has rays for: the rest lies beyond the fold of its lens."""

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.geometry.camera import Camera

PIXELS = 16
"""Along each side, so many are looked at."""


def border_with_rays(camera: Camera, size: tuple[int, int]) -> Float[Tensor, "*batch"]:
    """The part of the image's border `(*B,)`, from 0 to 1, whose pixels have rays."""
    along = torch.linspace(0, 1, PIXELS + 1, dtype=camera.dtype, device=camera.device)[:-1]
    zero, one = torch.zeros_like(along), torch.ones_like(along)
    sides = (along, zero), (one, along), (1 - along, one), (zero, 1 - along)
    unit = torch.cat([torch.stack(side, dim=-1) for side in sides])
    _, valid = camera.directions(unit * unit.new_tensor([size[0] - 1.0, size[1] - 1.0]))
    return valid.to(camera.dtype).mean(-1)
