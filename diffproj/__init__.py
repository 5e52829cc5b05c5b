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
* NumPy arrays and lists of numbers are taken wherever a tensor is, images excepted. They are copied, and take the dtype
  and device of the camera, lens or tensors that they meet; alone, an array of floats keeps its dtype, and all else
  becomes float64.
* What fails for one element is reported in `valid`; a mistake of the caller raises `TypeError` (the wrong kind) or
  `ValueError` (a value or shape that cannot be; `IndexError` where something is indexed) whose message names the
  argument, what it wants, and what it got.
* The world's unit is whatever the board's square is given in. RMS is OpenCV's: `sqrt(sum |e|^2 / number of points)`.

Glossary:

* Target: what is photographed in order to calibrate, with points that are known in the world. A `Chessboard` has its
  inner corners, those where four squares meet; `Landmarks` are points that were surveyed, wherever they are.
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
* Rig: cameras that stand still to each other. Its frame is that of its first camera. A moment is when several of them
  photograph the target in one place.
* Bow: how far a board is from flat, as a paraboloid. Held out: not used to calibrate, so that it can test.

The names of this page stay. They live in rooms, whose own pages say more: `diffproj.lens` and `diffproj.geometry` for
cameras and planes, `diffproj.targets` and `diffproj.calibration` for calibrating, `diffproj.measurement`,
`diffproj.nn`, `diffproj.files` and `diffproj.paper` for the uses. `diffproj.figures` draws, and `diffproj.synthetic`,
which lives in `diffproj.targets.synthetic`, renders photographs with known truth.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffproj import figures as figures
    from diffproj._public import *
    from diffproj.targets import synthetic as synthetic

__version__ = "0.1.0"

__all__ = [
    "AccuracyMap",
    "Adjustment",
    "AmbiguousPoseWarning",
    "AprilGrid",
    "Baseline",
    "BoardNotFoundError",
    "BoardNotFoundWarning",
    "BrownConrady",
    "Calibration",
    "CalibrationError",
    "CalibrationOptions",
    "CalibrationPrior",
    "Camera",
    "CameraDisagreementWarning",
    "CameraMismatchWarning",
    "Cauchy",
    "CharucoBoard",
    "Chessboard",
    "CircleGrid",
    "Coplanar",
    "Covariance",
    "CrossValidation",
    "Ellipses",
    "Experiment",
    "FusedMeasurement",
    "Heights",
    "Horizon",
    "Huber",
    "KannalaBrandt",
    "Landmarks",
    "LearnableCamera",
    "LearnablePlane",
    "LearnableRig",
    "Lengths",
    "Lens",
    "LensComparison",
    "LocateOptions",
    "Loss",
    "Measurement",
    "Mounting",
    "Observation",
    "PaperSetup",
    "PixelNoiseWarning",
    "Plane",
    "PlaneLoss",
    "PlaneMap",
    "PlaneProjector",
    "Positions",
    "ProjectorBank",
    "Quantity",
    "Reason",
    "RigCalibration",
    "RigCrossValidation",
    "Seen",
    "SoftL1",
    "Status",
    "Triangulation",
    "VanishingPoints",
    "Views",
    "adjust",
    "back_project",
    "bootstrap",
    "calibrate",
    "calibrate_rig",
    "collate",
    "cross_validate",
    "cross_validate_rig",
    "degrees_from_metres",
    "detect",
    "draw_target",
    "euler_from_rotation",
    "example_views",
    "explain",
    "fuse",
    "geotransform",
    "ground_resolution",
    "image_residuals",
    "load",
    "load_calibration",
    "load_camera",
    "locate",
    "measure",
    "metres_from_degrees",
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
    "stack",
    "torchvision_warp",
    "write_measuring_page",
    "write_report",
]
if TYPE_CHECKING:  # public, too, but not of `from diffproj import *`, which would wait for matplotlib
    __all__ += ["figures", "synthetic"]


_RENAMED = {"image_map": "AccuracyMap.over_image", "plane_map": "AccuracyMap.over_plane"}


if not TYPE_CHECKING:  # or type checkers would take any name

    def __getattr__(name: str) -> Any:
        """All public names when the first is asked for, and the new names of those that changed.

        `diffproj.figures` comes at its own first use, for it needs matplotlib.
        """
        if name in __all__ or name == "synthetic":
            public = import_module("diffproj._public")
            globals().update({each: getattr(public, each) for each in (*__all__, "synthetic")})
            return globals()[name]
        if name == "figures":
            return import_module("diffproj.figures")
        remedy = f"; it is diffproj.{_RENAMED[name]} now" if name in _RENAMED else ""
        raise AttributeError(f"module 'diffproj' has no attribute {name!r}{remedy}")


def __dir__() -> list[str]:
    """The public names, whether they were asked for yet or not."""
    return sorted([*__all__, "__version__", "figures", "synthetic"])
