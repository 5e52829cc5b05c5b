"""Poses beside camera matrices: those of a pair are read, and of others it is said that they are not."""

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj import cli
from tests.files.samples import ROS, npz
from tests.files.test_readers import load, poses

K = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
D = [0.1, -0.2, 0.001, 0.002, 0.0]
R = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0].tolist()
T = [0.12, 0.01, -0.02]
RT = [[*row, t] for row, t in zip(R, T, strict=True)]
ONE = {"camera_matrix": K, "dist_coeffs": D}
PAIR = {"K1": K, "D1": D, "K2": K, "D2": D}


@pytest.mark.parametrize(
    ("pose", "named"),
    [
        ({"R": R, "T": T}, "R, T"),
        ({"R": R, "T": [[x] for x in T]}, "R, T"),
        ({"rvec": [0.1, -0.2, 0.3], "tvec": T}, "rvec, tvec"),
        ({"rotation_matrix": R, "translation_vector": T}, "rotation_matrix, translation_vector"),
        ({"rotation": {"x": 0, "y": 0, "z": 0, "w": 1}, "translation": {"x": 1, "y": 2, "z": 3}}, "rotation, trans"),
        ({"CameraExtrinsicMat": [*RT, [0, 0, 0, 1]]}, "CameraExtrinsicMat"),
        ({"anything": RT}, "anything"),
        ({"extrinsics": {"rotation": R, "translation": T}}, "extrinsics"),
        ({"extrinsics": [0.1, -0.2, 0.3, *T]}, "extrinsics"),
        ({"stereo": {"R": R, "T": T}}, "stereo"),
        ({"extrinsic": np.ravel(RT).tolist()}, "extrinsic"),
        ({"anything": np.ravel(RT).tolist()}, "anything"),
        ({"extrinsic": [*np.transpose(R).ravel().tolist(), *T]}, "extrinsic"),
        ({"rotation": R, "position": T}, "rotation, position"),
        ({"orientation": {"x": 0, "y": 0, "z": 0, "w": 1}, "position": {"x": 1, "y": 2, "z": 3}}, "orientation, pos"),
        ({"mounting": {"quaternion": [1, 0, 0, 0], "location": T}}, "mounting"),
        ({"qw": 1, "qx": 0, "qy": 0, "qz": 0, "tx": 1, "ty": 2, "tz": 3}, "qw to qz, tx to tz"),
        ({f"t_{i}{j}": RT[i][j] for i in range(3) for j in range(4)}, "t_00 to t_23"),
        ({f"r{i}{j}": R[i - 1][j - 1] for i in (1, 2, 3) for j in (1, 2, 3)} | {"tvec": T}, "tvec, r11 to r33"),
        ({"x": 1, "y": 2, "z": 3, "roll": 0.1, "pitch": 0.2, "yaw": 0.3}, "x to z, roll to yaw"),
        ({"heading": 90.0, "tilt": 20.0, "height": 6.0}, "heading to tilt"),
        ({"extrinsics": {"rx": 0.1, "ry": 0.2, "rz": 0.3, "tx": 1, "ty": 2, "tz": 3}}, "extrinsics"),
        ({"extrinsics": [[*RT, [0, 0, 0, 1]]] * 3}, "extrinsics"),
        ({"extrinsicRotation": R, "extrinsicTranslation": T}, "extrinsicRotation, extrinsicTranslation"),
        ({"camera_ext_R": np.ravel(R).tolist(), "camera_ext_t": T}, "camera_ext_R, camera_ext_t"),
        ({"frames": [{"name": "a.png", "c2w": [*RT, [0, 0, 0, 1]]}]}, "frames"),
    ],
)
def test_a_pose_of_unknown_meaning_is_not_dropped_in_silence(
    tmp_path: Path, pose: dict[str, object], named: str
) -> None:
    with pytest.warns(UserWarning, match=rf"plain\.json: {named}.*a pose that is not read.*camera\.at\(R, t\)"):
        camera = load(tmp_path, "plain.json", json.dumps(ONE | pose))
    np.testing.assert_array_equal(poses(camera), np.eye(4))
    with pytest.warns(UserWarning, match=rf"cam0\.{named.split(',')[0]}.*a pose that is not read"):
        load(tmp_path, "plain.json", json.dumps({"cam0": ONE | pose, "cam1": ONE | pose}))


@pytest.mark.parametrize(
    "beside",
    [
        {},
        {"rvecs": [[0.1, 0.2, 0.3]] * 9, "tvecs": [T] * 9},
        {"extrinsic_parameters": [[0.1, 0.2, 0.3, *T]] * 9},
        {"R": R},  # of a rectification
        {"position": [1, 2, 3], "location": {"x": 1, "y": 2}, "window": {"position": [1, 2, 3]}},  # without a rotation
        {"position": "front", "origin": [0, 0, 0]},
        {"twelve": [0.5] * 12, "bounds": [[1, 0, 0, 1]] * 3},
        {"R1": R, "P1": [[*row, 0.0] for row in K], "Q": np.diag([1.0, 1, 0, 0.1]).tolist(), "E": R, "F": R},
        {"x": 1, "y": 2, "z": 3, "yaw": 0.5, "gx": 0, "gy": 0, "gz": 9.8, "qx": 1, "qy": 2},
        {"next_t": T, "context_t": T, "tilt": 0, "pan": 0, "zoom": 100},
        {"lat": 47.1, "lon": 8.2, "alt": 400, "v0": 1, "v1": 2, "v2": 3, "on_x": True, "on_y": True, "on_z": True},
        {f"m{i}{j}": 0.5 for i in range(3) for j in range(4)} | {"board_poses": [[*RT, [0, 0, 0, 1]]] * 3},
        {"board_rotation": R, "board_translation": T, "rectify_translation": T, "cameraRotation": R, "offset": T},
        {"observations": [{"pose": {"rotation": [1, 0, 0, 0], "translation": T}}] * 3},
        {"newcameramtx": K, "roi": [0, 0, 640, 480], "T": 25.5, "pose": "front", "transform": None},
    ],
)
def test_what_is_no_pose_is_not_taken_for_one(tmp_path: Path, beside: dict[str, object]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(tmp_path, "plain.json", json.dumps(ONE | beside))
        load(tmp_path, "plain.json", json.dumps(PAIR | beside | {"R": R, "T": T}))


@pytest.mark.parametrize(
    "names", [("R", "T"), ("rotation_matrix", "translation_vector"), ("RotationMatrix", "TranslationVector")]
)
def test_a_pair_is_placed_by_what_opencv_calls_r_and_t(tmp_path: Path, names: tuple[str, str]) -> None:
    pose = dict(zip(names, (R, T), strict=True))
    sides = dict.fromkeys(("left", "right"), ONE)
    for tree in (PAIR | pose, sides | pose):
        both = load(tmp_path, "plain.json", json.dumps(tree))
        np.testing.assert_allclose(poses(both[0]), np.eye(4))
        np.testing.assert_allclose(poses(both[1])[:3], RT, atol=1e-15)
    arrays = {key: np.array(value) for key, value in (PAIR | pose).items()}
    np.testing.assert_allclose(poses(load(tmp_path, "pair.npz", npz(**arrays))[1])[:3], RT, atol=1e-15)
    with pytest.raises(ValueError, match=f"from the first camera to the second, got {names[0]}"):
        load(tmp_path, "plain.json", json.dumps(PAIR | {names[0]: R}))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        *(("left", "right"), ("cam0", "cam1"), ("camera2", "camera10"), ("camL", "camR"), ("leftCam", "rightCam")),
        *(
            ("cam_a", "cam_b"),
            ("cam", "cam2"),
            ("cam", "cam1"),
            ("camera", "projector"),
            ("stereo 1", "stereo 2"),
            ("master", "slave"),
        ),
        *(
            ("cam0_left", "cam1_right"),
            ("left0", "right1"),
            ("camera", "right"),
            ("camera", "second"),
            ("camleft", "camright"),
            ("camera_1_left", "camera_2_right"),
            ("cam122", "cam123"),
        ),
    ],
)
def test_names_tell_the_first_of_a_pair_whatever_the_order_in_the_file(tmp_path: Path, first: str, second: str) -> None:
    """The left camera was placed where the right one is, if it stood behind it in the file."""
    for names in ((first, second), (second, first)):
        tree = dict.fromkeys(names, ONE) | {"R": R, "T": T}
        np.testing.assert_array_equal(poses(load(tmp_path, "plain.json", json.dumps(tree), camera=first)), np.eye(4))
        placed = load(tmp_path, "plain.json", json.dumps(tree), camera=second)
        np.testing.assert_allclose(poses(placed)[:3], RT, atol=1e-15)


def test_a_pair_whose_names_tell_no_order_has_no_pose(tmp_path: Path) -> None:
    """It was that of whichever name is later in the alphabet, or in the file."""
    flat = {"rgb_K": K, "rgb_D": D, "depth_K": K, "depth_D": D}
    pairs = [
        ("rgb", "depth"),
        ("depth", "rgb"),
        ("cam_845112", "cam_123456"),
        ("thermal", "camera"),
        ("left1", "right0"),
        *(("cam", "cam123"), ("cam", "cam_b"), ("depth", "right"), ("camera", "depth2"), ("cam1", "cam2x")),
        *(("cam_1", "cam1"), ("cam9", "cam100"), ("cam_ab", "cam_b")),
    ]
    for tree in (flat, *(dict.fromkeys(pair, ONE) for pair in pairs)):
        with pytest.warns(UserWarning, match="R, T: a pose that is not read"):
            assert not load(tmp_path, "plain.json", json.dumps(tree | {"R": R, "T": T})).t.any()


def test_cameras_are_counted_by_their_numbers(tmp_path: Path) -> None:
    """As text, 10 comes before 2."""
    tree = {f"cam{i}_K": [[500.0 + i, 0, 320], [0, 501, 240], [0, 0, 1]] for i in (10, 2)}
    assert load(tmp_path, "plain.json", json.dumps(tree)).K[:, 0, 0].tolist() == [502.0, 510.0]


def test_three_cameras_have_no_pair_s_pose(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="R, T: a pose that is not read"):
        both = load(tmp_path, "plain.json", json.dumps(PAIR | {"K3": K, "D3": D, "R": R, "T": T}))
    assert not both.t.any()


def test_the_command_line_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.json").write_text(json.dumps(ONE | {"R": R, "T": T}))
    for command, *files in (["info", "a.json"], ["convert", "a.json", "b.json"]):
        assert cli.main([command, *(str(tmp_path / name) for name in files)]) == 0
        assert "R, T: a pose that is not read" in capsys.readouterr().err
    assert dp.load_camera(tmp_path / "b.json").size is None


def test_a_pose_beside_a_camera_info_is_not_dropped_in_silence(tmp_path: Path) -> None:
    pose = f"T_cam_lidar: {[*RT, [0, 0, 0, 1]]}\n"
    with pytest.warns(UserWarning, match="T_cam_lidar: a pose that is not read"):
        load(tmp_path, "ost.yaml", ROS + pose)


def test_cameras_in_a_list_stand_where_they_say(tmp_path: Path) -> None:
    cameras = [{"name": f"00_0{i}", "K": K, "distCoef": D, "resolution": [640, 480]} for i in range(3)]
    posed = [camera | {"R": R, "t": [[x] for x in T]} for camera in cameras]
    for tree in (posed, {"calibDataSource": "a", "cameras": posed}):
        every = load(tmp_path, "plain.json", json.dumps(tree))
        assert every.batch_shape == (3,)
        np.testing.assert_allclose(poses(load(tmp_path, "plain.json", json.dumps(tree), camera="00_02"))[:3], RT)
    with pytest.raises(ValueError, match="want the lens in the same mapping"):
        load(tmp_path, "plain.json", json.dumps({"cameras": [{"name": "a", "K": K}], "distCoef": D}))


def test_a_pose_beside_numbers_one_by_one_is_not_dropped_in_silence(tmp_path: Path) -> None:
    tree = {"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0, "rvec": [0.1, -0.2, 0.3], "tvec": T}
    with pytest.warns(UserWarning, match="rvec, tvec: a pose that is not read"):
        load(tmp_path, "plain.json", json.dumps(tree))


def test_a_pair_s_pose_does_not_replace_poses_of_their_own(tmp_path: Path) -> None:
    """The second camera was moved to T without a word, while the first one stayed at its own pose."""
    eye, pose = np.eye(3).tolist(), {"R": R, "T": T}
    own = {"cam0": ONE | {"R": eye, "t": [5.0, 0, 0]}, "cam1": ONE | {"R": eye, "t": [9.0, 0, 0]}}
    for tree in (own, own | {"cam1": ONE}, own | {"cam0": ONE}):
        with pytest.warns(UserWarning, match="R, T: a pose that is not read"):
            both = load(tmp_path, "plain.json", json.dumps(tree | pose))
        wanted = [[tree[name].get("t", [0.0, 0, 0])[0], 0, 0] for name in ("cam0", "cam1")]
        assert both.t.tolist() == wanted
    with pytest.warns(UserWarning, match="R, t: a pose that is not read"):
        one = load(tmp_path, "plain.json", json.dumps({"cam0": own["cam0"], "R": R, "t": T}))
    assert one.t.tolist() == [5.0, 0, 0]
    with pytest.warns(UserWarning, match="R, T: a pose that is not read"):
        both = load(tmp_path, "plain.json", json.dumps({"stereo": PAIR | {"R": eye, "T": [9.0, 0, 0]}} | pose))
    assert both.t.tolist() == [[0, 0, 0], [9, 0, 0]]


def test_rotations_with_numbers_are_those_of_a_rectification(tmp_path: Path) -> None:
    """Both were taken for the pair's rotation, or one of them for its translation."""
    numbered = PAIR | {"rotation_matrix_1": R, "rotation_matrix_2": R}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not load(tmp_path, "plain.json", json.dumps(numbered)).t.any()
        both = load(tmp_path, "plain.json", json.dumps(numbered | {"rotation_matrix": R, "translation_vector": T}))
    np.testing.assert_allclose(poses(both[1])[:3], RT, atol=1e-15)
    with pytest.warns(UserWarning, match=r"translation_vector.*a pose that is not read"):
        assert not load(tmp_path, "plain.json", json.dumps(numbered | {"translation_vector": T})).t.any()
    twice = PAIR | {"rotation_matrix": R, "RotationMatrix": R, "translation_vector": T}
    with pytest.raises(ValueError, match="want rotation_matrix once, got rotation_matrix, RotationMatrix"):
        load(tmp_path, "plain.json", json.dumps(twice))


@pytest.mark.parametrize("beside", [{"T": 25.5}, {"R": R}, {"R": R, "T": 25.5}, {"R": 0.9}])
def test_half_a_pose_beside_two_mappings_is_none(tmp_path: Path, beside: dict[str, object]) -> None:
    """The files were refused, though T was a temperature, and R a rectification."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both = load(tmp_path, "plain.json", json.dumps(dict.fromkeys(("left", "right"), ONE) | beside))
    np.testing.assert_array_equal(poses(both[1]), np.eye(4))


def test_a_lone_translation_is_not_dropped_in_silence(tmp_path: Path) -> None:
    for tree in (PAIR, dict.fromkeys(("left", "right"), ONE)):
        with pytest.warns(UserWarning, match="T: a pose that is not read"):
            load(tmp_path, "plain.json", json.dumps(tree | {"T": T}))
