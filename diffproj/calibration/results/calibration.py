"""`Calibration`: a camera with the poses of its views, what is left over, how it ended, and how sure it is."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from diffproj._core.arguments import instance
from diffproj._core.copying import Copied
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.bow import bow_deviation, bowed
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.problem.shape_names import Shape
from diffproj.calibration.results import left_out
from diffproj.calibration.results import mismatch as mismatches
from diffproj.calibration.results.account import Account, told_of
from diffproj.calibration.results.ambiguity import SURE, OtherPoses, widened
from diffproj.calibration.results.comparison import LensComparison
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.indexed import Indexed
from diffproj.calibration.results.mismatch import Mismatch
from diffproj.calibration.results.positions import Positions, positions
from diffproj.calibration.results.record import Recorded
from diffproj.calibration.results.region import covered_region
from diffproj.calibration.results.remark import Remarks, text_of
from diffproj.geometry.camera import Camera
from diffproj.targets.exif import Told
from diffproj.targets.residuals import projected_minus_seen
from diffproj.targets.views import Views

Objective = Literal["image", "plane"]
"""What is minimised: the distance on the image in pixels, or on the board in world units."""


class CalibrationError(RuntimeError):
    """The corners do not determine the camera, or the solver did not converge; the message says which and why.

    Attributes:
        calibration: where it ended, a `Calibration` or a `RigCalibration`, or `None` where there is nothing to show.
    """

    def __init__(self, message: str, calibration: Any = None) -> None:
        super().__init__(message)
        self.calibration = calibration


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Account, Copied, Recorded, Indexed):
    """A camera with the poses of the views that it was found from, and those views.

    Many cameras side by side have a batch shape `*B`; for one camera it is empty. `calibration[i]` is one of many.

    Attributes:
        camera: intrinsics and lens with the world frame in the camera, batch shape `*B`: what one saves.
        cameras: the same camera at the pose of each view, batch shape `(*B, V)`: `X_cam = R X_board + t`. Where no
            corner of a view was used, its pose is only a place holder. Where a view fits two poses, the better one;
            the other is in `alternatives`.
        views: the corners that were given.
        nominal: the target's points `(N, 3)` in world units, as they were given.
        used: which corners were used `(*B, V, N)`: seen, not rejected as outliers, and in a view with at least 4.
        rejected: which corners were rejected as outliers `(*B, V, N)`.
        discounted: which of the used ones a robust loss holds for wrong `(*B, V, N)`: they count less than half, and
            are further off than four deviations of the noise, or their view is too noisy for the scale of a loss like
            Cauchy's. `None` without such a loss, and for the cameras of a rig.
        status: how it ended, `Status` codes `(*B,)`.
        iterations: how many steps the solver tried `(*B,)`.
        bow: how far the middle of the board stands off its edges along x and y `(*B, 2)` in world units, where it was
            fitted.
        objective: what was minimised.
        causes: for each camera that did not converge, the cause in words; `*B` flattened.
        pixel_sigma: the standard deviation of a corner's coordinate in pixels, as the residuals tell it `(*B,)`: their
            root mean square over the degrees of freedom; under a robust loss, 1.4826 times their median.
        degrees_of_freedom: how many independent residuals tell `pixel_sigma` `(*B,)`, and so the scale of the
            covariance; `None` where that is not known.
        lens_region: for what `locate` found with a calibration, the `region` of that one.
        calibrated_on: for the same, what files tell of the photographs behind the intrinsics, as `Views.told` does.
        shares: how much each view counted for the camera `(*B, V)`: 1, or 1 over the number of views that show the
            board as it does, to within 2 px, which bring nothing new. `None` where all counted fully.
        skew: whether the skew of K is among the parameters: it was fitted, or K had some that was held.
        comparison: how the lenses fared, where `distortion="auto"` compared them.
        landmarks: the names of the N points, where they are `Landmarks`; `None` for a board.
        unit: the world's unit, such as `"mm"`, where it is known; files keep it.
        displacements: how far each point of the target lies from where it was given `(*B, N, 3)` in world units, where
            `shape="free"` fitted them, or several views showed `Landmarks` with a sigma.
        uncertain: which of the landmarks came with an error of their own `(N,)`; `None` where none did. What is found
            by the same ones, in other views or with other cameras, is off in the same way.
        rig: which rig the camera is of, where it was calibrated with others: a text that these have, too. The errors of
            all of them go together.
    """

    camera: Camera
    cameras: Camera
    views: Views
    nominal: Float[Tensor, "n 3"]
    used: Bool[Tensor, "*batch v n"]
    rejected: Bool[Tensor, "*batch v n"]
    status: Int[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    bow: Float[Tensor, "*batch 2"] | None = None
    objective: Objective = "image"
    causes: tuple[str, ...] = ()
    pixel_sigma: Float[Tensor, "*batch"] | None = None
    shares: Float[Tensor, "*batch v"] | None = None
    skew: bool = False
    degrees_of_freedom: Float[Tensor, "*batch"] | None = None
    lens_region: Float[Tensor, "*#batch directions"] | None = None
    comparison: LensComparison | None = None
    unit: str | None = None
    landmarks: tuple[str, ...] | None = None
    displacements: Float[Tensor, "*batch n 3"] | None = None
    uncertain: Bool[Tensor, " n"] | None = None
    discounted: Bool[Tensor, "*batch v n"] | None = None
    rig: str | None = None
    calibrated_on: tuple[Told, ...] | None = None
    _covariance: Callable[[], Covariance] | None = None
    _others: Callable[[], OtherPoses] | None = None
    _remarks: Callable[[], tuple[Remarks, ...]] | None = None
    _mismatch: Callable[[], Mismatch] | None = None

    @property
    def points(self) -> Float[Tensor, "*#batch n 3"]:
        """The target's points in world units as they were fitted `(*B, N, 3)`; as they were given `(N, 3)`, if flat."""
        if self.displacements is not None:
            return self.nominal + self.displacements
        return self.nominal if self.bow is None else bowed(self.nominal, self.bow)

    @property
    def board_points(self) -> Float[Tensor, "*batch n 3"]:
        """The same for each camera `(*B, N, 3)`."""
        return self.points.expand(*self.views.batch_shape, -1, -1)

    @property
    def points_deviation(self) -> Float[Tensor, "*batch n 3"]:
        """The standard deviation of each coordinate of `points` `(*B, N, 3)`, where they were fitted; 0 where not.

        Infinite for points that fewer than two views show. `covariance.points` has how they go together.

        Raises:
            ValueError: the calibration came from a file without a covariance.
        """
        if self.bow is not None:
            first = self.parameters.few - 2
            return bow_deviation(self.nominal, self.covariance.shared[..., first : first + 2, first : first + 2])
        if self.displacements is None:
            return torch.zeros_like(self.board_points)
        spread = self.covariance.points.diagonal(dim1=-2, dim2=-1)
        return spread.sqrt().unflatten(-1, (-1, 3))

    @property
    def shape(self) -> Shape:
        """What was fitted of the target's shape."""
        return "free" if self.displacements is not None else "flat" if self.bow is None else "bow"

    @property
    def parameters(self) -> Parametrisation:
        """The names and the order of the shared parameters."""
        count = 0 if self.displacements is None else len(self.nominal)
        return Parametrisation.of(self.camera, self.bow is not None, self.skew, count)

    @property
    def shared(self) -> Float[Tensor, "*batch s"]:
        """The shared parameters `(*B, s)`, in the order of `parameters.names`."""
        return self.parameters.pack(self.camera, self.bow, self.displacements)

    @property
    def residuals(self) -> Float[Tensor, "*batch v n 2"]:
        """Projected minus seen corners `(*B, V, N, 2)` in pixels; zero where a corner was not used.

        Infinite where one was used that the camera does not project, for it lies beyond the fold of the lens. (A
        calibration that has converged has none.)
        """
        points = self.board_points.unsqueeze(-3)
        residuals, projected = projected_minus_seen(self.cameras, points, self.views.pixels, self.used)
        return torch.where((self.used & ~projected).unsqueeze(-1), torch.inf, residuals)

    @property
    def left_out(self) -> Bool[Tensor, "*batch v n"]:
        """Which corners do not count, or hardly `(*B, V, N)`: `rejected` as outliers, or `discounted`."""
        return self.rejected if self.discounted is None else self.rejected | self.discounted

    @property
    def counting(self) -> Bool[Tensor, "*batch v n"]:
        """Which corners count `(*B, V, N)`: those `used` that no robust loss holds for wrong."""
        return self.used if self.discounted is None else self.used & ~self.discounted

    @property
    def view_rms(self) -> Float[Tensor, "*batch v"]:
        """RMS reprojection error of each view `(*B, V)` in pixels; NaN where no corner was used; see `residuals`."""
        return (self.residuals.square().sum(dim=(-2, -1)) / self.used.sum(-1)).sqrt()

    @property
    def rms(self) -> Float[Tensor, "*batch"]:
        """RMS reprojection error `(*B,)` in pixels as OpenCV defines it: `sqrt(sum |e|^2 / number of points)`.

        NaN where there are no corners, as after `adjust`, whose evidence is counted in deviations of its own.
        """
        return (self.residuals.square().sum(dim=(-3, -2, -1)) / self.used.sum((-2, -1))).sqrt()

    @property
    def converged(self) -> Bool[Tensor, "*batch"]:
        """Whether it ended at a minimum that the views determine `(*B,)`."""
        return self.status == Status.CONVERGED

    @property
    def message(self) -> str:
        """How it ended, in a sentence, and the remarks; for many cameras, how many converged and why others did not."""
        ends = self._ends()
        if not self.views.batch_shape:
            return "; ".join([ends[0], *told_of(self)])
        failed = [f"camera {i}: {ends[i]}" for i in self.status.flatten().nonzero().flatten().tolist()]
        count = f"{len(ends) - len(failed)} of {len(ends)} cameras converged"
        return "; ".join([count, *failed, *filter(None, [self.doubts])])

    @property
    def doubts(self) -> str:
        """What makes the poses doubtful, in words; empty where nothing does, or where it is not known.

        Views that are `ambiguous`; views of which too many corners are `left_out` as outliers; of what `locate` found,
        views that the calibration or the camera does not fit: see `mismatch`; and where poses alone were found,
        residuals that the `pixel_sigma` that was said does not explain, and files that tell of another camera or zoom.
        """
        misfit = mismatches.described(self.mismatch, self.views.names, self.lens_region is not None)
        points = "corners" if self.landmarks is None else "landmarks"
        few = left_out.described(self.counting, self.left_out, self.views.names, points, self.discounted is not None)
        return "; ".join(filter(None, [self.ambiguity, misfit, few, self.contradiction]))

    @cached_property
    def mismatch(self) -> Mismatch:
        """How the views compare with the calibration that they were located with: `ratio`, `doubtful`, `scale`.

        The photographs of another camera, zoom or focus are `doubtful`: their corners are not where this calibration
        sees them, by more than noise and what it leaves open. Their `ratio`, residuals in times the calibration's, need
        not be large. Of views that were located with a camera alone those are `doubtful` whose residuals other
        intrinsics would explain nearly all of; their `ratio` is to what these would leave. The ratio is NaN where
        there is nothing to compare with.
        """
        return self._mismatch() if self._mismatch is not None else mismatches.none_at_all(self.used)

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What is to be known of each camera that converged, `*B` flattened; empty where nothing is.

        That its lens had to be kept from folding; that the residuals are no noise, but change smoothly over the image,
        repeat on the board, or are large; and what to try. Computed at the first call.
        """
        return tuple(map(text_of, self.findings))

    @cached_property
    def findings(self) -> tuple[Remarks, ...]:
        """The same one by one, each with its `kind`."""
        return self._remarks() if self._remarks is not None else ((),) * max(1, self.status.numel())

    @property
    def posed(self) -> Bool[Tensor, "*batch v"]:
        """Which views' poses are known `(*B, V)`: of which a corner was used, or that other evidence tells."""
        return self.used.any(-1) if self.used.shape[-1] else self.converged.unsqueeze(-1).expand(self.used.shape[:-1])

    @property
    def has_covariance(self) -> bool:
        """Whether the covariance is known: not where the calibration came from a file without it."""
        return self._covariance is not None

    @property
    def knows_intrinsics(self) -> bool:
        """Whether the covariance holds that of the intrinsics: not where they were all held, as `locate` holds them."""
        if not self.has_covariance:
            return False
        known = self.covariance_of_kept_poses
        count = self.parameters.of_camera.size
        return bool((known.shared[..., :count, :count] != 0).any())

    @cached_property
    def covariance(self) -> Covariance:
        """The joint covariance of intrinsics, lens, the target's shape and every pose; computed at the first call.

        Where a view has another pose that may be the right one, that of its pose is the mean square of the error of the
        pose that was kept: its own covariance, and the step to the other pose as often as that is the right one.

        Raises:
            ValueError: the calibration came from a file without one.
        """
        own = self.covariance_of_kept_poses
        if not self.has_alternatives or not bool((self.other_poses.probability > 0).any()):
            return own
        return widened(own, (self.cameras.R, self.cameras.t), self.other_poses, self._middle)

    @property
    def _middle(self) -> Float[Tensor, "3"]:
        """That about which two poses turn: of the target; after `adjust` that of the covariance."""
        known = self.covariance_of_kept_poses.middle
        if known is not None:
            return known
        return self.nominal.mean(0) if len(self.nominal) else self.nominal.new_zeros(3)

    @cached_property
    def covariance_of_kept_poses(self) -> Covariance:
        """The same as if no view had another pose: to be taken together with `alternatives` and `likelihood_ratio`.

        Raises:
            ValueError: the calibration came from a file without one.
        """
        if self._covariance is None:
            raise ValueError("covariance: want a calibration that was computed here, got one from a file without it")
        return self._covariance()

    @cached_property
    def positions(self) -> Positions:
        """Where the camera stood in each view, `(*B, V, 3)` in the world, with the covariance of each.

        Raises:
            ValueError: the calibration came from a file without a covariance.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> calibration.positions.points.shape, bool((calibration.positions.deviations < 3).all())  # millimetres
            (torch.Size([13, 3]), True)
        """
        return positions(self.cameras, self.covariance, self.views.names)

    @property
    def has_alternatives(self) -> bool:
        """Whether other poses are known: not where the calibration came from a file without them."""
        return self._others is not None

    @cached_property
    def other_poses(self) -> OtherPoses:
        """The other pose of each view and its odds; searched for at the first call.

        Raises:
            ValueError: the calibration came from a file without them.
        """
        if self._others is None:
            raise ValueError(
                "alternatives: want a calibration that was computed here, got one from a file without them"
            )
        return self._others()

    @property
    def alternatives(self) -> Camera:
        """The camera at the other pose of each view, batch shape `(*B, V)`.

        Seen from afar, a plane has two poses that look alike. The one that fits better is in `cameras`, the other here.
        Where there is no other, or none that comes near, both are the same, and `likelihood_ratio` is infinite. In
        `calibrate` and `refine`, intrinsics and lens are held for it.

        Raises:
            ValueError: the calibration came from a file without them.
        """
        return self.cameras.at(self.other_poses.R, self.other_poses.t)

    @property
    def likelihood_ratio(self) -> Float[Tensor, "*batch v"]:
        """How many times likelier the pose in `cameras` is than that in `alternatives` `(*B, V)`, from 1 to infinity.

        The other one is right with the probability `1 / (1 + likelihood_ratio)`. Where the corners' noise is not known
        but estimated from few of them, the ratio is smaller.

        Raises:
            ValueError: the calibration came from a file without them.
        """
        return self.other_poses.ratio

    @property
    def ambiguous(self) -> Bool[Tensor, "*batch v"]:
        """Whether the pose of a view may well be the other one `(*B, V)`: with a probability above 1 %.

        Raises:
            ValueError: the calibration came from a file without the other poses.
        """
        return self.other_poses.ratio < SURE

    @cached_property
    def region(self) -> Float[Tensor, "*#batch directions"] | None:
        """Where in the image the corners that determined the lens lie `(*B, 64)`: see `calibration/results/region.py`.

        They are the corners of the views; for what `locate` found, those of the calibration that it was given. `None`
        where they are not known, as after `locate` with a camera alone.
        """
        if self.lens_region is not None:
            return self.lens_region
        own = (self.knows_intrinsics or not self.has_covariance) and self.used.shape[-1] > 0
        return covered_region(self.views.pixels, self.used) if own else None


def as_calibration(calibration: Calibration) -> Calibration:
    """A calibration as it is.

    Raises:
        TypeError: it is none.
    """
    want = "a dp.Calibration"
    return instance("calibration", calibration, Calibration, want, "dp.calibrate and dp.load_calibration give one")
