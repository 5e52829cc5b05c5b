"""Initial estimates in closed form, for all views of all cameras at once: homographies, focal lengths, poses.

A view of the plane z = 0 through a camera without distortion is a homography `H ~ K [r1 r2 t]` (Zhang 2000). That r1
and r2 are orthogonal and of equal length gives two equations per view, linear in `1 / f_x^2` and `1 / f_y^2` once the
principal point is fixed, here at the centre of the image. Zhang's full system, with the principal point as unknown, is
more sensitive to lens distortion than it is useful, but for images cut out of larger ones. With K known, the columns of
`K^-1 H` are the pose.

Where these equations have no plausible solution (parallel views, strong distortion), the focal length is chosen from a
coarse grid: the one under which the columns of `K^-1 H` are closest to orthonormal.
"""

import math

import torch
from torch import Tensor

FOCAL_SCALE = (0.4, 0.6, 0.8, 1.0, 1.3, 1.8, 2.5, 4.0)
"""Grid of focal lengths, in units of the image's longer side."""
FISHEYE_SCALE = (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.2)
"""The same for a fisheye, in units of the longer side over pi: 1 is a field of view of 180 degrees."""
MAX_CORNERS = 24
"""Maximum number of corners per homography, spread evenly over the list of those used."""
DIVISION_GRID, DIVISION_RANGE = (-0.3, -0.15, 0.0), (-0.45, 0.15)
"""Grid and limits of the division model's lambda: -0.3 moves the corner of the image inwards by 30 %."""
FEW_VIEWS = 4
"""Views of a camera up to which all of them take part in the estimate of lambda."""
DIVISION_VIEWS = 4
"""Views of a camera with more of them that lambda is estimated from: those that reach furthest out."""
MAX_ANGLE = math.radians(75)
"""Corners further from the axis than this are left out of homographies: the axis of a fisheye, or of turned rays."""


def homographies(points: Tensor, xy: Tensor, used: Tensor) -> Tensor:
    """Homographies `(P, V, 3, 3)` from the board, with its centroid as origin, to `xy (P, V, N, 2)`.

    The direct linear transform with normalised points (Hartley 1997). Its matrix of nine unknowns is made of moments of
    the points, so that the first six are eliminated by a matrix of 3 x 3, and what is left has its null vector in
    closed form. Not finite or arbitrary where the used corners do not determine a homography.
    """
    N = xy.shape[2]
    board = points[:, :2] - points[:, :2].mean(0)
    if N > MAX_CORNERS:  # an initial estimate needs no more
        step = torch.arange(1, MAX_CORNERS + 1, device=xy.device)
        if bool(used.all()):
            chosen = -(-step * N // MAX_CORNERS) - 1
            board, xy, used = board[chosen], xy[:, :, chosen], used[:, :, chosen]
        else:
            number = used.cumsum(-1)
            count = number[..., -1:]
            place = -(-step * count.clamp(min=MAX_CORNERS) // MAX_CORNERS)
            chosen = torch.searchsorted(number, place).clamp(max=N - 1)
            used, board = step <= count, board[chosen]
            xy = xy.gather(2, chosen.unsqueeze(-1).expand(-1, -1, -1, 2))
    both = torch.cat([board.expand_as(xy), xy], dim=-1)
    both = torch.where(used.unsqueeze(-1), both, 0.0)
    weight = used.unsqueeze(-1).to(both)
    count = weight.sum(-2, keepdim=True).clamp(min=1)
    middle = both.sum(-2, keepdim=True) / count
    both = (both - middle) * weight
    size = (both.square().sum(-2) / count.squeeze(-2)).unflatten(-1, (2, 2)).sum(-1).sqrt()
    both = both.unflatten(-1, (2, 2)) / size[..., None, :, None]
    # The moments of (x, y, 1) times its transpose, with 1, u, v and u^2 + v^2.
    a, uv = torch.cat([both[..., 0, :], weight], dim=-1), both[..., 1, :]
    factors = torch.cat([weight, uv, uv.square().sum(-1, keepdim=True)], dim=-1)
    moments = ((a.unsqueeze(-1) * a.unsqueeze(-2)).flatten(-2).mT @ factors).unflatten(-2, (3, 3))
    A, by_u, by_v, by_both = moments.unbind(-1)
    follow = torch.linalg.solve_ex(A, torch.cat([by_u, by_v], dim=-1))[0]
    left = by_both - by_u @ follow[..., :3] - by_v @ follow[..., 3:]
    last = torch.linalg.cross(left[..., 0], left[..., 1])  # of the symmetric matrix, what is across to two columns
    last = last / last[..., 2:]
    rows = (follow.unflatten(-1, (2, 3)) * last[..., None, None, :]).sum(-1)  # (P, V, 3, 2): by u and by v
    upper = rows.mT * size[..., 1, None, None] + middle[..., 2:].mT * last.unsqueeze(-2)
    H = torch.cat([upper, last.unsqueeze(-2)], dim=-2)
    linear = H[..., :2] / size[..., 0, None, None]
    H = torch.cat([linear, H[..., 2:] - linear @ middle[..., :2].mT], dim=-1)
    return H / H[..., 2:, 2:]


def division(
    points: Tensor, pixels: Tensor, used: Tensor, middle: Tensor, radius: float
) -> tuple[Tensor, Tensor | None]:
    """Estimate the division model's lambda, `(P,)`: `centred = distorted / (1 + lambda (|distorted| / radius)^2)`.

    Grid search with parabolic interpolation (model: Fitzgibbon 2001): homographies are fitted after undistortion with
    each lambda of the grid, and the minimum of the parabola through their errors is taken; 0 if it has none. In small
    batches all views are used, and their undistorted homographies `(P, V, 3, 3)`, interpolated over lambda, are
    returned as well, which saves a call; otherwise the views that reach furthest out are used, and `None` returned.
    """
    P, V = used.shape[:2]
    offset = torch.where(used.unsqueeze(-1), pixels - middle[:, None, None], 0.0)
    reach = offset.square().sum(-1).amax(-1)
    every = V <= FEW_VIEWS  # of one camera: what it gives must not depend on the others
    if not every:
        far = reach.topk(min(V, DIVISION_VIEWS), dim=1).indices
        chosen = torch.arange(P, device=far.device).unsqueeze(1), far
        pixels, used = pixels[chosen], used[chosen]
    nodes = len(DIVISION_GRID)
    seen, kept = pixels.repeat(nodes, 1, 1, 1), used.repeat(nodes, 1, 1)
    lam = seen.new_tensor(DIVISION_GRID).repeat_interleave(P)
    xy = without_division(seen, middle.repeat(nodes, 1), lam, radius)
    H = homographies(points, xy, kept)
    board = torch.nn.functional.pad(points[:, :2] - points[:, :2].mean(0), (0, 1), value=1.0)
    mapped = board @ H.mT
    count = kept.sum(-1).clamp(min=1)
    off = torch.where(kept.unsqueeze(-1), mapped[..., :2] / mapped[..., 2:] - xy, 0.0).square().sum((-2, -1)) / count
    size = torch.linalg.det(H).abs() / H[..., 2, 2].abs().pow(3)  # area magnification at the board's centre
    error = torch.where(off.isfinite() & size.isfinite(), off / size, 0.0).sum(-1).reshape(nodes, P)
    a, b, c = DIVISION_GRID
    slope_1, slope_2 = (error[1] - error[0]) / (b - a), (error[2] - error[1]) / (c - b)
    bend = (slope_2 - slope_1) / (c - a)
    lowest = (a + b) / 2 - slope_1 / (2 * bend)
    found = torch.where((bend > 0) & lowest.isfinite(), lowest, 0.0).clamp(*DIVISION_RANGE)
    if not every:
        return found, None
    scaled = (H / H[..., 2:, 2:]).reshape(nodes, P, V, 3, 3)
    shares = [  # Lagrange polynomials
        (found - b) * (found - c) / ((a - b) * (a - c)),
        (found - a) * (found - c) / ((b - a) * (b - c)),
        (found - a) * (found - b) / ((c - a) * (c - b)),
    ]
    return found, (scaled * torch.stack(shares)[:, :, None, None, None]).sum(0)


def without_division(pixels: Tensor, middle: Tensor, lam: Tensor, radius: float) -> Tensor:
    """Pixels `(P, V, N, 2)`, undistorted by the division model with lambda from `division`."""
    offset = pixels - middle[:, None, None]
    factor = 1 + lam[:, None, None, None] * offset.square().sum(-1, keepdim=True) / radius**2
    return middle[:, None, None] + offset / factor


def focal_lengths(H: Tensor, principal_point: Tensor, size: float, enough: Tensor, tied: bool) -> Tensor:
    """Focal lengths `(P, 2)` in pixels.

    Args:
        H: homographies `(P, V, 3, 3)` to pixels.
        principal_point: `(P, 2)`.
        size: the image's longer side in pixels.
        enough: which views have enough corners `(P, V)`.
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
    plausible = ((candidates > 0) & (f > 0.1) & (f < 50)).all(-1) & (f[..., 0] / f[..., 1] - 1).abs().lt(0.6)
    skew = _skewness(h1[:, None], h2[:, None], f[:, :, None], sound[:, None, :, 0])
    # A solution of the equations is preferred over a grid value unless the latter is clearly better.
    solved_count = solved.shape[1]
    skew[:, solved_count:] = skew[:, solved_count:] * 2 + 1e-9
    best = torch.where(plausible & skew.isfinite(), skew, torch.inf).argmin(-1)
    best = torch.where(plausible.any(-1), best, solved_count + FOCAL_SCALE.index(1.0))
    return f[torch.arange(len(f), device=f.device), best] * size


def intrinsics(H: Tensor, middle: Tensor, size: float, enough: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Focal lengths and principal point of a camera without lens, by Zhang's full system without skew.

    Args:
        H: homographies `(P, V, 3, 3)` to pixels.
        middle: the middle of the image `(P, 2)`, in px.
        size: the image's longer side in pixels.
        enough: which views have enough corners `(P, V)`.

    Returns:
        Focal lengths `(P, 2)`, principal point `(P, 2)`, and whether the system has such a solution `(P,)`.
    """
    h1, h2 = _centred_columns(H, middle, size)

    def row(a: Tensor, b: Tensor) -> Tensor:
        """What `a^T B b` multiplies of (B_11, B_22, B_13, B_23, B_33), for B = K^-T K^-1."""
        return torch.stack(
            [
                a[..., 0] * b[..., 0],
                a[..., 1] * b[..., 1],
                a[..., 0] * b[..., 2] + a[..., 2] * b[..., 0],
                a[..., 1] * b[..., 2] + a[..., 2] * b[..., 1],
                a[..., 2] * b[..., 2],
            ],
            dim=-1,
        )

    rows = torch.stack([row(h1, h2), row(h1 + h2, h1 - h2) / 2], dim=2)
    sound = (enough & rows.isfinite().all(-1).all(-1))[..., None, None]
    A = torch.where(sound, rows, 0.0).flatten(1, 2)
    B = torch.linalg.eigh(A.mT @ A).eigenvectors[..., 0]
    c = -B[:, 2:4] / B[:, :2]
    inverse = B[:, :2] / (B[:, 4:] + (B[:, 2:4] * c).sum(-1, keepdim=True))  # 1 / f^2
    plausible = (inverse > 0).all(-1) & (inverse < 100).all(-1) & (c.abs() < 20).all(-1)
    f = torch.where(plausible.unsqueeze(-1), inverse, 1.0).rsqrt()
    return f * size, middle + torch.where(plausible.unsqueeze(-1), c, 0.0) * size, plausible


def principal_point(H: Tensor, middle: Tensor, size: float, enough: Tensor) -> Tensor:
    """Principal points `(P, 2)` of cameras with square pixels and no lens, whatever the focal length.

    With `q = c_x^2 + c_y^2 + f^2` as an unknown of its own Zhang's equations are linear and have a solution, even where
    no focal length goes with it. Arguments are those of `intrinsics`; the middle where the solution is none.
    """
    h1, h2 = _centred_columns(H, middle, size)

    def row(a: Tensor, b: Tensor) -> Tensor:
        """What multiplies (c_x, c_y, q) in `a^T B b`, and what is left."""
        mixed = [-(a[..., i] * b[..., 2] + a[..., 2] * b[..., i]) for i in (0, 1)]
        return torch.stack([*mixed, a[..., 2] * b[..., 2], a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]], dim=-1)

    rows = torch.stack([row(h1, h2), row(h1 + h2, h1 - h2) / 2], dim=2)
    sound = (enough & rows.isfinite().all(-1).all(-1))[..., None, None]
    A = torch.where(sound, rows, 0.0).flatten(1, 2)
    gram = A.mT @ A
    scale = gram.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    gram = gram * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    solved = torch.linalg.solve_ex(gram[:, :3, :3], -gram[:, :3, 3:])[0].squeeze(-1)
    c = (solved * scale[:, :3] / scale[:, 3:])[:, :2]
    plausible = c.isfinite().all(-1) & (c.abs() < 20).all(-1)
    return middle + torch.where(plausible.unsqueeze(-1), c, 0.0) * size


def poses(H: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Poses `(R, t)`, `(P, V, 3, 3)` and `(P, V, 3)`, from homographies to the normalised plane.

    The whole board is in front of the camera. Where a homography is not usable, the board is placed parallel to the
    image, at ten times its half extent.
    """
    h1, h2, h3 = H.unbind(-1)
    facing = torch.where(h3[..., 2:] < 0, -1.0, 1.0)  # the board's centre is in front
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
    # Wrongly ordered corners may give a board that reaches behind the camera: it is moved away.
    lowest = (R[..., 2, :2] @ points[:, :2].mT).amin(-1) + t[..., 2]
    near = 0.2 * (points - points.mean(0)).abs().amax()
    return R, t + torch.nn.functional.pad((near - lowest).clamp(min=0).unsqueeze(-1), (2, 0))


def poses_along(points: Tensor, rays: Tensor, used: Tensor, perspective: bool) -> tuple[Tensor, Tensor]:
    """Poses `(R, t)`, `(P, V, 3, 3)` and `(P, V, 3)`, from the corners' rays `(P, V, N, 3)`, however far off the axis.

    With `perspective` all used corners are in front of the camera, where alone it sees them.
    """
    turn, xy, ahead = turned_rays(rays, used)
    R, t = poses(homographies(points, xy, ahead), points)
    R, t = turn @ R, (turn @ t.unsqueeze(-1)).squeeze(-1)
    if perspective:
        depth = (R[..., 2, :2] @ points[:, :2].mT) + t[..., 2:]
        lowest = torch.where(used, depth, torch.inf).amin(-1)
        near = 0.01 * (points - points.mean(0)).abs().amax()
        sight = turn[..., 2]
        behind = torch.where(lowest <= 0, near - lowest, 0.0)  # far out a corner may well be near the camera's plane
        t = t + sight / sight[..., 2:].clamp(min=1e-3) * behind.unsqueeze(-1)
    return R, t


def turned_rays(rays: Tensor, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each view's rays `(P, V, N, 3)` turned so that their mean is the axis, in the normalised plane.

    Beside a wide lens a view is as good as in its middle, but its rays have no place, or a far one, on the plane z = 1.

    Returns:
        The rotation `(P, V, 3, 3)`, by half a turn, so that it leads back too; the rays' points `(P, V, N, 2)` after
        it; and which of the used ones are within `MAX_ANGLE` of the mean `(P, V, N)`.
    """
    rays = torch.where(used.unsqueeze(-1), rays, 0.0)
    rays = rays / _length(rays, keep=True).clamp(min=1e-300)
    mean = rays.sum(-2)
    between = mean / _length(mean, keep=True).clamp(min=1e-300) + mean.new_tensor([0.0, 0, 1])
    turn = _half_turn(between / _length(between, keep=True).clamp(min=1e-300))
    straight = rays @ turn
    ahead = used & (straight[..., 2] > math.cos(MAX_ANGLE))
    xy = straight[..., :2] / torch.where(ahead, straight[..., 2], 1.0).unsqueeze(-1)
    return turn, torch.where(ahead.unsqueeze(-1), xy, 0.0), ahead


def upright_poses(points: Tensor, xy: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """Poses `(R, t)` of boards that face the camera, turned, scaled and placed as `xy (P, V, N, 2)` says.

    The start of last resort: an affine map is determined by corners that determine no homography, and bears wrong ones
    better. Of the map, the rotation within the image and the scale are kept.
    """
    count = used.sum(-1, keepdim=True).clamp(min=1).to(xy.dtype)
    weight = used.unsqueeze(-1).to(xy.dtype)
    board = points[:, :2] - points[:, :2].mean(0)
    seen_board = (board * weight).sum(-2) / count
    seen = torch.where(used.unsqueeze(-1), xy, 0.0)
    middle = seen.sum(-2) / count
    offset, place = (board - seen_board.unsqueeze(-2)) * weight, (seen - middle.unsqueeze(-2)) * weight
    # The similarity that maps one to the other in the least-squares sense, as a complex number.
    cosine = (offset * place).sum((-2, -1))
    sine = (offset[..., 0] * place[..., 1] - offset[..., 1] * place[..., 0]).sum(-1)
    flipped = (offset[..., 0] * place[..., 0] - offset[..., 1] * place[..., 1]).sum(-1)
    flipped_sine = (offset[..., 0] * place[..., 1] + offset[..., 1] * place[..., 0]).sum(-1)
    mirrored = torch.hypot(flipped, flipped_sine) > torch.hypot(cosine, sine)
    cosine, sine = torch.where(mirrored, flipped, cosine), torch.where(mirrored, flipped_sine, sine)
    size = offset.square().sum((-2, -1)).clamp(min=1e-300)
    length = torch.hypot(cosine, sine).clamp(min=1e-300)
    c, s = cosine / length, sine / length
    handed = torch.where(mirrored, -1.0, 1.0).to(xy)
    zero = torch.zeros_like(c)
    R = torch.stack([c, -handed * s, zero, s, handed * c, zero, zero, zero, handed], dim=-1).unflatten(-1, (3, 3))
    depth = (size / length).clamp(max=1e12)
    centre = torch.nn.functional.pad(points[:, :2].mean(0) + seen_board, (0, 1)).unsqueeze(-1)
    return R, torch.nn.functional.pad(middle, (0, 1), value=1.0) * depth.unsqueeze(-1) - (R @ centre).squeeze(-1)


def other_pose(R: Tensor, t: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """The second solution of the planar pose ambiguity: the normal mirrored at the line of sight to the centre."""
    center = points.mean(0)
    middle = R @ center + t
    sight = middle / _length(middle, keep=True)
    # Two half-turns, about the normal and then about the line of sight, are the smallest rotation from one normal
    # to the other, and a rotation for every pose, seen edge-on too.
    turn = _half_turn(sight) @ _half_turn(R[..., 2])
    other = turn @ R
    return other, middle - other @ center


def equidistant_rays(pixels: Tensor, principal_point: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
    """Undistorted points `(P, V, N, 2)` for an equidistant fisheye, and which are within `MAX_ANGLE` of the axis."""
    offset = (pixels - principal_point[:, None, None]) / focal[:, None, None, None]
    angle = _length(offset, keep=True)
    inside = angle < MAX_ANGLE
    safe = torch.where(inside & (angle > 1e-9), angle, 1.0)
    scale = torch.where(angle > 1e-9, safe.tan() / safe, 1.0)
    return torch.where(inside, offset * scale, 0.0), inside.squeeze(-1)


def _centred_columns(H: Tensor, principal_point: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """The first two columns of `[[1/size, -c/size], [0, 1]] H`, `(P, V, 3)` each."""
    upper = (H[..., :2, :2] - principal_point[:, None, :, None] * H[..., 2:, :2]) / size
    columns = torch.cat([upper, H[..., 2:, :2]], dim=-2)
    # The scale of a homography is arbitrary: normalised, so that every view has the same weight.
    columns = columns / columns.square().sum((-2, -1), keepdim=True).sqrt()
    return columns[..., 0], columns[..., 1]


def _skewness(h1: Tensor, h2: Tensor, f: Tensor, sound: Tensor) -> Tensor:
    """Deviation of the columns of `K^-1 H` from orthogonality and equal length, mean square over views `(P, C)`."""
    scale = torch.nn.functional.pad(f.reciprocal(), (0, 1), value=1.0)
    a, b = h1 * scale, h2 * scale
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    off = (4 * ab.square() + (aa - bb).square()) / (aa + bb).square()
    return torch.where(sound, off, 0.0).sum(-1) / sound.sum(-1).clamp(min=1)


def _half_turn(axis: Tensor) -> Tensor:
    """The rotations `(*, 3, 3)` by half a turn about unit vectors `(*, 3)`."""
    return 2 * axis.unsqueeze(-1) * axis.unsqueeze(-2) - torch.eye(3, dtype=axis.dtype, device=axis.device)


def _length(vector: Tensor, keep: bool = False) -> Tensor:
    return vector.square().sum(-1, keepdim=keep).sqrt()
