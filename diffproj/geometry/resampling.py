"""Resampling an image to another grid, against aliasing: how many samples a target pixel takes, and their mean.

Where a target pixel's footprint in the source is larger than a pixel, it is the mean of n x m bilinear samples about a
pixel apart. Each image of a batch has numbers of its own, so that no image depends on the others. They follow the
footprint f without a jump: n samples up to f = n, n + 1 from f = n + 1/4 on, and between the two the mean of both
results, weighted by where f lies. Said by the caller, the numbers are the same for all, nothing is looked up in
advance, and nothing depends on values: that is for `torch.compile`, export, and speed.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from diffproj._core.numerics import block_points
from diffproj._core.torch_private import has_no_values, in_recording, stands_for_a_batch
from diffproj.geometry.grid import pixel_grid

LookUp = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""Maps places in the target, `x (N,)` and `y (N,)` in pixels from its first corner, to positions in the source,
`u (*B, N)` and `v (*B, N)` in pixels from the centre of its first pixel, and `valid (*B, N)`."""
Chosen = tuple[Tensor, ...] | None
"""Which images of the batch: an index as `Tensor.nonzero(as_tuple=True)` gives it; `None` for all."""

MAX_SUPERSAMPLING = 128
"""Maximum number of samples along each side of a pixel."""
BAND = 0.25
"""By how much a footprint goes beyond n pixels until there are n + 1 samples alone."""
MOST_STEPS = 100_000
"""Of the target's pixels of an image, whose footprints are compared."""
UNKNOWN = "samples: want how many a pixel takes, got None where no values say it; samples=1 is fastest"
"""What is said where the number of samples depends on values that cannot be read."""


def resampled(
    source: Tensor,
    look_up_of: Callable[[Chosen], LookUp],
    shape: tuple[int, int],
    like: Tensor,
    samples: tuple[int, int] | None = None,
) -> tuple[Tensor, Tensor]:
    """Resample sources to targets.

    Args:
        source: `(*B, C, H, W)`.
        look_up_of: gives the look-up of some images of the batch.
        shape: `(rows, columns)` of the target.
        like: a tensor of the look-up's dtype and device.
        samples: along a pixel's sides, to the right and down; from the footprint of each image if left out.

    Returns:
        The targets `(*B, C, rows, columns)`, 0 where not valid; and `valid (*B, rows, columns)`: at least half of the
        pixel's samples are in the source.
    """
    corners = pixel_grid(*shape, like)
    if samples is not None:
        total, share = _mean(source, look_up_of(None), corners, samples)
        return (total, share > 0) if samples == (1, 1) else _finished(total, share)
    recording = not torch.compiler.is_compiling() and in_recording()  # whose numbers would be those of its example
    if recording or has_no_values(like) or has_no_values(source):
        raise ValueError(UNKNOWN)
    with torch.no_grad():
        u, v, valid = look_up_of(None)(*_apart(corners + 0.5))
        if stands_for_a_batch(u):
            raise ValueError(UNKNOWN)
        if 0 in (*source.shape[:-3], *valid.shape[:-1], *u.shape[:-1]):  # of no images
            return _finished(*_mean(source, look_up_of(None), corners, (1, 1)))
        shown = (valid & _inside(u, v, _size(source))).unflatten(-1, shape)
        places = torch.stack([u, v], dim=-1)
        footprints = _footprints(look_up_of(None), corners, places.unflatten(-2, shape), shown)
        between = any(bool(((more > 0) & (more < 1)).any()) for _, more in map(_numbers, footprints))
    if between and torch.is_grad_enabled():  # how the weights of two results move with the camera
        places = torch.stack(look_up_of(None)(*_apart(corners + 0.5))[:2], dim=-1)
        footprints = _footprints(look_up_of(None), corners, places.unflatten(-2, shape), shown)
    # A target may reach far beyond the source: only the part about what is shown is sampled.
    (top, bottom), (left, end) = (_range_of(shown.transpose(-1, axis).flatten(0, -2).any(0)) for axis in (-2, -1))
    part = corners[top:bottom, left:end]
    batch = torch.broadcast_shapes(source.shape[:-3], shown.shape[:-2])
    every = source.expand(*batch, *source.shape[-3:])
    numbers = [_numbers(footprint.expand(batch)) for footprint in footprints]
    total, share = torch.zeros((), dtype=source.dtype, device=source.device), like.new_zeros(())
    for right in _distinct(numbers[0]):
        for down in _distinct(numbers[1]):
            weight = _weight(numbers[0], right) * _weight(numbers[1], down)
            if not bool((weight > 0).any()):
                continue
            chosen = None if bool((weight > 0).all()) else weight.nonzero(as_tuple=True)
            if chosen is not None and not batch:
                chosen = None
            images = source if chosen is None else every[chosen]
            found, seen = _mean(images, look_up_of(chosen), part, (right, down))
            of_each = weight if chosen is None else weight[chosen]
            found, seen = found * of_each[..., None, None, None].to(found), seen * of_each[..., None, None]
            if chosen is not None:
                found = found.new_zeros(*batch, *found.shape[-3:]).index_put(chosen, found)
                seen = seen.new_zeros(*batch, *seen.shape[-2:]).index_put(chosen, seen)
            total, share = total + found, share + seen
    around = (left, shape[1] - end, top, shape[0] - bottom)
    mean, covered = _finished(total, share)
    return torch.nn.functional.pad(mean, around), torch.nn.functional.pad(covered, around)


def _finished(total: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """The mean over the samples that are in the source, and where these are at least half."""
    covered = share >= 0.5 - 1e-6
    return torch.where(covered.unsqueeze(-3), total / share.clamp(min=0.25).unsqueeze(-3).to(total), 0.0), covered


def _mean(source: Tensor, look_up: LookUp, corners: Tensor, samples: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The sum of samples over their number `(*B, C, rows, columns)`, and the share that is in the source.

    Args:
        source: `(*B, C, H, W)`.
        look_up: where places of the target are in the source.
        corners: of the target's pixels `(rows, columns, 2)`.
        samples: to the right and down.
    """
    right, down = samples
    rows, columns = corners.shape[:2]
    offsets = ((pixel_grid(down, right, corners) + 0.5) / corners.new_tensor([right, down])).reshape(-1, 2)
    images = 1 if torch.compiler.is_compiling() else source.shape[:-3].numel()  # a graph is for any number of them
    most = max(1, block_points(corners.device) // max(1, rows * columns * images))
    total, share = torch.zeros((), dtype=source.dtype, device=source.device), corners.new_zeros(())
    for some in offsets.split(most):
        u, v, valid = look_up(*_apart(corners + some[:, None, None]))
        sampled, seen = _sampled(source, u, v, valid, (len(some) * rows, columns))
        if len(offsets) == 1:
            return sampled, seen.to(corners.dtype)
        total = total + sampled.unflatten(-2, (len(some), rows)).sum(-3)
        share = share + seen.unflatten(-2, (len(some), rows)).sum(-3)
    return total / len(offsets), share / len(offsets)


def _sampled(source: Tensor, u: Tensor, v: Tensor, valid: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Bilinear samples `(*B, C, rows, columns)` of the source at positions `(u, v)`, and which are inside it."""
    width, height = _size(source)
    seen = valid & _inside(u, v, (width, height))
    batch = torch.broadcast_shapes(source.shape[:-3], seen.shape[:-1])
    # An image of one row or column becomes one of two: positions are told by the distance between first and last.
    source = source.expand(*batch, source.shape[-3], max(height, 2), max(width, 2))
    # Beyond the outermost centres an image goes on as it is there. What is not seen is far outside, where all is 0.
    columns = [
        torch.where(seen, (part * (2 / (max(side, 2) - 1)) - 1).clamp(-1, 1), -3.0)
        for part, side in ((u, width), (v, height))
    ]
    flat = torch.stack(columns, dim=-1).to(source.dtype).expand(*batch, -1, -1).reshape(-1, *shape, 2)
    sampled = grid_sample(source.reshape(-1, *source.shape[-3:]), flat, align_corners=True)
    return sampled.reshape(*batch, *sampled.shape[1:]), seen.expand(*batch, -1).unflatten(-1, shape)


def _apart(places: Tensor) -> tuple[Tensor, Tensor]:
    """Places `(*shape, 2)` one after the other, x and y by themselves `(N,)`."""
    x, y = places.reshape(-1, 2).T.contiguous()
    return x, y


def _inside(u: Tensor, v: Tensor, size: tuple[int, int]) -> Tensor:
    """As `inside`, by components: operations over a last axis of two are slow."""
    return ((u - (size[0] - 1) / 2).abs() <= size[0] / 2) & ((v - (size[1] - 1) / 2).abs() <= size[1] / 2)


def _size(source: Tensor) -> tuple[int, int]:
    """Width and height."""
    return source.shape[-1], source.shape[-2]


def _range_of(lines: Tensor) -> tuple[int, int]:
    """The range of lines `(n,)` that are shown, and one more on each side; all where none is."""
    where = lines.nonzero().flatten()
    return (max(0, int(where[0]) - 1), min(len(lines), int(where[-1]) + 2)) if len(where) else (0, len(lines))


# ----------------------------------------------------------------------------------------------------- how many samples


def _footprints(look_up: LookUp, corners: Tensor, places: Tensor, shown: Tensor) -> list[Tensor]:
    """To the right and down: see `_footprint`."""
    return [_footprint(look_up, corners, places, shown, axis) for axis in (-1, -2)]


def _footprint(look_up: LookUp, corners: Tensor, places: Tensor, shown: Tensor, axis: int) -> Tensor:
    """The footprint of the target's pixels in the source along a side, in px, for each image `(*B,)`.

    It is the 90th percentile over the target's pixels that are shown, from neighbour to neighbour, or, where there are
    none, from edge to edge; 1 where nothing is shown.

    Args:
        look_up: where places of the target are in the source.
        corners: of the target's pixels `(rows, columns, 2)`.
        places: of their middles in the source `(*B, rows, columns, 2)`.
        shown: which of these lie in the source `(*B, rows, columns)`.
        axis: along which: -1 to the right, -2 down.
    """
    step, pairs = places.diff(dim=axis - 1).norm(dim=-1), shown.shape[axis] - 1
    both = shown.narrow(axis, 0, pairs) & shown.narrow(axis, 1, pairs)
    footprint = _percentile(step.flatten(-2), both.flatten(-2))
    if bool(footprint.isnan().any()):
        half = corners.new_tensor([0.5, 0.0] if axis == -1 else [0.0, 0.5])
        first, last = (look_up(*_apart(corners + 0.5 + side * half)) for side in (-1, 1))
        length = torch.stack([last[0] - first[0], last[1] - first[1]], dim=-1).norm(dim=-1)
        alone = _percentile(length, first[2] & last[2] & shown.flatten(-2))
        footprint = torch.where(footprint.isnan(), alone, footprint)
    return footprint.nan_to_num(1.0)


def _percentile(values: Tensor, counts: Tensor) -> Tensor:
    """The 90th percentile of those values `(*B, n)` that count; NaN where none does."""
    if values.numel() == 0:
        return values.new_full(values.shape[:-1], torch.nan)
    every = 1 + values.shape[-1] // MOST_STEPS
    return torch.where(counts, values, torch.nan)[..., ::every].nanquantile(0.9, dim=-1)


def _numbers(footprint: Tensor) -> tuple[Tensor, Tensor]:
    """The number of samples along a side, and the share of the result with one more, `(*B,)`."""
    fewer = (footprint - BAND).ceil().clamp(1, MAX_SUPERSAMPLING)
    more = ((footprint - fewer) / BAND).clamp(0, 1)
    return fewer, torch.where(fewer < MAX_SUPERSAMPLING, more, 0.0)


def _distinct(numbers: tuple[Tensor, Tensor]) -> list[int]:
    """All numbers of samples that some image needs."""
    fewer, more = numbers
    return sorted({int(n) for n in fewer.unique().tolist()} | {int(n) + 1 for n in fewer[more > 0].unique().tolist()})


def _weight(numbers: tuple[Tensor, Tensor], n: int) -> Tensor:
    """The share of the result with n samples, of each image `(*B,)`."""
    fewer, more = numbers
    return torch.where(fewer == n, 1 - more, torch.where(fewer + 1 == n, more, 0.0))
