"""Diagnosis of a fit: views that contradict the board, parameters that the views do not determine."""

import math

import torch
from torch import Tensor

from diffproj.calibration.fitting.closed_form import homographies
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import mean_squares
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import INTRINSICS
from diffproj.calibration.results.distinct import one_view
from diffproj.calibration.trust.adequacy import LENS_WORDS, grave_remedy, gravely_inadequate, poses_only
from diffproj.calibration.trust.handedness import left_handed
from diffproj.calibration.trust.reach import folds_at_corners, lost_corners
from diffproj.targets.boards import Board, faces_away
from diffproj.targets.landmarks import Landmarks

MAX_RELATIVE_STD = 0.1
"""Standard deviation of a focal length or principal point, relative to the focal length along its axis, above which it
counts as undetermined."""
MAX_OF_ONE_VIEW = 0.3
"""The same where all views show the target alike: then it is told with its deviation, for points near the target are
put back no worse for it, and further off the error bars hold it."""
MAX_RELATIVE_RESIDUAL = 0.1
"""RMS residual of a view, relative to the RMS distance of its corners from their centroid, above which they do not
match the board."""
MIN_FORESHORTENING = 0.05
"""Relative change of scale over the board's image (foreshortening) below which the view counts as face on."""
PARALLEL_ANGLE = math.radians(15)
"""Angle between boards below which they count as parallel: they hardly determine the focal length, and the tilt
found is arbitrary."""

FEWEST_FOR_A_SHAPE = 6
"""Different views that free points take, of which nothing is known beforehand. From fewer the shape takes what is wrong
in a single view for its own: on real photographs, error bars then were half of what they should be."""

EXPLAINED = 4.0
"""Mean square of residuals over a noise that is known, up to which they may be nothing else."""

NEARLY_NONE, MOST = 1e-3, 0.9
"""Weight below which a robust loss leaves nearly nothing of a corner, and the share of such corners that is most."""

FOCAL = INTRINSICS[:2]
KNOWN_FOCAL = ', or give priors={"focal": (value, deviation)} where it is known roughly'
LANDMARKS_REMEDY = (
    "are pixels and landmarks in the same order, all coordinates in one unit, and x and y not exchanged? "
    "reject_outliers=True with pixel_sigma finds few wrong ones among many"
)
LEFT_HANDED = (
    "the corners fit the mirror image of the landmarks and not the landmarks: their coordinates are left-handed; "
    "exchange x and y, or change the sign of one of them (with z up, x east and y north are right-handed); or are u "
    "and v exchanged?"
)


class LacksViews(str):
    """A cause that other views would mend: these do not determine the camera, or a pose of theirs."""

    __slots__ = ()


ONE_VIEW = LacksViews(
    "one view does not tell the focal length from the principal point, the lens and the unevenness of the board: add "
    "views with the board tilted by 20 to 50 degrees about both axes, or let fixed or priors hold the principal point "
    "and the lens (a known camera needs but one view to be located)"
)


def verdicts(found: Fit, names: tuple[str, ...], board: object) -> tuple[Tensor, tuple[str, ...]]:
    """The status `(P,)` of each camera, and the cause in words where it did not converge (else empty)."""
    with torch.inference_mode():
        status, causes = _verdicts(found, names, board)
    return status.clone(), causes


def _verdicts(found: Fit, names: tuple[str, ...], board: object) -> tuple[Tensor, tuple[str, ...]]:
    task, solution = found.task, found.solution
    used = task.used.any(-1)
    R, t = solution.local
    known = found.plain_covariance
    no_pose = used & known.undetermined_views
    mirrored = ~no_pose & _mirrored(R, t, task.points, used, board)
    error = _relative_error(found)
    misfits = ~no_pose & used & (error > MAX_RELATIVE_RESIDUAL)
    unknown = known.undetermined.clone()
    # Points that hardly any view shows stay where they are, and say nothing of others.
    if task.restraint is not None and not task.surveyed:
        unknown[:, task.parameters.few :] &= ~task.restraint.unknown
        size = (task.points - task.points.mean(0)).square().sum(-1).mean().sqrt()
        unsure = known.shared.diagonal(dim1=-2, dim2=-1).sqrt()[:, task.parameters.few :]
        unknown[:, task.parameters.few :] |= unsure.isfinite() & (unsure > MAX_RELATIVE_STD * size)
        shapeless = _too_few_for_a_shape(task)
        unknown[:, -1] |= shapeless
    std = known.shared.diagonal(dim1=-2, dim2=-1).sqrt()[:, :4]
    unknown[:, :4] |= _hardly_known(task, std / solution.shared[:, (0, 1, 0, 1)].abs())
    none = ~used.any(-1)
    finite = solution.cost.isfinite()
    folded = finite & ~no_pose.any(-1) & folds_at_corners(task, solution.shared, solution.local)
    redundant = (found.degrees_of_freedom() > 0) | found.has_prior()
    held = poses_only(task)
    if held:  # four corners leave two degrees of freedom
        unknown[:] = False
    alone = _leans_on_one_view(task)
    status = solution.status
    wrong_lens = finite & ~folded & gravely_inadequate(found)
    at_fault = (mirrored | misfits | no_pose).any(-1)
    handed = finite & ~no_pose.any(-1) & left_handed(task, solution, _unexplained(found, error))
    degenerate = none | handed | at_fault | unknown.any(-1) | ~redundant | alone | folded | wrong_lens
    status = torch.where(degenerate & finite & (status != Status.DIVERGED), Status.DEGENERATE, status)
    causes = [""] * len(status)
    if not bool(status.any()):
        return status, tuple(causes)
    swamped = _swamped(found)
    for p in status.nonzero().flatten().tolist():
        if bool(none[p]):
            causes[p] = "no view shows at least 4 corners"
        elif not bool(finite[p]) and held and bool(task.pixels[p][task.used[p]].isfinite().all()):
            unmet = used[p] & ~solution.equations.c[p].isfinite()
            causes[p] = _misfit(_joined_names(names, unmet if bool(unmet.any()) else used[p]), board, held)
        elif not bool(finite[p]):
            causes[p] = (
                "the rays of some corners miss the board, beyond the lens's fold or the horizon: fit a lens with fewer "
                "coefficients, or take objective='image'"
                if task.objective == "plane" and bool(task.pixels[p][task.used[p]].isfinite().all())
                else "the corners are not finite, or the start puts the board behind the camera"
            )
        elif bool(swamped[p]):
            causes[p] = (
                "the scale of the loss is so far below the residuals that nearly every corner counts as an outlier: "
                "give it about twice the noise of a corner, in the residual's unit"
            )
        elif status[p] == Status.DIVERGED:
            continue
        elif bool(no_pose[p].any()):
            causes[p] = LacksViews(
                f"the corners of {_joined_names(names, no_pose[p])} do not determine a pose: do they lie on a line?"
            )
        elif bool(handed[p]):
            causes[p] = LEFT_HANDED
        elif bool(folded[p]) and (held or not bool(misfits[p].any())):
            causes[p] = _folded(task, int(lost_corners(task, solution.shared, solution.local)[p].sum()))
        elif bool(wrong_lens[p]):
            sigma = f"{float(found.pixel_sigma()[p]):.1f} px in each coordinate"
            causes[p] = f"the residuals, {sigma}, {LENS_WORDS} over the image, {grave_remedy(found, p)}"
        elif bool(misfits[p].any()):
            causes[p] = _misfit(_joined_names(names, misfits[p]), board, held)
        elif bool(mirrored[p].any()):
            causes[p] = (
                f"{_joined_names(names, mirrored[p])} show{'s' * (int(mirrored[p].sum()) == 1)} the board mirrored: "
                "number the corners of each row from the other end"
            )
        elif bool(alone[p]) and not (int(used[p].sum()) == 1 and bool(unknown[p].any())):
            several = int(used[p].sum()) > 1
            causes[p] = LacksViews(f"the views show the board alike, and {ONE_VIEW}") if several else ONE_VIEW
        elif not bool(redundant[p]) or bool(unknown[p].any()):
            few = task.parameters.few_names
            lacking = [name for name, lost in zip(few, unknown[p].tolist(), strict=False) if lost]
            if task.free and not task.surveyed:
                causes[p] = LacksViews(_shapeless(lacking, bool(unknown[p, len(few) :].any()), int(used[p].sum())))
                continue
            seen = task.part(slice(p, p + 1))
            free = task.basis is None or bool(task.basis[p, 2:4].any())
            if task.solid or isinstance(board, Landmarks):
                causes[p] = LacksViews(_undetermined_by_landmarks(lacking, free, task.solid))
                continue
            causes[p] = LacksViews(_undetermined(lacking, R[p, used[p]], _foreshortening(seen)[0, used[p]], free))
    return status, tuple(causes)


def _misfit(views: str, board: object, held: bool) -> str:
    """That the corners of these views fit no pose of the target."""
    what, remedy = ("board", "are its columns and rows right, and are its corners in order?")
    if isinstance(board, Landmarks):
        what, remedy = ("landmarks", LANDMARKS_REMEDY)
    camera = "; is the camera that of these photographs, of their zoom and their size?" if held else ""
    return f"the corners of {views} do not match the {what}: {remedy}{camera}"


def _swamped(found: Fit) -> Tensor:
    """Which cameras are fitted by a robust loss under which nearly no corner counts `(P,)`."""
    task = found.task
    if task.loss is None:
        return torch.zeros_like(found.solution.status, dtype=torch.bool)
    residual = task.problem.linearise(found.solution.shared, found.solution.local)[:, :, -1]
    outlying = task.used & (task.loss.weight(residual.square().sum(2)) < NEARLY_NONE)
    return outlying.sum((-2, -1)) > MOST * task.used.sum((-2, -1))


def _leans_on_one_view(task: Task) -> Tensor:
    """Which cameras have one view, or views alike, and more to be found than the focal lengths `(P,)`."""
    free = torch.ones_like(task.pixels[:, 0, 0, :1]).expand(-1, len(task.names)) > 0
    if task.basis is not None:
        free = (task.basis != 0).any(-1)
    if task.prior is not None:
        free = free & (task.prior.precision.diagonal(dim1=-2, dim2=-1) == 0)
    more = free[:, 2 : task.parameters.few if task.surveyed else None].any(-1)
    if task.solid:  # points in space tell even in one view
        return torch.zeros_like(more)
    return more & one_view(task.points, task.pixels, task.used) if bool(more.any()) else more


def _relative_error(found: Fit) -> Tensor:
    """RMS residual of each view, over the RMS distance of its corners from their centroid, `(P, V)`.

    With weights their mean by weight, whatever their unit; under a robust loss the robust std of the residuals as they
    are, for the loss would hide a view that fits nowhere.
    """
    task = found.task
    count = task.used.sum(-1).clamp(min=1)
    seen = task.pixels if task.objective == "image" else task.points[:, :2].expand_as(task.pixels)
    seen = torch.where(task.used.unsqueeze(-1), seen, 0.0)
    middle = seen.sum(-2) / count.unsqueeze(-1)
    spread = torch.where(task.used.unsqueeze(-1), seen - middle.unsqueeze(-2), 0.0).square().sum((-2, -1)) / count
    if task.loss is None:
        squares = 2 * mean_squares(task, found.solution.equations.c)
    else:
        residual = task.problem.linearise(found.solution.shared, found.solution.local)[:, :, -1]
        size = torch.where(task.used.unsqueeze(2), residual.abs(), torch.nan).flatten(2)
        squares = 2 * (1.4826 * size.nanmedian(-1).values).square()
    return (squares / spread.clamp(min=1e-30)).sqrt().nan_to_num(0.0)


def _unexplained(found: Fit, error: Tensor) -> Tensor:
    """That error where the noise is not known to explain it; 0 where it is."""
    if not found.knows_noise:
        return error
    explained = found.variance_of_residuals() <= EXPLAINED
    return torch.where(explained.unsqueeze(-1), 0.0, error)


def _mirrored(R: Tensor, t: Tensor, points: Tensor, used: Tensor, board: object) -> Tensor:
    """Which views show the board mirrored `(P, V)`: against a board's axes, or else against the majority."""
    middle = R @ points.mean(0) + t
    away = (R[..., 2] * middle).sum(-1) > 0  # the board's z points away from the camera
    if isinstance(board, Landmarks):  # not printed on one face of anything
        return torch.zeros_like(used)
    if isinstance(board, Board):
        expected = torch.full_like(away[:, :1], faces_away(board))
    else:
        expected = 2 * (away & used).sum(-1, keepdim=True) >= used.sum(-1, keepdim=True)
    return used & (away != expected)


def _folded(task: Task, count: int) -> str:
    what = f"{'1 corner lies' if count == 1 else f'{count} corners lie'} beyond the fold of the lens"
    if task.basis is not None and task.basis.shape[-1] == 0:
        return f"{what}: hide {'it' if count == 1 else 'them'}, or take a camera whose lens reaches as far"
    other = "'brown5'" if task.lens == "fisheye" else "'brown5' or 'fisheye'" if len(task.names) > 9 else "'fisheye'"
    return f"{what}: fit distortion={other}, which may reach as far"


def _undetermined(lacking: list[str], R: Tensor, foreshortening: Tensor, free_principal_point: bool) -> str:
    what = _lacking(lacking)
    normals = R[..., 2]
    if len(normals) == 1:
        why = "the only view is seen face on" if foreshortening[0] < MIN_FORESHORTENING else "one view is not enough"
        remedy = f"add views tilted by 20 to 50 degrees about both axes{KNOWN_FOCAL * ('f_x' in lacking)}"
        return f"{what}: {why}; {remedy}{', or fix the principal point and the lens' * free_principal_point}"
    across = torch.linalg.cross(normals, normals[:1].expand_as(normals)).norm(dim=-1)
    if bool((across < math.sin(PARALLEL_ANGLE)).all()):
        what += ": all views are parallel"
    return f"{what}; add photographs with the board tilted by 20 to 50 degrees about both axes"


def _lacking(names: list[str]) -> str:
    return f"the views do not determine {', '.join(names)}" if names else "there are fewer corners than parameters"


def _undetermined_by_landmarks(lacking: list[str], free_principal_point: bool, solid: bool) -> str:
    remedies = ["more landmarks, near and far" + " and off their plane" * (not solid)]
    if free_principal_point or any(name not in FOCAL for name in lacking) or not lacking:
        remedies.append('fixed=("principal_point", "distortion"), or some of the lens such as "k3"')
    if set(lacking) & set(FOCAL) or not lacking:
        remedies.append('tied_focal=True, or priors={"focal": (value, deviation)} where it is known roughly')
    return f"{_lacking(lacking)}: {'; '.join(remedies)}"


def _hardly_known(task: Task, deviation: Tensor) -> Tensor:
    """Which parameters have too large a deviation, relative to the focal length, to count as known `(P, 4)`."""
    lost = ~(deviation <= MAX_RELATIVE_STD)
    if bool((lost & (deviation <= MAX_OF_ONE_VIEW)).any()):
        lost &= ~(one_view(task.points, task.pixels, task.used).unsqueeze(-1) & (deviation <= MAX_OF_ONE_VIEW))
    return lost


def _foreshortening(task: Task) -> Tensor:
    """Relative change of the image's scale over the board `(P, V)`, from the homography alone."""
    H = homographies(task.points, task.pixels, task.used)
    half = (task.points[:, :2] - task.points[:, :2].mean(0)).abs().amax(0)
    return (H[..., 2, :2].abs() * half).sum(-1) / H[..., 2, 2].abs()


def _too_few_for_a_shape(task: Task) -> Tensor:
    """Which cameras have too few different views for free points of which nothing is known beforehand `(P,)`."""
    views = task.used.any(-1).to(task.pixels)
    views = (views if task.shares is None else views * task.shares).sum(-1)
    free = torch.zeros_like(views) > 0
    if task.restraint is not None:
        free = (task.restraint.printed == 0).flatten(1).all(-1)
    return free & (views < FEWEST_FOR_A_SHAPE - 0.5)


def _shapeless(lacking: list[str], points: bool, views: int) -> str:
    """What is to be said where the points of the target are free."""
    lacking = [*lacking, *(["the places of the target's points"] if points else [])]
    what = (
        f"{views} views do not determine {', '.join(lacking)}" if lacking else "there are fewer corners than parameters"
    )
    return (
        f"{what} together with its shape: take {FEWEST_FOR_A_SHAPE} and more that differ, tilted by 20 to 50 degrees "
        "about both axes; or say how well the target was printed, such as priors={'points': 0.1}; or take shape='flat'"
    )


def _joined_names(names: tuple[str, ...], chosen: Tensor) -> str:
    return ", ".join(names[i] for i in chosen.nonzero().flatten().tolist())
