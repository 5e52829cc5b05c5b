"""Poses of points in space, to start from: one view at a time, by OpenCV's SQPnP.

SQPnP (Terzakis and Lourakis 2020) minimises over all rotations and takes any number of points from three on, on a plane
or not. It sees points on the plane z = 1, so each view's rays are turned to the axis first. Where several poses fit
about as well it gives them all, and so do the boards that face the camera or lean four ways, for near planes.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from diffproj.calibration.fitting import closed_form
from diffproj.calibration.problem.parametrisation import Pose

CANDIDATES = 3
"""Poses of SQPnP that are kept."""
FEWEST = 4
"""Points that it takes."""


def space_poses(points: Tensor, rays: Tensor, used: Tensor) -> list[Pose]:
    """Poses `(R, t)`, `(P, V, 3, 3)` and `(P, V, 3)`, that may explain the rays `(P, V, N, 3)` of points `(N, 3)`.

    Several for each view, those of one number side by side; where a view has fewer, or too few rays, some are alike or
    arbitrary.
    """
    turn, xy, ahead = closed_form.turned_rays(rays, used)
    upright = closed_form.upright_poses(points, xy, ahead)
    scale = float(points.abs().amax())
    near = (points / scale).numpy(force=True).astype(np.float64)
    P, V = used.shape[:2]
    R = upright[0].unsqueeze(0).repeat(CANDIDATES, 1, 1, 1, 1).numpy(force=True)
    t = upright[1].unsqueeze(0).repeat(CANDIDATES, 1, 1, 1).numpy(force=True)
    seen, which = xy.numpy(force=True), ahead.numpy(force=True)
    for p in range(P):
        for v in range(V):
            found = _sqpnp(near[which[p, v]], seen[p, v][which[p, v]])
            for number in range(CANDIDATES):
                if found:
                    rotation, shift = found[min(number, len(found) - 1)]
                    R[number, p, v], t[number, p, v] = rotation, scale * shift
    turned = (turn @ torch.from_numpy(R).to(points), (turn @ torch.from_numpy(t).to(points).unsqueeze(-1)).squeeze(-1))
    return [tuple(z[number] for z in turned) for number in range(CANDIDATES)]


def _sqpnp(points: np.ndarray, xy: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations and translations of one view, the best first; none where there are too few points or no solution."""
    if len(points) < FEWEST or not np.isfinite(xy).all():
        return []
    try:
        _, rotations, shifts, _ = cv2.solvePnPGeneric(
            points, np.ascontiguousarray(xy), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return []
    found = [(cv2.Rodrigues(turn)[0], shift.reshape(3)) for turn, shift in zip(rotations, shifts, strict=True)]
    return [(R, t) for R, t in found if np.isfinite(R).all() and np.isfinite(t).all() and math.isfinite(float(t.sum()))]
