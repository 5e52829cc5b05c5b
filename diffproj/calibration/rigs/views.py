"""What the calibration of a rig is given, checked: the views of each camera, and the moments that they share."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffproj._core.arguments import called, number
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.own_frame import OwnFrame
from diffproj.targets.target import Target
from diffproj.targets.views import Views, as_views

Moments = Mapping[str, Sequence[str | int]]
"""By camera: the name or the number of the moment of each of its views."""


@dataclass(frozen=True, eq=False)
class RigViews:
    """The views of C cameras at M moments.

    Attributes:
        names: of the cameras.
        moments: their names, in the order in which they were first given.
        data: of each camera, with views `(1, V_c, N, 2)`.
        where: the moment of each view, a number from 0 `(V_c,)`, by camera.
    """

    names: tuple[str, ...]
    moments: tuple[str, ...]
    data: dict[str, Data]
    where: dict[str, Tensor]

    @property
    def points(self) -> Tensor:
        """The target's points `(N, 3)` about their middle."""
        return self.data[self.names[0]].points

    @property
    def frame(self) -> OwnFrame:
        """The target's own frame, which is solved in."""
        return self.data[self.names[0]].frame

    @property
    def spread(self) -> Tensor | None:
        """The covariances of landmarks in their own frame `(N, 3, 3)`; `None` where they are exact."""
        return self.data[self.names[0]].spread

    @property
    def middle(self) -> Tensor:
        """The middle of the target `(3,)` in its own frame."""
        return self.data[self.names[0]].middle

    def shared_moments(self, one: str, other: str) -> tuple[Tensor, Tensor]:
        """The numbers of the views in which two cameras see the same moments, `(K,)` each."""
        views = [self.where[name] for name in (one, other)]
        seen = [self.data[name].used[0].any(-1) for name in (one, other)]
        same = (views[0].unsqueeze(-1) == views[1]) & seen[0].unsqueeze(-1) & seen[1]
        first, second = same.nonzero().unbind(-1)
        return first, second


def rig_views(
    views_by_camera: Mapping[str, Views], target: Target, moments: Moments | None, weights: Any, who: str
) -> RigViews:
    """The views, with the camera's name in every message.

    Raises:
        TypeError: no mapping from names to views.
        ValueError: they do not fit together.
    """
    if not isinstance(views_by_camera, Mapping):
        raise TypeError(
            f"views_by_camera: want a mapping from names of cameras to dp.Views, got {called(views_by_camera)}"
        )
    names = tuple(views_by_camera)
    if not all(isinstance(name, str) and name for name in names):
        raise TypeError(f"views_by_camera: want names of cameras as keys, got {called(names)}")
    if len(names) < 2:
        raise ValueError(
            f"views_by_camera: want the views of at least two cameras, got {len(names)}; dp.calibrate is for one"
        )
    if weights is not None and not isinstance(weights, Mapping):
        weights = dict.fromkeys(names, number("weights", weights, "a mapping from names of cameras, or a number"))
    _check_names("weights", weights or {}, names)
    data = {}
    for name in names:
        label = f"views_by_camera[{name!r}]"
        views = as_views(views_by_camera[name], label)
        if views.batch_shape:
            raise ValueError(f"{label}: want those of one camera, got batch shape {tuple(views.batch_shape)}")
        if views.device != views_by_camera[names[0]].device:
            raise ValueError(
                f"{label}: want device {views_by_camera[names[0]].device} as the first, got {views.device}"
            )
        try:
            data[name] = Data(views, target, (weights or {}).get(name))
        except (TypeError, ValueError) as error:
            said = str(error)
            told = said.replace("views:", f"{label}:", 1) if said.startswith("views:") else said
            told = told.replace("weights:", f"weights[{name!r}]:", 1) if told.startswith("weights:") else told
            raise type(error)(told) from None
    labels = _labels(views_by_camera, moments, who)
    order = list(dict.fromkeys(label for name in names for label in labels[name]))
    places = {label: i for i, label in enumerate(order)}
    where = {
        name: torch.tensor([places[label] for label in labels[name]], dtype=torch.long, device=data[name].pixels.device)
        for name in names
    }
    return RigViews(names, tuple(order), data, where)


def _labels(views_by_camera: Mapping[str, Views], moments: Moments | None, who: str) -> dict[str, list[str]]:
    """The moment of each view, by camera."""
    if moments is None:
        labels = {name: list(views.names) for name, views in views_by_camera.items()}
        if not _any_shared(labels):
            labels = {name: [_without(name, view) for view in views.names] for name, views in views_by_camera.items()}
        if not _any_shared(labels):
            raise ValueError(
                f"{who}: the names of the views tell no moment that two cameras share: give views of the same moment "
                "the same name, or moments={'" + next(iter(views_by_camera)) + "': [...], ...}, the name or number "
                "of each view's moment by camera"
            )
    else:
        if not isinstance(moments, Mapping):
            raise TypeError(f"moments: want a mapping from names of cameras, got {called(moments)}")
        _check_names("moments", moments, tuple(views_by_camera))
        labels = {}
        for name, views in views_by_camera.items():
            if name not in moments:
                raise ValueError(f"moments: want those of every camera in views_by_camera, got none of {name!r}")
            labels[name] = _listed(name, moments[name], len(views))
    for name, own in labels.items():
        double = next((label for label in own if own.count(label) > 1), None)
        if double is not None:
            raise ValueError(f"moments[{name!r}]: want each moment once, got {double!r} several times")
    return labels


def _listed(name: str, given: Any, count: int) -> list[str]:
    if isinstance(given, Tensor) or hasattr(given, "tolist"):
        given = given.tolist()
    if isinstance(given, str) or not isinstance(given, list | tuple | range):
        raise TypeError(f"moments[{name!r}]: want a list of names or numbers, got {called(given)}")
    wrong = next((item for item in given if isinstance(item, bool) or not isinstance(item, str | int)), None)
    if wrong is not None:
        raise TypeError(f"moments[{name!r}]: want names or whole numbers, got {called(wrong)}")
    if len(given) != count:
        raise ValueError(f"moments[{name!r}]: want {count}, one for each of its views_by_camera, got {len(given)}")
    return [str(item) for item in given]


def _check_names(argument: str, given: Mapping[str, Any], names: tuple[str, ...]) -> None:
    stranger = next((name for name in given if name not in names), None)
    if stranger is not None:
        raise ValueError(f"{argument}: want names of cameras, {', '.join(names)}, got {stranger!r}")


def _any_shared(labels: Mapping[str, list[str]]) -> bool:
    count = sum(len(set(own)) for own in labels.values())
    return len({label for own in labels.values() for label in own}) < count


def _without(camera: str, view: str) -> str:
    """The name of a view without the camera's in it, as `left03.jpg` or `cam0/0003.png` have it."""
    return re.sub(rf"{re.escape(camera)}(?![0-9])|{re.escape(camera)}(?=[0-9]+\.)", "", view)
