"""The public names, gathered from their rooms: what `diffproj` imports when the first of them is asked for.

That takes as long as PyTorch does, for which `diffproj --help` need not wait. `X as X` tells type checkers that a name
is handed on.
"""

from diffproj.calibration.ambiguity import AmbiguousPoseWarning as AmbiguousPoseWarning
from diffproj.calibration.calibrate import calibrate as calibrate
from diffproj.calibration.comparison import LensComparison as LensComparison
from diffproj.calibration.covariance import Covariance as Covariance
from diffproj.calibration.locate import locate as locate
from diffproj.calibration.losses import Cauchy as Cauchy
from diffproj.calibration.losses import Huber as Huber
from diffproj.calibration.losses import Loss as Loss
from diffproj.calibration.losses import SoftL1 as SoftL1
from diffproj.calibration.options import CalibrationOptions as CalibrationOptions
from diffproj.calibration.options import LocateOptions as LocateOptions
from diffproj.calibration.refine import refine as refine
from diffproj.calibration.result import Calibration as Calibration
from diffproj.calibration.result import CalibrationError as CalibrationError
from diffproj.calibration.solver import Status as Status
from diffproj.calibration.validation import CrossValidation as CrossValidation
from diffproj.calibration.validation import bootstrap as bootstrap
from diffproj.calibration.validation import cross_validate as cross_validate
from diffproj.files.load import load as load
from diffproj.files.load import load_calibration as load_calibration
from diffproj.files.load import load_camera as load_camera
from diffproj.files.save import save_camera as save_camera
from diffproj.geometry.back_projection import PlaneMap as PlaneMap
from diffproj.geometry.back_projection import Reason as Reason
from diffproj.geometry.back_projection import back_project as back_project
from diffproj.geometry.back_projection import explain as explain
from diffproj.geometry.back_projection import ground_resolution as ground_resolution
from diffproj.geometry.camera import Camera as Camera
from diffproj.geometry.euler import euler_from_rotation as euler_from_rotation
from diffproj.geometry.euler import rotation_from_euler as rotation_from_euler
from diffproj.geometry.plane import Plane as Plane
from diffproj.geometry.rectification import plane_axes as plane_axes
from diffproj.geometry.rectification import rectify as rectify
from diffproj.geometry.rectification import render as render
from diffproj.lens.brown_conrady import BrownConrady as BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt as KannalaBrandt
from diffproj.lens.models import register_lens as register_lens
from diffproj.lens.protocol import Lens as Lens
from diffproj.measurement.accuracy_map import AccuracyMap as AccuracyMap
from diffproj.measurement.measure import measure as measure
from diffproj.measurement.measurement import Measurement as Measurement
from diffproj.measurement.quantity import Quantity as Quantity
from diffproj.nn.camera import LearnableCamera as LearnableCamera
from diffproj.nn.loss import PlaneLoss as PlaneLoss
from diffproj.nn.plane import LearnablePlane as LearnablePlane
from diffproj.nn.prior import CalibrationPrior as CalibrationPrior
from diffproj.nn.projector import PlaneProjector as PlaneProjector
from diffproj.paper.experiment import Experiment as Experiment
from diffproj.paper.experiment import run_experiment as run_experiment
from diffproj.paper.route import paper_route as paper_route
from diffproj.paper.setup import PaperSetup as PaperSetup
from diffproj.paper.setup import paper_setup as paper_setup
from diffproj.targets import synthetic as synthetic
from diffproj.targets.chessboard import Chessboard as Chessboard
from diffproj.targets.detection import BoardNotFoundError as BoardNotFoundError
from diffproj.targets.detection import BoardNotFoundWarning as BoardNotFoundWarning
from diffproj.targets.detection import detect as detect
from diffproj.targets.examples import example_views as example_views
from diffproj.targets.residuals import image_residuals as image_residuals
from diffproj.targets.residuals import plane_residuals as plane_residuals
from diffproj.targets.views import Views as Views
