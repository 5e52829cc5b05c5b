"""Photographs that their files say are not of one camera, one zoom or one turn, or that are mirror images."""

import hashlib
import itertools
import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import diffproj as dp
from diffproj.cli import main
from diffproj.cli.photographs import one_photograph
from diffproj.targets.exif import Exif
from diffproj.targets.one_camera import against_one_camera, doubts, of_another_camera, told_of

BOARD = dp.Chessboard(5, 4)


def photograph(path: Path, orientation: int = 1, focal: float | None = None, serial: str | None = None) -> None:
    """A board from the front, with what a camera tells of the photograph."""
    squares = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.ones((30, 30))).astype(np.uint8) * 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    part = exif.get_ifd(0x8769)
    if focal is not None:
        part[0x920A] = IFDRational(round(100 * focal), 100)
    if serial is not None:
        part[0xA431] = serial
    Image.fromarray(cv2.copyMakeBorder(squares, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)).save(path, exif=exif)


def warned(folder: Path, orientation: str = "sensor") -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        dp.detect(folder, BOARD, orientation=orientation)
    return [str(one.message) for one in told]


def test_another_zoom_is_told(tmp_path: Path) -> None:
    for name, focal in (("a", 24.0), ("b", 24.72), ("c", 24.0), ("d", None)):
        photograph(tmp_path / f"{name}.jpg", focal=focal)
    (told,) = warned(tmp_path)
    assert "one camera with one zoom, got different focal lengths by their EXIF data: 24 mm in" in told
    assert f"24.72 mm in {tmp_path / 'b.jpg'}; calibrate them by themselves" in told
    assert "d.jpg" not in told


def test_another_camera_is_told_before_its_focal_length(tmp_path: Path) -> None:
    photograph(tmp_path / "a.jpg", focal=24.0, serial="12")
    photograph(tmp_path / "b.jpg", focal=28.0, serial="13")
    (told,) = warned(tmp_path)
    assert "got cameras of different serial numbers by their EXIF data: 12 in" in told


def test_one_camera_is_told_nothing_of(tmp_path: Path) -> None:
    for name, orientation, focal in (("a", 1, 24.0), ("b", 3, 24.05), ("c", 3, None)):
        photograph(tmp_path / f"{name}.jpg", orientation, focal)
    assert warned(tmp_path) == []


def test_focal_lengths_are_compared_alike_in_any_order() -> None:
    for focal in itertools.permutations((4.25, 4.27, 4.29)):
        assert doubts(["a", "b", "c"], [Exif(focal=one) for one in focal], upright=False) == []
    far = {4.25: "a", 4.27: "b", 4.29: "c", 4.5: "d", 4.1: "e"}
    for focal in itertools.permutations(far):
        (told,) = doubts([far[one] for one in focal], [Exif(focal=one) for one in focal], upright=False)
        kept = ", ".join(far[one] for one in focal if far[one] in "abc")
        assert f"4.27 mm in {kept} and 4.1 mm in e and 4.5 mm in d; calibrate them by themselves" in told
    zoom = [Exif(zoom=one) for one in (1.0, 2.0, 2.0)]
    (told,) = doubts(["a", "b", "c"], zoom, upright=False)
    assert "got different digital zooms by their EXIF data: 2x in b, c and 1x in a;" in told


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_one_mirror_image_is_told_as_one(orientation: int) -> None:
    (told,) = doubts(["a.jpg", "b.jpg"], [Exif(orientation), Exif()], upright=False)
    assert told == (
        "a.jpg: this file holds a mirror image, and viewers flip it back, as EXIF data ask; pixels count as recorded, so "
        "lengths are right, but x and y are mirrored; to count pixels as viewers show them, give orientation='upright'"
    )


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirror_images_are_told(tmp_path: Path, orientation: int) -> None:
    photograph(tmp_path / "a.jpg", orientation)
    photograph(tmp_path / "b.png", orientation)
    (told,) = warned(tmp_path)
    assert told.startswith(
        f"{tmp_path / 'a.jpg'}, {tmp_path / 'b.png'}: these files hold mirror images, and viewers flip"
    )
    assert "lengths are right, but x and y are mirrored; to count pixels as viewers show them, give" in told
    assert told.endswith("give orientation='upright'")
    assert warned(tmp_path, "upright") == []


def test_upright_photographs_that_were_turned_apart_are_told(tmp_path: Path) -> None:
    for name, orientation in (("a", 1), ("b", 3), ("c", 1)):
        photograph(tmp_path / f"{name}.jpg", orientation)
    (told,) = warned(tmp_path, "upright")
    assert told.startswith(f"{tmp_path / 'b.jpg'}: EXIF data turn these another way than the others")
    assert warned(tmp_path) == []


def test_a_file_that_does_not_tell_how_it_was_turned_is_not_blamed() -> None:
    """Messengers save photographs upright, without EXIF data."""
    assert told_of(Exif(), upright=True) == told_of(Exif(), upright=False) == ()
    turned, saved = [told_of(Exif(6, focal=24.0), upright=True)] * 2, told_of(Exif(focal=24.0), upright=True)
    assert of_another_camera(turned, ["a"], [saved]) == ""
    assert against_one_camera(["a", "b", "c"], [*turned, saved]) == []
    assert against_one_camera(["a", "b"], [told_of(Exif(2), upright=False), told_of(Exif(), upright=False)]) == []
    assert doubts(["a", "b", "c"], [Exif(6), Exif(6), Exif()], upright=True) == []
    (told,) = doubts(["a", "b", "c"], [Exif(6), Exif(6), Exif(1)], upright=True)
    assert told.startswith("c: EXIF data turn these another way")


def test_a_file_of_several_pictures_is_told() -> None:
    assert doubts(["a.tif"], [Exif(pictures=3)], upright=False) == [
        "a.tif: want one picture a file, got several; the first was taken"
    ]
    assert doubts(["image 1"], [None], upright=True) == []


def test_a_file_is_read_once_for_its_pixels_and_what_it_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.png", "b.jpg", "c.tif"):
        photograph(tmp_path / name, 3)
    read, whole = [], Path.read_bytes

    def counted(path: Path) -> bytes:
        read.append(path.name)
        return whole(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    dp.detect(tmp_path, BOARD)
    assert read == ["a.png", "b.jpg", "c.tif"]
    read.clear()
    one_photograph(tmp_path / "a.png", "sensor")
    assert read == ["a.png"]


def zoomed(folder: Path, focal: dict[int, float], orientation: dict[int, int]) -> Path:
    """Rendered photographs of one camera, with EXIF data."""
    camera = dp.Camera([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], size=(320, 240))
    turns = ((0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0), (0.3, 0.3, 0.2), (0.4, -0.4, 0.1))
    for n, turn in enumerate(turns):
        R = dp.rotation_from_euler(*torch.tensor(turn, dtype=torch.float64))
        t = torch.tensor([0.0, 0, 200 + 10 * n], dtype=torch.float64) - R @ BOARD.points.double().mean(0)
        pixels = np.asarray(dp.synthetic.photograph(camera.at(R, t), BOARD, seed=n))
        exif = Image.Exif()
        exif[0x0112] = orientation.get(n, 1)
        exif.get_ifd(0x8769)[0x920A] = IFDRational(round(100 * focal.get(n, 24.0)), 100)
        Image.fromarray(pixels).save(folder / f"{n}.png", exif=exif)
    return folder


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_files_tell_of_two_zooms_is_in_the_verdict_and_in_the_file(tmp_path: Path) -> None:
    views = dp.detect(zoomed(tmp_path, {1: 28.0}, {}), BOARD)
    found = dp.calibrate(views, BOARD, "none")
    assert found.verdict.startswith("Weak")
    assert "EXIF data tell of different focal lengths" in found.verdict
    assert "24 mm in 0.png, 2.png, 3.png and 2 more and 28 mm in 1.png: calibrate them by" in found.remarks[0]
    dp.save_camera(tmp_path / "camera.json", found)
    again = dp.load_calibration(tmp_path / "camera.json")
    assert again.verdict == found.verdict
    assert "EXIF" in dp.refine(again.views, BOARD, again.camera).verdict
    several = dp.calibrate([views, views[[0, 2, 3, 4, 5]]], BOARD, "none")
    assert [isinstance(one, dp.Calibration) and "EXIF" in one.verdict for one in several] == [True, False]
    for alone in (views[[0, 2, 3, 4, 5]], views[2:]):
        assert "EXIF" not in dp.calibrate(alone, BOARD, "none").verdict
    hidden = torch.zeros_like(views.visible)
    hidden[1] = True  # the one that is zoomed does not count
    assert "EXIF" not in dp.calibrate(views.hiding(hidden), BOARD, "none").verdict
    one = dp.Views.stack([views, views])
    assert "EXIF" not in dp.calibrate(one, BOARD, "none").remarks[0]
    assert not dp.locate(views, BOARD, found.camera).doubts


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_views_turned_apart_are_in_the_verdict(tmp_path: Path) -> None:
    folder = zoomed(tmp_path, {}, {2: 3, 4: 2})
    upright = dp.calibrate(dp.detect(folder, BOARD, orientation="upright"), BOARD, "none")
    assert "EXIF data tell of photographs that were turned apart" in upright.verdict
    as_recorded = dp.calibrate(dp.detect(folder, BOARD), BOARD, "none")
    assert "EXIF data tell of mirror images among the others, 4.png, which" in as_recorded.remarks[0]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_rig_is_told_of_a_camera_that_changed(tmp_path: Path) -> None:
    folder = zoomed(tmp_path, {1: 28.0}, {})
    views = dp.detect(folder, BOARD)
    other = dp.Views(views.pixels, views.visible, views.names, views.size)
    rig = dp.calibrate_rig({"a": views, "b": other}, BOARD, "none")
    told = [one for one in rig.remarks if "EXIF" in one]
    assert len(told) == 1
    assert told[0].startswith("a: EXIF data tell of different focal lengths, 24 mm in 0.png")
    few = torch.zeros_like(views.visible)
    few[1, 3:] = True  # three corners do not make a view count
    rig = dp.calibrate_rig({"a": views.hiding(few), "b": other}, BOARD, "none")
    assert not [one for one in rig.remarks if "EXIF" in one]


@pytest.mark.filterwarnings("ignore:photographs:UserWarning")
def test_a_photograph_of_another_zoom_than_the_calibration_s_is_doubtful(tmp_path: Path) -> None:
    """Of four corners or of a lens that moved little residuals do not tell; the file does, also from the saved camera."""
    views = dp.detect(zoomed(tmp_path, {1: 28.0, 3: 24.05}, {}), BOARD)
    dp.save_camera(tmp_path / "camera.json", dp.calibrate(views[[0, 2, 4, 5]], BOARD, "none"))
    known = dp.load_calibration(tmp_path / "camera.json")
    said = (
        "1.png: EXIF data tell of another focal length than those of the photographs that the camera was calibrated on"
    )
    with pytest.warns(dp.CameraMismatchWarning, match=f"locate: {said}: 28 mm, not 24 mm"):
        located = dp.locate(views[[1, 3]], BOARD, known)
    assert located.doubts == f"{said}: 28 mm, not 24 mm"
    assert dp.measure([[100.0, 100.0]], located, dp.Plane.z(0.0), 0, 0.5).doubts == located.doubts
    assert not dp.locate(views[[0, 3]], BOARD, known).doubts
    assert not dp.locate(views[[1]], BOARD, known.camera).doubts
    with pytest.warns(dp.CameraMismatchWarning, match=said):
        fixed = dp.locate(views[[1]], BOARD, known, priors={"height": (200.0, 100.0)}, pixel_sigma=0.1)
    assert said in fixed.doubts


@pytest.mark.filterwarnings("ignore:photographs:UserWarning")
@pytest.mark.filterwarnings("ignore::diffproj.CameraMismatchWarning")
@pytest.mark.parametrize("priors", [None, {"height": (200.0, 100.0)}])
def test_a_located_photograph_is_not_taken_for_one_that_its_camera_was_calibrated_on(
    tmp_path: Path, priors: dict[str, tuple[float, float]] | None
) -> None:
    views = dp.detect(zoomed(tmp_path, {1: 28.0}, {}), BOARD)
    calibration = dp.calibrate(views[[0, 2, 3, 4, 5]], BOARD, "none")
    once = dp.locate(views[[1]], BOARD, calibration, priors=priors, pixel_sigma=0.1)
    dp.save_camera(tmp_path / "once.json", once)
    for known in (once, dp.load_calibration(tmp_path / "once.json"), dp.locate(views[[1]], BOARD, once)):
        assert "EXIF" not in dp.locate(views[[0]], BOARD, known).doubts
        assert "another focal length" in dp.locate(views[[1]], BOARD, known).doubts
    alone = dp.locate(views[[1]], BOARD, calibration.camera)  # nothing tells what that camera was calibrated on
    dp.save_camera(tmp_path / "alone.json", alone)
    for known in (alone, dp.load_calibration(tmp_path / "alone.json")):
        assert "EXIF" not in dp.locate(views[[0]], BOARD, known).doubts


@pytest.mark.filterwarnings("ignore:photographs:UserWarning")
@pytest.mark.filterwarnings("ignore::diffproj.CameraMismatchWarning")
def test_of_many_cameras_residuals_are_not_blamed_for_what_files_tell(tmp_path: Path) -> None:
    views = dp.detect(zoomed(tmp_path, {1: 28.0}, {}), BOARD)
    calibration = dp.calibrate(views[[0, 2, 3, 4, 5]], BOARD, "none")
    files = "EXIF data speak against the photographs of cameras 0, 1 being of the camera that was given"
    both = views[[0, 1]].expand(2)
    assert dp.locate(both, BOARD, calibration).contradiction == f"{files}: see remarks"
    assert (
        dp.locate(both, BOARD, calibration, pixel_sigma=1e-4).contradiction
        == f"{files}; the residuals of cameras 0, 1 are larger than pixel_sigma says: see remarks"
    )


def test_other_cameras_are_told_by_what_differs_first() -> None:
    own = [told_of(Exif(1, "Canon", "12", "50mm", 50.0), False)] * 2
    assert [value for name, value in own[0] if name == "serial"] == [
        "#" + hashlib.blake2b(b"12", digest_size=4).hexdigest()
    ]
    assert of_another_camera(own, ["a"], [told_of(Exif(1, "Canon", "12", "50mm", 50.1), False)]) == ""
    assert of_another_camera(own, ["a"], [told_of(Exif(), False)]) == ""
    assert of_another_camera([()], ["a"], [told_of(Exif(2, "Nikon"), True)]) == ""
    assert of_another_camera(own, ["a"], []) == ""
    for exif, words in (
        (
            Exif(1, "Nikon", "13"),
            "another camera than those of the photographs that the camera was calibrated on: Nikon,",
        ),
        (Exif(1, "Canon", "13"), "another camera, by its serial number, than"),
        (Exif(1, "Canon", "12", "35mm"), "another lens than"),
        (Exif(2, "Canon"), "another way of counting pixels, mirrored, than"),
    ):
        assert words in of_another_camera(own, ["a"], [told_of(exif, False)])
    turned = [told_of(Exif(6), True)]
    assert "another turn than" in of_another_camera(turned, ["a"], [told_of(Exif(1), True)])


def test_commands_tell_a_photograph_of_another_zoom_than_the_camera_s(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They read a photograph's pixels before it is searched, and what its file tells has to go along."""
    folder = zoomed(tmp_path, {1: 28.0}, {})
    views = dp.detect([folder / f"{n}.png" for n in (0, 2, 3, 4, 5)], BOARD)
    dp.save_camera(tmp_path / "camera.json", dp.calibrate(views, BOARD, "none"))
    corners = dp.detect(folder / "1.png", BOARD).pixels[0]
    rows = [",".join(map(str, (*p, *x))) for p, x in zip(corners.tolist(), BOARD.points.tolist(), strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(["u,v,x,y,z", *rows]))
    camera, on = ("--camera", str(tmp_path / "camera.json")), ("--board", "5x4", "--square", "25", "--points", "99,99")
    for command in (
        ["measure", str(folder / "1.png"), *camera, *on],
        ["locate", str(folder / "1.png"), *camera, "--landmarks", str(tmp_path / "points.csv")],
    ):
        assert main([*command, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        said = "1.png: EXIF data tell of another focal length than those of the photographs"
        assert [text for text in told["warnings"] if said in text]
        assert said in told.get("doubts", told.get("verdict"))
    few = "\n".join(["u,v,x,y,z", rows[0], rows[4], rows[-1]])
    (tmp_path / "three.csv").write_text(few)
    known, out = ("--prior", "tilt=-60+-30", "--pixel-sigma", "0.5"), str(tmp_path / "out.json")
    for name, more in (("three.csv", ()), ("points.csv", ("--free", "focal"))):
        at = ("--landmarks", str(tmp_path / name), *known, *more)
        for photograph, expected in (("1.png", True), ("2.png", False)):
            assert main(["locate", str(folder / photograph), *camera, *at, "-o", out, "--json"]) == 0
            told = json.loads(capsys.readouterr().out)
            assert bool([text for text in told["warnings"] if said in text]) == expected
            assert (said in told["verdict"]) == expected
            assert (said in dp.load_calibration(out).remarks[0]) == expected
    assert main([*["measure", str(folder / "2.png"), *camera, *on], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []
