"""Pixels of one calibrated camera to world coordinates on known planes, inside PyTorch.

Batched, differentiable in every camera parameter, and honest about where there is no answer.

Conventions, which hold everywhere:

* Camera frame: x right, y down, z forward. Extrinsics are world to camera, `X_cam = R X_world + t`; the centre of
  projection is `C = -R^T t`.
* Pixels `(u, v) = (x, y)` with integer coordinates at pixel centres. Resizing an image by `s` maps a coordinate
  `c -> s c + (s - 1) / 2`. COLMAP and nerfstudio put the first pixel's centre at 0.5: add 0.5 to `c_x`, `c_y` going
  there.
* Plane: `a x + b y + c z = d`, that is `n . X = d`; the normal need not be a unit vector.
* Distortion coefficients in OpenCV's order `k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]`; fisheye `k1..k4`.
* Shapes: `K (*B, 3, 3)`, pixels `(*B, N, 2)`, points `(*B, N, 3)`; a camera or plane has batch shape `*B`, which
  broadcasts. dtype and device of the input are kept and must agree; half and bfloat16 pixels are lifted. A caller's
  tensor is never written.
* What fails for one element is reported in `valid`; a mistake of the caller raises `TypeError` or `ValueError`.
* The world's unit is whatever the board's square is given in. RMS is OpenCV's: `sqrt(sum |e|^2 / number of points)`.

Glossary:

* Target: what is photographed in order to calibrate, with points that are known in the world. A `Chessboard` has its
  inner corners, those where four squares meet.
* View: where one photograph shows the points of the target. `Views` holds many.
* Intrinsics `K`: focal lengths `f_x`, `f_y` and principal point `c_x`, `c_y`, in pixels.
* Pose, or extrinsics: rotation `R` and translation `t`, where the world lies as the camera sees it.
* Normalised plane: the plane `z = 1` of the camera frame. `K` takes its points to pixels.
* Lens, or distortion: how the glass moves points of the normalised plane. Its domain is the disc on which the model is
  one-to-one, so that it can be undone.
* Projection: from a point of the world to its pixel. Back-projection: from a pixel along its viewing ray to the point
  where the ray meets a plane.
* Rectification: an image resampled to look straight down on a plane, to scale. Rendering: the way back.
* Residual: projected minus measured pixels, or found minus true points of the plane; the docstring says which.
* Deviation: standard deviation, one sigma. Covariance: deviations of many quantities with their correlations.
* Ground resolution: how many world units a pixel covers on a plane. It does not tell how well a point is measured.
* Bow: how far a board is from flat, as a paraboloid. Held out: not used to calibrate, so that it can test.

The names of this page stay. They live in rooms, whose own pages say more: `diffproj.lens` and `diffproj.geometry` for
cameras and planes, `diffproj.targets` and `diffproj.calibration` for calibrating, `diffproj.measurement`,
`diffproj.nn`, `diffproj.files` and `diffproj.paper` for the uses. `diffproj.figures` draws, and `diffproj.synthetic`,
which lives in `diffproj.targets.synthetic`, renders photographs with known truth.
"""

from importlib import import_module
from typing import Any

from diffproj.calibration.ambiguity import AmbiguousPoseWarning
from diffproj.calibration.calibrate import calibrate
from diffproj.calibration.comparison import LensComparison
from diffproj.calibration.covariance import Covariance
from diffproj.calibration.locate import locate
from diffproj.calibration.losses import Cauchy, Huber, Loss, SoftL1
from diffproj.calibration.mismatch import CameraMismatchWarning
from diffproj.calibration.options import CalibrationOptions, LocateOptions
from diffproj.calibration.refine import refine
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.calibration.solver import Status
from diffproj.calibration.validation import CrossValidation, bootstrap, cross_validate
from diffproj.files.load import load_calibration, load_camera
from diffproj.files.save import save_camera
from diffproj.geometry.back_projection import PlaneMap, Reason, back_project, explain, ground_resolution
from diffproj.geometry.camera import Camera
from diffproj.geometry.euler import euler_from_rotation, rotation_from_euler
from diffproj.geometry.plane import Plane
from diffproj.geometry.rectification import plane_axes, rectify, render
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt
from diffproj.lens.models import register_lens
from diffproj.lens.protocol import Lens
from diffproj.measurement.accuracy_map import AccuracyMap
from diffproj.measurement.choices import PixelNoiseWarning
from diffproj.measurement.measure import measure
from diffproj.measurement.measurement import Measurement
from diffproj.measurement.quantity import Quantity
from diffproj.nn.camera import LearnableCamera
from diffproj.nn.loss import PlaneLoss
from diffproj.nn.plane import LearnablePlane
from diffproj.nn.prior import CalibrationPrior
from diffproj.nn.projector import PlaneProjector
from diffproj.paper.experiment import Experiment, run_experiment
from diffproj.paper.route import paper_route
from diffproj.paper.setup import PaperSetup, paper_setup
from diffproj.targets import synthetic as synthetic
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import BoardNotFoundError, BoardNotFoundWarning, detect
from diffproj.targets.examples import example_views
from diffproj.targets.residuals import image_residuals, plane_residuals
from diffproj.targets.views import Views

__version__ = "0.1.0"

__all__ = [
    "AccuracyMap",
    "AmbiguousPoseWarning",
    "BoardNotFoundError",
    "BoardNotFoundWarning",
    "BrownConrady",
    "Calibration",
    "CalibrationError",
    "CalibrationOptions",
    "CalibrationPrior",
    "Camera",
    "CameraMismatchWarning",
    "Cauchy",
    "Chessboard",
    "Covariance",
    "CrossValidation",
    "Experiment",
    "Huber",
    "KannalaBrandt",
    "LearnableCamera",
    "LearnablePlane",
    "Lens",
    "LensComparison",
    "LocateOptions",
    "Loss",
    "Measurement",
    "PaperSetup",
    "PixelNoiseWarning",
    "Plane",
    "PlaneLoss",
    "PlaneMap",
    "PlaneProjector",
    "Quantity",
    "Reason",
    "SoftL1",
    "Status",
    "Views",
    "back_project",
    "bootstrap",
    "calibrate",
    "cross_validate",
    "detect",
    "euler_from_rotation",
    "example_views",
    "explain",
    "ground_resolution",
    "image_residuals",
    "load_calibration",
    "load_camera",
    "locate",
    "measure",
    "paper_route",
    "paper_setup",
    "plane_axes",
    "plane_residuals",
    "rectify",
    "refine",
    "register_lens",
    "render",
    "rotation_from_euler",
    "run_experiment",
    "save_camera",
]


_RENAMED = {"image_map": "AccuracyMap.over_image", "plane_map": "AccuracyMap.over_plane"}


def __getattr__(name: str) -> Any:
    """`diffproj.figures` at its first use, for it needs matplotlib, which nothing else does; names that changed."""
    if name == "figures":
        return import_module("diffproj.figures")
    remedy = f"; it is diffproj.{_RENAMED[name]} now" if name in _RENAMED else ""
    raise AttributeError(f"module 'diffproj' has no attribute {name!r}{remedy}")
