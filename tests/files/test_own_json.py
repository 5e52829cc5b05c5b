"""This package's own JSON: what it says is checked to the last number, earlier versions are read, many views load fast."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.files.own_json import _unpacked

D = torch.float64


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left")[:4], dp.Chessboard())


@pytest.fixture(scope="module")
def document(calibration: dp.Calibration, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("own") / "c.json"
    dp.save_camera(path, calibration)
    return json.loads(path.read_text())


def write(path: Path, document: dict[str, Any], where: str, value: Any) -> Path:
    """The document with something else at one place."""
    changed = json.loads(json.dumps(document))
    *parents, last = where.split("/")
    inner = changed
    for key in parents:
        inner = inner[int(key) if isinstance(inner, list) else key]
    if value is Ellipsis:
        del inner[last]
    else:
        inner[int(last) if isinstance(inner, list) else last] = value
    path.write_text(json.dumps(changed))
    return path


DAMAGE = [
    ("calibration/visible", [[True]], "want shape"),
    ("calibration/visible", [[1.0] * 54] * 4, "want true and false"),
    ("calibration/visible/0", [True] * 53, "want true and false|lists of equal lengths"),
    ("calibration/used", [[True] * 54] * 3, "used: want shape"),
    ("calibration/pixels", [[[1.0, 2.0]]], "pixels: want shape"),
    ("calibration/pixels/0/0/0", 300.0, "rms: want"),
    ("calibration/pixels/0/0/0", float("nan"), "pixels: want finite numbers"),
    ("calibration/pixels/0/0/0", "300", "pixels: want numbers"),
    ("calibration/names", ["a"], "names: want 4"),
    (
        "calibration/findings",
        [{"camera": 4, "kind": "skew", "sentence": "", "reason": ""}],
        "findings: want camera, kind",
    ),
    ("calibration/findings", [{"camera": 0, "kind": "s", "sentence": "", "reason": ""}], "findings: want camera, kind"),
    (
        "calibration/findings",
        [{"camera": 0, "kind": "skew", "sentence": 1, "reason": ""}],
        "findings: want a list of te",
    ),
    ("calibration/names/0", 7, "names: want a list of texts"),
    ("calibration/points/0", [0.0, 0.0], "points: want"),
    ("calibration/R/0/0/0", 0.5, "R: want rotation matrices"),
    ("calibration/t/0/0", 1e3, "rms: want"),
    ("calibration/rms", 0.1, "rms: want .* something was changed"),
    ("calibration/rms", None, "rms: want"),
    ("calibration/rms", -0.2, "rms: want numbers of at least 0"),
    ("calibration/pixel_sigma", -0.1, "pixel_sigma: want numbers of at least 0, got -0.1"),
    ("calibration/degrees_of_freedom", -4.0, "degrees_of_freedom: want numbers of at least 0"),
    ("calibration/shares", [1.0, 1.0, 1.0, -1.0], "shares: want numbers of at least 0"),
    ("calibration/objective", "sum", "objective: want image or plane, got 'sum'"),
    ("calibration/status", 7, "status: want whole numbers from 0 to"),
    ("calibration/status", 0.5, "status: want whole numbers"),
    ("calibration/skew", 0, "skew: want true or false"),
    ("calibration/size", [640], "size: want width and height"),
    (
        "calibration/covariance/shared/0/0",
        float("nan"),
        "covariance: want finite numbers where the calibration converged",
    ),
    ("calibration/covariance/shared/0/0", None, "covariance: want finite numbers where the calibration converged"),
    ("calibration/covariance/shared/0/0", -1.0, "shared: want variances of at least 0"),
    ("calibration/covariance/alone/0/0/0", -1.0, "alone: want variances of at least 0"),
    ("calibration/covariance/follow", [[0.0]], "follow: want shape"),
    ("calibration/covariance/names", ["f_x"], "undetermined: want shape"),
    ("calibration/covariance/undetermined", ..., "want the key undetermined"),
    ("calibration/other_poses/likelihood_ratio", [-0.1] * 4, "likelihood_ratio: want numbers of at least 0"),
    ("calibration/status", ..., "want the key status"),
    ("camera/K/0/0", "533", "K: want numbers"),
    ("camera/K/0/0", float("nan"), "K: want finite values"),
    ("camera/K/0/0", 500.0, "rms: want"),
    ("camera/lens/model", "Pinhole", "want the key Pinhole"),
    ("camera/lens/coefficients", [0.1, 0.2], "coefficients: want"),
    ("camera/dtype", "float16", "want the key float16"),
    ("camera/size", [640.5, 480], "size, width: want a whole number"),
    ("camera/size", [1e300, 480], "size, width: want a whole number from 1 to 1000000"),
    ("version", 3, "want version 2 or earlier, got 3; a newer diffproj reads it"),
    ("version", "2", "want version 2 or earlier"),
]


@pytest.mark.parametrize(("where", "value", "message"), DAMAGE)
def test_damage_is_named(tmp_path: Path, document: dict[str, Any], where: str, value: Any, message: str) -> None:
    path = write(tmp_path / "c.json", document, where, value)
    with pytest.raises(ValueError, match=f"c.json: .*({message})") as caught:
        dp.load_calibration(path)
    assert "\n" not in str(caught.value)


def test_a_gap_in_the_covariance_is_no_error_bar_of_zero(tmp_path: Path, document: dict[str, Any]) -> None:
    for value in (None, float("nan")):
        for block in ("shared/0/0", "alone/2/3/3", "follow/1/0/0"):
            path = write(tmp_path / "c.json", document, f"calibration/covariance/{block}", value)
            with pytest.raises(ValueError, match="covariance: want finite numbers"):
                dp.load(path)


def test_version_1_is_read(tmp_path: Path, calibration: dp.Calibration, document: dict[str, Any]) -> None:
    old = json.loads(json.dumps(document | {"version": 1}))
    for key in ("remarks", "findings", "other_poses", "shares", "degrees_of_freedom", "lens_region", "skew"):
        del old["calibration"][key]
    del old["calibration"]["covariance"]["dispersion"]
    (tmp_path / "old.json").write_text(json.dumps(old))
    found = dp.load_calibration(tmp_path / "old.json")
    assert torch.equal(found.residuals, calibration.residuals)
    assert not found.has_alternatives


def test_keys_of_a_later_release_are_passed_over(tmp_path: Path, document: dict[str, Any]) -> None:
    path = write(tmp_path / "c.json", document, "calibration/of_a_later_release", {"a": 1})
    assert isinstance(dp.load(path), dp.Calibration)


def test_a_byte_order_mark_is_passed_over(tmp_path: Path, document: dict[str, Any]) -> None:
    (tmp_path / "c.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(document).replace("\n", "\r\n").encode())
    assert isinstance(dp.load(tmp_path / "c.json"), dp.Calibration)


def test_fields_come_and_go_without_a_file(calibration: dp.Calibration) -> None:
    again = dp.Calibration.from_fields(calibration.to_fields(), calibration.camera)
    assert torch.equal(again.covariance.full(), calibration.covariance.full())
    assert torch.equal(again.likelihood_ratio, calibration.likelihood_ratio)
    assert again.summary() == calibration.summary()
    with pytest.raises(KeyError, match="pixels"):
        dp.Calibration.from_fields(
            {k: v for k, v in calibration.to_fields().items() if k != "pixels"}, calibration.camera
        )


def test_a_noise_that_was_known_stays_known(tmp_path: Path) -> None:
    """JSON has no infinity: without degrees of freedom `locate` would take the corners' noise from a few residuals."""
    views, board = dp.example_views("left"), dp.Chessboard()
    known = dp.calibrate(views[:4], board, pixel_sigma=0.2)
    dp.save_camera(tmp_path / "c.json", known)
    loaded = dp.load_calibration(tmp_path / "c.json")
    assert loaded.degrees_of_freedom is not None
    assert bool(loaded.degrees_of_freedom.isinf())
    assert loaded.summary() == known.summary()
    found, again = (dp.locate(views[4:6], board, one) for one in (known, loaded))
    assert torch.equal(found.covariance.full(), again.covariance.full())
    old = dp.Calibration.from_fields(
        {name: field for name, field in known.to_fields().items() if name != "degrees_of_freedom"}, known.camera
    )
    assert old.degrees_of_freedom is None
    assert "degrees_of_freedom" not in old.to_fields()


def test_many_views_are_packed_and_come_back_exactly(tmp_path: Path) -> None:
    views = dp.example_views("left")
    many = dp.Views(views.pixels[torch.arange(100) % 13] + 0.1 * torch.randn(100, 54, 2, dtype=D), size=views.size)
    want = dp.calibrate(many, dp.Chessboard())
    dp.save_camera(tmp_path / "c.json", want)
    text = (tmp_path / "c.json").read_text()
    assert len(text) < 800_000
    packed = json.loads(text)["calibration"]["pixels"]
    assert packed["shape"] == [100, 54, 2]
    assert np.array_equal(_unpacked(packed), want.views.pixels.numpy())
    before = time.perf_counter()
    found = dp.load_calibration(tmp_path / "c.json")
    assert time.perf_counter() - before < 0.5  # 0.03 s; a thousand views take 0.1 s
    assert torch.equal(found.covariance.full(), want.covariance.full())
    assert torch.equal(found.residuals, want.residuals)
    for value, message in (
        ({"shape": [100, 54, 2], "float64": "AAAA"}, "got 3 bytes"),
        ({"shape": 4, "bool": ""}, "packed"),
    ):
        with pytest.raises(ValueError, match=message):
            dp.load_calibration(write(tmp_path / "d.json", json.loads(text), "calibration/pixels", value))


def test_a_fleet_with_a_camera_that_failed_comes_back(tmp_path: Path) -> None:
    views = dp.example_views("left")
    pixels = torch.stack([views.pixels, views.pixels.new_zeros(views.pixels.shape)])
    fleet = dp.calibrate(dp.Views(pixels, size=views.size), dp.Chessboard(), throw=False)
    dp.save_camera(tmp_path / "c.json", fleet)
    found = dp.load_calibration(tmp_path / "c.json")
    assert found.status.tolist() == fleet.status.tolist()
    assert torch.equal(found.covariance.shared[0], fleet.covariance.shared[0])
