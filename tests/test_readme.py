"""Every call of the README's table works as it is written, in an empty folder with photographs and camera files."""

import doctest
import importlib
import io
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from kornia.augmentation import RandomHorizontalFlip

import diffproj as dp
from diffproj import cli

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
D = torch.float64


def rows() -> dict[str, list[str]]:
    """From what the reader wants to the calls, one for each piece of code in the second column."""
    table = README.partition("| I want to | call |\n|---|---|\n")[2].partition("\n\n")[0]
    cells = [re.fullmatch(r"\| (.+?) \| (.+) \|", line) for line in table.splitlines()]
    assert all(cells)
    return {cell[1]: re.findall("`(.+?)`", cell[2]) for cell in cells if cell}


ROWS = rows()


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    """What the README's first example defines."""
    source = README.partition("```python\n")[2].partition("```")[0]
    names: dict[str, Any] = {}
    test = doctest.DocTestParser().get_doctest(source, names, "README", "README.md", 0)
    assert doctest.DocTestRunner().run(test, clear_globs=False, out=io.StringIO().write).failed == 0
    return test.globs


@pytest.fixture(scope="module")
def folder(example: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of the board by the camera of the example, and its files."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "photos").mkdir()
    calibration, board = example["calibration"], example["board"]
    for number in range(6):
        image = dp.synthetic.photograph(calibration.cameras[number], board, seed=number).numpy()
        cv2.imwrite(str(folder / "photos" / f"{number}.jpg"), image)
    shutil.copy(folder / "photos" / "3.jpg", folder / "photo.jpg")
    film = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, calibration.camera.size)
    for path in sorted((folder / "photos").iterdir()):
        film.write(cv2.imread(str(path)))
    film.release()
    for name, height in (("survey.csv", 0.0), ("gcp.csv", -60.0)):  # the corners, each third at a height
        places = board.points.to(D) + height * (torch.arange(len(board.points)) % 3 == 0)[:, None] * torch.eye(3)[2]
        seen, _ = calibration.cameras[3].project(places)
        lines = [",".join(map(str, numbers)) for numbers in torch.cat([seen, places], dim=-1).tolist()]
        (folder / name).write_text("\n".join(["u,v,x,y,z", *lines]))
    shutil.copytree(folder / "photos", folder / "cameras" / "a")
    dp.save_camera(folder / "camera.json", calibration)
    dp.save_camera(folder / "camera.yaml", calibration)
    two = calibration.cameras[:2]
    two = dp.Camera(two.K, two.R, two.t, size=two.size)
    dp.save_camera(folder / "camchain.yaml", two, format="kalibr")
    dp.save_camera(folder / "cameras.txt", two.without_pose())
    return folder


def inputs(example: dict[str, Any]) -> dict[str, Any]:
    """The names of the table: those of the example, and small inputs for what a reader brings."""
    camera, calibration = example["camera"], example["calibration"]
    K, dist, rvec, tvec = camera.to_opencv()
    right = dp.example_views("right")
    plane = dp.Plane.z(0.0)
    image = torch.rand(1, 1, 480, 640, dtype=D)
    augment = RandomHorizontalFlip(p=1.0)
    augment(image)
    undistorted = dp.Camera(camera.K, camera.R, camera.t, size=camera.size)
    pair = {"left": example["views"], "right": right}
    rig = dp.calibrate_rig(pair, example["board"])
    return {
        **{name: example[name] for name in ("torch", "dp", "board", "views", "calibration", "camera", "pixels")},
        **{name: example[name] for name in ("points", "valid")},
        "K": K,
        "dist": dist,
        "rvec": rvec,
        "tvec": tvec,
        "w": 640,
        "h": 480,
        "corners": torch.stack([calibration.views.pixels, right.pixels]),
        "visible": torch.stack([calibration.views.visible, right.visible]),
        "left_views": example["views"],
        "right_views": right,
        "views_by_camera": pair,
        "rig": rig,
        "known": rig,
        "plane": plane,
        "located": dp.locate(example["views"], example["board"], calibration),
        "measured": dp.measure(example["pixels"].detach(), calibration, plane, view=0, pixel_sigma=0.5),
        "extent": (0.0, 0.0, 200.0, 125.0),
        "resolution": 2.5,
        "image": image,
        "texture": torch.rand(1, 50, 80, dtype=D),
        "augment": augment,
        "projector": dp.PlaneProjector(camera, plane),
        "cameras": calibration.cameras,
        "which": torch.arange(13) < 5,
        "target": torch.zeros(2, 3, dtype=D),
        "normals": torch.tensor([[0.0, 0, 1], [0.0, 0.1, 1]], dtype=D),
        "offsets": torch.tensor([0.0, 10.0], dtype=D),
        "coefficients": camera.distortion.coefficients,
        "xy": torch.rand(5, 2, dtype=D) * 0.2,
        "left": 100,
        "top": 50,
        "undistorted": undistorted,
        "pinhole": undistorted.to_kornia(),
        "psi": torch.tensor(0.1),
        "phi": torch.tensor(0.2),
        "theta": torch.tensor(0.3),
        "R": camera.R,
        **evidence(),
        **surveyed(calibration.cameras[0]),
        "other": dp.measure(example["pixels"].detach() + 0.1, calibration, plane, view=0, pixel_sigma=0.5),
        "deviations": torch.tensor([0.5, 0.8], dtype=D).expand(len(example["pixels"]), 2),
        "latitudes_longitudes": [[40.4168, -3.7038], [40.4169, -3.7038]],
    }


def surveyed(camera: dp.Camera) -> dict[str, Any]:
    """Points in space that a camera sees."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(12, 3, dtype=D, generator=generator) * torch.tensor([200.0, 125, -80], dtype=D)
    return {
        "surveyed": points,
        "clicked": camera.project(points)[0] + 0.3 * torch.randn(12, 2, dtype=D, generator=generator),
        "names": [f"post {i}" for i in range(12)],
        "origin": torch.tensor([100.0, 60, 0], dtype=D),
    }


def evidence() -> dict[str, Any]:
    """What a camera on a mast sees."""
    mast = dp.Camera.mounted(6.0, 20.0, heading_deg=30.0, fov_deg=70.0, size=(640, 480))
    landmarks = torch.tensor([[8.0, 12, 0], [5, 18, 2], [14, 16, 1], [10, 25, 0]], dtype=D)
    standing = torch.tensor([[6.0, 10, 0], [8, 14, 0]], dtype=D)
    return {
        "mast": mast,
        "landmarks": landmarks,
        "seen": mast.project(landmarks)[0],
        "horizon": mast.project(mast.center + 1e6 * torch.tensor([[0.3, 1, 0], [0.9, 1, 0]], dtype=D))[0],
        "feet": mast.project(standing)[0],
        "tops": mast.project(standing + torch.tensor([0, 0, 1.75], dtype=D))[0],
        "ends": mast.project(standing + torch.tensor([3.5, 0, 0], dtype=D))[0],
        "meeting": mast.project(mast.center + 1e9 * torch.eye(3, dtype=D)[[1, 0]])[0],
        "shore": landmarks[:3, :2],
    }


@pytest.fixture
def names(example: dict[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    monkeypatch.chdir(folder)
    with torch.enable_grad():
        yield inputs(example)


def test_the_table_is_found() -> None:
    assert len(ROWS) > 35
    assert all(ROWS.values())


@pytest.mark.parametrize("wish", ROWS)
def test_calls_work_as_they_are_written(wish: str, names: dict[str, Any]) -> None:
    for call in ROWS[wish]:
        if call.startswith("diffproj "):
            assert cli.main(shlex.split(call)[1:]) == 0
        else:
            exec(compile(call, "README.md", "exec"), names)  # noqa: S102


def test_the_figure_of_a_mounted_camera_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / ".readme"))
    drawn = importlib.import_module("mounting").figure()
    assert [axes.get_title() for axes in drawn.axes] == ["from the side", "the picture", "from above"]
    assert len(dp.figures.png(drawn, dpi=40)) > 3000
