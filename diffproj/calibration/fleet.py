"""Many cameras of different numbers of views and image sizes: like ones are solved side by side, each ends as alone.

Cameras of one image size are put into batches, those of fewer views with hidden ones behind. The solver runs over a
batch; what is said of a camera, its status, remarks and covariance, is said of its own part. What cannot be solved in
a batch (a choice of lenses, circles whose centres are found round by round) is done camera by camera, as is a batch of
which something does not fit together, so that the error is of one camera.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from diffproj._core.arguments import Array, called, tensor_of
from diffproj.calibration.fitting.data import BOARD_SIZE, Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.one_lens import fitted
from diffproj.calibration.outcome import outcome, remarks_on
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.trust.entangled import Entangled
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.target import Target, points_of
from diffproj.targets.views import Views, as_views

Outcome = Calibration | CalibrationError

MOST = 256
"""Cameras in a batch: enough to hide call overhead, and few enough for memory."""
FILLED = 1.5
"""Most views of a camera in a batch, over the fewest: what is more than the hidden views cost is not."""
BY_CAMERA = ("weights", "pixel_sigma")
"""Options of which each camera may have its own."""


def each_calibrated(
    cameras: Sequence[Views],
    target: Target,
    distortion: Any,
    chosen: Options,
    one_camera: Callable[[Views, Options], Calibration],
    told: bool = False,
) -> list[Outcome]:
    """The calibration of each camera, or why there is none, in their order.

    Args:
        cameras: the views of each.
        target: what they all show.
        distortion: the lens, or `"auto"`.
        chosen: the options.
        one_camera: what calibrates one camera.
        told: work out the remarks on all of them, side by side; each at its first call if not.

    Raises:
        TypeError: an element is no `dp.Views`, or an option is of another type.
        ValueError: an element is a batch, has another number of corners than the target or no size, or no camera fits
            together with the options.
    """
    count = len(points_of(target))
    for number, views in enumerate(cameras):
        _check(f"views[{number}]", views, count)
    options = [_own_options(chosen, number, len(cameras)) for number in range(len(cameras))]
    found: dict[int, Outcome] = {}
    mistakes: list[ValueError] = []
    alone = distortion == "auto" or isinstance(target, CircleGrid)
    for batch in _batches(cameras):
        many = None
        if len(batch) > 1 and not alone:
            many = _side_by_side([cameras[i] for i in batch], target, distortion, [options[i] for i in batch], told)
        for place, number in enumerate(batch):
            try:
                found[number] = one_camera(cameras[number], options[number]) if many is None else many[place]
            except CalibrationError as error:
                found[number] = error
            except ValueError as error:
                mistakes.append(error)
                found[number] = CalibrationError(f"calibrate: of views[{number}], {error}")
        if chosen.progress is not None:
            chosen.progress(len(found), len(cameras))
    if len(mistakes) == len(cameras):
        raise mistakes[0]
    return [found[number] for number in range(len(cameras))]


def _check(name: str, views: Views, count: int) -> None:
    as_views(views, name)
    if views.batch_shape:
        raise ValueError(f"{name}: want those of one camera, got batch shape {tuple(views.batch_shape)}")
    if views.pixels.shape[-2] != count:
        got = views.pixels.shape[-2]
        raise ValueError(f"{name}: want {count} corners in each as the target has, got {got}; {BOARD_SIZE}")
    if views.size is None:
        raise ValueError(f"{name}: want the photographs' size, got None; give Views(..., size=(width, height))")


def _own_options(chosen: Options, number: int, count: int) -> Options:
    """The options of one camera."""
    own: dict[str, Any] = {"progress": None}
    for name in BY_CAMERA:
        given = getattr(chosen, name)
        if not isinstance(given, list | tuple):
            continue
        if len(given) != count:
            raise ValueError(f"{name}: want a number, or a list of {count}, one for each camera, got {len(given)}")
        own[name] = given[number]
    return chosen.but(**own)


def _batches(cameras: Sequence[Views]) -> Iterator[list[int]]:
    """Which cameras are solved side by side: of one size and device, and of about as many views."""
    kinds: dict[Any, list[int]] = {}
    for number, views in enumerate(cameras):
        kinds.setdefault((views.size, views.device), []).append(number)
    for numbers in kinds.values():
        batch: list[int] = []
        for number in sorted(numbers, key=lambda i: len(cameras[i])):
            if batch and (len(batch) == MOST or len(cameras[number]) > FILLED * len(cameras[batch[0]])):
                yield batch
                batch = []
            batch.append(number)
        yield batch


def _side_by_side(
    cameras: Sequence[Views], target: Target, distortion: Any, options: Sequence[Options], told: bool
) -> list[Outcome] | None:
    """Each camera as it would be alone; `None` where something does not fit together."""
    most = max(map(len, cameras))
    try:
        pixels = torch.stack([_filled(views.pixels.to(torch.float64), most, 0.0) for views in cameras])
        visible = torch.stack([_filled(views.visible, most, False) for views in cameras])
        whole = Views.unchecked(pixels, visible, tuple(f"view {i + 1}" for i in range(most)), cameras[0].size)
        together = {name: _together(name, cameras, options, most) for name in BY_CAMERA}
        _, found = fitted(whole, target, distortion, options[0].but(**together))
        data = [Data(v, target, o.weights, o.pixel_sigma) for v, o in zip(cameras, options, strict=True)]
    except (ValueError, RuntimeError):
        return None
    results: list[Outcome] = []
    for row, (views, own, chosen) in enumerate(zip(cameras, data, options, strict=True)):
        try:
            results.append(outcome("calibrate", own, found.alone(row, len(views)), views.size, chosen.throw))
        except CalibrationError as error:
            results.append(error)
    return _with_remarks(results, found, data[0], cameras) if told else results


def _with_remarks(results: Sequence[Outcome], found: Fit, data: Data, cameras: Sequence[Views]) -> list[Outcome]:
    """The same with the remarks on each, from the fit of all."""
    ends = [int(one.status) if isinstance(one, Calibration) else int(Status.DIVERGED) for one in results]
    status = torch.tensor(ends, device=found.solution.status.device)
    texts = remarks_on(found, status, Entangled(found, status), data, cameras)
    return [
        replace(one, _remarks=partial(_same, (text,))) if isinstance(one, Calibration) else one
        for one, text in zip(results, texts, strict=True)
    ]


def _same(known: Any) -> Any:
    """What a calibration calls for what it computes late; a function of the module, so that it can be pickled."""
    return known


def _filled(values: torch.Tensor, most: int, filling: float | bool) -> torch.Tensor:
    """Values `(V, ...)` with as many behind as make `most` views."""
    behind = values.new_full((most - len(values), *values.shape[1:]), filling)
    return torch.cat([values, behind])


def _together(name: str, cameras: Sequence[Views], options: Sequence[Options], most: int) -> Any:
    """An option of the corners for all cameras `(P, V, N)`, or as it is, where it is a number or `None`."""
    given = [getattr(own, name) for own in options]
    if all(value is given[0] for value in given) and (given[0] is None or isinstance(given[0], int | float)):
        return given[0]
    if any(value is None for value in given):
        raise ValueError(f"{name}: want it for every camera or for none, got {called(given)}")
    each: list[torch.Tensor] = []
    for views, value in zip(cameras, given, strict=True):
        wide: torch.Tensor | Array = tensor_of(name, value)
        each.append(_filled(wide.to(torch.float64).expand(views.visible.shape), most, 1.0))
    return torch.stack(each)
