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
"""

from diffproj.back_projection import PlaneMap, Reason, back_project, explain
from diffproj.board import BoardNotFoundError, BoardNotFoundWarning, Chessboard, Views, detect, example_views
from diffproj.calibration import Calibration, CalibrationError, Covariance, Status, calibrate, locate, refine
from diffproj.camera import Camera
from diffproj.experiment import Experiment, run_experiment
from diffproj.files import load_calibration, load_camera, save_camera
from diffproj.learnable import LearnableCamera, image_residuals, plane_residuals
from diffproj.lens import BrownConrady, KannalaBrandt, Lens
from diffproj.losses import Cauchy, Huber, Loss, SoftL1
from diffproj.maps import AccuracyMap, image_map, plane_map
from diffproj.measurement import Measurement, Quantity, measure
from diffproj.modules import CalibrationPrior, LearnablePlane, PlaneLoss, PlaneProjector, ground_resolution
from diffproj.paper_route import paper_route
from diffproj.plane import Plane
from diffproj.rectification import plane_axes, rectify, render
from diffproj.rotation import euler_from_rotation, rotation_from_euler
from diffproj.validation import CrossValidation, bootstrap, cross_validate

__version__ = "0.1.0"

__all__ = [
    "AccuracyMap",
    "BoardNotFoundError",
    "BoardNotFoundWarning",
    "BrownConrady",
    "Calibration",
    "CalibrationError",
    "CalibrationPrior",
    "Camera",
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
    "Loss",
    "Measurement",
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
    "image_map",
    "image_residuals",
    "load_calibration",
    "load_camera",
    "locate",
    "measure",
    "paper_route",
    "plane_axes",
    "plane_map",
    "plane_residuals",
    "rectify",
    "refine",
    "render",
    "rotation_from_euler",
    "run_experiment",
    "save_camera",
]
