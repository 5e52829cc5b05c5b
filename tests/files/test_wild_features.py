"""Odd features of real files, each read as its program means it, or refused."""

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from tests.files.samples import SAMPLES, mat
from tests.files.test_readers import load, numbers, poses

TURN = [[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]

ORB_PAIR = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 190.5
Camera.fy: 191.5
Camera.cx: 254.5
Camera.cy: 256.5
Camera.k1: 0.1
Camera.k2: 0.2
Camera.p1: 0.01
Camera.p2: 0.02
Camera.k3: 0.3
Camera2.fx: 180.5
Camera2.fy: 181.5
Camera2.cx: 252.5
Camera2.cy: 253.5
Camera2.k1: -0.1
Camera2.k2: -0.2
Camera2.p1: -0.01
Camera2.p2: -0.02
Tlr: !!opencv-matrix
  rows: 3
  cols: 4
  dt: f
  data:[ 0.6, -0.8, 0, 0.1,
         0.8, 0.6, 0, 0.2,
         0, 0, 1, 0.3]
Camera.width: 512
Camera.height: 500
Viewer.PointSize:2
"""


def test_settings_of_a_pair_whose_first_camera_has_no_number(tmp_path: Path) -> None:
    first, second = (load(tmp_path, "pair.yaml", ORB_PAIR, camera=i) for i in (0, 1))
    assert numbers(first) == ([190.5, 191.5, 254.5, 256.5], [0.1, 0.2, 0.01, 0.02, 0.3])
    assert numbers(second) == ([180.5, 181.5, 252.5, 253.5], [-0.1, -0.2, -0.01, -0.02])  # and not the first one's k3
    assert first.size == second.size == (512, 500)
    left_from_right = np.vstack([np.column_stack([TURN, [0.1, 0.2, 0.3]]), [0, 0, 0, 1]])
    np.testing.assert_allclose(poses(second), np.linalg.inv(left_from_right), atol=1e-15)
    assert torch.equal(first.t, torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize("comment", [" # the type has to be said at the top", "\t#", "  "])
def test_a_comment_behind_opencvs_directive(tmp_path: Path, comment: str) -> None:
    camera = load(tmp_path, "camchain.yaml", f"%YAML:1.0{comment}\n" + SAMPLES["camchain.yaml"].decode(), camera="cam0")
    assert torch.equal(camera.K, load(tmp_path, "camchain.yaml", camera="cam0").K)


def test_kitti_is_told_by_lines(tmp_path: Path) -> None:
    """A plain YAML of a stereo pair has `P1:` too, with lists in the lines below it."""
    rows = "".join(f"- - {row[0]}\n  - {row[1]}\n  - {row[2]}\n" for row in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    text = f"P1:\n{rows}- - 0.0\n  - 0.0\n  - 1.0\n" + "camera_matrix: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n"
    assert numbers(load(tmp_path, "stereo.yaml", text)) == ([500.0, 500.0, 320.0, 240.0], [])


@pytest.mark.parametrize(("said", "kind"), [("0.", dp.BrownConrady), ("1.", dp.KannalaBrandt)])
def test_a_flag_that_is_written_with_a_point(tmp_path: Path, said: str, kind: type) -> None:
    text = f"fisheye_model: {said}\nK: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\nD: [0.1, 0.01, 0.001, 0.002]\n"
    assert type(load(tmp_path, "camera.yml", text).distortion) is kind


def test_four_coefficients_of_bouguets_may_be_a_fisheyes(tmp_path: Path) -> None:
    five, four = "0.1 ; -0.2 ; 0.001 ; 0.002 ; 0 ]", "0.1 ; -0.2 ; 0.001 ; 0.002 ]"
    text = f"fc = [ 500 ; 501 ];\ncc = [ 320 ; 240 ];\nkc = [ {five};\nnx = 640;\nny = 480;\n"
    assert numbers(load(tmp_path, "Calib_Results.m", text))[1] == [0.1, -0.2, 0.001, 0.002, 0.0]
    said = r"kc: want 5 .* got 4, which may be those of the toolbox's fisheye model, or .*: if they are k1 k2 p1 p2, append a"
    with pytest.raises(ValueError, match=said + r" 0; if the fisheye's, build dp\.Camera\(K, dist"):
        load(tmp_path, "Calib_Results.m", text.replace(five, four))
    assert numbers(load(tmp_path, "Calib_Results.m", text.replace(five, "0 ; 0 ; 0 ; 0 ]")))[1] == [0.0] * 4


def test_matlabs_stereo_pair_stands_as_it_says(tmp_path: Path) -> None:
    def camera(focal: float) -> dict[str, object]:
        return {
            "RadialDistortion": [-0.3, 0.1],
            "TangentialDistortion": [0.001, 0.002],
            "ImageSize": [480, 640],
            "IntrinsicMatrix": [[focal, 0.0, 0.0], [0.0, focal, 0.0], [321.0, 241.0, 1.0]],
        }

    R, t = np.array(TURN), [-120.0, 1.0, 2.0]
    pair: dict[str, object] = {
        "CameraParameters1": camera(700.0),
        "CameraParameters2": camera(710.0),
        "RotationOfCamera2": R.T.tolist(),
        "TranslationOfCamera2": t,
    }
    nested: dict[str, object] = {"stereoParams": pair}
    for name, content in (
        ("a.json", json.dumps(pair)),
        ("b.json", json.dumps(nested)),
        ("a.mat", mat(pair)),
        ("b.mat", mat(nested)),
    ):
        first, second = (load(tmp_path, name, content, camera=f"CameraParameters{i}") for i in (1, 2))
        assert (numbers(first)[0][0], numbers(second)[0][0]) == (700.0, 710.0)
        # MATLAB multiplies from the left: [x y z] R + t
        X = np.array([0.3, -0.2, 4.0])
        at_second = X @ R.T + t
        np.testing.assert_allclose(second.R.numpy() @ X + second.t.numpy(), at_second, atol=1e-12)
        assert not first.t.any()
    del pair["TranslationOfCamera2"]
    with pytest.raises(ValueError, match="TranslationOfCamera2: want it beside RotationOfCamera2, got none"):
        load(tmp_path, "a.json", json.dumps(pair))
    del pair["RotationOfCamera2"]
    for pose in ({}, {"PoseCamera2": {"R": TURN, "Translation": t}}):  # the latter since R2022b; both were silent
        with pytest.warns(UserWarning, match="the second camera stands where the first one does, for there is no Rot"):
            assert not load(tmp_path, "a.json", json.dumps(pair | pose)).t.any()


@pytest.mark.parametrize("beside", [{"binning_x": 2}, {"roi": {"x_offset": 9, "y_offset": 0, "width": 9, "height": 9}}])
def test_a_part_of_the_calibrated_image_is_told_of_beside_opencvs_keys_too(
    tmp_path: Path, beside: dict[str, object]
) -> None:
    """In a camera_info it is refused; here the keys may be settings of the camera while it was calibrated."""
    K = {"camera_matrix": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "dist_coeffs": [0.1, 0, 0, 0, 0]}
    numbers_alone = {"fx": 500, "fy": 500, "cx": 320, "cy": 240}
    for tree in (K | beside, numbers_alone | beside, {"left": K | beside, "right": K}):
        with pytest.warns(UserWarning, match=rf"{next(iter(beside))}: want .*K is of the image before"):
            assert load(tmp_path, "a.json", json.dumps(tree), camera=0).K[0, 2] == 320.0
    whole = {"roi": {"x_offset": 0, "y_offset": 0, "width": 640, "height": 480}, "binning_x": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for size in ({"image_size": [640, 480]}, {"image_width": 640, "image_height": 480}, {}):
            load(tmp_path, "a.json", json.dumps(K | whole | size))


@pytest.mark.parametrize("key", ["model", "camera_model", "type"])
def test_a_pinhole_of_numbers_one_by_one_has_no_lens(tmp_path: Path, key: str) -> None:
    """It was refused."""
    for value in ("pinhole", "PINHOLE", "perspective"):
        tree = {key: value, "fx": 500, "fy": 501, "cx": 320, "cy": 240, "width": 640, "height": 480}
        assert load(tmp_path, "a.json", json.dumps(tree)).distortion is None
    with pytest.raises(ValueError, match="want k1 k2 p1 p2 beside"):
        load(tmp_path, "a.json", json.dumps(tree | {key: "radtan"}))


def _rectified_pair() -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """R and T of a pair, and R1 R2 P1 P2 of OpenCV's rectification."""
    K = np.array([[450.0, 0, 370], [0, 451, 245], [0, 0, 1]])
    R, T = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0], np.array([-0.11, 0.004, -0.002])
    found = cv2.stereoRectify(K, np.zeros(5), K, np.zeros(5), (752, 480), R, T[:, None])
    return R, T, [np.asarray(one) for one in found[:4]]


def _orb_before_rectification(turns: list[np.ndarray], P: np.ndarray, shift: float) -> str:
    def block(key: str, values: np.ndarray) -> str:
        rows, columns = np.atleast_2d(values).shape
        data = ", ".join(map(repr, np.ravel(values).tolist()))
        return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:[{data}]\n"

    lines = f"%YAML:1.0\nCamera.fx: {P[0, 0]}\nCamera.fy: {P[1, 1]}\nCamera.cx: {P[0, 2]}\nCamera.cy: {P[1, 2]}\n"
    lines += "Camera.k1: 0.0\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\n"
    lines += f"Camera.width: 752\nCamera.height: 480\nCamera.bf: {shift}\nLEFT.width: 752\nLEFT.height: 480\n"
    for side, focal, turn in (("LEFT", 458.5, turns[0]), ("RIGHT", 457.5, turns[1])):
        lines += block(f"{side}.K", np.array([[focal, 0, 367], [0, focal + 1, 248], [0, 0, 1]]))
        lines += block(f"{side}.D", np.array([-0.28, 0.07, 0.0002, 1e-05, 0.0])) + block(f"{side}.R", turn)
    return lines


def _stella_before_rectification(turns: list[np.ndarray], P: np.ndarray, shift: float, model: str) -> str:
    camera = {"fx": P[0, 0], "fy": P[1, 1], "cx": P[0, 2], "cy": P[1, 2], "cols": 752, "rows": 480}
    camera |= {"model": "perspective", "focal_x_baseline": shift, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
    raw: dict[str, object] = {"model": model}
    for side, focal, turn in (("left", 458.5, turns[0]), ("right", 457.5, turns[1])):
        raw[f"K_{side}"] = [focal, 0, 367, 0, focal + 1, 248, 0, 0, 1]
        raw[f"D_{side}"] = [-0.28, 0.07, 0.0002, 1e-05, 0.0][: 4 if model == "fisheye" else 5]
        raw[f"R_{side}"] = turn.ravel().tolist()
    return json.dumps({"Camera": camera, "StereoRectifier": raw})


@pytest.mark.parametrize("model", ["orb", "perspective", "fisheye"])
def test_settings_of_a_rectified_pair_have_the_cameras_before_it(tmp_path: Path, model: str) -> None:
    R, T, (R1, R2, P1, P2) = _rectified_pair()
    if model == "orb":
        text = _orb_before_rectification([R1, R2], P1, -P2[0, 3])
    else:
        text = _stella_before_rectification([R1, R2], P1, -P2[0, 3], model)
    left, right, rectified = (load(tmp_path, "pair.yaml", text, camera=name) for name in ("left", "right", "rectified"))
    assert (numbers(left)[0], numbers(right)[0]) == ([458.5, 459.5, 367.0, 248.0], [457.5, 458.5, 367.0, 248.0])
    assert type(left.distortion) is (dp.KannalaBrandt if model == "fisheye" else dp.BrownConrady)
    assert left.size == right.size == (752, 480)
    np.testing.assert_allclose(poses(left), np.eye(4))
    np.testing.assert_allclose(poses(right)[:3], np.column_stack([R, T]), atol=1e-12)
    np.testing.assert_allclose(rectified.K.numpy(), P1[:, :3])
    assert not rectified.t.any()


@pytest.mark.parametrize(
    ("old", "message"),
    [("Camera.bf: ", "want bf, baseline times focal length"), ("RIGHT.R: ", "right camera: want K, D and R before")],
)
def test_a_pair_before_rectification_is_whole(tmp_path: Path, old: str, message: str) -> None:
    _, _, (R1, R2, P1, P2) = _rectified_pair()
    text = _orb_before_rectification([R1, R2], P1, -P2[0, 3])
    with pytest.raises(ValueError, match=message):
        load(tmp_path, "pair.yaml", text.replace(old, f"Other{old}"))


def test_nuimages_has_lenses(tmp_path: Path) -> None:
    sensors = json.loads(SAMPLES["calibrated_sensor.json"])
    D = [-0.3, 0.1, 0.001, 0.002, 0.03]
    for given in (D, [*D, 0.0], []):
        sensors[1]["camera_distortion"] = given
        assert numbers(load(tmp_path, "calibrated_sensor.json", json.dumps(sensors)))[1] == given[:5]
    sensors[1]["camera_distortion"] = [*D, 0.01]
    with pytest.raises(ValueError, match=r"camera_distortion, k4: want 0, got 0\.01: it is a factor of r\^8"):
        load(tmp_path, "calibrated_sensor.json", json.dumps(sensors))


def test_kittis_tracking_set_has_lines_without_a_colon(tmp_path: Path) -> None:
    lines = SAMPLES["calib.txt"].decode().splitlines()[:4]
    lines += ["R_rect 9.99e-01 9.8e-03 -7.4e-03 -9.8e-03 9.99e-01 -4.2e-03 7.4e-03 4.3e-03 9.99e-01", "Tr_velo_cam 1 2"]
    got = load(tmp_path, "calib.txt", "\n".join(lines) + "\n", camera="P2")
    assert torch.equal(got.K, load(tmp_path, "calib.txt", camera="P2").K)
    with pytest.raises(ValueError, match="want lines of a name, a colon and numbers, got 'R_rect left right'"):
        load(tmp_path, "calib.txt", "\n".join([*lines[:4], "R_rect left right"]))


def test_metashape_says_which_cameras_of_a_rig_it_leaves_out(tmp_path: Path) -> None:
    follower = '<camera id="7" sensor_id="0" master_id="0" label="right_1"/></cameras>'
    text = SAMPLES["cameras.xml"].decode().replace("</cameras>", follower)
    with pytest.warns(UserWarning, match=r"cameras: 1 follow the first camera of a rig, such as right_1, and are not"):
        load(tmp_path, "cameras.xml", text, camera="DJI_0001")


@pytest.mark.parametrize(
    ("given", "said"), [(0, "0"), (None, "nothing"), ("calib.npz", r"'calib\.npz' in quotes"), (float("nan"), "nan")]
)
def test_what_is_no_camera_matrix_under_its_name_is_named(tmp_path: Path, given: object, said: str) -> None:
    with pytest.raises(ValueError, match=rf"camera_matrix: want 3 x 3 numbers, got {said}$"):
        load(tmp_path, "plain.json", json.dumps({"camera_matrix": given, "distortion_coefficients": 0}))


def test_a_rectified_pair_stands_apart_by_its_baseline(tmp_path: Path) -> None:
    intrinsics = {"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0}
    lines = ["%YAML:1.0", 'Camera.type: "Rectified"', "Camera.width: 640", "Camera.height: 480", "Stereo.b: 0.54"]
    lines += [f"Camera{i}.{key}: {x}" for i in (1, 2) for key, x in intrinsics.items()]
    both = load(tmp_path, "pair.yaml", "\n".join(lines))
    assert both.t.tolist() == [[0.0, 0.0, 0.0], [-0.54, 0.0, 0.0]]
    assert both.distortion is None
    assert both.size == (640, 480)


def test_a_rectification_beside_k_makes_no_camera_info(tmp_path: Path) -> None:
    K = [[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]
    tree = {"K": K, "dist": [0.1, -0.2, 0.001, 0.002, 0.0], "R": np.eye(3).tolist(), "P": [[*row, 0] for row in K]}
    assert numbers(load(tmp_path, "plain.json", json.dumps(tree))) == ([500.0, 501.0, 320.0, 240.0], tree["dist"])
    del tree["dist"]
    with pytest.raises(ValueError, match="want distortion_coefficients and distortion_model in a camera_info"):
        load(tmp_path, "plain.json", json.dumps(tree))


@pytest.mark.parametrize("kind", ["", 'Camera.type: "PinHole"\n'])
def test_a_lens_that_holds_for_both_cameras_is_not_dropped(tmp_path: Path, kind: str) -> None:
    """Both cameras were read without a lens, or, with a type beside it, refused for the lack of one."""
    text = "".join(
        line + "\n"
        for line in ORB_PAIR.splitlines()
        if not line.startswith(("Camera.f", "Camera.c", "Camera.type", "Camera2"))
    )
    text = text.replace("%YAML:1.0\n", f"%YAML:1.0\n{kind}")
    for i in (1, 2):
        text += "".join(f"Camera{i}.{key}: {250.5 + i}\n" for key in ("fx", "fy", "cx", "cy"))
    for i in (1, 2):
        camera = load(tmp_path, "pair.yaml", text, camera=i - 1)
        assert numbers(camera) == ([250.5 + i] * 4, [0.1, 0.2, 0.01, 0.02, 0.3])
    second = load(tmp_path, "pair.yaml", text + "Camera2.k1: -0.1\n", camera=1)
    assert numbers(second)[1] == [-0.1, 0.2, 0.01, 0.02, 0.3]


def test_focal_lengths_that_contradict_those_that_are_read_are_told_of(tmp_path: Path) -> None:
    """They were passed over."""
    K = [[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist(), "K": K} for name in "ab"]
    sides = {"w": 640, "h": 480}
    agreeing = [
        ({"fl_x": 500, "fl_y": 501, "frames": frames} | sides),
        ({"K": K, "fx": 500.4, "fy": 500.6}),
        ({"K": K, "fx": None, "fy": "a"}),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for tree in agreeing:
            load(tmp_path, "a.json", json.dumps(tree))
    for tree, focal in (
        ({"camera_angle_x": 0.9, "frames": frames} | sides, 662.5),
        ({"K": K, "fx": 99, "fy": 99}, 500),
    ):
        with pytest.warns(UserWarning, match=r"(K|fx, fy): focal lengths .* beside those that were read, ") as told:
            camera = load(tmp_path, "a.json", json.dumps(tree))
        assert camera.K[..., 0, 0].ravel()[0] == pytest.approx(focal, abs=0.1)
        assert len(told) == 1
