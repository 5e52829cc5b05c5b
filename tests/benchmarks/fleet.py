"""A fleet of rendered cameras from photographs to error bars, with its time by stage: python tests/benchmarks/fleet.py 1000

The photographs are drawn first, by two processes, which is not counted. `--dask` searches them on a local cluster of two
workers as well, which must give the same cameras.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch

import diffproj as dp
from diffproj import synthetic

BOARD = dp.Chessboard(8, 5, 25.0)
GIVEN = ("--board", "8x5", "--square", "25mm", "--distortion", "brown4")


def render(folder: Path, seed: int, views: int = 8, size: tuple[int, int] = (480, 360)) -> float:
    """Photographs by one camera, into a folder; returns its focal length."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    random = torch.Generator().manual_seed(seed)
    u = torch.rand(5, generator=random, dtype=torch.float64)
    f, width, height = 380 + 120 * float(u[0]), *size
    middle = width / 2 + 8 * float(u[1]) - 4, height / 2 + 8 * float(u[2]) - 4
    K = torch.tensor([[f, 0, middle[0]], [0, f, middle[1]], [0, 0, 1]], dtype=torch.float64)
    lens = dp.BrownConrady(torch.tensor([-0.2 * u[3], 0.1 * u[4], 0, 0], dtype=torch.float64))
    cameras = synthetic.random_cameras(
        dp.Camera(K, distortion=lens, size=size), BOARD, views, distance=(1.2, 1.8), seed=seed
    )
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(views):
        grey = drawn(cameras[number]) + 4 * torch.randn(height, width, generator=random).numpy()
        cv2.imwrite(str(folder / f"{number}.png"), grey.clip(0, 255).astype(np.uint8))
    return f


def drawn(camera: dp.Camera, fine: int = 2) -> np.ndarray:
    """The board as a camera sees it, blurred: each pixel the mean of so many places along u and v."""
    width, height = camera.size or (0, 0)
    places = (torch.arange(fine, dtype=torch.float32) + 0.5) / fine - 0.5
    u = (torch.arange(width).unsqueeze(-1) + places).flatten()
    v = (torch.arange(height).unsqueeze(-1) + places).flatten()
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).flatten(0, 1)
    points, valid = dp.back_project(pixels, camera.to(torch.float32), dp.Plane.z(0.0))
    column, row = (points[:, :2] / BOARD.square).unbind(-1)
    inside = valid & (column > -1) & (column < BOARD.columns) & (row > -1) & (row < BOARD.rows)
    paper = valid & (column > -2) & (column < BOARD.columns + 1) & (row > -2) & (row < BOARD.rows + 1)
    dark = inside & ((column.floor() + row.floor()) % 2 == 0)
    grey = torch.where(dark, 30.0, torch.where(paper, 220.0, 140.0)).reshape(fine * height, fine * width)
    return cv2.GaussianBlur(cv2.resize(grey.numpy(), (width, height), interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def render_fleet(fleet: Path, cameras: int, views: int = 8) -> dict[str, float]:
    """So many cameras in a folder; the true focal lengths by name."""
    names = [f"camera{number}" for number in range(cameras)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        tasks = {name: pool.submit(render, fleet / name, seed, views) for seed, name in enumerate(names)}
        return {name: task.result() for name, task in tasks.items()}


def calibrate(fleet: Path, output: Path, *more: str) -> dict:
    """What `diffproj calibrate --fleet` says of itself."""
    command = [
        sys.executable,
        "-m",
        "diffproj",
        "calibrate",
        "--fleet",
        str(fleet),
        *GIVEN,
        "-o",
        str(output),
        "--json",
    ]
    return json.loads(subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cameras", type=int, nargs="?", default=50)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--dask", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fleet, output = Path(folder) / "fleet", Path(folder) / "cameras.jsonl"
        begin = time.perf_counter()
        truth = render_fleet(fleet, options.cameras, options.views)
        print(f"{options.cameras} cameras of {options.views} photographs drawn in {time.perf_counter() - begin:.0f} s")
        report = calibrate(fleet, output)
        print(json.dumps({name: report[name] for name in ("calibrated", "failed", "seconds")}, indent=1))
        lines = [json.loads(line) for line in output.read_text().splitlines()]
        off = [
            (line["summary"]["f_x"] - truth[line["name"]]) / line["summary"]["f_x_deviation"]
            for line in lines
            if "summary" in line
        ]
        print(f"f_x off by {torch.tensor(off).square().mean().sqrt():.2f} of its deviations (RMS)")
        print(f"{output.stat().st_size / len(lines) / 1000:.0f} kB a camera")
        if options.dask:
            from distributed import Client, LocalCluster

            with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster):
                other = Path(folder) / "dask.jsonl"
                report = calibrate(fleet, other, "--dask", cluster.scheduler_address)
            print("on a Dask cluster:", json.dumps(report["seconds"]))
            again = {line["name"]: line for line in map(json.loads, other.read_text().splitlines())}
            same = all(line.get("camera") == again[line["name"]].get("camera") for line in lines)
            print("the same cameras" if same else "other cameras")


if __name__ == "__main__":
    main()
