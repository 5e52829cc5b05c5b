"""Which of the minima of the evidence `adjust` takes, and which other one may be the true one.

The solver goes down from the camera's own pose. Where that explains little, where few residuals are left over to show
that it does not, and where points on a plane look alike from both sides, it goes down from elsewhere too.
"""

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffproj.calibration.evidence.descent import FEW, Found, Rival, Task, descended, reach, spare, surveyed
from diffproj.calibration.evidence.pose_parameters import ANGLES, PLACE
from diffproj.calibration.evidence.search import starts
from diffproj.calibration.evidence.some_cameras import STATE, for_some
from diffproj.calibration.least_squares.solver import Prior, Status
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.geometry.mounting import mounting_from_rotation

UNDETERMINED_STEPS = 30
"""Steps where there are fewer residuals than unknowns: many places explain them, and the solver would go on long."""
POOR = 9.0
"""Cost per spare residual from which on other starts are tried."""
SURELY = 3.0
"""Cost by which the other pose must be lower to be taken in the place of that which the camera's own led to: it is 20
times as likely then."""
RIVAL, RIVAL_STEPS = 50.0, 4
"""Cost by which the other pose may lie higher after so many steps to be followed to its minimum."""
ANOTHER = 2.0
"""Turn in degrees from which on a pose is another one."""
ELSEWHERE = 0.05
"""The same of its place, in the distance of what was seen."""
ENOUGH = 4
"""Landmarks, as many as the camera sees, that tell a pose but for its mirror image."""
SPARSE, SPARSE_TRIED, SPARSE_STEPS = 8, 8, 40
"""Spare residuals below which other minima are looked for; how many starts are followed, and for how many steps."""
FAR = 30.0
"""Turn in degrees from where the camera began from which on it is taken as the new beginning for the last steps."""
HAIR = 1e-4
"""Cost of half a turn away from the camera's own direction, over 4."""
TRIED = 8
"""How many of them are followed, for `FEW` steps before the best is followed to its minimum."""


def best(task: Task, steps: int) -> Found:
    """The minimum from the camera's own pose; where it explains little, the best from other poses too.

    With it comes the lowest other one as its rival, or in its place if it is much lower: where the evidence tells the
    whole pose, that at its mirror image; where it tells little more than the unknowns, any that other starts lead to.
    """
    return _about_itself(task, _lowest(task, steps), steps)


def _lowest(task: Task, steps: int) -> Found:
    """The same, with turns about where each camera began."""
    found = _nearest(task, steps)
    if steps == 0 or not task.pieces:
        return found
    landmarks, left = surveyed(task)[1].sum(-1), spare(task, found)
    sparse = (landmarks < ENOUGH) & (left >= 0) & (left < SPARSE)
    mirrored = (landmarks >= 3) & ~sparse
    if not bool((sparse | mirrored).any()):
        return found
    found = replace(found, rival=_none(found))
    # Those of one number of landmarks together: starts depend on it, and each camera has those it had alone.
    for count in landmarks[sparse].unique().tolist():
        rows = (sparse & (landmarks == count)).nonzero().flatten()
        found = for_some(task, found, rows, partial(_with_other, steps=steps, anywhere=count >= 3))
    if bool(mirrored.any()):
        found = for_some(task, found, mirrored.nonzero().flatten(), partial(_with_rival, steps=steps))
    few = mirrored & (2 * landmarks < POSE + _free_intrinsics(task)) & (left >= 0) & (left < SPARSE)
    for count in landmarks[few].unique().tolist():
        rows = (few & (landmarks == count)).nonzero().flatten()
        found = for_some(task, found, rows, partial(_with_nearer_rival, steps=steps))
    return found


def _free_intrinsics(task: Task) -> int:
    """How many numbers of the camera itself are found along with its pose."""
    return sum(at < task.known.camera.size for at in task.known.columns) - task.known.tied


def _about_itself(task: Task, found: Found, steps: int) -> Found:
    """The minimum with turns about where the camera is now, if nothing is known of turns.

    Cayley's map is stretched far from where it began, without end at half a turn: what is small there is not what is
    small here. So cameras that turned far take their last steps here.
    """
    if found.parameters.start is None or not task.known.turns_freely:
        return found
    far = (found.values[:, -POSE:-3].norm(dim=-1) > FAR) & (found.status == Status.CONVERGED)
    R = found.parameters.rotation(found.values)
    values = found.values.clone()
    values[:, -POSE:-3] = 0.0
    here = replace(found, parameters=replace(found.parameters, start=R), values=values)
    if steps == 0 or not task.pieces or not bool(far.any()):
        return here
    again = descended(task, R, values, found.prior, (), steps)
    return _exchanged(here, again, far & (_ended(again) <= found.cost))


def _none(found: Found) -> Rival:
    """No rival of any camera."""
    R, place = found.parameters.rotation(found.values), found.values[:, -3:]
    return Rival(torch.full_like(found.cost, torch.inf), R, place)


def _nearest(task: Task, steps: int) -> Found:
    """The minimum from the camera's own pose; where it explains little, the best from other poses too."""
    own, R = task.own(), task.camera.R.reshape(-1, 3, 3)
    prior = task.known.prior(own, task.batch)
    begin = task.known.begin(own, prior)
    basis, none = task.known.basis(begin), torch.zeros(len(begin), dtype=torch.long, device=begin.device)
    few = spare(task, Found(task.known.parameters(R), basis, prior, begin, none, none, begin[:, 0])) < 0
    steps = min(steps, UNDETERMINED_STEPS) if bool(few.all()) else steps
    found = descended(task, R, begin, prior, (), steps)
    if not task.pieces or steps == 0:
        return found
    left = spare(task, found)
    # Where there are fewer residuals than unknowns, another start tells no more.
    poor = (found.status == Status.DIVERGED) | (~(2 * found.cost <= POOR * left.clamp(min=1)) & (left >= 0))
    if not bool(poor.any()):
        return found
    near, away = _elsewhere(task, found, TRIED)
    P = len(begin)
    chosen = (near.cost + away).nan_to_num(torch.inf).reshape(-1, P).argmin(0) * P + torch.arange(P, device=own.device)
    R = R if near.parameters.start is None else near.parameters.start[chosen]
    other = descended(task, R, near.values[chosen], prior, (), steps)
    return _exchanged(found, other, poor & (_ended(other) < _ended(found)))


def _elsewhere(task: Task, found: Found, count: int) -> tuple[Found, Tensor]:
    """The few starts all around that explain most, after a few steps `(k P,)`; and the hair of cost of each."""
    R = task.camera.R.reshape(-1, 3, 3)
    begin = task.known.begin(task.own(), found.prior)
    camera = task.known.parameters(R).unpack(begin, (len(begin),), task.camera.size)
    rotations, values = starts(task.pieces, task.known, camera, begin, task.batch)
    K, P = values.shape[:2]
    first = task.known.parameters(R).rotation(begin)
    hair = _away(rotations, first)
    if not task.known.angles:
        rotations, values[..., -POSE:-3] = task.known.turned_to(rotations, R)
    flat = rotations.flatten(0, 1)
    blocks = task.evidence(task.known.parameters(flat), (K,), ()).residuals(values.flatten(0, 1))
    off = (values - found.prior.mean).square() * found.prior.precision.diagonal(dim1=-2, dim2=-1)
    cost = blocks.square().sum(-1).log1p().sum(-1).reshape(K, P).nan_to_num(torch.inf, torch.inf)  # mild on outliers
    rows = (cost + off.log1p().sum(-1) + hair).topk(min(count, K), dim=0, largest=False).indices
    k, each = len(rows), torch.arange(P, device=rows.device)
    many = Prior(*(part.expand(k, *part.shape).flatten(0, 1) for part in found.prior[:2]))
    near = descended(task, rotations[rows, each].flatten(0, 1), values[rows, each].flatten(0, 1), many, (k,), FEW)
    return near, _away(near.parameters.rotation(near.values), first.repeat(k, 1, 1))


def _ended(found: Found) -> Tensor:
    """The cost `(P,)`, infinite where the solver came to no end."""
    return torch.where(found.status == Status.CONVERGED, found.cost, torch.inf).nan_to_num(torch.inf)


def _exchanged(found: Found, other: Found, where: Tensor) -> Found:
    """The minima with others in the place of some `(P,)`."""
    start = None
    if found.parameters.start is not None and other.parameters.start is not None:
        start = torch.where(where[:, None, None], other.parameters.start, found.parameters.start)
    parts = {
        name: torch.where(where.reshape(-1, *(1,) * (old.ndim - 1)), getattr(other, name), old)
        for name, old in ((name, getattr(found, name)) for name in STATE)
    }
    return replace(found, parameters=replace(found.parameters, start=start), **parts)


def _with_rival(task: Task, found: Found, *, steps: int) -> Found:
    """The minimum, or that at the mirrored pose if it is much lower; and the other of the two as its rival.

    Seen from afar, points on a plane look alike from both sides of the line of sight.
    """
    told = (spare(task, found) >= 0) & (found.status == Status.CONVERGED)
    if not bool(told.any()):
        return replace(found, rival=_none(found))
    begin, turn = _mirrored(task, found)
    near = descended(task, turn, begin, found.prior, (), min(steps, RIVAL_STEPS))
    told &= near.cost < found.cost + RIVAL  # of each by itself, whatever others of the batch there are
    if not bool(told.any()):
        return replace(found, rival=_none(found))
    turn = turn if near.parameters.start is None else near.parameters.start
    other = descended(task, turn, near.values, found.prior, (), steps)
    return _rivalled(task, found, other, told)


def _with_other(task: Task, found: Found, *, steps: int, anywhere: bool) -> Found:
    """The same with the lowest other minimum that starts all around lead to.

    As many residuals as unknowns are explained by several poses, and a few more hardly tell them apart. Unless
    `anywhere`, one that is turned by more than a right angle does not count: lines and heights look alike from behind,
    and which side it is the camera's own pose says.
    """
    P, left = len(found.values), spare(task, found)
    told = (left >= 0) & (left < SPARSE) & (found.status == Status.CONVERGED)
    near, _ = _elsewhere(task, found, SPARSE_TRIED)
    k = len(near.values) // P
    turn = near.parameters.rotation(near.values) if near.parameters.start is None else near.parameters.start
    ends = descended(task, turn, near.values, near.prior, (k,), min(steps, SPARSE_STEPS))
    apart = _apart(task, found, ends)
    if not anywhere:
        R = found.parameters.rotation(found.values).repeat(k, 1, 1)
        apart &= (ends.parameters.rotation(ends.values) * R).sum((-2, -1)) > 1
    cost = torch.where(apart, _ended(ends), torch.inf).reshape(k, P)
    chosen = cost.argmin(0) * P + torch.arange(P, device=cost.device)
    start = None if ends.parameters.start is None else ends.parameters.start[chosen]
    state = {name: getattr(ends, name)[chosen] for name in STATE}
    other = replace(found, parameters=replace(ends.parameters, start=start), **state)
    return _rivalled(task, found, other, told)


def _with_nearer_rival(task: Task, found: Found, *, steps: int) -> Found:
    """The same where the mirrored pose is known: the more likely of both is the rival.

    With a camera that is known roughly alone, four or five landmarks do not tell the pose but for its mirror image.
    """
    other, mirrored = _with_other(task, found, steps=steps, anywhere=True), found.rival
    if mirrored is None or other.rival is None:
        return other
    # Where the other was taken in the place of what was found, that is its rival, and lower than what was mirrored.
    nearer = (other.rival.above <= mirrored.above) | (other.cost < found.cost)
    parts = [
        torch.where(nearer.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
        for new, old in zip(other.rival, mirrored, strict=True)
    ]
    return replace(other, rival=Rival(*parts))


def _apart(task: Task, found: Found, other: Found) -> Tensor:
    """Which of `(k P,)` poses are others than that of their camera `(P,)`."""
    k = len(other.values) // len(found.values)
    R = found.parameters.rotation(found.values).repeat(k, 1, 1)
    place, away = found.values[:, -3:].repeat(k, 1), other.values[:, -3:]
    # The trace of a rotation by an angle a is 1 + 2 cos a.
    turned = (other.parameters.rotation(other.values) * R).sum((-2, -1)) < 1 + 2 * math.cos(math.radians(ANOTHER))
    return turned | ((away - place).norm(dim=-1) > ELSEWHERE * reach(task, found.values).repeat(k))


def _rivalled(task: Task, found: Found, other: Found, told: Tensor) -> Found:
    """The minima with others in the place of those that are much higher, and the higher of the two as rivals."""
    R, place = found.parameters.rotation(found.values), found.values[:, -3:]
    there, away = other.parameters.rotation(other.values), other.values[:, -3:]
    cost = torch.where(told & _apart(task, found, other), _ended(other), torch.inf)
    better = cost < found.cost - SURELY
    above = torch.where(better, found.cost - cost, cost - found.cost).nan_to_num(torch.inf, torch.inf)
    rival = Rival(above, torch.where(better[:, None, None], R, there), torch.where(better[:, None], place, away))
    return replace(_exchanged(found, other, better), rival=rival)


def _mirrored(task: Task, found: Found) -> tuple[Tensor, Tensor]:
    """Values `(P, q)` and rotations `(P, 3, 3)` of the pose that mirrors the plane of the points at the line of sight.

    With n the normal of the plane, m the middle of the points that the camera sees and s the direction to it,
    `R' = (I - 2 s s^T) R (I - 2 n n^T)`: what lies across s stays.
    """
    R, place = found.parameters.rotation(found.values), found.values[:, -3:]
    points, visible = surveyed(task)
    seen = visible.unsqueeze(-1).to(R)
    middle = (points * seen).sum(1) / seen.sum(1).clamp(min=1)
    normal = torch.linalg.svd((points - middle.unsqueeze(1)) * seen, full_matrices=False).Vh[:, -1]
    toward = (R @ (middle - place).unsqueeze(-1)).squeeze(-1)
    sight = toward / toward.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    across = R - 2 * sight.unsqueeze(-1) * (sight.unsqueeze(-2) @ R)
    normal = normal.unsqueeze(-2)
    turn = across - 2 * (across @ normal.mT) @ normal
    mirrored_place = middle - (turn.mT @ toward.unsqueeze(-1)).squeeze(-1)
    moving = torch.tensor([task.known.moves(name) for name in PLACE], device=R.device)
    angles = torch.zeros_like(place)
    if task.known.angles:
        given = torch.tensor([task.known.given(name) for name in ANGLES], device=R.device)
        angles = torch.where(given, found.values[:, -POSE:-3], torch.stack(mounting_from_rotation(turn), dim=-1))
    else:
        turn, angles = task.known.turned_to(turn, task.camera.R.reshape(-1, 3, 3))
    values = [found.values[:, :-POSE], angles, torch.where(moving, mirrored_place, place)]
    return torch.cat(values, dim=-1), turn


def _away(R: Tensor, first: Tensor) -> Tensor:
    """A hair of cost for turns from the camera's own direction: of poses that explain as much, the nearer one."""
    return HAIR * (3 - (R * first).sum((-2, -1)))
