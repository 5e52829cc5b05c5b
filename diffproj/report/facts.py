"""What every part of a report looks at, taken from a calibration once: corners, residuals and boards, as arrays."""

import math
import re
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.region import DIRECTIONS
from diffproj.report.document import shortened

NAME = 80
"""Characters of a name that are shown."""
OPTION = re.compile(r"\b(distortion|shape)=(['\"]?)(\w+)\2")
"""Of Python in the calibration's sentences, that the command line has by the same name."""


@dataclass(frozen=True)
class Facts:
    """What a calibration of one camera found.

    Attributes:
        calibration: on the CPU, without gradients.
        size: of the photographs, width and height in px.
    """

    calibration: Calibration
    size: tuple[int, int]

    @property
    def unit(self) -> str:
        """The world's unit."""
        return self.calibration.unit or "world units"

    def in_words(self, text: str) -> str:
        """A sentence of the calibration with the unit by its name, and the command's options beside Python's."""
        text = OPTION.sub(r"\g<0> (--\1 \3)", text.replace("world units", self.unit))
        return text.replace("skew=True", "skew=True (--skew)")

    @cached_property
    def names(self) -> list[str]:
        """The views' names, of a length that can be shown."""
        return [shortened(name, NAME) for name in self.calibration.views.names]

    @cached_property
    def pixels(self) -> Float[np.ndarray, "v n 2"]:
        """The corners that were seen."""
        return _array(self.calibration.views.pixels)

    @cached_property
    def used(self) -> Bool[np.ndarray, "v n"]:
        """Which of them were used."""
        return _array(self.calibration.used)

    @cached_property
    def rejected(self) -> Bool[np.ndarray, "v n"]:
        """Which of them were rejected as outliers."""
        return _array(self.calibration.rejected)

    @cached_property
    def residuals(self) -> Float[np.ndarray, "v n 2"]:
        """Projected minus seen corners in px; NaN where one was not used, or is not projected."""
        values = _array(self.calibration.residuals)
        kept = self.used[..., None] & np.isfinite(values).all(-1, keepdims=True)
        return np.where(kept, values, np.nan)

    @cached_property
    def known(self) -> Bool[np.ndarray, "v n"]:
        """Which corners have a residual."""
        return np.isfinite(self.residuals[..., 0])

    @cached_property
    def view_rms(self) -> Float[np.ndarray, " v"]:
        """RMS reprojection error of each view in px; NaN where no corner was used."""
        return _array(self.calibration.view_rms)

    @property
    def rms(self) -> float:
        """RMS reprojection error of all corners in px."""
        return float(self.calibration.rms)

    @property
    def sigma(self) -> float:
        """The standard deviation of a corner's coordinate in px."""
        known = self.calibration.pixel_sigma
        return self.rms / 2**0.5 if known is None else float(known)

    @property
    def converged(self) -> bool:
        """Whether the camera was found."""
        return bool(self.calibration.converged)

    @cached_property
    def deviations(self) -> dict[str, float]:
        """The standard deviation of each parameter; none where they are not known."""
        if not self.calibration.has_covariance:
            return {}
        few = self.calibration.parameters.few_names
        return {name: float(value) for name, value in self.calibration.covariance.deviations.items() if name in few}

    @cached_property
    def middle(self) -> Float[np.ndarray, "2"]:
        """The principal point in px."""
        return _array(self.calibration.camera.K[:2, 2])

    @property
    def planar(self) -> bool:
        """Whether the target is a board, whose tilt and outline mean something."""
        return self.calibration.landmarks is None

    @property
    def thing(self) -> str:
        """What one point of the target is called."""
        return "corner" if self.planar else "landmark"

    @cached_property
    def plane_z(self) -> float:
        """The height of the plane that the maps are of: the target's mean z, to a millionth of its extent or better.

        Any plane so near would do; so a mean of 30.1 is printed as 30.1, also of points that were given in float32.
        """
        nominal = _array(self.calibration.nominal)
        decimals = 6 - math.floor(math.log10(np.ptp(nominal, axis=0).max()))
        return round(float(nominal[:, 2].mean()), decimals) + 0.0  # no -0.0

    @cached_property
    def outlines(self) -> list[Shaped[np.ndarray, "_ 2"]]:
        """The convex hull of the corners used in each view; empty where there are none."""
        hulls = []
        for pixels, used in zip(self.pixels, self.used, strict=True):
            points = pixels[used].astype(np.float32)
            hull = cv2.convexHull(points).reshape(-1, 2) if len(points) > 2 else points[:0]
            hulls.append(hull.astype(float))
        return hulls

    @cached_property
    def tilts(self) -> Float[np.ndarray, "v 2"]:
        """The tilt of the board in each view in degrees: how much nearer its right side is, and its lower one."""
        return tilts_of(_array(self.calibration.cameras.R))

    @cached_property
    def distances(self) -> Float[np.ndarray, " v"]:
        """How far the middle of the target is from the camera in each view, in world units."""
        cameras = self.calibration.cameras
        middle = self.calibration.board_points.mean(-2)
        return _array((cameras.R @ middle + cameras.t).norm(dim=-1))

    @cached_property
    def seen_views(self) -> list[int]:
        """The numbers of the views with corners that were used."""
        return np.flatnonzero(self.used.any(-1)).tolist()

    @cached_property
    def usual_view(self) -> int:
        """The view whose distance is the usual one."""
        order = sorted(self.seen_views, key=lambda view: self.distances[view])
        return order[len(order) // 2] if order else 0

    @cached_property
    def region(self) -> Float[np.ndarray, "k 2"] | None:
        """The outline of the region that the corners cover, in px; `None` where it is not known."""
        reach = self.calibration.region
        if reach is None or not bool(reach.isfinite().all()):
            return None
        angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        far = _array(reach)
        pairs = np.stack([normal, np.roll(normal, -1, axis=0)], axis=1)
        return np.linalg.solve(pairs, np.stack([far, np.roll(far, -1)], axis=1)[..., None])[..., 0]


def tilts_of(R: Float[np.ndarray, "*v 3 3"]) -> Float[np.ndarray, "*v 2"]:
    """The tilts `(*V, 2)` in degrees of boards with rotations `(*V, 3, 3)`."""
    normal = R[..., :, 2] * np.where(R[..., 2:, 2] < 0, -1.0, 1.0)
    across = np.hypot(normal[..., 0], normal[..., 1])
    degrees = np.degrees(np.arctan2(across, normal[..., 2]))
    return normal[..., :2] * np.where(across > 0, degrees / np.maximum(across, 1e-300), 0.0)[..., None]


def _array(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float64 if values.is_floating_point() else None).numpy()
