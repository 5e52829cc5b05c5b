"""The shared unknowns of a rig: which they are, and where they stand."""

from dataclasses import dataclass

from diffproj.calibration.problem.parametrisation import BOW, POSE, Parametrisation
from diffproj.calibration.problem.shape import names_of

POSE_NAMES = ("omega_x", "omega_y", "omega_z", "tau_x", "tau_y", "tau_z")
"""How the pose of a camera moves in the rig, about and along the camera's axes."""


@dataclass(frozen=True)
class RigParameters:
    """The shared unknowns of a rig: which they are, and where they stand.

    Attributes:
        cameras: their names.
        kinds: the parameters of each.
        points: how many points of the target are free; 0 where their places are known.
        bow: whether the board's bow is among them.
    """

    cameras: tuple[str, ...]
    kinds: tuple[Parametrisation, ...]
    points: int = 0
    bow: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """`left.f_x`, ..., `right.tau_z`."""
        parts = []
        for number, (camera, kind) in enumerate(zip(self.cameras, self.kinds, strict=True)):
            own = kind.names if number == 0 else (*kind.names, *POSE_NAMES)
            parts += [f"{camera}.{name}" for name in own]
        return (*parts, *(BOW if self.bow else ()), *names_of(self.points))

    @property
    def size(self) -> int:
        """How many there are."""
        return self.few + 2 * self.bow + 3 * self.points

    @property
    def few(self) -> int:
        """How many there are without the target's shape."""
        return sum(kind.size + POSE for kind in self.kinds) - POSE

    def intrinsics(self, camera: int) -> slice:
        """Where those of a camera stand."""
        start = sum(kind.size + POSE for kind in self.kinds[:camera]) - POSE * (camera > 0)
        return slice(start, start + self.kinds[camera].size)

    def pose(self, camera: int) -> slice:
        """Where the pose of a camera stands; for the first behind the last, where nothing is."""
        if camera == 0:
            return slice(self.size, self.size + POSE)
        end = self.intrinsics(camera).stop
        return slice(end, end + POSE)

    def columns(self, camera: int) -> list[int]:
        """Those of intrinsics and pose of a camera."""
        own, pose = self.intrinsics(camera), self.pose(camera)
        return [*range(own.start, own.stop), *range(pose.start, pose.stop)]

    @property
    def poses(self) -> list[list[int]]:
        """Where the six unknowns of each camera's pose stand; for the first behind the last unknown."""
        slices = [self.pose(camera) for camera in range(len(self.cameras))]
        return [list(range(one.start, one.stop)) for one in slices]

    @property
    def alike(self) -> dict[Parametrisation, list[int]]:
        """The numbers of the cameras of each kind."""
        found: dict[Parametrisation, list[int]] = {}
        for number, kind in enumerate(self.kinds):
            found.setdefault(kind, []).append(number)
        return found

    def columns_of_views(self, camera: int) -> list[int]:
        """Those that the views of a camera depend on, but for free points: intrinsics, the bow, and its pose."""
        own, bow = self.columns(camera), range(self.few, self.few + 2 * self.bow)
        return [*own[:-POSE], *bow, *own[-POSE:]]
