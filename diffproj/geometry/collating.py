"""Joining cameras, planes, lenses and views to batches, by hand and in a `DataLoader`."""

import copy
from collections import UserDict
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from torch.utils.data import default_collate

from diffproj._core.arguments import called, listing
from diffproj._core.batched import Batched

B = TypeVar("B", bound=Batched)


def stack(items: Sequence[B], dim: int = 0) -> B:
    """Join cameras, planes, lenses or views of one kind along a new batch axis.

    It is the `stack` of their class: batch shapes broadcast, and constants such as the image size must agree.

    Args:
        items: at least one, all of one kind.
        dim: where the new axis stands among the batch axes.

    Raises:
        TypeError: none of these, or several kinds of them.
        ValueError: none, or what does not fit together.

    Example:
        >>> import torch, diffproj as dp
        >>> cameras = dp.stack([dp.Camera(torch.eye(3), size=(640, 480)) for _ in range(4)])
        >>> len(cameras), cameras.K.shape
        (4, torch.Size([4, 3, 3]))
    """
    want = "several cameras, planes, lenses or views of one kind"
    given = listing("items", items, want)
    if not given:
        raise ValueError(f"items: want {want}, got none")
    kind = type(given[0])
    if not isinstance(given[0], Batched):
        raise TypeError(f"items: want {want}, got {called(given[0])}")
    return kind.stack(given, dim)


def collate(samples: Sequence[Any]) -> Any:
    """Join the samples of a data set to a batch: what `DataLoader(..., collate_fn=dp.collate)` calls.

    Cameras, planes and lenses are joined by `stack`, in whatever dictionaries, tuples and lists they stand; all else as
    PyTorch's own `default_collate` does.

    Args:
        samples: at least one, all built alike.

    Raises:
        TypeError: samples that are not built alike, or that hold what PyTorch cannot join.
        ValueError: none, or cameras or tensors that do not fit together.

    Example:
        >>> import torch, diffproj as dp
        >>> samples = [{"image": torch.rand(3, 8, 8), "camera": dp.Camera(torch.eye(3))} for _ in range(2)]
        >>> batch = dp.collate(samples)
        >>> batch["image"].shape, batch["camera"].batch_shape
        (torch.Size([2, 3, 8, 8]), torch.Size([2]))
    """
    samples = listing("samples", samples, "several samples")
    if not samples:
        raise ValueError("samples: want at least one, got none")
    return _joined(samples)


def _joined(samples: list[Any]) -> Any:
    first = samples[0]
    kind = type(first)
    alike = all(isinstance(sample, kind) for sample in samples)
    if alike and isinstance(first, Mapping):
        alike = all(sample.keys() == first.keys() for sample in samples)
    if not alike:
        raise TypeError(f"samples: want ones that are built alike, got {', '.join(map(called, samples[:3]))}")
    if isinstance(first, Batched):
        try:
            return stack(samples)
        except (TypeError, ValueError) as error:
            raise type(error)(str(error).replace("items:", "samples:")) from None
    if isinstance(first, Mapping):
        joined = {key: _joined([sample[key] for sample in samples]) for key in first}
        if kind is dict or not isinstance(first, dict | UserDict):
            return joined
        batch = copy.copy(first)  # of its own kind, as default_collate does it; others' copies may share their values
        batch.update(joined)
        return batch
    if isinstance(first, tuple | list):
        if any(len(sample) != len(first) for sample in samples):
            raise TypeError(f"samples: want ones that are built alike, got {kind.__name__}s of different lengths")
        columns = [_joined(list(column)) for column in zip(*samples, strict=True)]
        return kind(*columns) if hasattr(first, "_fields") else kind(columns)
    try:
        return default_collate(samples)
    except TypeError:
        raise TypeError(f"samples: want what PyTorch's default_collate joins, got {called(first)}") from None
    except RuntimeError as error:  # shapes that differ, sparse tensors, no more memory to share
        raise ValueError(
            f"samples: want what PyTorch's default_collate joins, got {', '.join(map(called, samples[:3]))}: {error}"
        ) from error
