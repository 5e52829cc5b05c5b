"""The report tells the truth: its numbers are the calibration's, whatever the camera, and names are text in it."""

import base64
import contextlib
import html
import io
import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.calibration.results.region import in_region
from diffproj.report import svg
from diffproj.report.accuracy import accuracy_part
from diffproj.report.coverage import covered_share
from diffproj.report.facts import Facts, tilts_of
from diffproj.report.folds import folds_part
from diffproj.report.lens import curve
from diffproj.report.parameters import parameters_part
from diffproj.report.pictures import MOST_BYTES, pictures
from diffproj.report.shape import shape_part
from diffproj.report.suggestions import NINTHS, suggestions
from diffproj.report.usage import usage_part
from diffproj.report.verdict import verdict_part
from diffproj.report.write import report
from tests.report.outline import HOSTILE, Outline

D = torch.float64
BOARD = dp.Chessboard()
ANCHORS = [
    "verdict",
    "photographs",
    "residuals",
    "coverage",
    "lens",
    "parameters",
    "accuracy",
    "shape",
    "held-out",
    "use",
]


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return replace(dp.calibrate(dp.example_views("left"), BOARD), unit="mm")


@pytest.fixture(scope="module")
def page(calibration: dp.Calibration) -> str:
    return report(calibration)


def words(page: str) -> str:
    """What a page says, without its tags."""
    return " ".join(re.sub(r"<[^>]+>", " ", page).replace("&#39;", "'").split())


def few(number: int, distortion: str = "none") -> dp.Calibration:
    return dp.calibrate(dp.example_views("left")[:number], BOARD, distortion)


def fisheye() -> dp.Calibration:
    K = torch.tensor([[300.0, 0, 319.5], [0, 300.0, 239.5], [0, 0, 1]], dtype=D)
    lens = dp.KannalaBrandt(torch.tensor([0.02, -0.004, 0.001, 0.0], dtype=D))
    seen = dp.example_views("left")
    poses = dp.calibrate(seen, BOARD).cameras
    cameras = dp.Camera(K, poses.R, poses.t, lens, size=(640, 480))
    pixels, _ = cameras.project(BOARD.points.to(D))
    noise = 0.1 * torch.randn(pixels.shape, dtype=D, generator=torch.Generator().manual_seed(1))
    return dp.calibrate(dp.Views(pixels + noise, size=(640, 480)), BOARD, "fisheye")


def landmarks(dtype: torch.dtype = D, origin: tuple[float, ...] = (500.0, 4000.0, 30.0)) -> dp.Calibration:
    generator = torch.Generator().manual_seed(2)
    points = 10 * torch.rand(14, 3, dtype=D, generator=generator) + torch.tensor(origin, dtype=D)
    camera = dp.Camera(torch.tensor([[800.0, 0, 319.5], [0, 800.0, 239.5], [0, 0, 1]], dtype=D), size=(640, 480))
    R = dp.rotation_from_euler(*torch.tensor([0.2, 0.1, 0.3], dtype=D))
    t = -R @ points.mean(0) + torch.tensor([0.0, 0, 25], dtype=D)
    pixels, _ = camera.at(R, t).project(points)
    noise = 0.3 * torch.randn(pixels.shape, dtype=D, generator=generator)
    views = dp.Views((pixels + noise)[None].to(dtype), size=(640, 480))
    return dp.calibrate(views, dp.Landmarks(points.to(dtype)), "none", fixed=["principal_point"])


def not_converged() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left"), BOARD, max_iterations=2, throw=False)


KINDS: dict[str, Callable[[], dp.Calibration]] = {
    "pinhole": lambda: few(13),
    "two views": lambda: few(2),
    "brown8": lambda: few(13, "brown8"),
    "brown14": lambda: few(13, "brown14"),
    "auto": lambda: dp.calibrate(dp.example_views("right")[:8], BOARD, "auto"),
    "free": lambda: dp.calibrate(dp.example_views("left"), BOARD, shape="free"),
    "bow": lambda: dp.calibrate(dp.example_views("left"), BOARD, shape="bow"),
    "skew": lambda: dp.calibrate(dp.example_views("left"), BOARD, skew=True),
    "fisheye": fisheye,
    "landmarks": landmarks,
    "not converged": not_converged,
    "held": lambda: dp.calibrate(dp.example_views("left"), BOARD, fixed=["k3"]),
    "copies": lambda: dp.calibrate(dp.example_views("left")[[0, 0, 0, 1, 2, 3]], BOARD, "brown4"),
}


SLOW = ("auto", "brown14")


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow) if kind in SLOW else kind for kind in KINDS]
)
def test_every_kind_of_calibration_has_a_report(kind: str) -> None:
    found = KINDS[kind]()
    page = report(found, folds=None)
    outline = Outline(page)
    assert [a["id"] for tag, a in outline.elements if tag == "section"] == ANCHORS
    assert {"Good": "Good: ", "Weak": "Weak: ", "Not usable": "Not usable: "}[found.judgement.word] in page
    assert "nan" not in re.sub(r"[a-z]nan|nan[a-z]|data:[^\"]*", "", page.lower())
    assert not re.search(r'(?:points|d|x|y)="[^"]*(?:inf|None)', page)


def test_parts_come_in_their_order_with_headings_below_each_other(page: str) -> None:
    outline = Outline(page)
    assert [a["id"] for tag, a in outline.elements if tag == "section"] == ANCHORS
    levels = [int(tag[1]) for tag, _ in outline.elements if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    assert levels.count(1) == 1


def test_every_picture_says_what_it_shows(page: str) -> None:
    pictures = [a for tag, a in Outline(page).elements if tag == "svg" and a.get("aria-hidden") != "true"]
    assert len(pictures) >= 13 + 10
    assert all(a["role"] == "img" and len(a["aria-label"] or "") > 10 for a in pictures)
    assert not [tag for tag, _ in Outline(page).elements if tag == "img"]


def test_ids_differ_and_nothing_is_fetched(page: str) -> None:
    outline = Outline(page)
    names = [a["id"] for _, a in outline.elements if "id" in a]
    assert len(set(names)) == len(names)
    assert not re.search(r"https?:|url\((?!#)|@import|src=|//[a-z]", re.sub(r"http-equiv|data:[^\"]*", "", page))
    links = [value for _, a in outline.elements for name, value in a.items() if name == "href"]
    assert all(link is not None and link.startswith(("#", "data:")) for link in links)
    assert not [name for _, a in outline.elements for name in a if name.startswith("on") or name == "style"]


def test_remedies_are_told_to_those_without_python_too(page: str) -> None:
    text = words(page)
    assert "take shape='free' (--shape free), which finds" in text
    assert 'distortion="auto" , --distortion auto on the command line' in text.replace('"auto",', '"auto" ,')


def test_numbers_are_the_calibration_s(calibration: dp.Calibration, page: str) -> None:
    text = words(page)
    facts = calibration.to_dict()
    assert "13 views with 702 corners, 640 \N{MULTIPLICATION SIGN} 480 px" in text
    assert f"RMS reprojection error {facts['rms']:.3f} px" in text
    assert f"focal length {facts['f_x']:.2f} ± {facts['f_x_deviation']:.2f} px" in text
    for reason in calibration.judgement.reasons:
        assert reason[1:] in text
    for name, rms in zip(calibration.views.names, calibration.view_rms.tolist(), strict=True):
        assert f"{name} 54 {rms:.4f}" in text
        assert f"{name} 54 of 54 corners RMS {rms:.3f} px" in text
    for name in calibration.parameters.names:
        value, deviation = facts[name], facts[f"{name}_deviation"]
        row = re.search(rf"(?:^| ){name} (-?[\d.]+) ([\d.]+) (?:focal|principal|along|decentred)", text)
        assert row is not None
        assert float(row[1]) == pytest.approx(value, abs=0.06 * deviation)
        assert float(row[2]) == pytest.approx(deviation, rel=0.06)


def test_what_is_not_trusted_are_the_remarks(calibration: dp.Calibration, page: str) -> None:
    assert "repeat on the board" in calibration.remarks[0]
    told = Facts(calibration, (640, 480)).in_words(calibration.remarks[0]).replace("world units", "mm")
    assert told[1:] in words(page)
    assert "nothing speaks against" not in page


def test_nothing_of_a_camera_that_was_not_found_is_trusted() -> None:
    """The page said that the residuals, 36 px here, were those of noise, and that nothing spoke against the numbers."""
    views = dp.example_views("left")
    pixels = views.pixels.clone()
    pixels[3] = pixels[3, torch.randperm(54, generator=torch.Generator().manual_seed(0))]
    found = dp.calibrate(dp.Views(pixels, size=views.size), BOARD, throw=False)
    for failed in (found, not_converged()):
        assert failed.judgement.word == "Not usable"
        text = words(verdict_part(Facts(failed, (640, 480))).html)
        assert "nothing speaks against" not in text
        assert "What not to trust Any of the numbers" in text


def test_uses_are_what_measure_gives(calibration: dp.Calibration) -> None:
    facts = Facts(calibration, (640, 480))
    view = facts.usual_view
    assert sorted(facts.distances)[6] == facts.distances[view]
    ends = torch.tensor([[0.0, 62.5, 0], [200, 62.5, 0], [100, 62.5, 0]], dtype=D)
    pixels, _ = calibration.cameras[view].project(ends)
    text = words(verdict_part(facts).html)
    for sigma, group in (("detector", 1), (0.5, 2)):
        found = dp.measure(pixels, calibration, dp.Plane.z(0.0), view, sigma)
        length = found.lengths().deviation[0]
        row = re.search(r"the board's length, 200 mm ± ([\d.]+) mm ± ([\d.]+) mm", text)
        assert row is not None
        assert float(row[group]) == pytest.approx(float(length), rel=0.06)
        row = re.search(r"in the middle of the board ± ([\d.]+) mm ± ([\d.]+) mm", text)
        assert row is not None
        worst = torch.linalg.eigvalsh(found.covariance[2])[-1].sqrt()
        assert float(row[group]) == pytest.approx(float(worst), rel=0.06)


def test_tilts_say_which_side_is_nearer(calibration: dp.Calibration) -> None:
    corners = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], dtype=D)
    R = dp.rotation_from_euler(*(0.9 * torch.randn(3, 200, dtype=D)))
    depth = (R @ corners.T)[:, 2]
    seen = (R @ corners.T)[:, :2]
    for tilt, z, xy in zip(tilts_of(R.numpy()), depth, seen, strict=True):
        slope = np.linalg.lstsq(xy.T.numpy(), z.numpy(), rcond=None)[0]  # of depth over the image's right and down
        much = np.degrees(np.arctan(np.hypot(*slope)))
        np.testing.assert_allclose(tilt, -slope / np.hypot(*slope) * much, atol=1e-6)


def test_suggested_views_fill_what_is_bare_and_lie_in_the_image() -> None:
    found = few(3)
    facts = Facts(found, (640, 480))
    wanted = suggestions(facts)
    assert found.judgement.word == "Weak"
    assert len(wanted) == min(6, found.judgement.views)
    bare = found.judgement.bare
    assert {one.place for one in wanted[: len(bare)]} == set(bare[: len(wanted)])
    for one in wanted:
        row, column = divmod(NINTHS.index(one.place), 3)
        u, v = one.outline.mean(0)
        assert (int(u // (640 / 3)), int(v // 160)) == (column, row)
        assert ((one.outline >= -0.5) & (one.outline <= [639.5, 479.5])).all()
    tilts = np.array([one.tilt for one in wanted])
    assert len(np.unique(tilts.round(3), axis=0)) == len(tilts)
    np.testing.assert_allclose(np.hypot(*tilts.T), 35)


def test_nothing_is_suggested_where_nothing_is_asked_for(calibration: dp.Calibration) -> None:
    enough = replace(calibration)
    vars(enough)["judgement"] = replace(calibration.judgement, bare=(), tilt=False, views=0, remedies=())
    facts = Facts(enough, (640, 480))
    assert suggestions(facts) == []
    assert "Nothing has to be added." in verdict_part(facts).html


def test_the_covered_share_is_that_of_the_verdict(calibration: dp.Calibration) -> None:
    share = covered_share(Facts(calibration, (640, 480)))
    said = re.search(r"cover (\d+) % of the image", calibration.verdict)
    assert share is not None
    assert said is not None
    assert 100 * share == pytest.approx(float(said[1]), abs=1.0)


def test_the_region_s_outline_is_its_border(calibration: dp.Calibration) -> None:
    outline = Facts(calibration, (640, 480)).region
    assert outline is not None
    middle = outline.mean(0)
    for factor, inside in ((0.999, True), (1.001, False)):
        places = torch.tensor(middle + factor * (outline - middle))
        assert bool((in_region(places, calibration.region) == inside).all())


@pytest.mark.parametrize("kind", ["brown5", "fisheye"])
def test_the_lens_curve_is_what_the_camera_does(kind: str, calibration: dp.Calibration) -> None:
    found = calibration if kind == "brown5" else fisheye()
    drawn = curve(Facts(found, (640, 480)))
    camera = found.camera
    around = torch.linspace(0, 2 * math.pi, 721, dtype=D)[:-1]
    for n in (20, 80, 159):
        angle = math.radians(drawn.angle[n])
        rays = torch.stack(
            [math.sin(angle) * around.cos(), math.sin(angle) * around.sin(), 0 * around + math.cos(angle)], -1
        )
        pixels, _ = camera.without_pose().project(rays)
        radius = (pixels - camera.K[:2, 2]).norm(dim=-1).mean()
        assert drawn.radius[n] == pytest.approx(float(radius), rel=1e-4)
    # A draw from the covariance scatters as the band says.
    count = found.parameters.of_camera.size
    spread = found.covariance.shared[:count, :count]
    draws = torch.distributions.MultivariateNormal(found.shared[:count], spread).sample((3000,))
    posed = found.parameters.of_camera.unpack(draws, (camera.R.expand(3000, 3, 3), camera.t.expand(3000, 3)))
    ray = torch.tensor([[math.sin(math.radians(drawn.angle[80])), 0, math.cos(math.radians(drawn.angle[80]))]], dtype=D)
    pixels, _ = posed.without_pose().project(ray)
    radius = (pixels - posed.K[:, None, :2, 2]).norm(dim=-1)
    assert drawn.deviation[80] == pytest.approx(float(radius.std()), rel=0.1)


def test_folds_are_those_of_cross_validate(calibration: dp.Calibration) -> None:
    facts = Facts(calibration, (640, 480))
    known = dp.cross_validate(calibration.views, BOARD, folds=4)
    for given in (known, 4):
        text = words(folds_part(facts, given, None).html)
        held_out = float(known.held_out_px.square().mean().sqrt())
        assert f"held out have an RMS of {held_out:.3f} px" in text
        assert f"1 {float(known.in_sample_px[0]):.4f} {float(known.held_out_px[0]):.4f}" in text
    assert "not asked for" in folds_part(facts, None, None).html
    assert "It takes 4 views" in folds_part(Facts(few(3), (640, 480)), 5, None).html


def test_the_code_to_copy_runs(calibration: dp.Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    dp.save_camera("camera.json", calibration)
    cv2.imwrite("photograph.png", np.zeros((480, 640), np.uint8))
    for found in (calibration, few(13), fisheye()):
        page = usage_part(Facts(found, (640, 480)), "camera.json").html
        codes = dict(re.findall(r'<code class="(python|alone|opencv)">(.*?)</code>', page, re.S))
        names: dict[str, dict[str, object]] = {}
        for kind, code in codes.items():
            names[kind] = {}
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(html.unescape(code), names[kind])  # noqa: S102
            assert kind != "python" or "tensor" in printed.getvalue()
        camera = names["alone"]["camera"]
        assert isinstance(camera, dp.Camera)
        points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]], dtype=D)
        expected = found.camera.without_pose().project(points)[0]
        assert torch.equal(camera.project(points)[0], expected)
        matrix, distortion = names["opencv"]["camera_matrix"], names["opencv"]["distortion"]
        project = cv2.fisheye.projectPoints if "fisheye" in codes["opencv"] else cv2.projectPoints
        shaped = points.numpy()[:, None]
        seen = project(shaped, np.zeros((3, 1)), np.zeros((3, 1)), matrix, distortion)[0]
        np.testing.assert_allclose(seen.reshape(-1, 2), expected.numpy(), atol=1e-9)


def test_a_file_without_deviations_says_so(calibration: dp.Calibration, tmp_path: Path) -> None:
    dp.save_camera(tmp_path / "camera.json", calibration)
    again = Facts(dp.load_calibration(tmp_path / "camera.json"), (640, 480))
    for part in (verdict_part, parameters_part, accuracy_part):
        assert part(again).html == part(Facts(calibration, (640, 480))).html
    fields = json.loads((tmp_path / "camera.json").read_text())
    fields.get("calibration", fields).pop("covariance")
    (tmp_path / "poor.json").write_text(json.dumps(fields))
    page = words(report(dp.load_calibration(tmp_path / "poor.json"), folds=None))
    assert "holds no deviations" in page
    assert "not known" in page


def test_names_are_text(calibration: dp.Calibration) -> None:
    names = (HOSTILE, "x" * 300, "a\nb", *calibration.views.names[3:])
    views = dp.Views(calibration.views.pixels, names=names, size=(640, 480))
    found = replace(calibration, views=views, unit=HOSTILE)
    page = report(found, folds=None, title=HOSTILE, camera_file=f"{HOSTILE}.json")
    outline = Outline(page)
    assert outline.texts.get("script", []) == []
    assert not [tag for tag, _ in outline.elements if tag == "img"]
    assert not [name for _, a in outline.elements for name in a if name.startswith("on")]
    assert max(len(text) for text in outline.texts["b"]) <= 80
    assert outline.texts["h1"][0].startswith("</title>")


def photographs(folder: Path, count: int, size: tuple[int, int]) -> list[Path]:
    noise = np.random.default_rng(0)
    paths = [folder / f"{n}.png" for n in range(count)]
    for path in paths:
        cv2.imwrite(str(path), noise.integers(0, 255, (size[1], size[0]), dtype=np.uint8))
    return paths


def test_photographs_go_to_the_views_of_their_names(calibration: dp.Calibration, tmp_path: Path) -> None:
    paths = photographs(tmp_path, 3, (640, 480))
    corners = np.full((3, 2, 2), 100.0)
    found = pictures(paths, ("2.png", "0.png", "other"), corners, (640, 480))
    assert set(found.of_views) == set(found.sources) == {0, 1}
    assert found.others == ("1.png",)
    whole = cv2.imread(str(paths[2]), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(found.of_views[0].loupes[0], whole[88:113, 88:113])
    arrays = [np.full((480, 640), n, np.uint8) for n in range(2)]
    assert set(pictures(arrays, ("left", "right"), corners, None).of_views) == {0, 1}
    with pytest.raises(ValueError, match="photographs: want those of the views, left, right, got 3 others"):
        pictures(paths, ("left", "right"), corners, (640, 480))
    with pytest.raises(ValueError, match="photographs: want 320 x 240 px as the views have, got 640 x 480 px in"):
        pictures(paths, ("0.png",), corners, (320, 240))
    with pytest.raises(FileNotFoundError):
        report(calibration, ["missing.png"])


def test_26_large_photographs_stay_below_5_megabytes(calibration: dp.Calibration, tmp_path: Path) -> None:
    """Of noise, which is the worst there is: twice as large as photographs, by view."""
    views = calibration.views[[*range(13), *range(13)]]
    views = dp.Views(views.pixels * 2 + 0.5, names=[f"{n}.png" for n in range(26)], size=(1280, 960))
    found = dp.calibrate(views, BOARD, "brown4")
    page = report(found, photographs(tmp_path, 26, (1280, 960)), folds=None)
    assert page.count("data:image/jpeg") == 26 + 1  # and the one to measure in
    assert len(page.encode()) < 5e6
    assert MOST_BYTES * 4 / 3 < 2.5e6


def test_a_corner_is_enlarged_where_it_is(tmp_path: Path) -> None:
    image = np.zeros((60, 80), np.uint8)
    image[30, 50] = 255
    corners = np.array([[[np.nan, np.nan], [0.2, 59.4], [50.3, 29.8]]])
    kept = pictures(image, ("view",), corners, (80, 60))
    found = kept.enlarged(0, 50.3, 29.8)
    assert found is not None
    address, left, top = found
    content = cv2.imdecode(np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8), 0)
    row, column = np.argwhere(content == 255)[0]
    assert (left + column, top + row) == (50, 30)
    assert kept.enlarged(0, 40.0, 29.8) is None
    assert kept.enlarged(1, 50.3, 29.8) is None
    edge = kept.enlarged(0, 0.2, 59.4)
    assert edge is not None
    assert edge[1:] == (-12, 59 - 12)


def test_what_has_no_report_is_refused_with_a_remedy(calibration: dp.Calibration, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    views = dp.example_views("left")
    many = dp.calibrate(dp.Views(views.pixels[:8].unflatten(0, (2, 4)), size=(640, 480)), BOARD, "none")
    located = dp.locate(views[:2], BOARD, calibration)
    alone = dp.locate(views[:2], BOARD, calibration.camera)
    camera = calibration.camera
    camera = dp.Camera(camera.K, camera.R, camera.t, camera.distortion)
    sizeless = replace(calibration, views=dp.Views(views.pixels), camera=camera)
    for given, message in (
        (many, r"calibration: want one camera, got batch shape \(2,\); index it"),
        (located, "got poses of a known camera, as dp.locate finds them; write the report of the calibration that"),
        (alone, "got poses of a known camera"),
        (sizeless, "calibration: want one whose image size is known, got none; give views a size"),
    ):
        with pytest.raises(ValueError, match=message):
            dp.write_report(file, given)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.plain
def test_wrong_arguments_are_named(calibration: dp.Calibration, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    for wrong, error, message in (
        ({"calibration": calibration.camera}, TypeError, "calibration: want a dp.Calibration, got Camera"),
        ({"folds": 1}, ValueError, "folds: want a whole number of at least 2"),
        ({"folds": "5"}, TypeError, "folds: want a whole number"),
        ({"title": 3}, TypeError, "title: want a string, got 3"),
        ({"camera_file": None}, TypeError, "camera_file: want a string"),
        ({"orientation": "left"}, ValueError, "orientation: want one of 'sensor', 'upright'"),
        ({"target": dp.Chessboard(4, 5)}, ValueError, "target: want the calibration's, with 54 points, got 20"),
        ({"photographs": 3}, TypeError, "photographs: want file names"),
        ({"path": 3}, TypeError, "path: want the path of a file, got 3"),
    ):
        with pytest.raises(error, match=re.escape(message)):
            dp.write_report(**{"path": file, "calibration": calibration, **wrong})
    rig = dp.calibrate_rig(
        {"left": dp.example_views("left")[:5], "right": dp.example_views("right")[:5]}, BOARD, "none"
    )
    with pytest.raises(
        ValueError, match=r"calibration: want one camera, got a rig of 2; write one for each, of rig\[name"
    ):
        dp.write_report(file, rig)
    assert not file.exists()
    dp.write_report(file, rig["right"], folds=None)
    assert file.exists()


def test_a_report_is_written_whole_or_not_at_all(calibration: dp.Calibration, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text("before")
    with pytest.raises(ValueError, match="photographs"):
        dp.write_report(file, calibration, [np.zeros((4, 4), np.uint8)])
    assert file.read_text() == "before"
    with pytest.raises(FileNotFoundError):
        dp.write_report(tmp_path / "nowhere" / "report.html", calibration, folds=None)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    dp.write_report(file, calibration, folds=None)
    assert Outline(file.read_text(encoding="utf-8")).texts["h1"] == ["Calibration of a camera"]


def test_with_photographs_the_report_measures_in_one(
    calibration: dp.Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = calibration.views.names
    for path, name in zip(photographs(tmp_path, 13, (640, 480)), names, strict=True):
        path.rename(tmp_path / name)
    decode, colours = cv2.imdecode, []

    def counted(data: np.ndarray, flags: int) -> np.ndarray:
        colours.append(bool(flags & cv2.IMREAD_COLOR))
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", counted)
    outline = Outline(report(calibration, tmp_path, folds=None))
    assert colours == [False] * 13 + [True]
    usual = names[Facts(calibration, (640, 480)).usual_view]
    assert [a["id"] for tag, a in outline.elements if tag == "section"] == [*ANCHORS, "measuring-page"]
    assert outline.texts["h2"][-1] == f"Measure in {usual}"
    ids = [a["id"] for _, a in outline.elements if "id" in a]
    assert len(set(ids)) == len(ids)


def test_a_landmarks_plane_is_that_of_their_mean_height() -> None:
    """The maps were of that plane and called the board's; the code to copy measured on z = 0, 30 units below."""
    found = landmarks()
    page = report(found, folds=None)
    height = float(found.nominal[:, 2].mean())
    code = html.unescape(re.search(r'<code class="python">(.*?)</code>', page, re.DOTALL)[1])  # type: ignore[index]
    assert float(re.search(r"Plane\.z\((.*?)\)", code)[1]) == pytest.approx(height)  # type: ignore[index]
    for part in (accuracy_part(Facts(found, (640, 480))), usage_part(Facts(found, (640, 480)), "camera.json")):
        assert "board" not in words(part.html).replace("Board", "board")
        assert re.search("the plane of the landmarks.{1,2} mean z", words(part.html))


def test_landmarks_are_no_board_whose_shape_was_designed() -> None:
    """Where they have deviations of their own their places are found, too."""
    found = landmarks()
    part = shape_part(Facts(found, (640, 480)))
    assert part.title == "The landmarks' places"
    assert words(part.html).startswith("The landmarks were taken to be where they were surveyed.")
    cameras = [
        found.cameras[0].shifted(torch.tensor(offset, dtype=D)) for offset in ([0.0, 0, 0], [2, 0, 0], [0, 2, 0])
    ]
    pixels = torch.stack([camera.project(found.nominal)[0] for camera in cameras])
    surveyed = dp.Landmarks(found.nominal, sigma=0.05)
    moved = dp.refine(dp.Views(pixels, size=(640, 480)), surveyed, found.camera, pixel_sigma=0.3)
    assert moved.shape == "free"
    fitted = shape_part(Facts(moved, (640, 480)))
    assert "The place of every landmark was fitted along with the camera: they lie " in words(fitted.html)
    assert "board" not in (part.html + fitted.html).lower()
    assert shape_part(Facts(few(5), (640, 480))).title == "The board's shape"


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_plane_s_height_is_printed_without_the_dust_of_its_sum(dtype: torch.dtype) -> None:
    """It was one such as 30.100000000000005 in the code to copy."""
    found = landmarks(dtype, (0.0, 0.0, 30.0))
    facts = Facts(found, (640, 480))
    printed = re.search(r"Plane\.z\((.*?)\)", usage_part(facts, "camera.json").html)[1]  # type: ignore[index]
    assert re.fullmatch(r"35\.\d{1,6}", printed)
    extent = float((found.nominal.amax(0) - found.nominal.amin(0)).max())
    assert float(printed) == facts.plane_z == pytest.approx(float(found.nominal[:, 2].mean()), abs=1e-6 * extent)


def test_names_at_axes_are_whole_and_stand_apart() -> None:
    """Coordinates of a national grid ran out of the picture on the left, so that 8304040 read as 04e+06."""
    x, y = (644970.0, 645090.0), (8303970.0, 8304070.0)
    assert svg.tick_names(svg.ticks(*y)) == ["8303980", "8304000", "8304020", "8304040", "8304060"]
    for x_range, y_range in ((x, y), ((-1e-4, 2.6e-4), (-1e-4, 2e-4)), ((-1e8, 2.6e8), (-1e8, 2e8))):
        drawn = str(svg.Axes(x_range, y_range, left=svg.room_beside(y_range)).drawn("x, m", "y, m"))
        texts = re.findall(r'<text class="tick" x="(.*?)" y="(.*?)" text-anchor="(.*?)">(.*?)</text>', drawn)
        upright = [(float(u), name) for u, _, anchor, name in texts if anchor == "end"]
        across = sorted((float(u), name) for u, _, anchor, name in texts if anchor == "middle")
        assert len(upright) >= 4
        assert len(across) >= 2
        assert all(u - svg.DIGIT * len(name) >= 15 for u, name in upright)
        for (u, name), (u2, name2) in itertools.pairwise(across):
            assert u2 - u >= svg.DIGIT * (len(name) + len(name2)) / 2
