"""What a rig's fit comes to: how it ended, the cameras at their places, and each camera as a calibration."""

import hashlib
import itertools
from collections.abc import Mapping
from functools import cached_property, partial

import torch
from torch import Tensor

from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.distinct import ALIKE_PX
from diffproj.calibration.results.remark import Kind, text_of
from diffproj.calibration.rigs.alone import Alone
from diffproj.calibration.rigs.common_errors import CLEAR, CommonErrors, common_errors
from diffproj.calibration.rigs.connection import set_apart, single_moments
from diffproj.calibration.rigs.discounted import discounted
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.held_contradiction import contradicted_held
from diffproj.calibration.rigs.moment_contradiction import contradicting_moment
from diffproj.calibration.rigs.parameters import POSE_NAMES
from diffproj.calibration.rigs.prior_contradiction import contradicted_priors
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.rigs.uncertainty import (
    CameraNoise,
    camera_noise,
    of_camera,
    of_right_corners,
    plain_covariance,
    rig_covariance,
)
from diffproj.calibration.trust.verdict import FEWEST_FOR_A_SHAPE, MAX_RELATIVE_STD
from diffproj.geometry.camera import Camera
from diffproj.targets.one_camera import against_one_camera

FAR_WORSE, FAR_OFF = 10.0, 0.002
"""RMS of a camera over that on its own, and over the image's extent, beyond both of which there is no rig."""
UNLIKE = 2.0
"""Ratio of the noise of two cameras, in units of their weights, from which on a remark says so."""
WORSE_TOGETHER = 1.5
"""RMS of a camera in the rig over that on its own from which on a remark says so."""
STANDS_OUT = 6.0
"""RMS of a view over that of its camera's views, their median, from which on a remark says so."""


def rig_outcome(found: RigFit, alone: Mapping[str, Alone]) -> RigCalibration:
    """The calibrated rig."""
    views, names = found.views, found.views.names
    noise = camera_noise(found)
    wrong = discounted(found, noise)
    joint = _Late(found, noise, wrong)
    R, t = found.problem.cameras(found.shared)
    cameras, calibrations = {}, {}
    fingerprint = hashlib.blake2b(found.shared.cpu().numpy().tobytes(), digest_size=12).hexdigest()
    status, cause = _verdict(found, noise, alone)
    for c, name in enumerate(names):
        data, kind = views.data[name], found.parameters.kinds[c]
        own = found.shared[0, found.parameters.intrinsics(c)]
        where = views.where[name]
        R_v = R[c] @ found.local[0][0, where]
        t_v = (R[c] @ found.local[1][0, where].unsqueeze(-1)).squeeze(-1) + t[c]
        posed = kind.unpack(own, data.frame.world_pose(R_v, t_v))
        size = data.views.size
        one = kind.unpack(own, (R[c], t[c]))
        cameras[name] = Camera.unchecked(one.K, one.R, one.t, one.distortion, size)
        calibrations[name] = Calibration(
            cameras[name].without_pose(),
            Camera.unchecked(posed.K, posed.R, posed.t, posed.distortion, size),
            data.views.to(torch.float64),
            data.given_points.detach(),
            found.used[name],
            found.rejected[name],
            torch.tensor(int(status), device=own.device),
            torch.tensor(found.iterations, device=own.device),
            causes=(cause,),
            pixel_sigma=noise.pixel_variance[c].sqrt(),
            bow=bow_of(found),
            skew=kind.skew,
            degrees_of_freedom=noise.freedom[c],
            displacements=displacements(found),
            uncertain=data.uncertain,
            rig=fingerprint,
            discounted=None if wrong is None else wrong[name],
            _covariance=partial(_of_camera, found, joint, c),
            _others=partial(_others, found, alone[name], name, posed.R, posed.t),
        )
    lost = [name for name, one in calibrations.items() if not bool(one.rms.isfinite())]
    if lost and status == Status.CONVERGED:
        status, cause = (
            Status.DEGENERATE,
            (
                f"corners of {', '.join(map(repr, lost))} lie beyond the fold of the lens: fit one with fewer "
                "coefficients, or 'fisheye'"
            ),
        )
    R_m, t_m = views.frame.world_pose(found.local[0][0], found.local[1][0])
    return RigCalibration(
        cameras,
        calibrations,
        views.moments,
        {name: views.where[name] for name in names},
        R_m,
        t_m,
        status,
        found.iterations,
        cause,
        _covariance=joint,
        _remarks=partial(_remarks, found, noise, joint, alone, status),
    )


def displacements(found: RigFit) -> Tensor | None:
    """How far the target's points are from where they were given `(N, 3)`; `None` where they were not free."""
    if not found.parameters.points:
        return None
    return found.views.frame.turned_back(found.shared[0, found.parameters.few :].unflatten(-1, (-1, 3))).clone()


def bow_of(found: RigFit) -> Tensor | None:
    """The board's bow `(2,)` in world units; `None` where it was not fitted."""
    return found.shared[0, -2:].clone() if found.parameters.bow else None


class _Late:
    """The joint covariance, and what the corners of a view have in common, computed once, when it is asked for."""

    def __init__(self, found: RigFit, noise: CameraNoise, wrong: Mapping[str, Tensor] | None) -> None:
        self.found, self.noise, self.wrong = found, noise, wrong
        self.known: Covariance | None = None

    @cached_property
    def common(self) -> CommonErrors | None:
        """Errors that all corners of a view share; of these, wrong ones tell nothing."""
        found, noise = self.found, self.noise
        if self.wrong is not None and any(bool(part.any()) for part in self.wrong.values()):
            found = of_right_corners(found, self.wrong)
            noise = camera_noise(found)
        return common_errors(found, noise.variance / noise.bend, noise.freedom, noise.bend)

    def __call__(self) -> Covariance:
        if self.known is None:
            self.known = rig_covariance(self.found, self.noise, self.common, self.wrong)
            self.found.problem.forget()
        return self.known


def _of_camera(found: RigFit, joint: _Late, camera: int) -> Covariance:
    return of_camera(found, joint(), camera)


def _others(found: RigFit, alone: Alone, name: str, R: Tensor, t: Tensor) -> OtherPoses:
    """The other pose of each view `(V_c,)`: none where another camera saw the target at that moment, too."""
    views, seen = found.views, torch.zeros(len(found.views.moments), dtype=torch.long, device=R.device)
    for other in views.names:
        seen[views.where[other]] += found.used[other].any(-1).long()
    others = alone.others()
    doubtful = found.used[name].any(-1) & (seen[views.where[name]] == 1)
    return OtherPoses(
        torch.where(doubtful[:, None, None], others.R, R.detach()),
        torch.where(doubtful[:, None], others.t, t.detach()),
        torch.where(doubtful, others.ratio, torch.inf),
    )


def _verdict(found: RigFit, noise: CameraNoise, alone: Mapping[str, Alone]) -> tuple[Status, str]:
    status = Status(found.status)
    if status == Status.DIVERGED:
        return status, ""
    worse = []
    for name, residual in found.by_camera.items():
        rms = float((residual.square().sum() / found.used[name].sum().clamp(min=1)).sqrt())
        extent = float(found.views.data[name].pixels.amax())
        if not rms <= max(FAR_WORSE * alone[name].rms, FAR_OFF * extent):
            worse.append(f"{name} by {rms:.1f} px, on its own by {alone[name].rms:.2f}")
    if worse:
        said = "" if found.problem.known is None else "are the priors right, "
        return Status.DEGENERATE, (
            f"no rig explains what the cameras see ({'; '.join(worse)}): {said}do the moments fit together (moments=), "
            "were their photographs taken at once or of a board at rest, did the cameras keep their places, and are "
            "the corners numbered from the same end?"
        )
    if not float(noise.freedom.sum()) > 0:
        return Status.DEGENERATE, "there are fewer corners than unknowns: add moments"
    known = plain_covariance(found, noise)
    unknown = known.undetermined[0].clone()
    deviation = known.shared[0].diagonal().sqrt()
    if found.restraint is not None:
        few = found.parameters.few
        size = found.views.points.square().sum(-1).mean().sqrt()
        lost = unknown[few:] & ~found.restraint.unknown[0]
        lost |= deviation[few:].isfinite() & (deviation[few:] > MAX_RELATIVE_STD * size)
        views = sum(int(used.any(-1).sum()) for used in found.used.values())
        alone_tell = not bool((found.restraint.printed > 0).any())
        if bool(lost.any()) or (alone_tell and views < FEWEST_FOR_A_SHAPE):
            return Status.DEGENERATE, (
                f"{views} views do not determine the shape of the target together with the cameras: take more moments "
                "that differ, tilted by 20 to 50 degrees about both axes; or say how well the target was printed, such "
                "as priors={'points': 0.1}; or take shape='flat'"
            )
        unknown = unknown[:few]
    for c in range(len(found.views.names)):
        own = found.parameters.intrinsics(c)
        f = found.shared[0, own.start : own.start + 2].abs().repeat(2)  # along the same axis
        unknown[own.start : own.start + 4] |= ~(deviation[own.start : own.start + 4] <= MAX_RELATIVE_STD * f)
    if bool(unknown.any()):
        lacking = [name for name, lost in zip(found.parameters.names, unknown.tolist(), strict=False) if lost]
        listed = f"{', '.join(lacking[:6])}{', ...' * (len(lacking) > 6)}"
        placeless = any(name.rpartition(".")[2] in POSE_NAMES for name in lacking)
        if placeless and (apart := set_apart(found)):
            return Status.DEGENERATE, (
                f"views contradict the other cameras at their moments ({apart}), and those that are left do not "
                f"determine {listed}: do the moments fit together (moments=), did the cameras stand still, and are the "
                "corners numbered from the same end?"
            )
        return Status.DEGENERATE, (
            f"the views do not determine {listed}: add moments that these cameras share with others, and views with "
            "the target tilted by 20 to 50 degrees about both axes"
        )
    return status, ""


def _remarks(
    found: RigFit, noise: CameraNoise, joint: _Late, alone: Mapping[str, Alone], status: Status
) -> tuple[str, ...]:
    """What is to be known of the rig."""
    if status != Status.CONVERGED:
        return ()
    views, names, said = found.views, found.views.names, []
    for name in names:
        moments = [views.moments[int(views.where[name][v])] for v in found.apart[name].nonzero().flatten().tolist()]
        if moments:
            said.append(
                f"at {', '.join(moments)} {name} contradicts the other cameras and was left out: was the target "
                "turned, or one of the photographs of another moment?"
            )
    for name in found.restrained:
        said.append(f"k4, k5 and k6 of {name} are held as on its own, for without that its lens folds inside the image")
    said += _same_views(found)
    beforehand = []
    if found.problem.known is not None:  # else the covariance is not asked for here
        beforehand += contradicted_priors(found, noise, float(joint().dispersion))
    if (held := contradicted_held(found, noise)) is not None:
        beforehand += filter(None, [held.remark(found, float(joint().dispersion))])
    said += beforehand
    said += _unlike(found, noise)
    if joint.common is not None and joint.common.beyond > CLEAR:
        places = [i for one in found.parameters.poses[1:] for i in one]
        said += filter(None, [joint.common.remark(names, places, joint().shared)])
    # What is wrongly known beforehand makes moments contradict each other.
    if not beforehand and (other := contradicting_moment(found, noise)) is not None:
        said += filter(None, [other.remark(found, joint().shared)])
    found.problem.forget()  # what common errors are found from
    residuals = found.by_camera
    for name in names:
        used = found.used[name]
        squares, count = residuals[name].square().sum((-2, -1)), used.sum(-1)
        flat = found.restraint is None and not found.parameters.bow
        # On its own it had a flat target; what that says of the tags' distance holds for a free one. And priors weighed
        # against corners of 1 px there, which in the rig do so against the noise that these have.
        views_seen = views.data[name].views[used.any(-1)]
        said += [f"{name}: {sentence}" for sentence, _ in against_one_camera(views_seen.names, views_seen.told)]
        own = (one for one in alone[name].findings() if one.kind not in (Kind.PRIOR_WEIGHT, Kind.TOLD_APART))
        told = text_of(one for one in own if flat or one.kind == Kind.SPACING)
        if told:
            said.append(f"{name}, on its own: {told}")
        rms = float((squares.sum() / count.sum().clamp(min=1)).sqrt())
        if rms > WORSE_TOGETHER * alone[name].rms and rms > 1e-6:
            said.append(
                f"{name} fits by {rms:.2f} px in the rig and by {alone[name].rms:.2f} px on its own: did the cameras "
                "move against each other, or are photographs of a moment not simultaneous?"
            )
        each = (squares / count.clamp(min=1)).sqrt()
        out = (
            (count > 0) & (each > STANDS_OUT * each[count > 0].median().clamp(min=1e-6))
            if bool(count.any())
            else count > 0
        )
        if bool(out.any()):
            moments = [views.moments[int(views.where[name][v])] for v in out.nonzero().flatten().tolist()]
            said.append(
                f"{name} fits badly at {', '.join(moments)} ({float(each.max()):.2f} px): leave that out, or give "
                "reject_outliers=True"
            )
    said += single_moments(found)
    return tuple(said)


def _same_views(found: RigFit) -> list[str]:
    """A remark on each two cameras that see every corner in one place, as one camera does that was given twice."""
    views, said = found.views, []
    for one, other in itertools.combinations(views.names, 2):
        pairs = list(zip((one, other), views.shared_moments(one, other), strict=True))
        seen = torch.stack([found.used[name][rows] for name, rows in pairs]).all(0)
        first, second = (views.data[name].views.pixels[rows].to(torch.float64) for name, rows in pairs)
        apart = (first - second).norm(dim=-1)[seen]
        if len(apart) and float(apart.amax()) < ALIKE_PX:
            said.append(
                f"{one} and {other} see each corner in one place, to {float(apart.amax()):.2g} px: were photographs of "
                "one camera given for both?"
            )
    return said


def _unlike(found: RigFit, noise: CameraNoise) -> list[str]:
    """A remark on cameras whose corners scatter unlike each other, if there are some."""
    level = noise.variance.clamp(min=0).sqrt()
    if not bool((level > 1e-6).all()) or float(level.amax() / level.amin()) < UNLIKE:
        return []
    names = found.views.names
    sigma = dict(zip(names, noise.pixel_variance.sqrt().tolist(), strict=True))
    weights = ", ".join(f"{name!r}: {1 / s**2:.3g}" for name, s in sigma.items())
    told = ", ".join(f"{s:.2f} px" for s in sigma.values())
    return [f"the corners of {', '.join(names)} scatter by {told}: weights={{{weights}}} let each count by its noise"]
