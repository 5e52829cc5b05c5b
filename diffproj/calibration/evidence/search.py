"""Where `adjust` starts from when the camera's own pose explains nothing: a grid of directions, and what fits them.

For each direction in which the camera may look, surveyed points tell its place by a linear system: it lies on the ray
of each, seen backwards. Known heights and lengths scale with its height. The few places that explain the evidence best
are handed to the solver.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from diffproj.calibration.evidence.knowledge import Knowledge
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.observations import Heights, Horizon, Lengths, Seen
from diffproj.calibration.evidence.pose_parameters import PLACE
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.geometry.camera import Camera
from diffproj.geometry.mounting import mounting_of, rotation_from_mounting

TILTS = (-10.0, 2.0, 5.0, 10.0, 17.0, 27.0, 40.0, 55.0, 70.0, 85.0)
STEPS = 12
"""Headings all around."""
ROLLS = (0.0, 90.0, 180.0, 270.0)
TIMES = (3.0, 10.0, 30.0, 100.0, 300.0)
"""Heights of the camera in those of what is seen."""
FIRM = 1e6
"""How much more than the rays a place that is known weighs."""


def starts(
    pieces: Sequence[Observation], known: Knowledge, camera: Camera, begin: Tensor, batch: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Rotations `(K, P, 3, 3)` and values `(K, P, q)` to try.

    Args:
        pieces: the observations.
        known: what is known of the parameters.
        camera: P cameras at the poses that they begin with.
        begin: their values `(P, q)`.
        batch: the shape of the P cameras, over which observations broadcast.
    """
    most = {piece: int(piece.visible.sum(-1).amax()) for piece in pieces if isinstance(piece, Seen)}
    seen = [piece for piece, count in most.items() if count >= 2]
    turns = any(not isinstance(piece, Horizon | Heights | Lengths) for piece in pieces)  # those know no heading
    angles = _directions(known, camera, begin, rolls=any(count >= 3 for count in most.values()), turns=turns)
    R = rotation_from_mounting(*angles.unbind(-1))  # (K, P, 3, 3)
    held = [known.given(name) for name in PLACE]
    tries = [begin[:, -3:]]
    sizes = [float(piece.height.mean()) for piece in pieces if isinstance(piece, Heights)]
    sizes += [float(piece.length.mean()) for piece in pieces if isinstance(piece, Lengths)]
    if sizes and not held[-1]:
        tries += [torch.cat([tries[0][:, :2], torch.full_like(begin[:, -1:], times * sizes[0])], -1) for times in TIMES]
    places = [one.expand(*R.shape[:2], 3) for one in tries]
    if seen:
        stand = partial(_standing, seen, camera, R, batch=batch)
        places = [stand(tries[0], held)]
        if sizes and not held[-1]:
            places += [stand(one, [*held[:2], True]) for one in tries]
    place = torch.cat(places)
    R, angles = (part.repeat(len(places), *(1,) * (part.ndim - 1)) for part in (R, angles))
    moving = torch.tensor([known.moves(name) for name in PLACE], device=begin.device)
    place = torch.where(moving, place, begin[:, -3:])
    turned = angles if known.angles else torch.zeros_like(angles)
    front = begin[:, :-POSE].expand(*R.shape[:2], -1)
    return R, torch.cat([front, turned, place], dim=-1)


def _directions(known: Knowledge, camera: Camera, begin: Tensor, rolls: bool, turns: bool) -> Tensor:
    """Tilt, roll and heading `(K, P, 3)`: all around where nothing is known of them."""
    own = torch.stack(mounting_of(camera)[1:4], dim=-1)
    if known.angles:
        own = begin[:, -POSE:-3]
    given = [known.angles and known.given(name) for name in ("tilt", "roll", "heading")]
    grids = [
        TILTS,
        ROLLS if rolls else ROLLS[:1],
        [360 / STEPS * step for step in range(STEPS)] if turns else [None],
    ]
    axes = [
        [own[:, i]] if held or grid[0] is None else [torch.full_like(own[:, i], angle) for angle in grid]
        for i, (held, grid) in enumerate(zip(given, grids, strict=True))
    ]
    return torch.stack(
        [torch.stack([tilt, roll, heading], dim=-1) for tilt in axes[0] for roll in axes[1] for heading in axes[2]]
    )


def _standing(
    seen: Sequence[Seen], camera: Camera, R: Tensor, own: Tensor, given: Sequence[bool], batch: Sequence[int]
) -> Tensor:
    """The places `(K, P, 3)` that lie nearest to the rays of surveyed points, for each rotation `(K, P, 3, 3)`.

    Coordinates that are given keep their own values `(P, 3)`.
    """
    identity = torch.eye(3, dtype=R.dtype, device=R.device)
    held = torch.tensor(given, device=R.device).to(R)
    middle = torch.stack([piece.points.mean(0) for piece in seen]).mean(0).to(R)
    A, b = torch.zeros_like(R), torch.zeros_like(R[..., 0])
    still = camera.without_pose()
    for piece in seen:
        N = len(piece)
        pixels = piece.pixels.to(R).expand(*batch, N, 2).reshape(-1, N, 2)
        rays, valid = still.directions(pixels)
        weight = (valid & piece.visible.to(R.device).expand(*batch, N).reshape(-1, N)).to(R)
        rays = rays / rays.norm(dim=-1, keepdim=True)
        world = (R.unsqueeze(-3) * rays.unsqueeze(-1)).sum(-2)
        across = identity - world.unsqueeze(-1) * world.unsqueeze(-2)
        across = across * weight[..., None, None]
        A = A + across.sum(-3)
        b = b + (across @ (piece.points.to(R) - middle).unsqueeze(-1)).squeeze(-1).sum(-2)
    size = A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-300
    firm = size * (1e-6 * identity + FIRM * torch.diag(held))
    b = b + (firm @ (own - middle).unsqueeze(-1)).squeeze(-1)
    return middle + torch.linalg.solve_ex(A + firm, b.unsqueeze(-1))[0].squeeze(-1)
