"""Some cameras of a batch have the residuals by themselves that they have in it."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.evidence.some_cameras import OF_ITEMS, _divided

D = torch.float64
BATCH = (2, 3)
ROWS = torch.tensor([1, 3, 4])
G = torch.Generator().manual_seed(0)


def pixels(*shape: int) -> torch.Tensor:
    return 300 + 200 * torch.rand(*shape, 2, generator=G, dtype=D)


def of_batch(low: float) -> torch.Tensor:
    return low + torch.rand(*BATCH, 4, generator=G, dtype=D)


PLANES = dp.Plane(torch.tensor([0.0, 0, 1], dtype=D).expand(*BATCH, 3), 0.1 * torch.rand(*BATCH, generator=G, dtype=D))
PIECES = [
    dp.Seen(torch.rand(4, 3, generator=G, dtype=D), pixels(*BATCH, 4).where(of_batch(0)[..., None] > 0.3, torch.nan)),
    dp.Seen(torch.rand(4, 3, generator=G, dtype=D), pixels(4), of_batch(1.0), sigma=0.1),
    dp.Horizon(pixels(3, 4), of_batch(1.0)),
    dp.Heights(pixels(*BATCH, 4) + 200, pixels(*BATCH, 4), of_batch(1.0), torch.tensor([0.1, 0.2, 0.1, 0.3], dtype=D)),
    dp.Lengths(pixels(2, 1, 4) + 200, pixels(2, 1, 4) + 200, 3.0, of_batch(0.1), pixel_sigma=0.5),
    dp.Lengths(pixels(4) + 200, pixels(4) + 200, 3.0, 0.1, plane=PLANES),
    dp.VanishingPoints(["x", "y", "z", "y"], pixels=pixels(*BATCH, 4)),
    dp.VanishingPoints(["x", "y", "z", "y"], segments=pixels(*BATCH, 4, 2), pixel_sigma=of_batch(1.0)),
    dp.Coplanar(10 * torch.rand(4, 2, generator=G, dtype=D), pixels(*BATCH, 4)),
]


@pytest.mark.parametrize("piece", PIECES, ids=lambda piece: type(piece).__name__)
def test_of_each_kind(piece: dp.Seen) -> None:
    height = 5 + torch.rand(*BATCH, generator=G, dtype=D)
    cameras = dp.Camera.mounted(height, 40.0, 3.0, 20.0, position=[0.0, -6.0], focal=800.0, size=(800, 800))
    index = torch.unravel_index(ROWS, BATCH)
    few = _divided(piece, BATCH, index)
    assert few is not None
    whole = piece.residuals(cameras)
    alone = few.residuals(cameras[index])
    assert whole.shape[:2] == BATCH
    assert torch.equal(alone.isnan(), whole[index].isnan())
    assert torch.allclose(alone, whole[index], equal_nan=True)
    assert bool(alone.isfinite().any())


def test_of_every_class() -> None:
    """One that is not in the table is looked at with its whole batch."""
    assert {type(piece) for piece in PIECES} == set(OF_ITEMS)
    own = type("Own", (dp.Seen,), {})([[0.0, 5.0]], [[300.0, 300.0]])
    assert _divided(own, (2,), (torch.tensor([0]),)) is None
