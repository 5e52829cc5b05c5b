"""What the measuring page is made of: one file, one photograph, and a camera that its script understands."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import diffproj as dp
from diffproj.report.measuring import SCRIPTS, SIDE, colour, embedded, measuring_part, script
from diffproj.report.measuring_model import as_one, measuring_model
from diffproj.targets.images import grey, listed

D = torch.float64
GREY = np.full((480, 640), 90, np.uint8)


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left")[:6], dp.Chessboard())


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="measuring-data">(.*?)</script>', text)
    assert found
    return json.loads(found[1])


def test_one_file_of_few_bytes_that_names_no_address(calibration: dp.Calibration, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    dp.write_measuring_page(path, GREY, calibration, view="left02.jpg", unit="mm")
    text = path.read_text(encoding="utf-8")
    assert len(text) < 200_000
    assert not re.search(r"(?:src|href)\s*=\s*[\"'](?!data:|#)", text)
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")
    assert not re.search(r"\son[a-z]+\s*=", text.partition("<script>")[0])
    assert "unsafe" not in text
    data = data_of(text)
    assert (data["name"], data["unit"], data["size"], data["shown"]) == ("left02.jpg", "mm", [640, 480], [640, 480])
    assert data["model"]["planes"] == [{"name": "board", "normal": [0, 0, 1], "offset": 0}]
    assert list(tmp_path.iterdir()) == [path]


def test_the_script_reaches_for_nothing_outside() -> None:
    """No network, no markup from text, no code from text; and no file of it is long."""
    text = script()
    for word in (
        "fetch(",
        "XMLHttpRequest",
        "WebSocket",
        "innerHTML",
        "outerHTML",
        "insertAdjacent",
        "eval(",
        "Function(",
    ):
        assert word not in text
    assert "document.write" not in text
    folder = Path(dp.__file__).parent / "report" / "measuring_page"
    assert sorted(path.stem for path in folder.glob("*.js")) == sorted(SCRIPTS)
    for path in folder.iterdir():
        lines = path.read_text(encoding="utf-8").splitlines()
        assert len(lines) <= 400, path
        assert path.suffix != ".js" or lines[0].startswith("// "), path


def test_large_photographs_are_reduced() -> None:
    jpeg, shown = embedded(np.zeros((3000, 6000), np.uint8))
    assert shown == (SIDE, SIDE // 2)
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (SIDE // 2, SIDE, 3)


@pytest.mark.parametrize("deep", [False, True])
def test_colours_are_kept_where_there_are_8_bits(deep: bool, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint16 if deep else np.uint8)
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), image * (257 if deep else 1))
    found = colour(listed(str(path))[0])
    assert found.dtype == np.uint8
    assert found.shape == ((20, 30) if deep else (20, 30, 3))
    assert deep or (found == image).all()
    assert (colour(listed(image.astype(np.uint8))[0]) == image).all()


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_tiff_is_shown_as_its_pixels_count(orientation: int, tmp_path: Path) -> None:
    """OpenCV turns it, also where it is told not to: clicks would have been those of another image."""
    image = np.random.default_rng(0).integers(0, 256, (20, 30)).astype(np.uint8)
    path = tmp_path / "turned.tif"
    Image.fromarray(image).save(path, tiffinfo={0x0112: orientation})
    (photograph,) = listed(str(path))
    np.testing.assert_array_equal(colour(photograph)[..., 0], image)
    np.testing.assert_array_equal(grey(photograph), image)
    turned = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(colour(photograph, "upright"), turned)


def test_names_that_are_no_utf_8(calibration: dp.Calibration, tmp_path: Path) -> None:
    part = measuring_part(GREY, calibration, view=0, name="a\udcff\x00</script>" + "n" * 400)
    assert part.title.startswith("Measure in a?")
    assert len(part.title) <= 320
    assert part.html.encode()
    assert "</script>n" not in part.html


def test_the_plane_that_was_given_comes_first(calibration: dp.Calibration) -> None:
    given = measuring_model(*as_one(calibration, 0), dp.Plane([0.0, 0.5, 1.0], 4.0), 0.3)
    assert [plane["name"] for plane in given["planes"]] == ["given", "board"]
    assert given["planes"][0]["normal"] == [0.0, 0.5, 1.0]
    assert (given["sigma"], given["pixels_too"]) == (0.3, False)
    told = measuring_model(*as_one(calibration, 0), None, "detector")
    assert told["sigma"] == pytest.approx(float(calibration.pixel_sigma))
    assert told["pixels_too"]


def test_cameras_of_all_origins_are_taken(calibration: dp.Calibration) -> None:
    """Alone, without a lens from Kornia, from a mast by evidence, and from landmarks; all of it finite as JSON."""
    camera = calibration.cameras[0]
    pinhole = dp.Camera(camera.K, camera.R, camera.t, size=(640, 480))
    mast = dp.Camera.mounted(6.0, 20.0, fov_deg=70.0, size=(640, 480))
    known = dp.adjust(mast, priors={"height": 0.02, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    places = torch.rand(8, 3, dtype=D) * 100
    seen, _ = camera.project(places)
    located = dp.locate(dp.Views([seen]), dp.Landmarks(places), calibration)
    for one, includes in ((camera, "pixels"), (pinhole.to_kornia(), "pixels"), (known, "pose"), (located, "camera")):
        model = measuring_model(*as_one(one, None), None, 0.5)
        assert model["includes"] == includes
        assert json.loads(json.dumps(model, allow_nan=False)) == model


class Mirror(dp.Lens):
    """A lens of somebody else's."""

    batch_shape, dtype, device, domain = torch.Size(), D, torch.device("cpu"), torch.tensor(1.0, dtype=D)

    def project_direction(self, direction: Any) -> Any: ...

    def unproject(self, xy_distorted: Any) -> Any: ...

    def to(self, *_: Any, **__: Any) -> "Mirror":
        return self

    def expand(self, *_: int) -> "Mirror":
        return self

    def detach(self) -> "Mirror":
        return self

    def __getitem__(self, _: Any) -> "Mirror":
        return self


def test_what_cannot_be_is_refused_by_name(calibration: dp.Calibration, tmp_path: Path) -> None:
    path, camera = tmp_path / "page.html", calibration.cameras[0]
    foreign = dp.Camera(camera.K, camera.R, camera.t, Mirror(), (640, 480))
    cases: list[tuple[tuple[Any, ...], type[Exception], str]] = [
        ((GREY[:400], camera), ValueError, "photograph: want 640 x 480 px"),
        ((tmp_path / "none.jpg", camera), FileNotFoundError, "photograph: no such file"),
        ((torch.zeros(2, 3, 480, 640), camera), ValueError, "photograph: want one, got shape"),
        ((GREY, calibration.cameras), ValueError, r"calibration: want one camera, got batch shape \(6,\); index it"),
        ((GREY, calibration), ValueError, "view: want one of the calibration's 6 views"),
        ((GREY, foreign), TypeError, "lens"),
        ((GREY, camera, dp.Plane.z(torch.zeros(2, dtype=D))), ValueError, "plane: want one plane"),
        ((GREY, camera, None, None, "detector"), ValueError, "pixel_sigma: want px"),
        ((GREY, camera, None, None, 0.0), ValueError, "pixel_sigma: want a standard deviation in px"),
    ]
    for arguments, error, message in cases:
        with pytest.raises(error, match=message):
            dp.write_measuring_page(path, *arguments)
    assert not list(tmp_path.iterdir())
