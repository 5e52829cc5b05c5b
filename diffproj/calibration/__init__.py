"""Calibration: a camera and its poses from the corners of a board seen in photographs."""

from diffproj.calibration.calibrate import calibrate, locate, refine
from diffproj.calibration.covariance import Covariance
from diffproj.calibration.data import PlanarTarget
from diffproj.calibration.reprojection import LensModel
from diffproj.calibration.result import Calibration, CalibrationError, Objective
from diffproj.solver import Status

__all__ = [
    "Calibration",
    "CalibrationError",
    "Covariance",
    "LensModel",
    "Objective",
    "PlanarTarget",
    "Status",
    "calibrate",
    "locate",
    "refine",
]
