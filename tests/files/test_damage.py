"""Damaged files: each kind by name, and thousands drawn at random. Only errors that name the file; no wrong camera."""

import contextlib
import json
import random
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import diffproj as dp
from tests.files.damage import damaged
from tests.files.samples import (
    DIST,
    MRCAL,
    NERFSTUDIO,
    OPENCV_STEREO,
    OPENCV_XML,
    OPENCV_YAML,
    PLAIN_JSON,
    ROS,
    ROS_INI,
    SAMPLES,
    K,
    npy,
    npz,
    npz_of,
)


def refuse(folder: Path, name: str, content: str | bytes, message: str) -> None:
    """Loading has to fail in one line that names the file."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as caught:
        dp.load_camera(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_matrix_of_opencv_says_its_shape(tmp_path: Path) -> None:
    """`FileStorage` of OpenCV 5.0 writes past its memory here, and the process ends."""
    for line in ("   rows: 3\n", "   cols: 3\n"):
        refuse(
            tmp_path, "a.yml", OPENCV_YAML.replace(line, "", 1), "camera_matrix: want a matrix with rows, cols and data"
        )
    for rows in ("2", "4", "-3", "1e300", "3.5", '"3"', "[3]", "nan", ""):
        refuse(
            tmp_path,
            "a.yml",
            OPENCV_YAML.replace("rows: 3", f"rows: {rows}", 1),
            "camera_matrix, rows: want|want 2 x 3|want 4 x 3",
        )
    refuse(
        tmp_path,
        "a.yml",
        OPENCV_YAML.replace("[ 6.84", "[ 1., 6.84"),
        "want 3 x 3 numbers as rows and cols say, got 10 in data",
    )
    refuse(tmp_path, "a.yml", OPENCV_YAML.replace("dt: d", 'dt: "2d"', 1), "want one number an entry")


@pytest.mark.parametrize(
    "name", ["distortion_coefs", "DistortionCoeffs_1x5", "lens_parameters", "kc_left_x_dist", "radial", "abc"]
)
def test_a_key_that_looks_like_a_lens_is_never_passed_over(tmp_path: Path, name: str) -> None:
    refuse(tmp_path, "a.yml", OPENCV_YAML.replace("distortion_coefficients", name), f"{name}: want .*lens")


def test_a_lens_that_is_no_list_is_no_pinhole(tmp_path: Path) -> None:
    start = PLAIN_JSON.index('"distCoeffs"')
    for value in (
        "null",
        '"0.1 0.2 0.3 0.4 0.5"',
        "5",
        "true",
        "{}",
        "[[1, 2], [3, 4]]",
        "[0.1, null, 0, 0, 0]",
        '["0.1", 0, 0, 0, 0]',
    ):
        refuse(tmp_path, "a.json", PLAIN_JSON[:start] + f'"distCoeffs": {value}}}', "distCoeffs")


def test_the_lens_of_one_camera_of_two_is_missed(tmp_path: Path) -> None:
    refuse(tmp_path, "a.yml", OPENCV_STEREO.replace("D2:", "X2:"), "camera 2: want its distortion")
    refuse(tmp_path, "a.yml", OPENCV_STEREO.replace("M2:", "X2:"), "D2: want a camera matrix to this lens")
    refuse(tmp_path, "a.yml", OPENCV_STEREO.replace("T:", "X:"), "want R and T from the first camera to the second")


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("distortion_model: ftheta", "distortion_model: want a model equal to OpenCV's perspective or fisheye one"),
        ("camera_model: omni", "camera_model: want a model equal"),
        ("xi: 1.2", "xi: want a perspective or fisheye lens of OpenCV, got the parameters of an omnidirectional"),
        ("fisheye_model: 1", "want the 4 coefficients of a fisheye lens"),
        ("fisheye_model: 2", "fisheye_model: want a model"),
        ("image_width: 1280", "image_width: want the key once, got it twice"),
        ("cameraMatrix: [1, 2]", "want one of the kind, got camera_matrix too"),
        ("k3: 0.1", "k3: want a name that is known to hold the lens"),
    ],
)
def test_a_model_is_obeyed_or_refused_and_a_key_stands_once(tmp_path: Path, key: str, message: str) -> None:
    refuse(tmp_path, "a.yml", OPENCV_YAML + key + "\n", message)


def test_equal_keys_are_refused_in_all_three(tmp_path: Path) -> None:
    refuse(tmp_path, "a.yml", OPENCV_YAML + OPENCV_YAML[OPENCV_YAML.index("camera_matrix") :], "want the key once")
    block = OPENCV_XML[OPENCV_XML.index("<dist_coeffs ") : OPENCV_XML.index("</opencv_storage>")]
    refuse(
        tmp_path,
        "a.xml",
        OPENCV_XML.replace("</opencv_storage>", block + "</opencv_storage>"),
        "dist_coeffs: want the element once",
    )
    refuse(tmp_path, "a.json", PLAIN_JSON[:-2] + ', "distCoeffs": [0, 0, 0, 0, 0]}', "distCoeffs: want the key once")


@pytest.mark.parametrize("size", ["1e300", "-640", "0.5", '"640"', "nan", "[640]", "true", "99999999999999999999"])
def test_sizes_that_are_none(tmp_path: Path, size: str) -> None:
    refuse(tmp_path, "a.yml", OPENCV_YAML.replace("1280", size), "image, width: want|only one of them")
    refuse(tmp_path, "ost.yaml", ROS.replace("640", size, 1), "size, width: want|only one of them")


def test_half_a_size_and_an_exchanged_one(tmp_path: Path) -> None:
    refuse(
        tmp_path, "a.yml", OPENCV_YAML.replace("image_height: 960\n", ""), "want width and height, got only one of them"
    )
    refuse(tmp_path, "a.npz", npz(mtx=K, dist=DIST, image_size=np.array([300, 640])), "looks like height and width")


@pytest.mark.parametrize("number", ["nan", ".nan", "1e999", '"650."', "abc", "010", "1:30", "null", "[1]"])
def test_numbers_that_are_none(tmp_path: Path, number: str) -> None:
    refuse(tmp_path, "a.yml", OPENCV_YAML.replace("6.4163537587632698e+02", number), "camera_matrix|want 9|YAML")
    refuse(tmp_path, "ost.yaml", ROS.replace("0.031195", number), "distortion_coefficients")


def test_matrices_that_are_no_intrinsics(tmp_path: Path) -> None:
    for matrix, message in (
        (K.T, "as if rows and columns were exchanged"),
        (K * [[-1], [1], [1]], "want positive focal lengths"),
        (K * 0 + np.diag([0, 0, 1]), "the camera is not calibrated"),
        (np.triu(K + np.eye(3, k=1)), "which OpenCV ignores"),
        (K[:2], "want 3 x 3 numbers, got 2 x 3"),
    ):
        refuse(tmp_path, "a.json", json.dumps({"K": matrix.tolist(), "dist": DIST.tolist()}), message)


def test_text_that_is_cut_off(tmp_path: Path) -> None:
    for name, data in SAMPLES.items():
        if name in ("cameras.txt", "cameras.bin", "images.txt"):
            continue
        (tmp_path / name).write_bytes(data)
        whole = dp.load_camera(tmp_path / name, camera=0) if not name.startswith("images") else None
        for part in (0.3, 0.55):
            (tmp_path / name).write_bytes(data[: int(part * len(data))])
            with contextlib.suppress(ValueError):
                found = dp.load_camera(tmp_path / name, camera=0)
                # A later camera was cut off, or the size at the end of the file.
                assert whole is not None
                assert torch.equal(found.K, whole.K)
                assert type(found.distortion) is type(whole.distortion)
    refuse(tmp_path, "ost.txt", ROS_INI[: ROS_INI.index("rectification")], "want a projection of 12 numbers at its end")


def test_binary_files_that_are_cut_off_or_lie(tmp_path: Path) -> None:
    for name in ("cameras.bin", "calibration.npz", "matrix.npy"):
        data = SAMPLES[name]
        for length in range(9, len(data), max(1, len(data) // 23)):
            refuse(tmp_path, name, data[:length], name)
    refuse(
        tmp_path,
        "cameras.bin",
        b"\xff" * 8 + SAMPLES["cameras.bin"][8:],
        "want as many records as the file has room for",
    )
    refuse(tmp_path, "cameras.bin", SAMPLES["cameras.bin"] + b"\0", "bytes as its records need")
    header = npy(K).replace(b"(3, 3), }", b"(3, 10**9)")
    refuse(
        tmp_path,
        "a.npz",
        npz_of([("mtx.npy", header)]),
        "mtx: want an array as numpy.save writes it|numbers as its header",
    )
    refuse(
        tmp_path,
        "a.npz",
        npz_of([("mtx.npy", npy(K)), ("dist.npy", npy(DIST)[:-8])]),
        "dist: want 5 numbers as its header says",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refuse(tmp_path, "a.npz", npz_of([("mtx.npy", npy(K)), ("mtx.npy", npy(K))]), "mtx: want the array once")


@pytest.mark.parametrize("opening", ["[", "{", '{"a":', "- ", "<a>", "a:\n ", "(", "[{"])
def test_deep_nesting(tmp_path: Path, opening: str) -> None:
    for name in ("a.json", "a.yaml", "a.xml", "a.cameramodel"):
        refuse(tmp_path, name, opening * 5000, name)
    refuse(
        tmp_path, "a.json", PLAIN_JSON[:-2] + ', "a": ' + "[" * 60 + "]" * 60 + "}", "want at most 40 levels of nesting"
    )
    refuse(
        tmp_path,
        "a.cameramodel",
        MRCAL.replace("[ 4000", "[" * 5000 + "4000"),
        "too deeply nested|want a Python literal",
    )


def test_references_and_entities_do_not_grow(tmp_path: Path) -> None:
    bomb = "a: &a [1, 1]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(20)
    )
    refuse(tmp_path, "a.yaml", bomb, r"\*a: want the value itself, got a reference to it")
    refuse(
        tmp_path,
        "a.xml",
        '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><l>&a;</l>',
        "want XML without a document type",
    )


def test_byte_order_marks_and_line_ends_do_no_harm(tmp_path: Path) -> None:
    for name, data in SAMPLES.items():
        if Path(name).suffix in (".bin", ".npz", ".npy") or name == "images.txt":
            continue
        (tmp_path / name).write_bytes(data)
        want = dp.load_camera(tmp_path / name, camera=0)
        for other in (b"\xef\xbb\xbf" + data, data.replace(b"\n", b"\r\n"), data.decode().encode("utf-16")):
            (tmp_path / name).write_bytes(other)
            assert torch.equal(dp.load_camera(tmp_path / name, camera=0).K, want.K), name


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"want a file, got a folder; name the file in it"):
        dp.load_camera(tmp_path)
    with pytest.raises(ValueError, match="NUL character"):
        dp.load_camera(f"{tmp_path}/a\0.json")
    with pytest.raises(ValueError, match="got a pipe or a device"):
        dp.load_camera("/dev/null")
    for start in (b"\x89PNG\r\n", b"\xff\xd8\xff\xe0", b"\x1f\x8b\x08", b"\x80\x04\x95"):
        refuse(tmp_path, "a.yaml", start + b"\0" * 100, "want a camera file, got")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"k2"', '"k4": 0.01, "k2"'), "k4: want 0, got 0.01: here it is a factor of r\\^8"),
        (
            ('"OPENCV"', '"EQUIRECTANGULAR"'),
            "camera_model: want OPENCV, PINHOLE or OPENCV_FISHEYE, got 'EQUIRECTANGULAR'",
        ),
        (('"k1"', '"k_1"'), "k_1: want a name that is known to hold the lens"),
        (("[0.0, 0.0, 0.0, 1.0]]},", "[0.0, 0.0, 0.0, 2.0]]},"), "transform_matrix: want the last row 0 0 0 1"),
        (("[0.6, 0.0, 0.8, 1.0]", "[-0.6, 0.0, -0.8, 1.0]"), "left-handed"),
        (("[0.6, 0.0, 0.8, 1.0]", "[0.6, 0.0, 0.9, 1.0]"), "want a rotation"),
        (("frame_00002", "frame_00001"), "want each file once"),
        (('"k1"', '"ftheta_p0": 0.1, "k1"'), "ftheta_p0: want a perspective or fisheye lens"),
        (('"OPENCV"', '"OPENCV_FISHEYE"'), "p1: want 0"),
        (('"w": 3008, ', ""), "want width and height, got only one"),
    ],
)
def test_what_nerfstudio_has_and_we_do_not(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    refuse(tmp_path, "transforms.json", NERFSTUDIO.replace(*change), message)


def test_a_pose_with_a_scale_is_named_as_one(tmp_path: Path) -> None:
    fields = json.loads(NERFSTUDIO)
    for row in fields["frames"][0]["transform_matrix"][:3]:
        row[:3] = [2 * x for x in row[:3]]
    refuse(tmp_path, "transforms.json", json.dumps(fields), "want a rotation, got one times 2: take the scale out")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "cameras.txt",
            ("1 OPENCV", "1 THIN_PRISM_FISHEYE"),
            "THIN_PRISM_FISHEYE: want one of COLMAP's models that equal",
        ),
        ("cameras.txt", ("1 OPENCV", "1 FOV"), "FOV: want one of COLMAP's models"),
        ("cameras.txt", ("1 OPENCV", "1 FULL_OPENCV"), "FULL_OPENCV: want 12 parameters, got 8"),
        ("cameras.txt", ("2 OPENCV", "1 OPENCV"), "want each id once"),
        ("images.txt", (" 1 left", " 7 left"), "want a camera of cameras.txt, got the id 7"),
        ("images.txt", ("0.9659258", "0.5659258"), "want a quaternion of length 1"),
        ("camchain.yaml", ("camera_model: pinhole", "camera_model: ds"), "want pinhole, got 'ds'"),
        (
            "camchain.yaml",
            ("camera_model: pinhole", "camera_model: plumb_bob"),
            "the lens 'plumb_bob'; write camera_mo",
        ),
        ("camchain.yaml", ("distortion_model: radtan", "distortion_model: fov"), "got 'fov', which is neither"),
        ("camchain.yaml", ("  distortion_model: radtan\n", ""), "want a distortion_model, got none"),
        ("camchain.yaml", ("intrinsics: [458", "intrinsic: [458"), "cam0: want intrinsics"),
        ("camchain.yaml", ("T_cn_cnm1", "T_cn_x"), "want T_cam_imu or T_imu_cam as the pose"),
        ("camchain.yaml", ("1.76187114e-05]", "1.76187114e-05, 0.1, 0.2]"), "want 4 coefficients of radtan"),
        ("calib.txt", ("P2:", "P1:"), "P1: want the line once"),
        ("calib.txt", ("4.575831e+01", "abc"), "P2: want numbers"),
        ("calib_cam_to_cam.txt", ("K_02", "X_02"), "K_02: want the camera matrix beside D_02"),
        ("calib_cam_to_cam.txt", ("D_02", "X_02"), "want D_02 with it"),
        ("calibrated_sensor.json", ('"rotation"', '"x"'), "want rotation"),
        ("EuRoC.yaml", ("Camera1.p2", "Camera1.x2"), "want k1 k2 p1 p2, then k3"),
        (
            "EuRoC.yaml",
            ("PinHole", "KannalaBrandt8"),
            "want k1 to k4 of the fisheye lens that the file names, got k1, k2, p1",
        ),
        ("EuRoC.yaml", ("PinHole", "Equirectangular"), "type: want a model equal"),
        ("cam0_kb.yaml", ("KANNALA_BRANDT", "SCARAMUZZA"), "model_type: want PINHOLE or KANNALA_BRANDT"),
        ("stella.yaml", ("k4:", "k_4:"), "k_4: want a name that is known"),
        ("camera.cameramodel", ("OPENCV8", "CAHVORE"), "lensmodel: want one of LENSMODEL_PINHOLE"),
        ("camera.cameramodel", ("OPENCV8", "OPENCV5"), "intrinsics: want 9 numbers, got 12"),
        ("camera.cameramodel", ("'imagersize'", "'lensmodel'"), "want the key once"),
        ("camera.cameramodel", ("1761.18", "__import__('os').abort(), 1761.18"), "want a Python literal"),
        ("matlab.json", ('"TangentialDistortion"', '"x"'), "want TangentialDistortion"),
        (
            "cameras.xml",
            ('type="frame" class="adjusted"', 'type="fisheye" class="adjusted"'),
            "want a frame sensor, got 'fisheye'",
        ),
        ("cameras.xml", ("<k3>0.0117</k3>", "<k4>0.0117</k4>"), "k4: want 0"),
        (
            "ost.yaml",
            ("plumb_bob", "rational_polynomial"),
            "want 8 coefficients for distortion_model rational_polynomial",
        ),
        ("ost.yaml", ("plumb_bob", "ftheta"), "distortion_model: want a model"),
        ("ost.yaml", ("camera_name", "binning_x: 2\ncamera_name"), "binning_x: want 0 or 1"),
        ("ost.yaml", ("camera_name", "binning_x: '2'\ncamera_name"), "binning_x: want 0 or 1"),
        (
            "ost.yaml",
            ("camera_name", "roi: {x_offset: 8, y_offset: 0, width: 8, height: 8}\ncamera_name"),
            "roi: want the whole",
        ),
    ],
)
def test_what_formats_have_and_we_do_not(tmp_path: Path, name: str, change: tuple[str, str], message: str) -> None:
    for beside in ("cameras.txt", "cameras.bin"):
        (tmp_path / beside).write_bytes(SAMPLES[beside])
    changed = SAMPLES[name].decode().replace(*change)
    assert changed != SAMPLES[name].decode()
    refuse(tmp_path, name, changed, message)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.xml",
            '<!DOCTYPE lensdatabase SYSTEM "l.dtd">\n<lensdatabase version="2"></lensdatabase>',
            "a lensfun database",
        ),
        ("a.json", '{"value0": {"intrinsics": [{"camera_type": "ds"}]}}', "a calibration of Basalt"),
        ("a.json", '{"camera_type": "fisheye", "camera_path": [{"fov": 50}]}', "a camera path of nerfstudio"),
        ("a.xmp", '<x:xmpmeta xmlns:x="a"><a xmlns:xcr="b" xcr:Skew="0"/></x:xmpmeta>', "a camera of RealityCapture"),
        ("a.nvm", "NVM_V3\n\n1\na.jpg 500 1 0 0 0 0 0 0 0.1 0\n", "a model of VisualSFM or Bundler"),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "intrinsics": [{"key": 0}]}', "a scene of OpenMVG"),
        ("a.json", '{"fx": 1.0, "ppx": 2.0, "model": "distortion.brown_conrady"}', "intrinsics of RealSense"),
        (
            "calib.txt",
            "cam0=[3979.911 0 1244.772; 0 3979.911 1019.507; 0 0 1]\ndoffs=124.343\n",
            "a Middlebury calib.txt",
        ),
        ("a.toml", '[cam_0]\nname = "A"\nsize = [ 1920, 1080,]\n', "an anipose calibration"),
        ("a.json", '{"v2": {"projection_type": "perspective", "focal": 0.85, "k1": 0.0}}', "cameras of OpenSfM"),
        ("a.yaml", "model_type: MEI\nmirror_parameters:\n   xi: 3.6\n", "an omnidirectional camera"),
        ("a.xml", "<opencv_storage><rvec>1 2 3</rvec></opencv_storage>", "a pose alone"),
        ("a.npy", npy(np.zeros((7, 17))), "the poses of LLFF"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + b" " * 105 + b"\x00\x02IM" + b"\0" * 400, "toStruct"),
    ],
)
def test_files_of_other_programs_are_named(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    refuse(tmp_path, name, content, message)


def test_a_lens_beside_its_camera_matrix(tmp_path: Path) -> None:
    (tmp_path / "dist.npy").write_bytes(npy(DIST))
    refuse(tmp_path, "mtx.npy", npy(K), "want the lens with its camera matrix, got it in dist.npy beside it")


FUZZ = """
import sys
from pathlib import Path
import pytest
import tests.files.test_damage as t
print(t.fuzz(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])))
"""


def fuzz(folder: Path, seed: int, count: int) -> int:
    """Load so many damaged files; returns how many were refused. Anything but a refusal that names the file raises."""
    rng, refused = random.Random(seed), 0  # noqa: S311
    dp.save_camera(folder / "own.json", dp.calibrate(dp.example_views("left")[:3], dp.Chessboard()))
    samples = SAMPLES | {"own.json": (folder / "own.json").read_bytes()}
    for name, data in samples.items():
        (folder / name).write_bytes(data)
    names = list(samples)
    for i in range(count):
        name = names[i % len(names)]
        kind, data = damaged(samples[name], rng)
        (folder / name).write_bytes(data)
        try:
            found = dp.load_camera(folder / name, camera=0)
            assert all(bool(tensor.isfinite().all()) for tensor in (found.K, found.R, found.t)), (name, kind)
            if name == "own.json":
                dp.load(folder / name)
        except (OSError, ValueError, UserWarning) as error:  # a warning, where it is an error, tells too
            said, refused = str(error), refused + 1
            if str(folder / name) not in said or "\n" in said:
                raise AssertionError(f"{name} after {kind}") from error
        (folder / name).write_bytes(samples[name])
    return refused


def test_damage_at_random_is_refused_by_name(tmp_path: Path) -> None:
    assert fuzz(tmp_path, seed=0, count=150) > 90


@pytest.mark.slow
def test_much_damage_ends_no_process(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-W", "error", "-c", FUZZ, str(tmp_path), "1", "20000"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 12_000
