"""`Indexed`: some of many calibrations that were made side by side, chosen as elements of a tensor."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from diffproj._core.batched import check_index, index_batch
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.mismatch import Mismatch
from diffproj.calibration.results.remark import Remarks
from diffproj.targets.views import Views

C = TypeVar("C", bound="Indexed")

BEHIND = {
    **{"used": 2, "rejected": 2, "status": 0, "iterations": 0, "bow": 1, "pixel_sigma": 0, "shares": 1},
    **{"degrees_of_freedom": 0, "lens_region": 1, "displacements": 2, "discounted": 2},
}
"""How many axes the tensors of a calibration have behind those of the batch."""

BEHIND_OF_COVARIANCE = {
    **{"shared": 2, "undetermined": 1, "undetermined_views": 1, "dispersion": 0},
    **{"_follow": 3, "_mixed": 3, "_alone": 3, "_arm": 2, "_common": 3},
}
"""The same for its covariance."""


class Indexed:
    """What gives one calibration of many, or some of them."""

    def __getitem__(self: C, index: Any) -> C:
        """Some of many calibrations, chosen as one indexes a tensor of shape `*B`; `calibration[3]` is one of them.

        It holds all that a calibration of its own would: poses, covariance, other poses, remarks.

        Raises:
            TypeError: it is a single calibration, or the index is not one that tensors take.
            IndexError: there is no such calibration, or the index does not fit the batch shape.

        Example:
            >>> import diffproj as dp, torch
            >>> left, right = dp.example_views("left"), dp.example_views("right")
            >>> both = dp.Views(torch.stack([left[:9].pixels, right[:9].pixels]), size=left.size)
            >>> calibrations = dp.calibrate(both, dp.Chessboard())
            >>> calibrations[1].rms.shape, calibrations[1].verdict.split(":")[0]
            (torch.Size([]), 'Good')
        """
        many: Any = self
        check_index(index)
        shape = self._shape_of_many("index")
        causes = [many.causes[i] for i in numbers(shape, index)] if many.causes else ()
        some = {name: some_of(getattr(many, name), shape, index, behind) for name, behind in BEHIND.items()}
        late = {
            "_covariance": many.has_covariance,
            "_others": many.has_alternatives,
            "_remarks": many._remarks is not None,
            "_mismatch": many._mismatch is not None,
        }
        views = many.views
        return replace(
            many,
            camera=many.camera.expand(*shape)[index],
            cameras=many.cameras[_before_views(index)],
            views=Views.unchecked(
                index_batch(views.pixels, index, 3),
                index_batch(views.visible, index, 2),
                views.names,
                views.size,
                views.told,
            ),
            causes=tuple(causes),
            **some,
            **self._chosen(shape, index),
            **{name: partial(LATE[name], many, index) if known else None for name, known in late.items()},
        )

    def __iter__(self: C) -> Iterator[C]:
        """Those of the first batch axis, one after the other.

        Raises:
            TypeError: it is a single calibration.
        """
        return (self[number] for number in range(self._shape_of_many("calibration")[0]))

    def _chosen(self, shape: torch.Size, index: Any) -> dict[str, Any]:  # noqa: ARG002
        """What a kind of calibration has besides, of those that are chosen."""
        return {}

    def _shape_of_many(self, name: str) -> torch.Size:
        shape: torch.Size = cast(Any, self).views.batch_shape
        if not shape:
            raise TypeError(
                f"{name}: want many calibrations to choose from, got one; calibration.cameras[view] is its camera in a "
                "view, calibration.views[view] are its corners there"
            )
        return shape


def numbers(shape: torch.Size, index: Any) -> list[int]:
    """Which of all, one after the other."""
    return index_batch(torch.arange(shape.numel(), device="cpu").reshape(shape), index, 0).flatten().tolist()


def _before_views(index: Any) -> Any:
    """The index of a batch for what has the axis of views behind it."""
    parts = index if isinstance(index, tuple) else (index,)
    return (*parts, slice(None)) if any(part is Ellipsis for part in parts) else index


def some_of(tensor: Tensor | None, shape: torch.Size, index: Any, behind: int) -> Tensor | None:
    """Some of a tensor with so many axes behind those of the batch."""
    if tensor is None:
        return None
    return index_batch(tensor.expand(*shape, *tensor.shape[tensor.ndim - behind :]), index, behind)


def _covariance(many: Any, index: Any) -> Covariance:
    whole: Covariance = many.covariance_of_kept_poses
    shape = many.views.batch_shape
    parts = {name: some_of(getattr(whole, name), shape, index, n) for name, n in BEHIND_OF_COVARIANCE.items()}
    return replace(whole, **parts)


def _others(many: Any, index: Any) -> OtherPoses:
    whole: OtherPoses = many.other_poses
    return OtherPoses(
        index_batch(whole.R, index, 3), index_batch(whole.t, index, 2), index_batch(whole.ratio, index, 1)
    )


def _remarks(many: Any, index: Any) -> tuple[Remarks, ...]:
    return tuple(many.findings[i] for i in numbers(many.views.batch_shape, index))


def _mismatch(many: Any, index: Any) -> Mismatch:
    return Mismatch(*(index_batch(part, index, 1) for part in many.mismatch))


LATE = {"_covariance": _covariance, "_others": _others, "_remarks": _remarks, "_mismatch": _mismatch}
"""What is computed late, and how it is chosen from that of all."""
