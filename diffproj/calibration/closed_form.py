"""Where the solver starts: homographies, focal lengths and poses in closed form, for all views of all cameras at once.

A view of the plane z = 0 through a camera without lens is a homography `H ~ K [r1 r2 t]` (Zhang 2000). That r1 and r2
are orthogonal and of one length gives two equations for each view, linear in `1 / f_x^2` and `1 / f_y^2` once the
principal point is put where the camera says or in the middle of the image; Zhang's full system, which finds the
principal point too, suffers more from the lens than it gains. With K known, the columns of `K^-1 H` are the pose.

Where these equations have no sensible answer (parallel views, a strong lens), focal lengths on a coarse scale compete
instead: the one under which the views' columns are closest to orthonormal wins.
"""

import math

import torch
from kornia.geometry.homography import find_homography_dlt
from torch import Tensor

FOCAL_SCALE = (0.4, 0.6, 0.8, 1.0, 1.3, 1.8, 2.5, 4.0)
"""Focal lengths to try, in units of the image's longer side."""
FISHEYE_SCALE = (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.2)
"""Focal lengths to try for a fisheye, in units of the longer side over pi: 1 has half a turn across the image."""
ENOUGH = 24
"""Corners of a view that a homography is taken from at most, spread over those that were seen."""
DIVISION_TRIES, DIVISION_RANGE = (-0.3, -0.15, 0.0), (-0.45, 0.15)
"""What the one number for a lens is looked for among, and its limits: -0.3 moves the image's corner by a third."""
FEW_VIEWS = 64
"""Views in all up to which the cost is that of calls, not of views."""
DIVISION_VIEWS = 4
"""Views of a camera that the lens is looked for in."""
WIDEST = math.radians(75)
"""Directions further from the axis do not take part in a homography."""


def homographies(points: Tensor, xy: Tensor, used: Tensor) -> Tensor:
    """Homographies `(P, V, 3, 3)` from the board, with its centroid as origin, to `xy (P, V, N, 2)`.

    Not finite, or of no use, where the used corners do not determine one.
    """
    P, V, N, _ = xy.shape
    board = (points[:, :2] - points[:, :2].mean(0)).expand(P, V, N, 2)
    if N > ENOUGH:  # a start needs no more, however many there are
        order = used.cumsum(-1) * ENOUGH // used.sum(-1, keepdim=True).clamp(min=ENOUGH)
        spread = used & (order != torch.nn.functional.pad(order[..., :-1], (1, 0)))
        chosen = spread.to(xy.dtype).topk(ENOUGH).indices
        used = spread.gather(-1, chosen)
        chosen = chosen.unsqueeze(-1).expand(-1, -1, -1, 2)
        board, xy = board.gather(2, chosen), xy.gather(2, chosen)
    board, xy = board.reshape(P * V, -1, 2), xy.reshape(P * V, -1, 2)
    # Weights even where all are 1: what one view is computed by must not depend on another.
    return find_homography_dlt(board, xy, used.flatten(0, 1).to(xy.dtype), solver="lu").reshape(P, V, 3, 3)


def division(
    points: Tensor, pixels: Tensor, used: Tensor, middle: Tensor, radius: float
) -> tuple[Tensor, Tensor | None]:
    """The lens as one number `(P,)`: `lambda` of `centred = distorted / (1 + lambda (|distorted| / radius)^2)`.

    Straight lines of the board are straight on the image only without the lens: the number is where the homographies
    of a few views that reach far out fit best, on the parabola through three tries (Fitzgibbon 2001 has the model).
    Where there are few views in all, all are tried, and their homographies without the lens `(P, V, 3, 3)`, which are
    interpolated between the tries, come along: one call is dearer than a few more views.
    """
    P, V = used.shape[:2]
    offset = torch.where(used.unsqueeze(-1), pixels - middle[:, None, None], 0.0)
    reach = offset.square().sum(-1).amax(-1)
    every = P * V <= FEW_VIEWS
    if not every:
        far = reach.topk(min(V, DIVISION_VIEWS), dim=1).indices
        chosen = torch.arange(P, device=far.device).unsqueeze(1), far
        pixels, used = pixels[chosen], used[chosen]
    tries = len(DIVISION_TRIES)
    seen, kept = pixels.repeat(tries, 1, 1, 1), used.repeat(tries, 1, 1)
    lam = seen.new_tensor(DIVISION_TRIES).repeat_interleave(P)
    xy = without_division(seen, middle.repeat(tries, 1), lam, radius)
    H = homographies(points, xy, kept)
    board = torch.nn.functional.pad(points[:, :2] - points[:, :2].mean(0), (0, 1), value=1.0)
    mapped = board @ H.mT
    count = kept.sum(-1).clamp(min=1)
    off = torch.where(kept.unsqueeze(-1), mapped[..., :2] / mapped[..., 2:] - xy, 0.0).square().sum((-2, -1)) / count
    size = torch.linalg.det(H).abs() / H[..., 2, 2].abs().pow(3)  # area by which the board's middle is magnified
    error = torch.where(off.isfinite() & size.isfinite(), off / size, 0.0).sum(-1).reshape(tries, P)
    a, b, c = DIVISION_TRIES
    slope_1, slope_2 = (error[1] - error[0]) / (b - a), (error[2] - error[1]) / (c - b)
    bend = (slope_2 - slope_1) / (c - a)
    lowest = (a + b) / 2 - slope_1 / (2 * bend)
    found = torch.where((bend > 0) & lowest.isfinite(), lowest, 0.0).clamp(*DIVISION_RANGE)
    if not every:
        return found, None
    scaled = (H / H[..., 2:, 2:]).reshape(tries, P, V, 3, 3)
    shares = [  # Lagrange's
        (found - b) * (found - c) / ((a - b) * (a - c)),
        (found - a) * (found - c) / ((b - a) * (b - c)),
        (found - a) * (found - b) / ((c - a) * (c - b)),
    ]
    return found, (scaled * torch.stack(shares)[:, :, None, None, None]).sum(0)


def without_division(pixels: Tensor, middle: Tensor, lam: Tensor, radius: float) -> Tensor:
    """Pixels `(P, V, N, 2)` as they would be without the lens that `division` found."""
    offset = pixels - middle[:, None, None]
    factor = 1 + lam[:, None, None, None] * offset.square().sum(-1, keepdim=True) / radius**2
    return middle[:, None, None] + offset / factor


def focal_lengths(H: Tensor, principal_point: Tensor, size: float, enough: Tensor, tied: bool) -> Tensor:
    """Focal lengths `(P, 2)` in pixels.

    Args:
        H: homographies `(P, V, 3, 3)` to pixels.
        principal_point: `(P, 2)`.
        size: the image's longer side in pixels.
        enough: which views count `(P, V)`.
        tied: one focal length for both axes.
    """
    h1, h2 = _centred_columns(H, principal_point, size)
    d1, d2 = h1 + h2, h1 - h2
    rows = torch.stack([h1 * h2, d1 * d2 / 2], dim=2)  # (P, V, 2, 3): each times (1/f_x^2, 1/f_y^2, 1) is 0
    length = torch.stack([_length(h1) * _length(h2), _length(d1) * _length(d2) / 2], dim=2)
    sound = (enough & rows.isfinite().all(-1).all(-1)).unsqueeze(-1)
    rows = torch.where(sound.unsqueeze(-1), rows / length.clamp(min=1e-30).unsqueeze(-1), 0.0)
    A, b = rows[..., :2].flatten(1, 2), -rows[..., 2].flatten(1)
    both = A.sum(-1)
    one = ((both * b).sum(-1) / both.square().sum(-1)).unsqueeze(-1).expand(-1, 2)
    normal, right = A.mT @ A, (A.mT @ b.unsqueeze(-1)).squeeze(-1)
    determinant = normal[:, 0, 0] * normal[:, 1, 1] - normal[:, 0, 1].square()
    two = torch.stack(
        [
            normal[:, 1, 1] * right[:, 0] - normal[:, 0, 1] * right[:, 1],
            normal[:, 0, 0] * right[:, 1] - normal[:, 0, 1] * right[:, 0],
        ],
        dim=-1,
    ) / determinant.unsqueeze(-1)
    guesses = torch.tensor(FOCAL_SCALE, dtype=H.dtype, device=H.device).pow(-2)[None, :, None].expand(len(H), -1, 2)
    solved = one[:, None] if tied else torch.stack([two, one], dim=1)
    candidates = torch.cat([solved, guesses], dim=1)  # (P, C, 2), 1 / f^2
    f = candidates.clamp(min=1e-12).rsqrt()
    sensible = ((candidates > 0) & (f > 0.1) & (f < 50)).all(-1) & (f[..., 0] / f[..., 1] - 1).abs().lt(0.6)
    skew = _skewness(h1[:, None], h2[:, None], f[:, :, None], sound[:, None, :, 0])
    # What the equations give is preferred over a guess unless the guess is clearly better.
    solved_count = solved.shape[1]
    skew[:, solved_count:] = skew[:, solved_count:] * 2 + 1e-9
    best = torch.where(sensible & skew.isfinite(), skew, torch.inf).argmin(-1)
    best = torch.where(sensible.any(-1), best, solved_count + FOCAL_SCALE.index(1.0))
    return f[torch.arange(len(f), device=f.device), best] * size


def poses(H: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Poses `(R, t)`, `(P, V, 3, 3)` and `(P, V, 3)`, from homographies to the normalised plane.

    The whole board is in front. Where a homography is of no use, it stands upright, ten times its own size away.
    """
    h1, h2, h3 = H.unbind(-1)
    facing = torch.where(h3[..., 2:] < 0, -1.0, 1.0)  # the board's middle is in front
    n1, n2 = _length(h1, keep=True), _length(h2, keep=True)
    u1, u2 = facing * h1 / n1, facing * h2 / n2
    d1, d2 = u1 + u2, u1 - u2
    d1, d2 = d1 / _length(d1, keep=True), d2 / _length(d2, keep=True)
    r1, r2 = (d1 + d2) / math.sqrt(2), (d1 - d2) / math.sqrt(2)
    R = torch.stack([r1, r2, torch.linalg.cross(r1, r2)], dim=-1)
    center = torch.nn.functional.pad(points[:, :2].mean(0), (0, 1))
    t = facing * h3 / (n1 * n2).sqrt() - R @ center
    sound = (R.isfinite().all(-1).all(-1) & t.isfinite().all(-1))[..., None]
    away = 10 * (points - points.mean(0)).abs().amax() * H.new_tensor([0.0, 0, 1]) - center
    R = torch.where(sound[..., None], R, torch.eye(3, dtype=H.dtype, device=H.device))
    t = torch.where(sound, t, away)
    # Corners in another order than the board's may tilt it through the camera: then it is moved away.
    lowest = (R[..., 2, :2] @ points[:, :2].mT).amin(-1) + t[..., 2]
    near = 0.2 * (points - points.mean(0)).abs().amax()
    return R, t + torch.nn.functional.pad((near - lowest).clamp(min=0).unsqueeze(-1), (2, 0))


def other_pose(R: Tensor, t: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """The pose whose plane looks almost the same from afar: its normal mirrored at the line of sight to the middle."""
    center = points.mean(0)
    middle = R @ center + t
    sight = middle / _length(middle, keep=True)
    normal = R[..., 2]
    mirrored = 2 * (sight * normal).sum(-1, keepdim=True) * sight - normal
    # The smallest rotation from one normal to the other: I + [v]x + [v]x^2 / (1 + cos).
    cross = torch.linalg.cross(normal, mirrored)
    cosine = (normal * mirrored).sum(-1)[..., None, None]
    V = torch.zeros_like(R)
    V[..., 0, 1], V[..., 0, 2], V[..., 1, 2] = -cross[..., 2], cross[..., 1], -cross[..., 0]
    V = V - V.mT
    turn = torch.eye(3, dtype=R.dtype, device=R.device) + V + V @ V / (1 + cosine).clamp(min=1e-3)
    other = turn @ R
    return other, middle - other @ center


def equidistant_rays(pixels: Tensor, principal_point: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
    """Points `(P, V, N, 2)` of the normalised plane under an equidistant fisheye, and which are not too far out."""
    offset = (pixels - principal_point[:, None, None]) / focal[:, None, None, None]
    angle = _length(offset, keep=True)
    inside = angle < WIDEST
    safe = torch.where(inside & (angle > 1e-9), angle, 1.0)
    scale = torch.where(angle > 1e-9, safe.tan() / safe, 1.0)
    return torch.where(inside, offset * scale, 0.0), inside.squeeze(-1)


def _centred_columns(H: Tensor, principal_point: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """The first two columns of `[[1/size, -c/size], [0, 1]] H`, `(P, V, 3)` each."""
    upper = (H[..., :2, :2] - principal_point[:, None, :, None] * H[..., 2:, :2]) / size
    columns = torch.cat([upper, H[..., 2:, :2]], dim=-2)
    # Homographies differ in scale: with columns of length 1 each view weighs the same.
    columns = columns / columns.square().sum((-2, -1), keepdim=True).sqrt()
    return columns[..., 0], columns[..., 1]


def _skewness(h1: Tensor, h2: Tensor, f: Tensor, sound: Tensor) -> Tensor:
    """How far the columns of `K^-1 H` are from orthogonal and of equal length, mean square over views `(P, C)`."""
    scale = torch.nn.functional.pad(f.reciprocal(), (0, 1), value=1.0)
    a, b = h1 * scale, h2 * scale
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    off = (4 * ab.square() + (aa - bb).square()) / (aa + bb).square()
    return torch.where(sound, off, 0.0).sum(-1) / sound.sum(-1).clamp(min=1)


def _length(vector: Tensor, keep: bool = False) -> Tensor:
    return vector.square().sum(-1, keepdim=keep).sqrt()
