"""`Calibration`: a camera with the poses of its views, what is left over, how it ended, and how sure it is."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from diffproj._core.copying import Copied
from diffproj.calibration.ambiguity import SURE, OtherPoses, widened
from diffproj.calibration.border import border_with_rays
from diffproj.calibration.bow import bowed
from diffproj.calibration.comparison import LensComparison
from diffproj.calibration.covariance import Covariance
from diffproj.calibration.distinct import alike, described
from diffproj.calibration.parametrisation import BOW, SKEW, Parametrisation
from diffproj.calibration.region import covered_region
from diffproj.calibration.solver import Status
from diffproj.geometry.camera import Camera
from diffproj.targets.residuals import projected_minus_seen
from diffproj.targets.views import Views

Objective = Literal["image", "plane"]
"""What is minimised: the distance on the image in pixels, or on the board in world units."""

SENTENCES = {
    Status.CONVERGED: "converged: no step lowers the error any more",
    Status.MAX_ITERATIONS: "was still falling when the iterations ended: raise max_iterations, or look for mixed-up "
    "corners",
    Status.DIVERGED: "found no step that lowers the error: look for mixed-up corners, or start closer",
    Status.DEGENERATE: "the views do not determine the camera",
}

MAX_NAMES = 10
"""Names of ambiguous views in a message."""


class CalibrationError(RuntimeError):
    """The corners do not determine the camera, or the solver did not converge; the message says which and why.

    Attributes:
        calibration: where it ended, or `None` where there is nothing to show.
    """

    def __init__(self, message: str, calibration: "Calibration | None" = None) -> None:
        super().__init__(message)
        self.calibration = calibration


@dataclass(frozen=True, eq=False)
class Calibration(Copied):
    """A camera with the poses of the views that it was found from, and those views.

    Many cameras side by side have a batch shape `*B`; for one camera it is empty.

    Attributes:
        camera: intrinsics and lens with the world frame in the camera, batch shape `*B`: what one saves.
        cameras: the same camera at the pose of each view, batch shape `(*B, V)`: `X_cam = R X_board + t`. Where no
            corner of a view was used, its pose is only a place holder. Where a view fits two poses, the better one;
            the other is in `alternatives`.
        views: the corners that were given.
        points: the board's corners `(N, 3)` in world units, as if it were flat.
        used: which corners were used `(*B, V, N)`: seen, not rejected as outliers, and in a view with at least 4.
        rejected: which corners were rejected as outliers `(*B, V, N)`.
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
        shares: how much each view counted for the camera `(*B, V)`: 1, or 1 over the number of views that show the
            board as it does, to within 2 px, which bring nothing new. `None` where all counted fully.
        skew: whether the skew of K is among the parameters: it was fitted, or K had some that was held.
        comparison: how the lenses fared, where `distortion="auto"` compared them.
    """

    camera: Camera
    cameras: Camera
    views: Views
    points: Float[Tensor, "n 3"]
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
    _covariance: Callable[[], Covariance] | None = None
    _others: Callable[[], OtherPoses] | None = None
    _remarks: Callable[[], tuple[str, ...]] | None = None

    @property
    def board_points(self) -> Float[Tensor, "*batch n 3"]:
        """The board's corners `(*B, N, 3)` in world units with its bow, where one was fitted."""
        if self.bow is None:
            return self.points.expand(*self.views.batch_shape, -1, -1)
        return bowed(self.points, self.bow)

    @property
    def parameters(self) -> Parametrisation:
        """The names and the order of the shared parameters."""
        return Parametrisation.of(self.camera, self.bow is not None, self.skew)

    @property
    def shared(self) -> Float[Tensor, "*batch s"]:
        """The shared parameters `(*B, s)`, in the order of `parameters.names`."""
        return self.parameters.pack(self.camera, self.bow)

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
    def view_rms(self) -> Float[Tensor, "*batch v"]:
        """RMS reprojection error of each view `(*B, V)` in pixels; NaN where no corner was used; see `residuals`."""
        return (self.residuals.square().sum(dim=(-2, -1)) / self.used.sum(-1)).sqrt()

    @property
    def rms(self) -> Float[Tensor, "*batch"]:
        """RMS reprojection error `(*B,)` in pixels as OpenCV defines it: `sqrt(sum |e|^2 / number of points)`."""
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
            return "; ".join([ends[0], *filter(None, [*self.remarks, "" if self.status else self.doubts])])
        failed = [f"camera {i}: {ends[i]}" for i in self.status.flatten().nonzero().flatten().tolist()]
        count = f"{len(ends) - len(failed)} of {len(ends)} cameras converged"
        return "; ".join([count, *failed, *filter(None, [self.doubts])])

    @property
    def doubts(self) -> str:
        """Which views are ambiguous, in words; empty where none is, or where other poses are not known."""
        if not self.has_alternatives:
            return ""
        doubtful = [
            f"{self.views.names[view]}{f' of camera {tuple(camera)}' * bool(camera)}"
            for *camera, view in self.ambiguous.nonzero().tolist()
        ]
        if not doubtful:
            return ""
        more = f" and {len(doubtful) - MAX_NAMES} more views" if len(doubtful) > MAX_NAMES else ""
        return f"two poses fit {', '.join(doubtful[:MAX_NAMES])}{more}, and the one that was kept may be the wrong one"

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What is to be known of each camera that converged, `*B` flattened; empty where nothing is.

        That its lens had to be kept from folding; that the residuals are no noise, but change smoothly over the image,
        repeat on the board, or are large; and what to try. Computed at the first call.
        """
        return self._remarks() if self._remarks is not None else ("",) * max(1, self.status.numel())

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
        count = sum(not name.startswith("bow") for name in known.names)
        return bool((known.shared[..., :count, :count] != 0).any())

    @cached_property
    def covariance(self) -> Covariance:
        """The joint covariance of intrinsics, lens, bow and every pose; computed at the first call.

        Where a view has another pose that may be the right one, that of its pose is the mean square of the error of the
        pose that was kept: its own covariance, and the step to the other pose as often as that is the right one.

        Raises:
            ValueError: the calibration came from a file without one.
        """
        own = self.covariance_of_kept_poses
        if not self.has_alternatives or not bool((self.other_poses.probability > 0).any()):
            return own
        return widened(own, (self.cameras.R, self.cameras.t), self.other_poses, self.points.mean(0))

    @cached_property
    def covariance_of_kept_poses(self) -> Covariance:
        """The same as if no view had another pose: to be taken together with `alternatives` and `likelihood_ratio`.

        Raises:
            ValueError: the calibration came from a file without one.
        """
        if self._covariance is None:
            raise ValueError("covariance: want a calibration that was computed here, got one from a file without it")
        return self._covariance()

    @property
    def has_alternatives(self) -> bool:
        """Whether other poses are known: not where the calibration came from a file of an earlier version."""
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
        """Where in the image the corners that determined the lens lie `(*B, 64)`: see `calibration/region.py`.

        They are the corners of the views; for what `locate` found, those of the calibration that it was given. `None`
        where they are not known, as after `locate` with a camera alone.
        """
        if self.lens_region is not None:
            return self.lens_region
        own = self.knows_intrinsics or not self.has_covariance
        return covered_region(self.views.pixels, self.used) if own else None

    def summary(self) -> str:
        """One camera as a text for people: parameters with deviations, RMS of each view, how it ended.

        Raises:
            ValueError: there are many cameras.
        """
        if self.views.batch_shape:
            raise ValueError(f"summary: want one camera, got batch shape {tuple(self.views.batch_shape)}; see message")
        deviations = self.covariance.deviations if self._covariance is not None else {}
        values = dict(zip(self.parameters.names, self.shared.tolist(), strict=True))

        def line(title: str, names: tuple[str, ...], form: str, unit: str) -> str:
            texts = (f"{values[name]:{form}}{_spread(deviations.get(name), form)}" for name in names)
            return f"{title:<16}{'  '.join(texts)}{unit}"

        lines = [
            line("focal lengths", ("f_x", "f_y"), "10.3f", " px"),
            line("principal point", ("c_x", "c_y"), "10.3f", " px"),
            *(line(f"lens {name}", (name,), "10.5f", "") for name in self.parameters.coefficient_names),
        ]
        if self.parameters.skew:
            lines.append(line("skew", (SKEW,), "10.3f", " px"))
        if self.bow is not None:
            lines.append(line("bow along x, y", BOW, "10.4f", " world units"))
        lines.append(f"{'RMS':<16}{self.rms.item():10.4f} px over {int(self.used.sum())} corners")
        width = max(map(len, self.views.names), default=0)
        seen, used = self.views.visible.sum(-1).tolist(), self.used.sum(-1).tolist()
        odds = self.likelihood_ratio.tolist() if self.has_alternatives else [torch.inf] * len(used)
        for view, (name, rms) in enumerate(zip(self.views.names, self.view_rms.tolist(), strict=True)):
            out = self.rejected[view].nonzero().flatten().tolist()
            remark = f"  without corners {', '.join(map(str, out))}" if out and used[view] else ""
            if odds[view] < SURE:
                remark += f"  another pose is {odds[view]:.2g} times less likely"
            text = f"{rms:.4f} px{remark}" if used[view] else f"left out: {seen[view] - len(out)} corners, 4 are needed"
            lines.append(f"  {name:<{width}}  {text}")
        if self.shares is not None:
            same = alike(self.points, self.views.pixels.unsqueeze(0), self.used.unsqueeze(0))[0]
            lines.append(described(same, self.views.names))
        if self.camera.size is not None and (share := float(border_with_rays(self.camera, self.camera.size))) < 1:
            lines.append(
                f"{'image':<16}{100 * (1 - share):.0f} % of its border lies beyond the fold of the lens: no rays"
            )
        remarks = [*self.remarks[0].split("; "), "" if self.status else self.doubts]
        return "\n".join([*lines, self._ends()[0], *filter(None, remarks)])

    def _ends(self) -> list[str]:
        """How each camera ended, in a sentence."""
        codes = [Status(code) for code in self.status.flatten().tolist()]
        return [cause or SENTENCES[code] for code, cause in zip(codes, self.causes or ("",) * len(codes), strict=True)]


def _spread(deviation: Tensor | None, form: str) -> str:
    if deviation is None or not float(deviation) > 0:
        return ""
    return " (not determined)" if bool(deviation.isinf()) else f" ± {float(deviation):.{form.split('.')[1]}}"
