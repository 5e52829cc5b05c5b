"""The same on a CUDA device: 10^8 points, 4096 cameras, features from above, and the short calls of a network."""

from collections.abc import Iterator

import torch
from torch import Tensor

import diffproj as dp

from . import bev
from .calibration import simulated
from .comparing import Comparison
from .scenes import SIZE, K, R, T, both_ways, by_hand, by_hand_fused, camera


def comparisons() -> Iterator[Comparison]:
    if not torch.cuda.is_available():
        return
    ground, where = dp.Plane.z(torch.zeros((), device="cuda")), [tensor.cuda() for tensor in (K, R, T)]
    compiled, hand = torch.compile(dp.PlaneMap.__call__), torch.compile(by_hand_fused)
    held = [torch.rand(10**8, 2, device="cuda") * torch.tensor(SIZE, device="cuda")]
    for name in ("pinhole", "5-coefficient lens"):
        to_plane = dp.PlaneMap(camera(name != "pinhole").to("cuda"), ground)
        yield Comparison(
            f"GPU: PlaneMap, {name}, 10^8 points",
            lambda to_plane=to_plane: to_plane(held[0]),
            lambda: by_hand(held[0], *where),
            "pinhole by hand",
        )
        yield Comparison(
            f"GPU: PlaneMap compiled, {name}, 10^8 points",
            lambda to_plane=to_plane: compiled(to_plane, held[0]),
            lambda: hand(held[0], *where),
            "pinhole by hand, compiled",
        )
    held.clear()
    yield from _short_calls(where)
    for comparison in bev.comparisons("cuda"):
        comparison.__dict__["name"] = f"GPU: {comparison.name}"
        yield comparison
    board = dp.Chessboard()
    for cameras in (256, 4096):
        seen = simulated(cameras, 13, board)
        there = seen.to("cuda")
        yield Comparison(
            f"GPU: calibrate, {cameras} x 13 views",
            lambda there=there: dp.calibrate(there, board),
            lambda seen=seen: dp.calibrate(seen, board),
            f"{torch.get_num_threads()} CPU threads",
        )


def _short_calls(where: list[Tensor], count: int = 1000) -> Iterator[Comparison]:
    few = (torch.rand(count, 2) * torch.tensor(SIZE)).cuda().requires_grad_()
    for name, lens, learn in (
        ("frozen pinhole", False, ()),
        ("frozen, 5-coefficient lens", True, ()),
        ("learning focal length and pose behind it", True, ("focal", "pose")),
    ):
        projector = dp.PlaneProjector(camera(lens), dp.Plane.z(0.0), learn).to("cuda")
        yield Comparison(
            f"GPU: {name}, {count} points, both ways",
            both_ways(lambda projector=projector: projector(few)[0]),
            both_ways(lambda: by_hand(few, *where)),
            "pinhole by hand",
        )
