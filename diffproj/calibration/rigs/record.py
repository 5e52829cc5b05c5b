"""`RigRecorded`: a rig as a dictionary for a file and back, with all that it says checked on the way in."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.fields import codes, present, tensor
from diffproj.geometry.camera import Camera


class RigRecorded:
    """What gives a rig to a file and takes it from there; its cameras go on their own."""

    def to_fields(self: Any) -> dict[str, Any]:
        """Everything but the cameras as plain lists, strings and numbers; NaN and infinity may be among the numbers.

        Example:
            >>> import diffproj as dp
            >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
            >>> rig = dp.calibrate_rig(pair, dp.Chessboard())
            >>> dp.RigCalibration.from_fields(rig.to_fields(), rig.cameras).summary() == rig.summary()
            True
        """
        return {
            "moments": list(self.moments),
            "where": {name: where.tolist() for name, where in self.where.items()},
            "R_target": self.R_target.tolist(),
            "t_target": self.t_target.tolist(),
            "status": int(self.status),
            "iterations": self.iterations,
            "cause": self.cause,
            "remarks": list(self.remarks),
            "covariance": self.covariance.to_fields() if self.has_covariance else None,
            "calibrations": {name: one.to_fields() for name, one in self.calibrations.items()},
        }

    @classmethod
    def from_fields(cls: Any, fields: dict[str, Any], cameras: Mapping[str, Camera]) -> Any:
        """The rig that `to_fields` gave.

        Args:
            fields: lists or arrays, `None` for a number that is not finite.
            cameras: at their places, by name.

        Raises:
            KeyError: a field is missing.
            TypeError: a field is of the wrong type.
            ValueError: what the fields say does not fit together.
        """
        moments = fields["moments"]
        if not isinstance(moments, list) or not all(isinstance(moment, str) for moment in moments):
            raise ValueError("moments: want a list of texts, got something else")
        parts = fields["calibrations"]
        if list(parts) != list(cameras) or list(fields["where"]) != list(cameras):
            raise ValueError(f"calibrations: want those of {', '.join(cameras)}, got {', '.join(parts)}")
        calibrations = {
            name: Calibration.from_fields(parts[name], camera.without_pose()) for name, camera in cameras.items()
        }
        where = {
            name: codes(fields["where"], name, (len(one.views),), len(moments) - 1)
            for name, one in calibrations.items()
        }
        cause, remarks = fields["cause"], fields["remarks"]
        if not all(isinstance(text, str) for text in (cause, *remarks)):
            raise ValueError("remarks: want texts, got something else")
        status = codes(fields, "status", (), max(Status))
        covariance = Covariance.from_fields(fields["covariance"]) if present(fields, "covariance") else None
        if covariance is not None and tuple(covariance.undetermined_views.shape) != (len(moments),):
            raise ValueError(f"covariance: want {len(moments)} moments, got another number")
        return cls(
            dict(cameras),
            calibrations,
            tuple(moments),
            where,
            tensor(fields, "R_target", (len(moments), 3, 3)),
            tensor(fields, "t_target", (len(moments), 3)),
            Status(int(status)),
            int(codes(fields, "iterations", (), 2**31)),
            cause,
            _covariance=None if covariance is None else partial(_same, covariance),
            _remarks=partial(_same, tuple(remarks)),
        )


def _same(known: Any) -> Any:
    """What a rig calls for what it computes late; a function of the module, so that it can be pickled."""
    return known
