"""The options of a rig's calibration, and which unknowns they hold."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import torch
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj.calibration.fitting.options import Options, Progress, calibration_options
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.problem.constraints import Priors, of_points
from diffproj.calibration.problem.parametrisation import SKEW, Parametrisation
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.geometry.camera import Camera


class RigOptions(TypedDict, total=False):
    """The options of `calibrate_rig`.

    Attributes:
        fixed: what keeps its value. `"intrinsics"` of all cameras, `"rig"`, their poses; names or groups of parameters
            as in `calibrate` (`"k3"`, `"distortion"`, `"principal_point"`, ...), of all cameras that have them; or any
            of these of one camera, as `"left.intrinsics"`, `"left.k3"`, `"right.pose"`. Values are those of `cameras`;
            where there is none, as in `calibrate`, the middle of the image and 0 for the lens. Of cameras they count
            as exact; of calibrations, and of a rig, they err as its covariance says, and what is found follows. With
            free points, `"points_z"` keeps them in the plane.
        shape: of the target. `"flat"`, the default, has its points where the target says. `"bow"` fits the board's bow
            too, a paraboloid of two parameters that all cameras share. `"free"` fits the place of every point, in the
            plane and out of it, to all cameras together: `RigCalibration.points` then is the target as it was printed.
            Its origin, axes and size as a whole stay the target's, in the sense of least squares. That takes six views
            that differ, over all cameras, or a word on how well the target was printed.
        priors: what is known beforehand, by name: a standard deviation, about the values that `fixed` would keep, or a
            tuple `(mean, standard deviation)`. Names and groups of parameters as in `calibrate` (`"focal"`, `"k3"`,
            `"distortion"`, ...), of all cameras that have them or of one, as `"left.focal"`, which counts first. Of a
            camera's place, as `"right.baseline"`: `"baseline"`, its distance from the first camera; `"center"`, where
            it stands in that one's frame, `(3,)`, in world units; `"rotation"`, the rotation vector from that frame to
            its own, `(3,)`, in degrees, its deviations about the camera's own axes. With `shape="free"`, how well the
            target was printed: `{"points": 0.1}` has a standard deviation of 0.1 world units for each coordinate about
            its nominal place; or one for each axis, `(3,)`, or coordinate, `(N, 3)`; or `"points_x"`, `"points_y"` and
            `"points_z"`. All of it weighs against corners whose standard deviation is `1 / sqrt(weight)` px; without
            weights, against the noise that the residuals tell.
        weights: of the corners, by camera, each broadcasting to `(V, N)`: one over the variance of their coordinates,
            in px^-2; or one number. A corner of weight 0 takes no part. 1 everywhere if left out.
        loss: a robust loss such as `dp.Huber(0.5)`, its scale in pixels; least squares if left out.
        reject_outliers: leave out corners whose residual exceeds 5 (or so many) robust standard deviations of their
            camera, and repeat. False if left out.
        max_iterations: of the solver, 300 if left out.
        tolerance: the solver stops when the predicted reduction falls below this part of the cost; 3e-14 if left out.
        progress: called as `progress(done, total)` after each step of the joint fit.
        throw: raise where the rig did not converge, as it does if left out; if False, look at `status`. Where there is
            no rig to look at, as with cameras that nothing connects, it is raised all the same.
    """

    fixed: Sequence[str]
    shape: Literal["flat", "bow", "free"]
    priors: Priors | None
    weights: Mapping[str, Tensor | Array | float] | float | None
    loss: Loss | None
    reject_outliers: bool | float
    max_iterations: int
    tolerance: float
    progress: Progress | None
    throw: bool


def rig_options(who: str, given: Mapping[str, Any]) -> Options:
    """The options, checked.

    Raises:
        TypeError: an unknown option, or one of another type.
        ValueError: a value that is not allowed.
    """
    unknown = [name for name in given if name not in RigOptions.__annotations__]
    if unknown:
        raise TypeError(f"{who}: want options of {', '.join(RigOptions.__annotations__)}, got {unknown[0]!r}")
    return calibration_options(who, given)


def held_points(fixed: Sequence[str], points: int) -> tuple[tuple[str, ...], list[int]]:
    """The names that are left for the cameras, and which coordinates of free points are held, numbers from 0."""
    axes = [axis for name in fixed for axis in of_points(name)]
    names = tuple(name for name in fixed if not of_points(name))
    return names, [number for number in range(3 * points) if number % 3 in axes]


def held(parameters: RigParameters, fixed: Sequence[str]) -> tuple[dict[str, tuple[str, ...]], list[int]]:
    """What is held.

    Returns:
        The names of the parameters of each camera's own that are, and the positions of all shared unknowns that are.

    Raises:
        ValueError: an unknown name.
    """
    names: dict[str, set[str]] = {camera: set() for camera in parameters.cameras}
    positions: set[int] = set()
    for number, kind in enumerate(parameters.kinds):  # a skew that a camera brings is held
        if kind.skew:
            positions.add(parameters.intrinsics(number).start + kind.names.index(SKEW))
    for entry in fixed:
        owner, what = owner_of(parameters, entry)
        found = False
        for number, (camera, kind) in enumerate(zip(parameters.cameras, parameters.kinds, strict=True)):
            if owner not in (None, camera):
                continue
            if what == ("rig" if owner is None else "pose"):
                positions |= (
                    set(range(parameters.pose(number).start, parameters.pose(number).stop)) if number else set()
                )
                found = True
                continue
            own = range(kind.size) if what == "intrinsics" else positions_of(kind, what)
            found |= len(own) > 0
            names[camera] |= {kind.names[i] for i in own}
            positions |= {parameters.intrinsics(number).start + i for i in own}
        if not found:
            offered = ", ".join(("intrinsics", "rig", *parameters.kinds[0].names))
            raise ValueError(
                f"fixed: want names from {offered}, or one camera's, as {parameters.cameras[-1]}.pose, got {entry!r}"
            )
    kinds = dict(zip(parameters.cameras, parameters.kinds, strict=True))
    ordered = {camera: tuple(name for name in kinds[camera].names if name in own) for camera, own in names.items()}
    return ordered, sorted(positions)


def held_places(
    parameters: RigParameters, positions: Sequence[int], known: Mapping[str, Camera]
) -> dict[int, tuple[Tensor, Tensor]]:
    """The places in the rig, `(R, t)`, of the cameras whose pose is held, by their numbers.

    Raises:
        ValueError: nothing is known of one.
    """
    places, first = {}, known.get(parameters.cameras[0])
    for number, name in enumerate(parameters.cameras[1:], start=1):
        if parameters.pose(number).start not in positions:
            continue
        if first is None or name not in known:
            lacking = parameters.cameras[0] if first is None else name
            raise ValueError(
                f"fixed: want cameras={{{lacking!r}: ...}} at its pose, from which {name!r} is held; a calibration of "
                "one camera stands nowhere, a rig's cameras do"
            )
        places[number] = place_in_rig(first, known[name])
    return places


def free_directions(parameters: RigParameters, positions: Sequence[int], like: Tensor) -> Tensor | None:
    """The directions `(1, s, q)` in which the shared unknowns may move; `None` where all may."""
    if not positions:
        return None
    kept = [i for i in range(parameters.size) if i not in set(positions)]
    return torch.eye(parameters.size, dtype=like.dtype, device=like.device)[:, kept].unsqueeze(0)


def owner_of(parameters: RigParameters, entry: str) -> tuple[str | None, str]:
    """The camera that a name is of, `None` for all, and what it names of it: `left.k3` is `k3` of `left`."""
    return owner_among(parameters.cameras, entry)


def owner_among(cameras: Sequence[str], entry: str) -> tuple[str | None, str]:
    """The same of cameras by their names, of which one may begin as another does: `left` and `left.wide`."""
    owner = max((c for c in cameras if entry.startswith(f"{c}.")), key=len, default=None)
    return owner, entry if owner is None else entry[len(owner) + 1 :]


def place_in_rig(first: Camera, other: Camera) -> tuple[Tensor, Tensor]:
    """Where a camera stands in the frame of the first, `(R, t)`, in float64 and without graph."""
    one, two = first.to(torch.float64).detach(), other.to(torch.float64).detach()
    R = two.R @ one.R.mT
    return R, two.t - R @ one.t


def positions_of(kind: Parametrisation, name: str) -> list[int]:
    """Where a parameter of a camera's own stands, or a group; nowhere if it has none of that name."""
    try:
        return kind.positions("fixed", name)
    except ValueError:
        return []
