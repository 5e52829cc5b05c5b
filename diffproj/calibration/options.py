"""The options that `calibrate`, `refine` and `locate` share: written, typed, documented and checked once."""

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, TypedDict, get_args

import numpy as np
from torch import Tensor

from diffproj.calibration.constraints import Priors
from diffproj.calibration.losses import Loss
from diffproj.calibration.result import Objective

OUTLIER_LIMIT = 5.0
"""Robust standard deviations beyond which a corner is an outlier: of Gaussian residuals, 4 in a million."""

Progress = Callable[[int, int], Any]
"""Called with the number of steps done and their maximum."""


class LocateOptions(TypedDict, total=False):
    """The options of `locate`, which `calibrate` and `refine` take as well.

    Attributes:
        weights: of the corners, broadcasting to `(*B, V, N)`: one over the variance of their coordinates, in px^-2 (for
            the plane objective in world units). A corner of weight 0 takes no part. 1 everywhere if left out.
        loss: a robust loss such as `dp.Huber(0.5)`, its scale in pixels (in world units for the plane objective);
            least squares if left out.
        max_iterations: of the solver, 300 if left out.
        tolerance: the solver stops when the predicted reduction falls below this part of the cost; 3e-14 if left out.
        progress: called as `progress(done, total)` after each step; work in two stages starts again once.
        throw: raise where a camera did not converge, as it does if left out; if False, look at `Calibration.status`.
    """

    weights: Tensor | None
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
        bow: fit the board's bow too, a paraboloid of two parameters. Not with the plane objective, for a bowed board
            has no plane. False if left out.
        skew: fit the skew of K too, `K[0, 1]`, for sensors whose rows and columns are not at right angles. False if
            left out: it stays what it is, 0 in `calibrate`.
        fixed: names of parameters or groups (`"principal_point"`, `"distortion"`, `"k3"`, ...) that keep their starting
            values: those of the camera in `refine`; in `calibrate` the middle of the image, and 0 for the lens. (A
            known focal length is for `refine`.)
        tied_focal: `f_x : f_y` keeps the start's ratio, which is 1 in `calibrate`. False if left out.
        priors: what is known beforehand, by name or group: a standard deviation about the values that `fixed` would
            keep, or a tuple `(mean, standard deviation)`. It weighs against corners whose standard deviation is
            `1 / sqrt(weight)` px: give weights along with it, such as `torch.tensor(25.0)` for 0.2 px.
        reject_outliers: leave out corners whose residual exceeds 5 (or so many) robust standard deviations, and
            repeat; `Calibration.rejected` and the summary name them. False if left out.
    """

    objective: Objective
    bow: bool
    skew: bool
    fixed: Sequence[str]
    tied_focal: bool
    priors: Priors | None
    reject_outliers: bool | float


_LOCATE: LocateOptions = {
    "weights": None,
    "loss": None,
    "max_iterations": 300,
    "tolerance": 3e-14,
    "progress": None,
    "throw": True,
}
_CALIBRATION: CalibrationOptions = {
    **_LOCATE,
    "objective": "image",
    "bow": False,
    "skew": False,
    "fixed": (),
    "tied_focal": False,
    "priors": None,
    "reject_outliers": False,
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
    """
    options = _with_defaults("locate", given, _LOCATE)
    _check_loss(options.loss)
    return options


def calibration_options(who: str, given: Mapping[str, Any]) -> Options:
    """The options of `calibrate` or `refine`, checked.

    Raises:
        TypeError: an unknown option, or one of another type.
        ValueError: a value that is not allowed, or options that contradict each other.
    """
    options = _with_defaults(who, given, _CALIBRATION)
    if options.objective not in get_args(Objective):
        raise ValueError(f"objective: want one of {', '.join(get_args(Objective))}, got {options.objective!r}")
    if options.bow and options.objective == "plane":
        raise ValueError("bow: want False with objective='plane', for a bowed board has no plane")
    if isinstance(options.fixed, str):
        raise TypeError(f"fixed: want several names, as in fixed=({options.fixed!r},), got a string")
    if options.priors is not None and not isinstance(options.priors, Mapping):
        raise TypeError(f"priors: want a mapping from names, got {type(options.priors).__name__}")
    _check_loss(options.loss)
    reject = options.reject_outliers
    if not isinstance(reject, bool | np.bool_ | int | float) or not reject >= 0:
        raise ValueError(f"reject_outliers: want True or a number above 0, got {reject!r}")
    return options


def _with_defaults(who: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> Options:
    unknown = [name for name in given if name not in defaults]
    if unknown:
        raise TypeError(f"{who}: want options of {', '.join(defaults)}, got {unknown[0]!r}")
    return Options(**{**defaults, **given})


def _check_loss(loss: object) -> None:
    if loss is not None and not isinstance(loss, Loss):
        raise TypeError(f"loss: want one such as dp.Huber(0.5), got {type(loss).__name__}")
