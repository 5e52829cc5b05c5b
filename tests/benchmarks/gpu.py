"""Back-projection, calibration and top views on a CUDA device, against formulas by hand in the same process.

    python tests/benchmarks/gpu.py

Prints medians of ten calls, each timed to the end of its kernels, and the most memory that a call took beyond its
input. The peers: the ray cut with the plane by hand (pinhole), eager and compiled; the CPU for many cameras at once;
`grid_sample` with a grid by hand for six cameras' feature maps from above.
"""

import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic

D = torch.float64
K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
R = dp.rotation_from_euler(*torch.tensor([2.7, 0.25, 0.4]))
T = torch.tensor([10.0, -20, 500])
LENS = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002]))


def milliseconds(work: Callable[[], object], repeats: int = 10) -> float:
    """Median time of a call, its kernels included, after two that warm up."""
    times = []
    for attempt in range(repeats + 2):
        torch.cuda.synchronize()
        begin = time.perf_counter()
        work()
        torch.cuda.synchronize()
        if attempt > 1:
            times.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(times)


def extra_memory(work: Callable[[], object]) -> float:
    """Gigabytes that a call needs at most, beyond what was there before."""
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    work()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 1e9


def by_hand(pixels: Tensor, K: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """Rays of a pinhole cut with z = 0, as one writes it without a library."""
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0]
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    directions = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ R
    center = -R.T @ t
    return center - center[2] / directions[..., 2:] * directions


def many_points(count: int) -> None:
    """One camera, many pixels."""
    pixels = torch.rand(count, 2, device="cuda") * torch.tensor([640.0, 480], device="cuda")
    where = [tensor.cuda() for tensor in (K, R, T)]
    hand = torch.compile(by_hand)
    works: dict[str, Callable[[], object]] = {
        "by hand": lambda: by_hand(pixels, *where),
        "by hand, compiled": lambda: hand(pixels, *where),
    }
    for name, lens in (("pinhole", None), ("5-coefficient lens", LENS)):
        to_plane = dp.PlaneMap(
            dp.Camera(K, R, T, lens, (640, 480)).to("cuda"), dp.Plane.z(torch.zeros((), device="cuda"))
        )
        compiled = torch.compile(dp.PlaneMap.__call__)
        works[f"PlaneMap, {name}"] = lambda to_plane=to_plane: to_plane(pixels)
        works[f"PlaneMap, {name}, compiled"] = lambda to_plane=to_plane, call=compiled: call(to_plane, pixels)
    for name, work in works.items():
        took = milliseconds(work)
        print(
            f"{count:.0e} points, {name}: {took:8.2f} ms, {count / took / 1e6:6.1f} billion/s, {extra_memory(work):5.2f} GB"
        )


def many_cameras(cameras: int, views: int = 13) -> None:
    """Calibration of many cameras in one call, there and on the CPU."""
    board = dp.Chessboard()
    camera = dp.Camera(K.to(D), distortion=dp.BrownConrady(LENS.coefficients.to(D)), size=(640, 480))
    truth = synthetic.random_cameras(camera, board, cameras * views, seed=views)
    poses = truth.R.unflatten(0, (cameras, views)), truth.t.unflatten(0, (cameras, views))
    seen = synthetic.corner_views(camera.at(*poses), board, noise_px=0.2)
    there = seen.to("cuda")
    took = milliseconds(lambda: dp.calibrate(there, board), 3)
    begin = time.perf_counter()
    here = dp.calibrate(seen, board)
    took_here = 1e3 * (time.perf_counter() - begin)
    differs = (dp.calibrate(there, board).rms.cpu() - here.rms).abs().max()
    print(
        f"{cameras} cameras of {views} views: {took:.0f} ms, on {torch.get_num_threads()} CPU threads {took_here:.0f} ms; RMS differ by {differs:.1e} px"
    )


def from_above(batch: int = 4) -> None:
    """Six cameras' feature maps (32 channels, 32 x 88) on 100 x 100 cells of ground, and their gradients."""
    features = torch.rand(batch * 6, 32, 32, 88, device="cuda", requires_grad=True)
    small = torch.tensor([[80.0, 0, 43.5], [0, 80.0, 15.5], [0, 0, 1]])
    down = dp.rotation_from_euler(*torch.tensor([-2.0, 0.0, 0.0]))
    camera = dp.Camera(small.expand(batch * 6, 3, 3), down, torch.tensor([0.0, 1.5, 0.2]), size=(88, 32)).to("cuda")
    ground = dp.Plane.z(torch.zeros((), device="cuda"))
    extent, cell = (-25.0, -25.0, 25.0, 25.0), 2.0

    x = torch.linspace(-24.75, 24.75, 100, device="cuda")
    cells = torch.stack((*torch.meshgrid(x, x, indexing="xy"), torch.zeros(100, 100, device="cuda")), dim=-1)

    def hand() -> Tensor:
        seen = cells @ camera.R.mT[:, None] + camera.t[:, None, None]
        z = seen[..., 2:].clamp_min(1e-3)
        uv = seen[..., :2] / z * 80.0 + torch.tensor([43.5, 15.5], device="cuda")
        grid = (uv + 0.5) / torch.tensor([44.0, 16.0], device="cuda") - 1
        return torch.nn.functional.grid_sample(features, grid, align_corners=False)

    def ours() -> Tensor:
        return dp.rectify(features, camera, ground, extent, cell)[0]

    def both(work: Callable[[], Tensor]) -> Callable[[], object]:
        return lambda: torch.autograd.grad(work().sum(), features)

    for name, work in (("grid by hand", hand), ("rectify", ours)):
        forward, backward = milliseconds(work), milliseconds(both(work))
        print(
            f"from above, {name}: {forward:.2f} ms, with gradients {backward:.2f} ms, {extra_memory(both(work)):.2f} GB"
        )


def short_calls(count: int = 1000) -> None:
    """The time of a call in a network: forward, and with gradients, of a frozen and of a learning projector."""
    camera = dp.Camera(K, R, T, LENS, (640, 480))
    pixels = torch.rand(count, 2, device="cuda", requires_grad=True)
    where = [tensor.cuda() for tensor in (K, R, T)]
    works: dict[str, Callable[[], Tensor]] = {"pinhole by hand": lambda: by_hand(pixels, *where)}
    for name, seen_through, learn in (
        ("frozen pinhole", dp.Camera(K, R, T), ()),
        ("frozen, 5-coefficient lens", camera, ()),
        ("learning focal length and pose behind it", camera, ("focal", "pose")),
    ):
        projector = dp.PlaneProjector(seen_through, dp.Plane.z(0.0), learn).to("cuda")
        works[name] = lambda projector=projector: projector(pixels)[0]
    for name, work in works.items():
        forward = milliseconds(work)
        both = milliseconds(lambda work=work: work().sum().backward())
        print(f"{count} points, {name}: {forward:.2f} ms, with gradients {both:.2f} ms")


def main() -> None:
    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}, float32")
    many_points(10**6)
    many_points(10**8)
    short_calls()
    from_above()
    for cameras in (256, 4096):
        many_cameras(cameras)


if __name__ == "__main__":
    main()
