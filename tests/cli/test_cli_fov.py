"""`diffproj locate --fov`: without a camera file, with what is assumed told and counted."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import diffproj as dp
from diffproj.cli.assumed_camera import assumed_camera
from diffproj.cli.known_beforehand import FieldOfView
from diffproj.targets.exif import Exif
from tests.cli.commands import parser, runner

W, H = 1920, 1080
run, parsed = runner("locate"), parser("locate")
pytestmark = pytest.mark.usefixtures("there")
YARD = ("yard.png", "--landmarks", "marks.csv", "--pixel-sigma", "1")


def yard(seed: int, count: int, k1: float, relief: float = 0.0) -> tuple[dp.Camera, torch.Tensor, torch.Tensor]:
    """A camera that shows 70 degrees with its lens, marks around it, and the pixels that show them to 1 px."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    edge = np.tan(np.radians(35.0))
    K = [[W / 2 / (edge * (1 + k1 * edge**2)), 0, 959.5], [0, W / 2 / (edge * (1 + k1 * edge**2)), 539.5], [0, 0, 1]]
    posed = dp.Camera.mounted(8.0, 20.0, 3.0, 30.0, focal=1.0, size=(W, H))
    camera = dp.Camera.from_opencv(K, [k1, 0.0, 0.0, 0.0], size=(W, H)).at(posed.R, posed.t)
    seen = uniform(count, 2) * torch.tensor([W - 100.0, H - 500.0]) + torch.tensor([50.0, 450.0])
    heights = relief * uniform(count)
    points = torch.cat(
        [dp.back_project(seen[i : i + 1], camera, dp.Plane.z(float(heights[i])))[0] for i in range(count)]
    )
    return camera, points, seen + torch.randn(count, 2, generator=generator, dtype=torch.float64)


def write(path: Path, points: torch.Tensor, seen: torch.Tensor) -> None:
    rows = [",".join(map(str, (*p, *x))) for p, x in zip(seen.tolist(), points.tolist(), strict=True)]
    path.write_text("\n".join(["u,v,x,y,z", *rows]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph, one with EXIF data, and marks on the ground and on walls that it shows."""
    folder = tmp_path_factory.mktemp("fov")
    picture = np.full((H, W), 120, np.uint8)
    cv2.imwrite(str(folder / "yard.png"), picture)
    for name, zoom, size in (
        ("told.jpg", None, None),
        ("zoomed.jpg", IFDRational(2, 1), None),
        ("turned.jpg", None, (2 * H + 8, 2 * W)),
        ("cropped.jpg", None, (W, W * 3 // 4)),
    ):
        exif = Image.Exif()
        part = exif.get_ifd(0x8769)
        part[0xA405] = 27
        if size is not None:
            part[0xA002], part[0xA003] = size
        if zoom is not None:
            part[0xA404] = zoom
        Image.fromarray(picture).save(folder / name, exif=exif)
    write(folder / "marks.csv", *yard(1, 4, -0.1)[1:])
    write(folder / "walls.csv", *yard(2, 8, -0.1, 4.0)[1:])
    write(folder / "three.csv", *yard(1, 3, -0.1)[1:])
    return folder


def test_what_is_assumed_is_told_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    """As priors, which `refine` takes; with a camera file of the same field of view deviations are far smaller."""
    found = parsed(capsys, *YARD, "--fov", "70+-5", "-o", "out.json")
    edge = np.tan(np.radians(35.0))
    focal = W / 2 / edge
    corner = edge**2 * (1 + (H / W) ** 2)
    relative = np.hypot((1 + edge**2) / (2 * edge) * np.radians(5.0), 0.2 * edge**2)
    priors = {
        "focal": (focal, relative * focal),
        "c_x": (959.5, 0.02 * W),
        "c_y": (539.5, 0.02 * W),
        "k1": (0.0, 0.2),
        "k2": (0.0, 0.1 / corner),
    }
    assert {name: (one["value"], one["deviation"]) for name, one in found["priors"].items()} == {
        name: pytest.approx(pair) for name, pair in priors.items()
    }
    assert found["camera"] is None
    assert found["assumed"]["priors"] == ["focal", "c_x", "c_y", "k1", "k2"]
    assert "70 ± 5 degrees" in found["assumed"]["source"]
    assert found["deviations_include"] == ["pixels", "priors"]
    truth, points, seen = yard(1, 4, -0.1)
    camera = dp.Camera.from_opencv([[focal, 0, 959.5], [0, focal, 539.5], [0, 0, 1]], [0, 0, 0, 0], size=(W, H))
    marks = dp.Seen(dp.Landmarks(points), seen, pixel_sigma=1.0)
    adjusted = dp.adjust(camera.at(truth.R, truth.t), marks, priors=priors)
    assert [found["position"][axis]["value"] for axis in "xyz"] == pytest.approx(
        adjusted.cameras.center[0].tolist(), abs=1e-4
    )
    pixel, ground = [[900.0, 700.0]], dp.Plane.z(0.0)
    again = dp.measure(pixel, dp.load_calibration("out.json"), ground, 0, 1.0)
    wanted = dp.measure(pixel, adjusted, ground, pixel_sigma=1.0)
    torch.testing.assert_close(again.deviations, wanted.deviations, rtol=1e-2, atol=1e-6)
    dp.save_camera("same.yaml", camera)
    sure = parsed(capsys, *YARD, "--camera", "same.yaml")
    assert sure["assumed"] is None
    assert found["position"]["z"]["deviation"] > 4 * sure["position"]["z"]["deviation"]


def test_people_are_told_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, *YARD, "--fov", "70±5")
    assert (code, err) == (0, "")
    said = " ".join(out.split())
    assert "No camera file: 70 ± 5 degrees from the left to the right edge of 1920 px" in said
    assert "Assumed: square pixels, a lens of k1 and k2 alone; focal length 1371 ± 185 px, c_x 960 ± 38 px" in said
    assert "how far what is assumed may be off as said, but NOT pixels that are not square" in said
    assert "what --prior says" not in said
    assert all(len(line) <= 80 for line in out.splitlines())


def test_what_is_said_takes_the_place_of_what_is_assumed(capsys: pytest.CaptureFixture[str]) -> None:
    """A lens that bends shows more than its focal length tells: with k1 known that is surer, and another one."""
    found = parsed(
        capsys, *YARD, "--fov", "70+-5", "--prior", "k1=-0.1+-0.02", "--prior", "c_x=960+-2", "--prior", "height=8+-1"
    )
    assert found["assumed"]["priors"] == ["focal", "c_y", "k2"]
    assert found["priors"]["k1"] == {"value": -0.1, "deviation": 0.02}
    edge = np.tan(np.radians(35.0))
    assert found["priors"]["focal"]["value"] == pytest.approx(W / 2 / (edge * (1 - 0.1 * edge**2)))
    assert found["priors"]["focal"]["deviation"] < 0.1 * found["priors"]["focal"]["value"]
    code, out, _ = run(capsys, *YARD, "--fov", "70+-5", "--prior", "height=8+-1")
    assert code == 0
    assert "what --prior says" in " ".join(out.split())
    free = parsed(capsys, *YARD[:2], "walls.csv", *YARD[3:], "--fov", "60", "--free", "focal,principal_point")
    assert free["assumed"]["priors"] == ["k1", "k2"]
    assert abs(free["intrinsics"]["f_x"]["value"] - 1441) < 3 * free["intrinsics"]["f_x"]["deviation"]


def test_a_field_of_view_that_landmarks_contradict_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    walls = (*YARD[:2], "walls.csv", *YARD[3:])
    code, out, err = run(capsys, *walls, "--fov", "50+-2")
    assert code == 0
    told = r"ocal length \d+ ± \d+ px as the landmarks tell, .* deviations from what is assumed: check --fov"
    assert re.search(f"walls.csv: f{told}", err)
    assert re.search(f"F{told}", " ".join(out.split()))
    assert "Weak: the landmarks tell a focal length" in " ".join(out.split())  # it said "Good" beside the warning
    code, _, err = run(capsys, *walls, "--fov", "40+-2")
    assert code == 1
    assert "no pose was found that sees what was observed: check the camera, or look for mixed-up pixels" in err


def test_the_photographs_file_tells_the_focal_length(capsys: pytest.CaptureFixture[str]) -> None:
    """As that of a 35 mm film camera, by the diagonal of the photograph or, in 16:9, of a sensor with 4:3."""
    found = parsed(capsys, "told.jpg", *YARD[1:], "--fov", "exif")
    ends = 27 / np.hypot(36, 24) * np.array([np.hypot(W, H), np.hypot(W, W * 3 / 4)])
    focal, apart = ends.mean(), (ends[1] - ends[0]) / 2
    deviation = np.hypot(0.05 * focal, apart)
    assert found["priors"]["focal"] == {"value": pytest.approx(focal), "deviation": pytest.approx(deviation)}
    assert "27 mm of 35 mm film, if nobody cropped the photograph" in found["assumed"]["text"]
    # Made smaller, or turned, it shows as much.
    assert parsed(capsys, "turned.jpg", *YARD[1:], "--fov", "exif")["priors"] == found["priors"]


@pytest.mark.parametrize(
    ("size", "truths"),
    [
        ((4000, 3000), (4000 * 1.25,)),
        ((3024, 4032), (4032 * 1.25,)),
        ((6000, 4000), (np.hypot(6000, 4000),)),
        ((6016, 4000), (np.hypot(6016, 4000),)),
        ((4000, 2250), (np.hypot(4000, 2250), 4000 * 1.25, np.hypot(4000, 4000 / 1.5))),
        ((2250, 4000), (np.hypot(4000, 2250), 4000 * 1.25, np.hypot(4000, 4000 / 1.5))),
        ((3000, 3000), (np.hypot(3000, 3000), np.hypot(3000, 4000), np.hypot(3000, 4500))),
    ],
)
def test_a_file_means_the_photograph_or_the_whole_sensor(size: tuple[int, int], truths: tuple[float, ...]) -> None:
    """The diagonal in px that 43.3 mm of film stand for: 16:9 and 1:1 are parts of sensors with 4:3 or 3:2.

    Taken by the photograph's own to 5 %, whole sensors were 1.6 and 4.3 deviations off.
    """
    told = assumed_camera(FieldOfView(None, None), size, (), (), Exif(focal_35=28.0)).priors[0]
    off = [abs(28.0 / np.hypot(36, 24) * truth - told.value) / told.deviation for truth in truths]
    assert max(off) < 1
    if len(truths) == 1:
        assert max(off) < 0.02
        assert told.deviation == pytest.approx(0.05 * told.value)


def test_a_photograph_that_its_file_tells_to_be_cropped_tells_no_focal_length(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of 4:3 to 16:9, the focal length would be 9 % off, with a deviation of 5 %."""
    code, _, err = run(capsys, "cropped.jpg", *YARD[1:], "--fov", "exif")
    assert code == 1
    assert "--fov: want PHOTO as a whole, whose EXIF data tell its focal length, got 1920 x 1080 px of what" in err
    assert "1920 x 1440; say degrees" in err
    assert run(capsys, "cropped.jpg", *YARD[1:], "--fov", "70+-5")[0] == 0


@pytest.mark.parametrize("count", [4, 8])
def test_intervals_hold_with_a_lens_that_nobody_knows(count: int, capsys: pytest.CaptureFixture[str]) -> None:
    """With k1 = -0.1 and the field of view off by its deviation; four landmarks on a plane once leave another pose."""
    held = total = 0
    for seed in range(10, 18):
        camera, points, seen = yard(seed, count, -0.1)
        write(Path("drawn.csv"), points, seen)
        fov = f"{70 + 5 * (-1) ** seed}+-5"
        code, *_ = run(capsys, *YARD[:2], "drawn.csv", *YARD[3:], "--fov", fov, "-o", "drawn.json")
        assert code == 0
        pixels = torch.tensor([[300.0, 700.0], [900.0, 560.0], [1500.0, 900.0], [700.0, 980.0]], dtype=torch.float64)
        truth = dp.back_project(pixels, camera, dp.Plane.z(0.0))[0]
        lengths = dp.measure(pixels, dp.load_calibration("drawn.json"), dp.Plane.z(0.0), 0, 0.5).lengths()
        low, high = lengths.interval(0.95)
        true = (truth[1:] - truth[:-1]).norm(dim=-1)
        held += int(((low <= true) & (true <= high)).sum())
        total += len(true)
    assert held >= 0.9 * total


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            (*YARD, "--fov", "70"),
            1,
            r"--fov: want how far it may be off behind it, such as 70\+-5, got 70; or --free fo",
        ),
        ((*YARD, "--fov", "70+-25"), 1, "--fov: want what tells the focal length to 30%, got 4.% from 70 ± 25 degrees"),
        ((*YARD, "--fov", "150+-5"), 2, "--fov: want 0.5 to 110 degrees from the left .* have to be calibrated"),
        ((*YARD, "--fov", "70+-0"), 2, "--fov: want a standard deviation above 0"),
        ((*YARD, "--fov", "wide"), 2, r"--fov: want degrees, such as 70\+-5, or exif, got 'wide'"),
        ((*YARD, "--fov", "70+-5+-1"), 2, r"--fov: want degrees, such as 70\+-5"),
        ((*YARD, "--fov", "70+-5", "--camera", "a.yaml"), 2, "not allowed with argument --fov"),
        ((*YARD, "--fov", "70+-5", "--prior", "f_x=9+-1"), 1, "--prior: want no 'f_x' beside --fov, which tells the"),
        (
            (*YARD, "--fov", "70+-5", "--prior", "k1=-0.9+-1"),
            1,
            "--prior: want a k1 above -0.52 with this field of view",
        ),
        ((*YARD, "--fov", "70+-5", "--prior", "k9=0+-1"), 1, "--prior: want a name from tilt, .* got 'k9'"),
        ((*YARD[:-2], "--fov", "70+-5"), 1, "--fov: want --pixel-sigma beside it"),
        ((*YARD[1:], "--fov", "70+-5"), 1, "--fov: want PHOTO beside it, whose size tells the focal length in px"),
        (
            (*YARD, "--fov", "exif"),
            1,
            "--fov: want PHOTO with a focal length in its EXIF data, got no focal length of 35",
        ),
        (("zoomed.jpg", *YARD[1:], "--fov", "exif"), 1, "--fov: want PHOTO with .* in its EXIF data, got digital zoom"),
        ((*YARD[:2], "three.csv", *YARD[3:], "--fov", "70+-5"), 1, "want at least 4 .* such as height=6"),
        (YARD, 2, "the following arguments are required: --camera, or --fov"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found, out, err = run(capsys, *arguments)
    *others, line = err.splitlines()
    assert (found, out) == (code, ""), err
    assert re.search(message, line), line
    assert others == [] if code == 1 else others[0].startswith("usage: diffproj locate [PHOTO]")


def test_landmarks_nearly_on_a_line_end_in_no_fold(capsys: pytest.CaptureFixture[str]) -> None:
    """Where `refine` ends at less than half the focal length, with a landmark beyond the fold."""
    camera, points, seen = yard(14, 4, -0.1)
    write(Path("line.csv"), points, seen)
    found = parsed(capsys, *YARD[:2], "line.csv", *YARD[3:], "--fov", "75+-5")
    focal = found["intrinsics"]["f_x"]
    assert abs(focal["value"] - float(camera.K[0, 0])) < 2 * focal["deviation"]
    assert abs(found["position"]["z"]["value"] - 8.0) < 2 * found["position"]["z"]["deviation"]
