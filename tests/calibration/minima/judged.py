"""Whether `calibrate` ends in the lowest minimum: against the truth's, OpenCV's and SciPy's.

Every minimum of another is refined by diffproj's solver, so that all costs are of the same residuals and the same
corners, and its lens is asked whether it is one-to-one there.
"""

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

import diffproj as dp
from diffproj.calibration.results.border import border_with_rays
from diffproj.lens.models import MODELS

from .drawn import BOARD, KINDS, D, Draw, Problems

HIGHER = 1e-6
"""Part of the cost by which a minimum must be above another to be a miss."""
MATTERS = 0.1
"""Deviations of a parameter from which on a miss matters."""
FEWEST = 6
"""Corners of a view from which on OpenCV is given it."""


def cost_of(found: dp.Calibration, problems: Problems) -> Tensor:
    """What was minimised `(count,)`, over the same corners whatever was rejected; infinite for corners without pixels."""
    points = BOARD.points.to(D)
    pixels, _ = found.cameras.project(points)
    size = (pixels - problems.views.pixels).norm(dim=-1)
    counted = problems.views.visible & (problems.views.visible.sum(-1, keepdim=True) >= 4)
    if "loss" in problems.options:
        a = problems.options["loss"].scale
        each = torch.where(size <= a, size.square(), 2 * a * size - a * a)
    elif problems.options.get("reject_outliers"):
        each = size.square().clamp(max=25 * 2 * 0.04)
    else:
        return torch.where(found.used, found.residuals.square().sum(-1), 0.0).sum((-1, -2))
    return torch.where(counted, each.nan_to_num(torch.inf), 0.0).sum((-1, -2))


def with_lens_of(model: str, camera: dp.Camera) -> dp.Camera:
    """The true cameras with a lens of as many coefficients as the model has."""
    count = MODELS[model].count
    if camera.distortion is None or model == "fisheye":
        return camera
    if count == 0:
        return dp.Camera(camera.K, camera.R, camera.t, None, camera.size)
    known = camera.distortion.coefficients
    padded = torch.nn.functional.pad(known, (0, max(0, count - known.shape[-1])))[..., :count]
    return dp.Camera(camera.K, camera.R, camera.t, dp.BrownConrady(padded), camera.size)


def of_parameters(K: Tensor, lens: Tensor, R: Tensor, t: Tensor, model: str, size: Any) -> dp.Camera:
    """One camera with its views `(V,)`."""
    kind = dp.KannalaBrandt if model == "fisheye" else dp.BrownConrady
    V = len(R)
    distortion = None if model == "none" else kind(lens.expand(V, -1).clone())
    return dp.Camera(K.expand(V, 3, 3).clone(), R, t, distortion, size)


FLAGS = {
    "none": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    "brown4": cv2.CALIB_FIX_K3,
    "brown5": 0,
    "brown8": cv2.CALIB_RATIONAL_MODEL,
    "brown12": cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    "brown14": cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
}


def opencv(problems: Problems, i: int) -> dp.Camera | None:
    """OpenCV's answer from nothing but the corners, for views with enough of them; the others get none."""
    pixels, visible = problems.views.pixels[i].numpy(), problems.views.visible[i].numpy()
    points, size = BOARD.points.numpy().astype(np.float64), problems.views.size
    rows = [v for v in range(len(pixels)) if visible[v].sum() >= FEWEST]
    seen = [np.ascontiguousarray(pixels[v][visible[v]]) for v in rows]
    shown = [np.ascontiguousarray(points[visible[v]]) for v in rows]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    try:
        if problems.model == "fisheye":
            args = [s.reshape(1, -1, 3) for s in shown], [p.reshape(1, -1, 2) for p in seen], size
            flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
            _, K, d, r, t = cv2.fisheye.calibrate(*args, np.zeros((3, 3)), np.zeros((4, 1)), flags=flags, criteria=stop)
        else:
            args = [s.astype(np.float32) for s in shown], [p.astype(np.float32) for p in seen], size
            _, K, d, r, t = cv2.calibrateCamera(*args, None, None, flags=FLAGS[problems.model], criteria=stop)
    except cv2.error:
        return None
    count = MODELS[problems.model].count
    lens = torch.tensor(np.asarray(d).reshape(-1)[:count].copy())
    R = problems.truth.R[i].clone()
    place = problems.truth.t[i].clone()
    for row, v in enumerate(rows):
        R[v] = torch.from_numpy(cv2.Rodrigues(np.asarray(r[row], dtype=np.float64))[0])
        place[v] = torch.from_numpy(np.asarray(t[row], dtype=np.float64).reshape(3))
    K = torch.from_numpy(np.asarray(K))
    if not bool(K.isfinite().all() & lens.isfinite().all() & R.isfinite().all() & place.isfinite().all()):
        return None
    return of_parameters(K, lens, R, place, problems.model, size)


class Residuals:
    """The residuals of one camera in NumPy and OpenCV, with their derivatives by all parameters, as SciPy wants them.

    Parameters are f_x, f_y, c_x, c_y, the lens, then a rotation vector and a translation for each view.
    """

    def __init__(self, problems: Problems, i: int) -> None:
        visible = problems.views.visible[i].numpy()
        self.rows = [v for v in range(len(visible)) if visible[v].sum() >= 4]
        self.seen = [problems.views.pixels[i, v].numpy()[visible[v]] for v in self.rows]
        self.points = [BOARD.points.numpy().astype(np.float64)[visible[v]] for v in self.rows]
        self.model, self.count = problems.model, MODELS[problems.model].count
        self.few = 4 + self.count

    def pack(self, camera: dp.Camera) -> np.ndarray:
        K = camera.K[0].numpy()
        parts = [np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])]
        if camera.distortion is not None and self.count:
            parts.append(camera.distortion.coefficients[0].numpy())
        for v in self.rows:
            parts += [cv2.Rodrigues(camera.R[v].numpy())[0].ravel(), camera.t[v].numpy()]
        return np.concatenate(parts)

    def unpack(self, x: np.ndarray, near: dp.Camera) -> dp.Camera:
        K = torch.tensor([[x[0], 0, x[2]], [0, x[1], x[3]], [0, 0, 1]], dtype=D)
        R, t = near.R.clone(), near.t.clone()
        for row, v in enumerate(self.rows):
            pose = x[self.few + 6 * row :][:6]
            R[v] = torch.from_numpy(cv2.Rodrigues(pose[:3].copy())[0])
            t[v] = torch.from_numpy(pose[3:].copy())
        return of_parameters(K, torch.from_numpy(x[4 : self.few].copy()), R, t, self.model, near.size)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        self.last = x.copy(), *self._at(x)
        return self.last[1]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        if not np.array_equal(self.last[0], x):
            self(x)
        return self.last[2]

    def _at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, slopes = [], []
        for row, (points, seen) in enumerate(zip(self.points, self.seen, strict=True)):
            at = self.few + 6 * row
            pixels, J = (self._fisheye if self.model == "fisheye" else self._brown)(x, x[at : at + 6], points)
            wide = np.zeros((2 * len(points), len(x)))
            wide[:, : self.few], wide[:, at : at + 6] = J[:, : self.few], J[:, self.few :]
            values.append((pixels - seen).ravel())
            slopes.append(wide)
        return np.nan_to_num(np.concatenate(values), nan=1e6, posinf=1e6, neginf=-1e6), np.concatenate(slopes)

    def _brown(self, x: np.ndarray, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        K = np.array([[x[0], 0, x[2]], [0, x[1], x[3]], [0, 0, 1.0]])
        lens = x[4 : self.few] if self.count else np.zeros(4)
        pixels, J = cv2.projectPoints(points, pose[:3].copy(), pose[3:].copy(), K, lens.copy())[:2]
        own = np.concatenate([J[:, 6 : 10 + self.count], J[:, :6]], axis=1)
        return pixels.reshape(-1, 2), own

    def _fisheye(self, x: np.ndarray, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R, turns = cv2.Rodrigues(pose[:3].copy())
        X = points @ R.T + pose[3:]
        by_pose = np.zeros((len(X), 3, 6))
        by_pose[:, :, :3] = np.einsum("rij,nj->nir", turns.reshape(3, 3, 3), points)
        by_pose[:, :, 3:] = np.eye(3)
        side = np.maximum(np.hypot(X[:, 0], X[:, 1]), 1e-12)
        angle = np.arctan2(side, X[:, 2])
        powers = angle[:, None] ** np.array([3, 5, 7, 9])
        bent = angle + powers @ x[4:8]
        slope = 1 + (angle[:, None] ** np.array([2, 4, 6, 8])) @ (np.array([3, 5, 7, 9]) * x[4:8])
        unit = X[:, :2] / side[:, None]
        by_side = np.concatenate([unit, np.zeros((len(X), 1))], 1)
        square = (X**2).sum(1)
        by_angle = (X[:, 2:] * by_side - side[:, None] * np.array([0, 0, 1.0])) / square[:, None]
        turn = (np.eye(2) - unit[:, :, None] * unit[:, None]) / side[:, None, None]
        by_X = np.pad(bent[:, None, None] * turn, ((0, 0), (0, 0), (0, 1)))
        by_X = by_X + unit[:, :, None] * (slope[:, None] * by_angle)[:, None]
        plane = bent[:, None] * unit
        J = np.zeros((len(X), 2, 14))
        J[:, 0, 0], J[:, 1, 1], J[:, :, 2:4] = plane[:, 0], plane[:, 1], np.eye(2)
        J[:, :, 4:8] = x[:2, None] * unit[:, :, None] * powers[:, None]
        J[:, :, 8:] = x[:2, None] * (by_X @ by_pose)
        return plane * x[:2] + x[2:4], J.reshape(-1, 14)


def scipy_from(problems: Problems, i: int, camera: dp.Camera) -> dp.Camera | None:
    """Where SciPy's Levenberg-Marquardt (MINPACK) ends from there; `None` where it is not installed."""
    try:
        from scipy.optimize import least_squares
    except ImportError:
        return None
    residuals = Residuals(problems, i)
    start = residuals.pack(camera)
    if not np.isfinite(start).all():
        return None
    limits: dict[str, Any] = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15, "max_nfev": 80}
    try:
        found = least_squares(residuals, start, residuals.jacobian, method="lm", x_scale="jac", **limits)
    except (ValueError, cv2.error, np.linalg.LinAlgError):
        return None
    return residuals.unpack(found.x, camera)


def refined(problems: Problems, rows: list[int], cameras: list[dp.Camera]) -> dp.Calibration:
    """The minima from these cameras, each with its views `(V,)`."""
    pixels, visible = problems.views.pixels[rows], problems.views.visible[rows]
    first = cameras[0].distortion
    lens = None if first is None else type(first)(torch.stack([c.distortion.coefficients for c in cameras]))  # type: ignore[union-attr]
    K, R, t = (torch.stack([getattr(c, name) for c in cameras]) for name in "KRt")
    start = dp.Camera(K, R, t, lens, problems.views.size)
    views = dp.Views(pixels, visible, size=problems.views.size)
    return dp.refine(views, BOARD, start, throw=False, **problems.options)


def judged(
    kind: str, seed: int, count: int, scipy_share: float = 0.1, oracles: bool = True
) -> Iterator[dict[str, Any]]:
    """What came out for each of so many problems."""
    draw = Draw(seed)
    problems = KINDS[kind](count, draw)
    model, views = problems.model, problems.views
    found = dp.calibrate(views, BOARD, model, throw=False, **problems.options)  # type: ignore[arg-type]
    true = with_lens_of(model, problems.truth)
    best = dp.refine(views, BOARD, true, throw=False, **problems.options)
    ends: list[list[dict[str, Any]]] = [[] for _ in range(count)]
    plain = not problems.options

    def noted(name: str, rows: list[int], other: dp.Calibration) -> None:
        cut = Problems(
            dp.Views(views.pixels[rows], views.visible[rows], size=views.size),
            problems.truth[rows],
            model,
            problems.options,
        )
        cost, reach = cost_of(other, cut), border_with_rays(other.camera, views.size or (0, 0))
        for j, i in enumerate(rows):
            ends[i].append(
                {
                    "from": name,
                    "cost": float(cost[j]),
                    "converged": bool(other.converged[j]),
                    "reach": float(reach[j]),
                    "shared": other.shared[j].tolist(),
                    "cause": other.causes[j][:160] if len(other.causes) > j else "",
                    "iterations": int(other.iterations[j]),
                }
            )

    every = list(range(count))
    noted("calibrate", every, found)
    noted("truth", every, best)
    if plain and oracles:
        theirs = [opencv(problems, i) for i in every]
        rows = [i for i in every if theirs[i] is not None]
        if rows:
            noted("opencv", rows, refined(problems, rows, [theirs[i] for i in rows]))  # type: ignore[misc]
        chance = draw.uniform(0, 1, count)
        for i in every:
            own, other = ends[i][0], ends[i][1:]
            costs = [end["cost"] for end in ends[i]]
            differ = max(costs) > min(costs) * (1 + HIGHER) or not all(e["converged"] for e in [own, other[0]])
            if not differ and chance[i] >= scipy_share:
                continue
            for name, start in (("scipy from calibrate", found.cameras[i]), ("scipy from truth", true[i])):
                end = scipy_from(problems, i, start)
                if end is not None:
                    noted(name, [i], refined(problems, [i], [end]))
    remarks = found.remarks
    deviations = found.covariance.shared.diagonal(dim1=-2, dim2=-1).sqrt() if found.has_covariance else None
    for i in every:
        yield _verdict(
            ends[i], remarks[i] if i < len(remarks) else "", None if deviations is None else deviations[i]
        ) | {
            "kind": kind,
            "seed": seed,
            "count": count,
            "row": i,
            "model": model,
            "ends": ends[i],
        }


def _verdict(ends: list[dict[str, Any]], remark: str, deviation: Tensor | None) -> dict[str, Any]:
    """Missed (told or not, mattering or not), falsely refused, or lower than the truth, of a camera's `ends`."""
    own, others = ends[0], ends[1:]
    lowest = min(others, key=lambda end: end["cost"] if math.isfinite(end["cost"]) else math.inf)
    sane = [end for end in others if end["converged"] and end["reach"] >= min(own["reach"], 1.0)]
    best = min(sane, key=lambda end: end["cost"]) if sane else None
    gap = own["cost"] / max(lowest["cost"], 1e-300) - 1
    legal_gap = None if best is None else own["cost"] / max(best["cost"], 1e-300) - 1
    missed = own["converged"] and gap > HIGHER
    moved = math.nan
    if deviation is not None:
        far = (torch.tensor(own["shared"]) - torch.tensor(lowest["shared"])).abs() / deviation
        moved = float(far[deviation > 0].nan_to_num(0.0).amax()) if bool((deviation > 0).any()) else math.nan
    return {
        "converged": own["converged"],
        "missed": missed,
        "missed_sane": bool(own["converged"] and legal_gap is not None and legal_gap > HIGHER),
        "gap": gap,
        "sane_gap": legal_gap,
        "remark": remark[:300],
        "silent": bool(missed and not remark),
        "matters": bool(missed and not remark and moved > MATTERS),
        "moved": moved,
        "refused": not own["converged"],
        "falsely_refused": not own["converged"] and best is not None,
        "lower_than_truth": bool(own["converged"] and own["cost"] < ends[1]["cost"] * (1 - HIGHER)),
    }
