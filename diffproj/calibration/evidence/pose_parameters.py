"""The parameters that evidence tells of one mounted camera: intrinsics, lens, and how it is mounted, as one vector.

    f_x f_y c_x c_y | lens | skew | tilt roll heading | x y height            angles in degrees

Where nobody speaks of tilt, roll or heading, `turn_x turn_y turn_z` stand in their place: a turn of the camera about
its own axes from where it starts, in degrees too. It has no direction in which two angles turn the same way, as tilt 90
has.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.numerics import dot
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.geometry.camera import Camera
from diffproj.geometry.cayley import turned
from diffproj.geometry.mounting import mounting_from_rotation, rotation_from_mounting

ANGLES = ("tilt", "roll", "heading")
PLACE = ("x", "y", "height")
MOUNTING = (*ANGLES, *PLACE)
"""The six names of a mounting, in the order of the parameters."""
TURNS = ("turn_x", "turn_y", "turn_z")
GROUPS = {"position": ("x", "y"), "mounting": MOUNTING, "turn": TURNS}


@dataclass(frozen=True)
class PoseParameters:
    """The parameters of cameras that start from one.

    Attributes:
        camera: intrinsics and lens as names.
        start: rotations world to camera `(P, 3, 3)` that turns are about; `None` where angles are parameters.
    """

    camera: Parametrisation
    start: Tensor | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters in their order."""
        return (*self.camera.names, *(ANGLES if self.start is None else TURNS), *PLACE)

    def positions(self, option: str, name: str) -> list[int]:
        """Where a parameter stands, or a group: those of the camera, `position` and `mounting`.

        Args:
            option: which asks, for the message.
            name: of a parameter or a group.

        Raises:
            ValueError: no such name.
        """
        members = GROUPS.get(name, (name,))
        if set(members) <= set(self.names):
            return [self.names.index(member) for member in members]
        if name in ("focal", "principal_point", *(["distortion"] if self.camera.coefficient_names else [])):
            return self.camera.positions(option, name)
        groups = ["position", "mounting", "turn", "focal", "principal_point", "distortion"]
        offered = ", ".join([*MOUNTING, *TURNS, *groups, *self.camera.names])
        raise ValueError(f"{option}: want names from {offered}, got {name!r}")

    def pack(self, camera: Camera) -> Float[Tensor, "*batch q"]:
        """The parameters of cameras `(*B, q)`, upright ones."""
        if self.start is None:
            angles = torch.stack(mounting_from_rotation(camera.R), dim=-1)
        else:
            angles = camera.t.new_zeros(*camera.t.shape)
        return torch.cat([self.camera.pack(camera), angles, camera.center], dim=-1)

    def rotation(self, values: Float[Tensor, "p q"]) -> Float[Tensor, "p 3 3"]:
        """The rotations world to camera."""
        angles = values[..., -POSE:-3]
        if self.start is not None:
            return turned(self.start, angles.deg2rad())
        return rotation_from_mounting(*angles.unbind(-1))

    def unpack(self, values: Float[Tensor, "p q"], batch: Sequence[int], size: tuple[int, int] | None) -> Camera:
        """The cameras of batch shape `batch`, P of them, without a look at the values."""
        R = self.rotation(values)
        t = -dot(R, values[..., -3:].unsqueeze(-2))
        shared = values[..., :-POSE].reshape(*batch, self.camera.size)
        flat = self.camera.unpack(shared, (R.reshape(*batch, 3, 3), t.reshape(*batch, 3)))
        return Camera.unchecked(flat.K, flat.R, flat.t, flat.distortion, size)
