"""The options that `calibrate`, `refine` and `locate` share: written, typed, documented and checked once."""

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, TypedDict, get_args

import numpy as np
from torch import Tensor

from diffproj._core.arguments import Array, called, choice, flag, function, number, whole_number, words
from diffproj._core.warn import warn_caller
from diffproj.calibration.least_squares.losses import Loss, check_loss
from diffproj.calibration.problem.constraints import Priors, of_points
from diffproj.calibration.problem.shape_names import Shape
from diffproj.calibration.results.calibration import Objective

OUTLIER_LIMIT = 5.0
"""Robust standard deviations beyond which a corner is an outlier: of Gaussian residuals, 4 in a million."""

Progress = Callable[[int, int], Any]
"""Called with the number of steps done and their maximum."""


class LocateOptions(TypedDict, total=False):
    """The options of `locate`, which `calibrate` and `refine` take as well.

    Attributes:
        weights: of the corners, broadcasting to `(*B, V, N)`: one over the variance of their coordinates, in px^-2 (for
            the plane objective in world units), as far as it is known: the residuals tell its level. A corner of weight
            0 takes no part. 1 everywhere if left out.
        pixel_sigma: the standard deviation of the corners' coordinates in px where it is known, a number or
            broadcasting to `(*B, V, N)`: the covariance then is that of this noise, whatever the residuals are, and
            intervals are the normal distribution's; a remark says where views contradict each other by more than that.
            If left out, the residuals tell it. Not with `weights` or `objective="plane"`; under a robust `loss` it only
            weighs, for wrong corners have no deviation.
        reject_outliers: leave out corners whose residual exceeds 5 (or so many) robust standard deviations, and
            repeat; `Calibration.rejected` and the summary name them. False if left out.
        loss: a robust loss such as `dp.Huber(0.5)`, its scale in pixels (in world units for the plane objective);
            least squares if left out.
        max_iterations: of the solver, 300 if left out.
        tolerance: the solver stops when the predicted reduction falls below this part of the cost; 3e-14 if left out.
        progress: called as `progress(done, total)` after each step; work in two stages starts again once.
        throw: raise where a camera did not converge, as it does if left out; if False, look at `Calibration.status`.
    """

    weights: Tensor | Array | float | None
    pixel_sigma: Tensor | Array | float | None
    reject_outliers: bool | float
    loss: Loss | None
    max_iterations: int
    tolerance: float
    progress: Progress | None
    throw: bool


class CalibrationOptions(LocateOptions, TypedDict, total=False):
    """The options of `calibrate` and `refine`: those of `LocateOptions`, and these.

    Attributes:
        objective: `"image"`, the default, minimises pixels and is the statistically efficient one; `"plane"` minimises
            the distance on the target in world units, through `back_project`. It lowers that on the corners it is
            given; on others it was no better in trials on real views. Take it where the loss that matters is in world
            units.
        shape: of the target. `"flat"`, the default, has its points where the target says, all on one plane. `"bow"`
            fits the board's bow too, a paraboloid of two parameters. `"free"` fits the place of every point, in the
            plane and out of it: `Calibration.points` then is the target as it was printed, with its covariance. Its
            origin, axes and size as a whole stay the target's, in the sense of least squares. That takes more views
            (six and more), or a word on how well the target was printed: `priors={"points": 0.1}` has a standard
            deviation of 0.1 world units for each coordinate. `fixed=["points_z"]` keeps the points in the plane. Not
            with the plane objective, for only a flat target has one plane. `Landmarks` with a sigma that several views
            show are free points anyway, and that is what is known of them.
        bow: `True` is `shape="bow"`, as it was called before.
        skew: fit the skew of K too, `K[0, 1]`, for sensors whose rows and columns are not at right angles. False if
            left out: it stays what it is, 0 in `calibrate`.
        fixed: names of parameters or groups (`"principal_point"`, `"distortion"`, `"k3"`, ...) that keep their starting
            values: those of the camera in `refine`; in `calibrate` the middle of the image, and 0 for the lens. (A
            known focal length is for `refine`.)
        tied_focal: `f_x : f_y` keeps the start's ratio, which is 1 in `calibrate`. False if left out.
        priors: what is known beforehand, by name or group: a standard deviation about the values that `fixed` would
            keep, or a tuple `(mean, standard deviation)`, of each member of a group; with `tied_focal`, `"focal"` is
            one number, that of `f_x`, and is known once. It weighs against corners whose standard deviation is
            `pixel_sigma`, or `1 / sqrt(weight)` px, and 1 px where neither is given: give one along with it. (A remark
            says so where the noise that the residuals tell would move a parameter by half its deviation.) Under
            `"points"`, the standard deviation of the coordinates of free points about their nominal places: a number,
            or one for each axis, `(3,)`, or coordinate, `(N, 3)`; where neither is given, it weighs against the noise
            that the residuals tell.
    """

    objective: Objective
    shape: Shape
    bow: bool
    skew: bool
    fixed: Sequence[str]
    tied_focal: bool
    priors: Priors | None


_LOCATE: LocateOptions = {
    "weights": None,
    "pixel_sigma": None,
    "reject_outliers": False,
    "loss": None,
    "max_iterations": 300,
    "tolerance": 3e-14,
    "progress": None,
    "throw": True,
}
_CALIBRATION: CalibrationOptions = {
    **_LOCATE,
    "objective": "image",
    "shape": "flat",
    "bow": False,
    "skew": False,
    "fixed": (),
    "tied_focal": False,
    "priors": None,
}


class Options(SimpleNamespace):
    """All options as attributes, those that the caller left out with their defaults."""

    def but(self, **changes: Any) -> "Options":
        """The same with some of them changed."""
        return Options(**(vars(self) | changes))

    @property
    def outlier_limit(self) -> float | None:
        """Robust standard deviations beyond which a corner is rejected; `None` where none is."""
        if isinstance(self.reject_outliers, bool | np.bool_):
            return OUTLIER_LIMIT if self.reject_outliers else None
        return float(self.reject_outliers) or None


def locate_options(given: Mapping[str, Any]) -> Options:
    """The options of `locate`, checked.

    Raises:
        TypeError: an unknown option, or one of another type.
        ValueError: a value that is not allowed.
    """
    return _with_defaults("locate", given, _LOCATE)


def calibration_options(who: str, given: Mapping[str, Any]) -> Options:
    """The options of `calibrate` or `refine`, checked.

    Raises:
        TypeError: an unknown option, or one of another type.
        ValueError: a value that is not allowed, or options that contradict each other.
    """
    options = _with_defaults(who, given, _CALIBRATION)
    choice("objective", options.objective, get_args(Objective))
    choice("shape", options.shape, get_args(Shape))
    options.skew = flag("skew", options.skew)
    if flag("bow", options.bow):
        if given.get("shape", "bow") != "bow":
            raise ValueError(f"bow: want it left out beside shape={options.shape!r}, got True")
        warn_caller(f"{who}: bow=True is now shape='bow'", DeprecationWarning)
        options.shape = "bow"
    options.bow = options.shape == "bow"
    options.tied_focal = flag("tied_focal", options.tied_focal)
    options.fixed = words("fixed", options.fixed, "several names")
    if options.shape != "flat" and options.objective == "plane":
        raise ValueError(
            f"shape: want 'flat' with objective='plane', got {options.shape!r}; only a flat target has one plane"
        )
    if options.priors is not None:
        if not isinstance(options.priors, Mapping):
            raise TypeError(f"priors: want a mapping from names, got {called(options.priors)}")
        words("priors", tuple(options.priors), "names of parameters")
    if options.pixel_sigma is not None and options.objective == "plane":
        raise ValueError("pixel_sigma: want None with objective='plane', whose residuals are in world units")
    for option, names in (("fixed", options.fixed), ("priors", options.priors or ())):
        points = [name for name in names if of_points(name)]
        if points and options.shape != "free":
            raise ValueError(f"{option}: want {points[0]!r} with shape='free' only, got shape={options.shape!r}")
    return options


def _with_defaults(who: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> Options:
    unknown = [name for name in given if name not in defaults]
    if unknown:
        raise TypeError(f"{who}: want options of {', '.join(defaults)}, got {unknown[0]!r}")
    options = Options(**{**defaults, **given})
    check_loss(options.loss)
    options.max_iterations = whole_number("max_iterations", options.max_iterations, "a whole number of steps", least=0)
    options.tolerance = number("tolerance", options.tolerance, "a part of the cost, at least 0", least=0)
    if options.progress is not None:
        function("progress", options.progress, "a function of (done, total)")
    options.throw = flag("throw", options.throw)
    if options.pixel_sigma is not None and options.weights is not None:
        raise ValueError("pixel_sigma, weights: want one of the two, for weights are 1 / pixel_sigma^2")
    if not isinstance(options.reject_outliers, bool | np.bool_):
        want = "True or a number above 0"
        options.reject_outliers = number("reject_outliers", options.reject_outliers, want, least=0, most=1e6)
    return options
