"""`RigCalibration`: cameras at their places to each other, what is left over, how it ended, and how sure it is."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj._core.arguments import Array, choice
from diffproj._core.copying import Copied
from diffproj._core.numerics import check_untransformed
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.problem.shape_names import Shape
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.rigs.account import RigAccount
from diffproj.calibration.rigs.extrapolation import Rig
from diffproj.calibration.rigs.record import RigRecorded
from diffproj.calibration.rigs.triangulation import Triangulation, triangulated
from diffproj.geometry.camera import Camera
from diffproj.geometry.cayley import cross_matrix


class Baseline(NamedTuple):
    """The distance between the centres of two cameras, in world units.

    Attributes:
        length: that distance.
        deviation: its standard deviation.
    """

    length: float
    deviation: float


@dataclass(frozen=True, eq=False, repr=False)
class RigCalibration(RigAccount, Copied, RigRecorded):
    """Cameras at their places in a rig, with the views that they were found from.

    The rig's frame is that of its first camera: `X_cam = R X_rig + t`, with R the identity and t zero for the first.

    Attributes:
        cameras: each camera at its place in the rig, by name.
        calibrations: each camera as a calibration of its own, by name: with its views, its residuals, the pose of the
            target in each view (`X_cam = R X_target + t`) and its part of the joint covariance. `measure`, `locate` and
            whatever else takes a calibration take these.
        moments: the names of the M moments.
        where: which moment each view of a camera is of `(V,)`, by name.
        R_target, t_target: the target in the rig at each moment, `X_rig = R X_target + t`, `(M, 3, 3)` and `(M, 3)`.
            Where no camera saw it, they are only place holders.
        status: how it ended.
        iterations: how many steps the solver tried.
        cause: if it did not converge, the cause in words.
    """

    cameras: dict[str, Camera]
    calibrations: dict[str, Calibration]
    moments: tuple[str, ...]
    where: dict[str, Int[Tensor, " _"]]
    R_target: Float[Tensor, "m 3 3"]
    t_target: Float[Tensor, "m 3"]
    status: Status
    iterations: int
    cause: str = ""
    _covariance: Callable[[], Covariance] | None = None
    _remarks: Callable[[], tuple[str, ...]] | None = None

    def __getitem__(self, name: str) -> Calibration:
        """The calibration of one camera.

        Raises:
            TypeError: the name is no string.
            ValueError: there is no such camera.
        """
        return self.calibrations[self._named("name", name)]

    def __len__(self) -> int:
        """The number of cameras."""
        return len(self.cameras)

    def __iter__(self) -> Iterator[str]:
        """The names of the cameras, as of a dictionary."""
        return iter(self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the cameras; the first is the rig's frame."""
        return tuple(self.cameras)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The target's points as they were fitted, in world units; as they were given, if their shape was not free."""
        return next(iter(self.calibrations.values())).points

    @property
    def points_deviation(self) -> Float[Tensor, "n 3"]:
        """The standard deviation of each coordinate of `points`, where they were fitted; 0 where not.

        Infinite for points that fewer than two views show. `covariance.points` has how they go together.

        Raises:
            ValueError: the covariance is not known.
        """
        return next(iter(self.calibrations.values())).points_deviation

    @property
    def shape(self) -> Shape:
        """What was fitted of the target's shape."""
        return next(iter(self.calibrations.values())).shape

    @property
    def rms(self) -> float:
        """RMS reprojection error of all corners in pixels: `sqrt(sum |e|^2 / number of points)`."""
        squares, count = 0.0, 0
        for one in self.calibrations.values():
            squares += float(one.residuals.square().sum())
            count += int(one.used.sum())
        return (squares / max(1, count)) ** 0.5

    @property
    def converged(self) -> bool:
        """Whether it ended at a minimum that the views determine."""
        return self.status == Status.CONVERGED

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What is to be known of a rig that converged, and what to try; computed at the first call.

        Views that contradict the others and were left out, cameras that fit worse together than alone, moments that fit
        badly, cameras that see the target elsewhere than others do from moment to moment, a prior that the views
        contradict, and the remarks on each camera on its own.
        """
        return self._remarks() if self._remarks is not None else ()

    @property
    def has_covariance(self) -> bool:
        """Whether the covariance is known."""
        return self._covariance is not None

    @cached_property
    def covariance(self) -> Covariance:
        """The joint covariance of all cameras and of the target at every moment; computed at the first call.

        Names of parameters are `left.f_x`, ..., `right.omega_x`, ..., `right.tau_z`: a camera's pose in the rig is
        perturbed by `R <- exp(omega) R`, `t <- t + tau`, in radians about the camera's axes and in world units. Its
        "views" are the moments: poses of the target in the rig.

        `dispersion` says how much more the moments contradict each other than they would if all corners erred
        independently. Where all corners of a view are found to be off together, at each moment otherwise, as those of
        a camera that is late, these errors have a part of the covariance of their own. The deviations of the cameras'
        poses then hold more than `dispersion` says (on the bundled pair up to 1.45 times its root), those of intrinsics
        about as much: do not divide them by its root for a comparison.

        Raises:
            ValueError: it is not known.
        """
        if self._covariance is None:
            raise ValueError("covariance: want a rig that was calibrated here, got one from a file without it")
        return self._covariance()

    def place_covariance(self, name: str) -> Float[Tensor, "6 6"]:
        """The covariance of a camera's pose in the rig, omega and tau; 0 for the first camera, which is the frame.

        Raises:
            TypeError: the name is no string.
            ValueError: there is no such camera, or the covariance is not known.
        """
        J = self._places((self._named("name", name),))
        return J @ self._shared @ J.mT

    def baseline(self, one: str, other: str) -> Baseline:
        """The distance between the centres of two cameras, with its standard deviation.

        Raises:
            TypeError: a name is no string.
            ValueError: there is no such camera, or the covariance is not known.

        Example:
            >>> import diffproj as dp
            >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
            >>> length, deviation = dp.calibrate_rig(pair, dp.Chessboard()).baseline("left", "right")
            >>> print(f"{length:.1f}")
            83.2
        """
        pair = self._named("one", one), self._named("other", other)
        apart = self.cameras[pair[1]].center - self.cameras[pair[0]].center
        length = apart.norm()
        if not bool(length > 0):
            return Baseline(0.0, 0.0)
        J = self._places(pair)
        slopes = []
        for name, sign in zip(pair, (-1.0, 1.0), strict=True):
            camera = self.cameras[name]
            back = camera.R.mT  # C = -R^T t moves by -R^T [t]x omega - R^T tau
            slopes.append(sign * (apart / length) @ torch.cat([-back @ cross_matrix(camera.t), -back], dim=-1))
        slope = torch.cat(slopes) @ J
        return Baseline(float(length), float((slope @ self._shared @ slope).clamp(min=0).sqrt()))

    def triangulate(
        self,
        pixels_by_camera: Mapping[str, Float[Tensor, "n 2"] | Array],
        pixel_sigma: float | Mapping[str, float] | None = None,
    ) -> Triangulation:
        """Points in the rig's frame from their pixels in several cameras, with error bars.

        The sum of squared reprojection errors is minimised, each camera's over the variance of its pixels. The points
        carry no gradients.

        Args:
            pixels_by_camera: pixels `(N, 2)` of the same N points, by camera; NaN where a camera does not see a point.
            pixel_sigma: the standard deviation of a pixel's coordinate, a number or one by camera; that of the camera's
                own corners if left out.

        Returns:
            The points, with the joint covariance of the noise of their pixels and of the rig. Where pixels cannot be
            those of one point it `disagrees`, its covariance is as much larger as it takes to explain them, and a
            `CameraDisagreementWarning` says so.

        Raises:
            TypeError: no mapping from names to pixels.
            ValueError: no such camera, pixels of fewer than two cameras, other numbers of points, a sigma that is not
                positive, or a call under a transform of `torch.func`.

        Example:
            >>> import diffproj as dp
            >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
            >>> rig = dp.calibrate_rig(pair, dp.Chessboard())
            >>> found = rig.triangulate({name: views.pixels[0] for name, views in pair.items()})
            >>> side = (found.points[1] - found.points[0]).norm()
            >>> print(f"{side:.0f} mm")
            25 mm
        """
        check_untransformed("triangulate", "it takes any number of points in one call, and carries no gradients")
        columns = {name: self.parameters_of(name) for name in self.names}
        rig = Rig(self.cameras, self.calibrations, self.covariance, columns)
        return triangulated(rig, pixels_by_camera, pixel_sigma)

    def parameters_of(self, name: str) -> list[int]:
        """Where a camera's intrinsics stand among the covariance's names, then its pose, where it has one.

        Raises:
            TypeError: the name is no string.
            ValueError: there is no such camera, or the covariance is not known.
        """
        name = self._named("name", name)
        return [i for i, one in enumerate(self.covariance.names) if one.rpartition(".")[0] == name]

    @property
    def _shared(self) -> Tensor:
        """The covariance of the shared unknowns, infinite where they are not determined."""
        shared = self.covariance.shared
        return torch.where(shared.isinf(), torch.finfo(shared.dtype).max ** 0.25, shared)

    def _places(self, names: tuple[str, ...]) -> Tensor:
        """What takes the shared unknowns to the poses of cameras `(6 n, s)`."""
        s = len(self.covariance.names)
        J = self.t_target.new_zeros(POSE * len(names), s)
        for number, name in enumerate(names):
            if name != self.names[0]:
                rows = range(POSE * number, POSE * (number + 1))
                J[list(rows), self.parameters_of(name)[-POSE:]] = 1.0
        return J

    def _named(self, argument: str, name: Any) -> str:
        return choice(argument, name, self.names)
