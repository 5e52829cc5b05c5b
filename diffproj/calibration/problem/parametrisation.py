"""The parameters of a calibration as a vector: their names and order, and the way from a camera to it and back.

The views of a camera share

    f_x f_y c_x c_y | coefficients of the lens | skew | bow_x bow_y, or x_0 y_0 z_0 x_1 ...

in pixels, without unit, in pixels, and in world units. The skew is `K[0, 1]`; it and the target's shape, its bow or the
displacement of each of its points, are there only where they are fitted, or where K has skew that is held. Each view
has a pose of its own, `(R, t)`, which moves by six numbers, in radians about the camera's axes and in world units:

    omega (3) | tau (3)        R <- exp(omega) R, t <- t + tau

Whoever fits, names, prints, stores or differentiates parameters takes the order from here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj.calibration.problem.shape import AXES, names_of
from diffproj.geometry.camera import Camera
from diffproj.geometry.cayley import turned
from diffproj.geometry.intrinsics import focal_and_center, intrinsic_matrix
from diffproj.lens.models import MODELS, LensModel, coefficients_of, model_of

POSE = 6
"""Coordinates of a pose: omega and tau."""
INTRINSICS = ("f_x", "f_y", "c_x", "c_y")
SKEW = "skew"
BOW = ("bow_x", "bow_y")

Pose = tuple[Tensor, ...]
"""Rotations `(*, 3, 3)` and translations `(*, 3)`, world to camera."""


@dataclass(frozen=True)
class Parametrisation:
    """Which parameters the views of a camera share.

    Attributes:
        lens: the lens model.
        bow: whether the board's bow is among them.
        skew: whether the skew of K is.
        points: how many points of the target are free; 0 where their places are known.

    Example:
        >>> import diffproj as dp
        >>> camera = dp.calibrate(dp.example_views("left"), dp.Chessboard(), "brown4").camera
        >>> parameters = Parametrisation.of(camera)
        >>> parameters.names
        ('f_x', 'f_y', 'c_x', 'c_y', 'k1', 'k2', 'p1', 'p2')
        >>> shared = parameters.pack(camera)
        >>> torch.equal(parameters.unpack(shared, (camera.R, camera.t)).K, camera.K)
        True
    """

    lens: LensModel
    bow: bool = False
    skew: bool = False
    points: int = 0

    @classmethod
    def of(cls, camera: Camera, bow: bool = False, skew: bool = False, points: int = 0) -> "Parametrisation":
        """That of a camera, with the skew also where its K has some.

        Raises:
            TypeError: its lens is of another package.
        """
        model = model_of(camera.distortion)
        skewed = has_values(camera.K) and bool((camera.K[..., 0, 1] != 0).any())
        return cls(model.name, bow, skew or skewed, points)

    @property
    def of_camera(self) -> "Parametrisation":
        """The same without the shape of the target."""
        return replace(self, bow=False, points=0)

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """The names of the lens's coefficients."""
        return MODELS[self.lens].coefficient_names

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the s shared parameters in their order."""
        return (*self.few_names, *names_of(self.points))

    @property
    def few_names(self) -> tuple[str, ...]:
        """The same without the displacements of points."""
        return (*INTRINSICS, *self.coefficient_names, *([SKEW] if self.skew else ()), *(BOW if self.bow else ()))

    @property
    def size(self) -> int:
        """s, how many there are."""
        return self.few + 3 * self.points

    @property
    def few(self) -> int:
        """How many there are without the displacements of points."""
        return self.lens_end + self.skew + 2 * self.bow

    @property
    def lens_end(self) -> int:
        """How many there are without the skew and the target's shape."""
        return len(INTRINSICS) + MODELS[self.lens].count

    def pack(
        self,
        camera: Camera,
        bow: Float[Tensor, "*batch 2"] | None = None,
        displacements: Float[Tensor, "*batch n 3"] | None = None,
    ) -> Float[Tensor, "*batch s"]:
        """The shared parameters `(*B, s)` of a camera with an upper triangular K.

        Without a bow, or displacements of the points, the target is as it should be.

        Skew that is not among the parameters is left out.

        Raises:
            TypeError: its lens is of another package.
        """
        intrinsics = focal_and_center(camera.K)
        coefficients = coefficients_of(camera.distortion, intrinsics)
        parts = [intrinsics, coefficients.expand(*camera.batch_shape, coefficients.shape[-1])]
        if self.skew:
            parts.append(camera.K[..., 0, 1:2])
        if self.bow:
            parts.append(intrinsics.new_zeros(*camera.batch_shape, 2) if bow is None else bow.to(intrinsics))
        if self.points:
            nothing = intrinsics.new_zeros(*camera.batch_shape, 3 * self.points)
            parts.append(nothing if displacements is None else displacements.to(intrinsics).flatten(-2))
        return torch.cat(parts, dim=-1)

    def unpack(self, shared: Float[Tensor, "*batch s"], pose: Pose) -> Camera:
        """The camera at poses, without a look at the values.

        Args:
            shared: `(*B, s)`.
            pose: with batch axes `(*B, *V)`, those of `shared` in front.
        """
        R, t = pose
        batch = R.shape[:-2]
        shared = shared.reshape(*shared.shape[:-1], *(1,) * (R.ndim - 1 - shared.ndim), shared.shape[-1])
        skew = shared[..., self.lens_end] if self.skew else None
        K = intrinsic_matrix(shared[..., :2], shared[..., 2:4], skew)
        lens = MODELS[self.lens].lens(shared[..., len(INTRINSICS) : self.lens_end])
        return Camera.unchecked(K.expand(*batch, 3, 3), R, t, None if lens is None else lens.expand(*batch), None)

    def positions(self, option: str, name: str) -> list[int]:
        """Where a parameter stands, or a group: `focal`, `principal_point`, `distortion`, `bow`, `points`.

        `points_x`, `points_y` and `points_z` are the displacements of all points along an axis of the target.

        Args:
            option: which asks, for the message.
            name: of a parameter or a group.

        Raises:
            ValueError: no such name.
        """
        groups: dict[str, Sequence[str]] = {
            "focal": INTRINSICS[:2],
            "principal_point": INTRINSICS[2:],
            "distortion": self.coefficient_names,
            "bow": BOW if self.bow else (),
            "points": names_of(self.points),
            **{f"points_{axis}": names_of(self.points)[i::3] for i, axis in enumerate(AXES)},
        }
        members = groups.get(name, [name])
        if not members or not set(members) <= set(self.names):
            offered = [group for group, inside in groups.items() if inside]
            raise ValueError(f"{option}: want names from {', '.join([*offered, *self.few_names])}, got {name!r}")
        place = {member: number for number, member in enumerate(self.names)}
        return [place[member] for member in members]


def moved(pose: Pose, step: Float[Tensor, "*batch 6"]) -> Pose:
    """Poses `(R, t)` moved by `(omega, tau)`, to second order in the step."""
    R, t = pose
    return turned(R, step[..., :3]), t + step[..., 3:]
