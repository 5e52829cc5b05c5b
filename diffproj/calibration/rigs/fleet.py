"""Many rigs: their cameras on their own are calibrated side by side, and so are the rigs refined."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from diffproj._core.arguments import called
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.results.calibration import CalibrationError
from diffproj.calibration.rigs.alone import Alone, alone_together
from diffproj.calibration.rigs.one import RigTask, finished, rig_task
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.rigs.together import Refinement, side_by_side
from diffproj.targets.target import Target

MOST_VIEWS = 4000
"""Views of rigs that are refined at a time, for the sake of memory: more are no faster."""


def each_rig(
    rigs: Sequence[Any], target: Target, distortion: Any, moments: Any, cameras: Any, chosen: Options, who: str
) -> list[RigCalibration | CalibrationError]:
    """Each rig, or why there is none, in their order.

    Args:
        rigs: the views by camera of each.
        target: what they all show.
        distortion: the lens, or one by camera, for all rigs.
        moments: of the views of all rigs, or a list with those of each.
        cameras: known beforehand in all rigs, or a list with those of each.
        chosen: the options; the weights may be a list, too.
        who: was asked, for messages.

    Raises:
        TypeError: an element is no mapping, or something in it is of another type.
        ValueError: a list of another length, or no rig fits together.
    """
    for number, views in enumerate(rigs):
        if not isinstance(views, Mapping):
            raise TypeError(
                f"views_by_camera[{number}]: want a mapping from names of cameras to dp.Views, got {called(views)}"
            )
    own = {
        "moments": _of_each("moments", moments, len(rigs)),
        "cameras": _of_each("cameras", cameras, len(rigs)),
        "weights": _of_each("weights", chosen.weights, len(rigs)),
    }
    tasks: dict[int, RigTask] = {}
    found: dict[int, RigCalibration | CalibrationError] = {}
    mistakes: list[ValueError] = []

    def refused(number: int, error: ValueError) -> None:
        mistakes.append(error)
        found[number] = CalibrationError(f"{who}: of rig {number}, {error}")

    for number, views in enumerate(rigs):
        mine = chosen.but(weights=own["weights"][number], progress=None)
        try:
            tasks[number] = rig_task(
                views, target, distortion, own["moments"][number], own["cameras"][number], mine, who
            )
        except ValueError as error:
            refused(number, error)
    for number, rig in zip(tasks, calibrated_together(list(tasks.values())), strict=True):
        if isinstance(rig, ValueError):
            refused(number, rig)
        else:
            found[number] = rig
        if chosen.progress is not None:
            chosen.progress(len(found), len(rigs))
    if rigs and len(mistakes) == len(rigs):
        raise mistakes[0]
    return [found[number] for number in range(len(rigs))]


def calibrated_together(tasks: Sequence[RigTask]) -> Iterator[RigCalibration | CalibrationError | ValueError]:
    """Each rig, or why there is none, in their order."""
    own = alone_together([task.asked for task in tasks])
    for some in _some_at_a_time(tasks):
        yield from side_by_side([_from_its_cameras(tasks[number], own[number]) for number in some])


def _from_its_cameras(task: RigTask, own: Mapping[str, Alone] | Exception) -> Refinement[RigCalibration]:
    """The rig, or the error that its cameras on their own ended with."""
    if isinstance(own, Exception):
        raise own
    return (yield from finished(task, own))


def _some_at_a_time(tasks: Sequence[RigTask]) -> list[list[int]]:
    """Rigs by their numbers, as many as are kept in memory at a time."""
    batches: list[list[int]] = []
    views = 0
    for number, task in enumerate(tasks):
        own = sum(map(len, task.asked.views.where.values()))
        if not batches or views + own > MOST_VIEWS:
            batches.append([])
            views = 0
        batches[-1].append(number)
        views += own
    return batches


def _of_each(argument: str, given: Any, count: int) -> list[Any]:
    """One for each rig: of a list its elements, of anything else itself."""
    if not isinstance(given, list | tuple):
        return [given] * count
    if len(given) != count:
        raise ValueError(f"{argument}: want a list of {count}, one for each rig, got {len(given)}")
    return list(given)
