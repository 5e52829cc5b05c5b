"""What the training parts cost over the bare map, in time and memory.

Run alone on the machine: `python tests/benchmarks/modules.py [--threads N]`. Memory is the highest sum of what
PyTorch's allocator held beyond what was there before (pixels and gradients of an earlier step were: another 1.3 times the
output), as its profiler saw it.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity, profile

import diffproj as dp

LENS = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002]))


def compared(functions: dict[str, Callable[[], object]], rounds: int = 200) -> dict[str, float]:
    """Median seconds of each function, called in turn so that a busy moment of the machine meets them all."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(values[3:]) for name, values in times.items()}


def peak_bytes(function: Callable[[], object]) -> int:
    """Highest sum of allocated less freed bytes while the function runs."""
    function()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as seen:
        function()
    held, peak = 0, 0
    changes = (event for event in seen.profiler.kineto_results.events() if event.name() == "[memory]")
    for event in sorted(changes, key=lambda event: event.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    return peak


def camera(lens: dp.Lens | None) -> dp.Camera:
    """A web camera that looks down at a slant from half a metre, in millimetres."""
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
    R = dp.rotation_from_euler(*torch.tensor([2.7, 0.25, 0.4]))
    return dp.Camera(K, R, torch.tensor([10.0, -20, 500]), lens, size=(640, 480))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    torch.set_num_threads(parser.parse_args().threads)
    board = dp.Plane.z(0.0)
    print(f"{torch.get_num_threads()} thread(s), float32")
    for name, lens in (("pinhole", None), ("5-coefficient lens", LENS)):
        learn = ("focal", "principal_point", "pose", "plane") + (("distortion",) if lens else ())
        frozen, learned = dp.PlaneProjector(camera(lens), board), dp.PlaneProjector(camera(lens), board, learn)
        pixels = torch.rand(10**5, 2) * torch.tensor([640.0, 480])
        bare = dp.PlaneMap(camera(lens), board)
        took = compared({"bare": lambda: bare(pixels), "frozen": lambda: frozen(pixels)})  # noqa: B023
        rebuilt = compared({"map": learned.map})["map"]

        def step() -> None:
            inputs = pixels.requires_grad_()  # noqa: B023
            points, _ = learned(inputs)  # noqa: B023
            points.backward(torch.ones_like(points))

        peak = peak_bytes(step) / (12 * len(pixels))
        print(f"{name}, 10^5 points: frozen projector {took['frozen'] / took['bare']:.2f} x the bare map")
        print(f"{name}: a learnable projector rebuilds its map in {1e3 * rebuilt:.2f} ms")
        print(f"{name}, 10^5 points: forward and backward peak at {peak:.1f} x the output")


if __name__ == "__main__":
    main()
