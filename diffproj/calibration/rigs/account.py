"""`RigAccount`: what a `RigCalibration` tells people of itself: a summary, a line, a table, plain numbers."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
from torch import Tensor

from diffproj._core.shown import Shown, number, rounded
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import BOW
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera

SENTENCES = {
    Status.CONVERGED: "converged: no step lowers the error any more",
    Status.MAX_ITERATIONS: "was still falling when the iterations ended: raise max_iterations, or look for mixed-up "
    "moments",
    Status.DIVERGED: "found no step that lowers the error: look for mixed-up corners or moments",
    Status.DEGENERATE: "the views do not determine the rig",
}


class RigAccount(Shown):
    """The part of `RigCalibration` that is in words."""

    if TYPE_CHECKING:  # what `RigCalibration` has
        cameras: dict[str, Camera]
        calibrations: dict[str, Calibration]
        moments: tuple[str, ...]
        status: Status
        cause: str

        @property
        def names(self) -> tuple[str, ...]:
            """See `RigCalibration`."""
            ...

        @property
        def rms(self) -> float:
            """See `RigCalibration`."""
            ...

        @cached_property
        def remarks(self) -> tuple[str, ...]:
            """See `RigCalibration`."""
            ...

        @property
        def has_covariance(self) -> bool:
            """See `RigCalibration`."""
            ...

        def baseline(self, one: str, other: str) -> tuple[float, float]:
            """See `RigCalibration`."""
            ...

        def place_covariance(self, name: str) -> Tensor:
            """See `RigCalibration`."""
            ...

    @property
    def message(self) -> str:
        """How it ended, in a sentence, and the remarks."""
        return "; ".join([self.cause or SENTENCES[self.status], *self.remarks])

    def summary(self) -> str:
        """A text: each camera's intrinsics and its place in the rig with standard deviations, errors, and remarks.

        Rotations are rotation vectors in degrees, world to camera; translations and baselines in world units.
        """
        counts = f"{len(self.names)} cameras at {len(self.moments)} moments"
        lines = [f"rig of {counts}; its frame is that of {self.names[0]}"]
        for name in self.names:
            one = self.calibrations[name]
            seen = int(one.used.any(-1).sum())
            lines.append(f"{name}: RMS {float(one.rms):.4f} px over {int(one.used.sum())} corners in {seen} views")
            spread = one.covariance.deviations if self.has_covariance else {}
            named = zip(one.parameters.of_camera.names, one.shared.tolist(), strict=False)
            parts = [
                f"{key} {_spread(float(value), spread.get(key), 2 if index < 4 else 5)}"
                for index, (key, value) in enumerate(named)
            ]
            lines += [f"  {', '.join(parts[:4])} px", *([f"  {', '.join(parts[4:])}"] if parts[4:] else [])]
            if name != self.names[0]:
                lines += self._place(name)
        first = self.calibrations[self.names[0]]
        if first.bow is not None:
            spread = first.covariance.deviations if self.has_covariance else {}
            texts = [_spread(float(value), spread.get(key), 4) for key, value in zip(BOW, first.bow, strict=True)]
            lines.append(f"bow along x, y: {', '.join(texts)} world units")
        if first.displacements is not None:
            off = first.displacements.square().mean(0).sqrt().tolist()
            texts = [f"{value:.4f}" for value in off]
            if self.has_covariance:
                deviations = first.points_deviation
                told = deviations.isfinite().all(-1)
                sure = deviations[told].square().mean(0).sqrt().tolist()
                texts = [f"{text} ± {value:.4f}" for text, value in zip(texts, sure, strict=True)]
            lines.append(f"points off by {', '.join(texts)} world units in x, y, z (RMS)")
        lines += [f"RMS {self.rms:.4f} px", *(self.message.split("; "))]
        return "\n".join(lines)

    def _place(self, name: str) -> list[str]:
        camera = self.cameras[name]
        turn = rotation_vector_deg(camera)
        if not self.has_covariance:
            return [
                f"  rotation {', '.join(f'{x:.4f}' for x in turn)} degrees",
                f"  translation {', '.join(f'{x:.4g}' for x in camera.t.tolist())}",
            ]
        deviations = self.place_covariance(name).diagonal().clamp(min=0).sqrt().tolist()
        degrees = [math.degrees(x) for x in deviations[:3]]
        length, deviation = self.baseline(self.names[0], name)
        return [
            f"  rotation {', '.join(f'{x:.4f}' for x in turn)} ± {', '.join(f'{x:.4f}' for x in degrees)} degrees",
            f"  translation {', '.join(map(_rounded, camera.t.tolist(), deviations[3:]))}",
            f"  baseline {_rounded(length, deviation)} from {self.names[0]}",
        ]

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the summary by name, as Python's own: `left.f_x`, `left.f_x_deviation`, `right.t_x`, ...

        Example:
            >>> import diffproj as dp
            >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
            >>> found = dp.calibrate_rig(pair, dp.Chessboard()).to_dict()
            >>> found["status"], found["moments"], round(found["right.baseline"], 1)
            ('CONVERGED', 13, 83.2)
        """
        found: dict[str, Any] = {"status": self.status.name, "moments": len(self.moments), "rms": self.rms}
        for name in self.names:
            found |= {f"{name}.{key}": value for key, value in self.calibrations[name].to_dict().items()}
            if name == self.names[0]:
                continue
            camera = self.cameras[name]
            found |= dict(
                zip((f"{name}.rotation_{axis}_deg" for axis in "xyz"), rotation_vector_deg(camera), strict=True)
            )
            found |= dict(zip((f"{name}.t_{axis}" for axis in "xyz"), camera.t.tolist(), strict=True))
            if self.has_covariance:
                spread = self.place_covariance(name).diagonal().clamp(min=0).sqrt().tolist()
                found |= {
                    f"{name}.omega_{axis}_deviation_deg": math.degrees(d)
                    for axis, d in zip("xyz", spread[:3], strict=True)
                }
                found |= {f"{name}.t_{axis}_deviation": d for axis, d in zip("xyz", spread[3:], strict=True)}
                length, deviation = self.baseline(self.names[0], name)
                found |= {f"{name}.baseline": length, f"{name}.baseline_deviation": deviation}
        return found

    def _facts(self) -> list[str]:
        first = self.cameras[self.names[0]]
        away = [float((self.cameras[name].center - first.center).norm()) for name in self.names[1:]]
        reach = first.t.new_tensor(away)
        return [
            f"{len(self.names)} cameras",
            f"{len(self.moments)} moments",
            f"baseline{'s' * (len(away) > 1)} {number(reach, '.4g' if float(reach.amax()) < 10 else '.1f')}",
            f"RMS {self.rms:.4f} px",
            self.status.name.lower(),
        ]

    def _columns(self) -> dict[str, Sequence[Any]]:
        rows = [self.calibrations[name].to_dict() for name in self.names]
        columns: dict[str, Sequence[Any]] = {"camera": list(self.names)}
        columns |= {key: [row[key] for row in rows] for key in ("views", "rms", "f_x", "f_y", "c_x", "c_y")}
        centers = [self.cameras[name].center.tolist() for name in self.names]
        return columns | {axis: [center[i] for center in centers] for i, axis in enumerate("xyz")}

    def _note(self) -> str:
        return self.message


def rotation_vector_deg(camera: Camera) -> list[float]:
    """The rotation vector of a camera's pose, in degrees."""
    vector, _ = cv2.Rodrigues(camera.R.detach().cpu().numpy())
    return [math.degrees(float(x)) for x in vector.ravel()]


def _spread(value: float, deviation: Tensor | None, digits: int) -> str:
    text = f"{value:.{digits}f}"
    if deviation is None or not float(deviation) > 0:
        return text
    return f"{text} ± {float(deviation):.{digits}f}"


def _rounded(value: float, deviation: float) -> str:
    """Both to the second digit of the deviation."""
    return " ± ".join(filter(None, rounded(value, deviation)))
