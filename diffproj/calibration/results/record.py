"""`Recorded`: a calibration as a dictionary for a file and back, with all that it says checked on the way in."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.fields import codes, mask, present, tensor
from diffproj.calibration.results.mismatch import Mismatch
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.geometry.camera import Camera
from diffproj.targets.exif import Told
from diffproj.targets.views import Views

T = TypeVar("T")

OBJECTIVES = ("image", "plane")
TENSORS = (
    *("rms", "status", "iterations", "bow", "displacements", "used", "rejected", "pixel_sigma", "shares"),
    *("degrees_of_freedom", "lens_region", "discounted"),
)
"""Attributes that go into a file as they are."""

SAME_RMS = 1e-6
"""Relative difference of the RMS that a file says from that of what it holds: above it, something was changed."""

MOST_STEPS = 2**31


class Recorded:
    """What gives a calibration to a file and takes it from there; its camera goes on its own."""

    def to_fields(self: Any) -> dict[str, Any]:
        """Everything but the camera as plain lists, strings and numbers; NaN and infinity may be among the numbers.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> again = dp.Calibration.from_fields(calibration.to_fields(), calibration.camera)
            >>> again.summary() == calibration.summary()
            True
        """
        lists: dict[str, Tensor | None] = {name: getattr(self, name) for name in TENSORS}
        lists |= {
            "points": self.nominal,
            "R": self.cameras.R,
            "t": self.cameras.t,
            "pixels": self.views.pixels,
            "visible": self.views.visible,
        }
        others = self.other_poses if self.has_alternatives else None
        if self.degrees_of_freedom is None:
            del lists["degrees_of_freedom"]  # where it is there without a number, that is infinite: see `_freedom`
        return {
            "objective": self.objective,
            "unit": self.unit,
            "rig": self.rig,
            "uncertain": None if self.uncertain is None else self.uncertain.tolist(),
            "landmarks": None if self.landmarks is None else list(self.landmarks),
            "skew": self.skew,
            "causes": list(self.causes),
            "remarks": list(self.remarks),
            "findings": [
                {"camera": camera, **remark._asdict()}
                for camera, remarks in enumerate(self.findings)
                for remark in remarks
            ],
            "names": list(self.views.names),
            "size": self.views.size,
            "told": [dict(one) for one in self.views.told] or None,
            "calibrated_on": None if self.calibrated_on is None else [dict(one) for one in self.calibrated_on],
            **{name: None if found is None else found.tolist() for name, found in lists.items()},
            "covariance": self.covariance_of_kept_poses.to_fields() if self.has_covariance else None,
            "other_poses": others
            and {"likelihood_ratio": others.ratio.tolist(), "R": others.R.tolist(), "t": others.t.tolist()},
            "mismatch": None
            if bool(self.mismatch.ratio.isnan().all())
            else {name: part.tolist() for name, part in self.mismatch._asdict().items()},
        }

    @classmethod
    def from_fields(cls: Any, fields: dict[str, Any], camera: Camera) -> Any:
        """The calibration that `to_fields` gave, in float64; fields that earlier releases lacked may be missing.

        Args:
            fields: lists or arrays, `None` for a number that is not finite.
            camera: the camera with the world frame in it, batch shape `*B`.

        Raises:
            KeyError: a field is missing.
            TypeError: a field is of the wrong type.
            ValueError: shapes do not fit each other, a number is out of its range or not finite, or the RMS is not that
                of the residuals.
        """
        batch = tuple(camera.batch_shape)
        visible = mask(fields, "visible")
        if visible.ndim != len(batch) + 2 or tuple(visible.shape[:-2]) != batch:
            raise ValueError(f"visible: want shape (*{batch}, V, N) as the camera says, got {tuple(visible.shape)}")
        V, N = visible.shape[-2:]
        pixels = tensor(fields, "pixels", (*batch, V, N, 2))
        names, size, told = _names(fields["names"], V), _size(fields["size"]), _told("told", fields.get("told"), V)
        views = Views(pixels, visible, names, size, told)
        if None not in (views.size, camera.size) and views.size != camera.size:
            raise ValueError(f"size: want that of the camera, {camera.size}, got {views.size}")
        used, rejected = (mask(fields, name, (*batch, V, N)) for name in ("used", "rejected"))
        if bool((used & ~visible).any()) or bool((used & rejected).any()):
            raise ValueError("used: want corners that are visible and not rejected, got others")
        discounted = mask(fields, "discounted", (*batch, V, N)) if present(fields, "discounted") else None
        if discounted is not None and bool((discounted & ~used).any()):
            raise ValueError("discounted: want corners that are used, got others")
        R, t = tensor(fields, "R", (*batch, V, 3, 3)), tensor(fields, "t", (*batch, V, 3))
        posed = camera if not batch else camera[..., None]
        if camera.dtype != torch.float64:
            posed = posed.to(torch.float64)
        status = codes(fields, "status", batch, max(Status))
        objective = fields["objective"]
        if objective not in OBJECTIVES:
            raise ValueError(f"objective: want {' or '.join(OBJECTIVES)}, got {objective!r}")
        covariance, others = _covariance(fields, batch, V, status), _others(fields.get("other_poses"), batch, V)
        found = cls(
            camera,
            posed.at(R, t),
            views,
            tensor(fields, "points", (N, 3)),
            used,
            rejected,
            status,
            codes(fields, "iterations", batch, MOST_STEPS),
            tensor(fields, "bow", (*batch, 2)) if present(fields, "bow") else None,
            objective,
            _texts("causes", fields["causes"]),
            _later(fields, "pixel_sigma", batch),
            skew=_flag("skew", fields.get("skew", False)),
            shares=_later(fields, "shares", (*batch, V)),
            degrees_of_freedom=_freedom(fields, batch),
            lens_region=_region(fields),
            unit=_unit(fields.get("unit")),
            rig=_rig(fields.get("rig")),
            calibrated_on=_told("calibrated_on", fields.get("calibrated_on")),
            landmarks=_landmarks(fields.get("landmarks"), N),
            uncertain=mask(fields, "uncertain", (N,)) if present(fields, "uncertain") else None,
            discounted=discounted,
            displacements=tensor(fields, "displacements", (*batch, N, 3)) if present(fields, "displacements") else None,
            _covariance=None if covariance is None else partial(_same, covariance),
            _others=None if others is None else partial(_same, others),
            _remarks=_findings(fields, max(1, status.numel())),
            _mismatch=_mismatch(fields.get("mismatch"), (*batch, V)),
        )
        _check_rms(fields, found.rms)
        return found


def _check_rms(fields: dict[str, Any], rms: Tensor) -> None:
    """Compare the RMS that is told with that of the corners, the board and the camera, all of which it depends on."""
    told = tensor(fields, "rms", tuple(rms.shape), least=0, gaps=True)
    both = told.isfinite() & rms.isfinite()
    if bool((told.isfinite() != rms.isfinite()).any()) or bool(
        ((told - rms).abs() > SAME_RMS * rms + 1e-12)[both].any()
    ):
        raise ValueError(
            f"rms: want {rms.flatten()[:3].tolist()} px, as the camera and the corners in the file give, got "
            f"{told.flatten()[:3].tolist()}: something was changed; calibrate again"
        )


def _covariance(fields: dict[str, Any], batch: tuple[int, ...], views: int, status: Tensor) -> Covariance | None:
    if not present(fields, "covariance"):
        return None
    found = Covariance.from_fields(fields["covariance"])
    if tuple(found.undetermined_views.shape) != (*batch, views):
        raise ValueError(f"covariance: want {views} views, got shape {tuple(found.undetermined_views.shape)}")
    unknown = found.has_gaps
    if bool((unknown & (status == Status.CONVERGED)).any()):
        raise ValueError("covariance: want finite numbers where the calibration converged, got gaps")
    return found


def _others(fields: dict[str, Any] | None, batch: tuple[int, ...], views: int) -> OtherPoses | None:
    if fields is None:
        return None
    ratio = tensor(fields, "likelihood_ratio", (*batch, views), least=0, gaps=True)
    R, t = tensor(fields, "R", (*batch, views, 3, 3), gaps=True), tensor(fields, "t", (*batch, views, 3), gaps=True)
    return OtherPoses(R, t, torch.where(ratio.isnan(), torch.inf, ratio))


def _mismatch(fields: dict[str, Any] | None, shape: tuple[int, ...]) -> Callable[[], Mismatch] | None:
    if fields is None:
        return None
    ratio, scale = (tensor(fields, name, shape, least=0, gaps=True) for name in ("ratio", "scale"))
    return partial(_same, Mismatch(ratio, mask(fields, "doubtful", shape), scale))


def _findings(fields: dict[str, Any], cameras: int) -> Callable[[], tuple[Remarks, ...]] | None:
    """The remarks one by one; of a file without their kinds, each camera's text as one."""
    if "findings" not in fields and "remarks" not in fields:
        return None
    found: list[list[Remark]] = [[] for _ in range(cameras)]
    if "findings" in fields:
        for given in fields["findings"]:
            if not isinstance(given, dict) or given["camera"] not in range(cameras) or given["kind"] not in list(Kind):
                raise ValueError(f"findings: want camera, kind ({', '.join(Kind)}), sentence and reason, got {given!r}")
            sentence, reason = _texts("findings", (given["sentence"], given["reason"]))
            found[given["camera"]].append(Remark(sentence, Kind(given["kind"]), reason))
    else:
        texts = _texts("remarks", fields["remarks"])
        if len(texts) != cameras:
            raise ValueError(f"remarks: want {cameras}, one for each camera, got {len(texts)}")
        for remarks, text in zip(found, texts, strict=True):
            remarks += [Remark(text)] * bool(text)
    return partial(_same, tuple(map(tuple, found)))


def _later(fields: dict[str, Any], name: str, shape: tuple[int, ...]) -> Tensor | None:
    """A field of numbers that cannot be negative, or `None`; NaN where a number is missing."""
    return tensor(fields, name, shape, least=0, gaps=True) if present(fields, name) else None


def _freedom(fields: dict[str, Any], batch: tuple[int, ...]) -> Tensor | None:
    """Degrees of freedom, infinite where the noise was known, which a file has no number for; `None` if left out."""
    if "degrees_of_freedom" not in fields:
        return None
    found = tensor(fields, "degrees_of_freedom", batch, least=0, gaps=True)
    return torch.where(found.isnan(), torch.inf, found)


def _region(fields: dict[str, Any]) -> Tensor | None:
    if not present(fields, "lens_region"):
        return None
    reach = tensor(fields, "lens_region", gaps=True)
    return torch.where(reach.isnan(), -torch.inf, reach)


def _names(names: Any, count: int) -> tuple[str, ...]:
    found = _texts("names", names)
    if len(found) != count:
        raise ValueError(f"names: want {count}, one for each view, got {len(found)}")
    return found


def _told(name: str, told: Any, count: int | None = None) -> tuple[Told, ...] | None:
    """What so many photographs, or any number of them, told of their camera; files of earlier releases lack it."""
    if told is None:
        return None
    if not isinstance(told, list | tuple) or count not in (None, len(told)) or not all(map(_is_told, told)):
        want = "objects" if count is None else f"{count} objects, one for each view,"
        raise ValueError(f"{name}: want {want} of texts and numbers, got something else")
    return tuple(tuple(one.items()) for one in told)


def _is_told(one: Any) -> bool:
    """Whether it is a name and a text or a number each."""
    return isinstance(one, dict) and all(isinstance(k, str) and type(v) in (str, int, float) for k, v in one.items())


def _landmarks(names: Any, count: int) -> tuple[str, ...] | None:
    """The names of the points, where they are landmarks; files of earlier releases lack them."""
    if names is None:
        return None
    found = _texts("landmarks", names)
    if len(found) != count:
        raise ValueError(f"landmarks: want {count} names, one for each point, got {len(found)}")
    return found


def _texts(name: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(text, str) for text in value):
        raise ValueError(f"{name}: want a list of texts, got something else")
    return tuple(value)


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name}: want true or false, got {value!r}")  # noqa: TRY004
    return value


def _unit(unit: Any) -> str | None:
    """The world's unit; files of earlier releases lack it."""
    if not isinstance(unit, str | None):
        raise ValueError(f"unit: want a text, got {unit!r}")  # noqa: TRY004
    return unit


def _rig(rig: Any) -> str | None:
    """Which rig the camera is of; files of earlier releases lack it."""
    if not isinstance(rig, str | None):
        raise ValueError(f"rig: want a text, got {rig!r}")  # noqa: TRY004
    return rig


def _size(size: Any) -> tuple[int, int] | None:
    if size is None:
        return None
    if not isinstance(size, list | tuple) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise ValueError(f"size: want width and height in px, got {size!r}")
    return size[0], size[1]


def _same(known: T) -> T:
    """What a calibration calls for what it computes late; a function of the module, so that it can be pickled."""
    return known
