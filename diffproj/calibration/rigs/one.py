"""One rig: each camera on its own, the best-connected pairs chained, all refined together, and the target's shape."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from diffproj._core.numerics import check_untransformed
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.rigs.alone import Alone, Asked, alone, checked_cameras, lenses
from diffproj.calibration.rigs.fit import rig_fit
from diffproj.calibration.rigs.held_errors import held_errors
from diffproj.calibration.rigs.knowledge import RigKnowledge
from diffproj.calibration.rigs.options import held, held_places, held_points
from diffproj.calibration.rigs.outcome import rig_outcome
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.priors import PLACES, own_priors, rig_knowledge
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.rigs.shape import weighed_anew, with_bow, with_known_points, with_points
from diffproj.calibration.rigs.start import rig_start
from diffproj.calibration.rigs.together import Refinement, by_itself
from diffproj.calibration.rigs.views import Moments, rig_views
from diffproj.lens.models import LensModel
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.target import Target
from diffproj.targets.views import Views


@dataclass(frozen=True, eq=False)
class RigTask:
    """What is asked of a rig, checked.

    Attributes:
        asked: of its cameras, each on its own.
        parameters: the shared unknowns.
        positions: of those that are held.
        held_points: coordinates of free points that are, numbers from 0.
        places: `(R, t)` from the first camera's frame to that of each whose pose is held, by their numbers.
        known: what is known of them beforehand, if anything is.
        moved: how far the target's points are known to lie from where it has them `(N, 3)`, if they do.
        held_errors: the covariance of what is held, as `held_errors.py` has it; `None` where it counts as exact.
    """

    asked: Asked
    parameters: RigParameters
    positions: list[int]
    held_points: list[int]
    places: dict[int, tuple[Tensor, Tensor]]
    known: RigKnowledge | None = None
    moved: Tensor | None = None
    held_errors: Tensor | None = None


def rig_calibrated(task: RigTask) -> RigCalibration:
    """What `calibrate_rig` promises.

    Raises:
        CalibrationError: as `finished`.
    """
    return by_itself(finished(task, alone(task.asked)))


def rig_task(
    views_by_camera: Mapping[str, Views],
    target: Target,
    distortion: LensModel | Mapping[str, LensModel],
    moments: Moments | None,
    cameras: Any,
    chosen: Options,
    who: str,
    moved: Tensor | None = None,
) -> RigTask:
    """What is asked, looked at, with checked options; nothing is computed yet, and errors name `who` was asked.

    With `moved (N, 3)` the target's points are known to lie so far from where it has them.
    """
    check_untransformed(who, "a list of rigs is calibrated side by side")
    views = rig_views(views_by_camera, target, moments, chosen.weights, who)
    known = checked_cameras(cameras, views.names)
    placed = {name: known[name] for name in known if not _is_without_place(cameras, name)}
    lens = lenses(distortion, views.names)
    # What is held has to be known by camera before each is calibrated on its own; a known camera brings its lens.
    kinds = {name: Parametrisation.of(known[name]) if name in known else Parametrisation(lens[name]) for name in lens}
    parameters = RigParameters(views.names, tuple(kinds.values()))
    views.data[views.names[0]].check_options("image", chosen.shape, (*chosen.fixed, *(chosen.priors or ())))
    fixed, points = held_points(chosen.fixed, len(views.points))
    names, positions = held(parameters, fixed)
    priors = own_priors(parameters, chosen.priors)
    knowledge = rig_knowledge(parameters, priors, known, placed, views, positions)
    alone = {name: {what: value for what, value in own.items() if what not in PLACES} for name, own in priors.items()}
    # On its own, each camera takes landmarks for exact: their errors are unknowns that all views of the rig share.
    bare = Landmarks(target.points, target.names) if isinstance(target, Landmarks) else target
    places = held_places(parameters, positions, placed)
    asked = Asked(views, bare, lens, known, names, alone, chosen, who)
    errors = held_errors(cameras, parameters, positions)
    return RigTask(asked, parameters, positions, points, places, knowledge, moved, errors)


def _is_without_place(cameras: Any, name: str) -> bool:
    """Whether a camera was given as a calibration on its own, which stands nowhere."""
    return isinstance(cameras, Mapping) and isinstance(cameras[name], Calibration)


def finished(task: RigTask, own: Mapping[str, Alone]) -> Refinement[RigCalibration]:
    """The rig, from its cameras on their own, by what it wants of the solver.

    Raises:
        CalibrationError: there is none, or it did not converge, if that is to be raised.
    """
    views, chosen, who = task.asked.views, task.asked.options, task.asked.who
    seen = {name: one.seen for name, one in own.items()}
    start = rig_start(views, seen, task.places, who)
    found = yield from rig_fit(
        views,
        task.parameters,
        {name: one.shared for name, one in seen.items()},
        start,
        {name: one.used for name, one in seen.items()},
        task.positions,
        chosen,
        task.known,
        [name for name, one in own.items() if one.restrained],
    )
    if task.moved is not None:
        found = yield from with_known_points(found, task.moved, chosen)
    elif chosen.shape == "bow":
        found = yield from with_bow(found, chosen)
    elif chosen.shape == "free" or views.spread is not None:
        found = yield from with_points(found, task.held_points, chosen)
    elif task.known is not None:
        found = yield from weighed_anew(found, chosen)
    rig = rig_outcome(replace(found, held_errors=task.held_errors), own)
    if chosen.throw and rig.status != Status.CONVERGED:
        raise CalibrationError(f"{who}: {rig.message}", rig)
    return rig
