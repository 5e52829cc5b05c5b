"""What the training parts cost: a frozen and a learning projector behind a lens, and their memory."""

from collections.abc import Iterator

import torch
from torch import Tensor

import diffproj as dp

from .comparing import Comparison
from .scenes import board, both_ways, camera, some_pixels


def comparisons() -> Iterator[Comparison]:
    pixels, behind = some_pixels(1000), camera(lens=True)
    bare = dp.PlaneMap(behind, board())
    frozen = dp.PlaneProjector(behind, board())
    turn, above = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]]), dp.Plane.z(torch.tensor(5.0))

    def peer() -> object:
        return frozen(pixels)

    which = "behind a lens, 1000 points"
    yield Comparison(f"frozen projector {which}", peer, lambda: bare(pixels), "bare map", 1.1)
    yield Comparison(f"the same with warp=, {which}", lambda: frozen(pixels, warp=turn), peer, "without", 1.3)
    yield Comparison(f"the same with plane=, {which}", lambda: frozen(pixels, plane=above), peer, "without", 1.3)
    pose, pinhole = dp.PlaneProjector(behind, board(), "pose"), dp.PlaneProjector(camera(), board(), "pose")
    yield Comparison(
        "map of a learned pose, fixed lens", lambda: pose.map(), lambda: pinhole.map(), "of a pinhole's pose", 1.3
    )
    yield Comparison(
        "learned pose, fixed lens, 1000 points, both ways",
        both_ways(lambda: pose(pixels)[0]),
        both_ways(lambda: bare(_tracked(pixels))[0]),
        "bare map",
    )
    lens = dp.PlaneProjector(behind, board(), "distortion")
    yield Comparison("learned lens, 100 points", lambda: lens(pixels[:100]), lambda: bare(pixels[:100]), "bare map")
    for name, seen_from in (("pinhole", camera()), ("lens", behind)):
        learn = ("focal", "principal_point", "pose", "plane") + (("distortion",) if name == "lens" else ())
        projector, many = dp.PlaneProjector(seen_from, board(), learn), some_pixels(10**5)

        def step(projector: dp.PlaneProjector = projector, many: Tensor = many) -> None:
            points, _ = projector(_tracked(many))
            points.backward(torch.ones_like(points))

        yield Comparison(
            f"peak memory, both ways, {name}, 10^5 points",
            step,
            lambda: 12 * 10**5,
            "output",
            6.5 if name == "pinhole" else 12.0,
            memory=True,
        )


def _tracked(pixels: Tensor) -> Tensor:
    return pixels.detach().requires_grad_()
