"""What files of other programs mean beyond their usual shape is read so, or refused: nothing of it is dropped unsaid."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import diffproj as dp
from diffproj.files.names import FormatName
from tests.files.samples import SAMPLES, npy
from tests.files.test_readers import load, numbers, poses

K = [[600.0, 0.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
FOUR = {"fx": 600.0, "fy": 610.0, "cx": 320.0, "cy": 240.0}


def _chain(count: int) -> dict[str, dict[str, object]]:
    """A camchain in which camera n is 2^n to the right of the one before, and has a focal length of 500 + n."""
    cameras: dict[str, dict[str, object]] = {}
    for i in range(count):
        cameras[f"cam{i}"] = {"camera_model": "pinhole", "distortion_model": "radtan", "resolution": [640, 480]}
        cameras[f"cam{i}"] |= {"intrinsics": [500.0 + i, 500.0, 320.0, 240.0], "distortion_coeffs": [0.1, 0, 0, 0]}
        if i:
            place = np.eye(4)
            place[0, 3] = -(2.0**i)
            cameras[f"cam{i}"]["T_cn_cnm1"] = place.tolist()
    return cameras


def test_kalibr_chains_more_than_ten_cameras_by_their_numbers(tmp_path: Path) -> None:
    """It writes them in the alphabet's order, cam10 before cam2; they were chained in that of the file."""
    text = yaml.safe_dump(_chain(12))  # which sorts, as Kalibr does
    assert text.index("cam10") < text.index("cam2")
    both = load(tmp_path, "camchain.yaml", text)
    assert both.t[:, 0].tolist() == [2.0 - 2.0 ** (i + 1) for i in range(12)]
    assert both.K[:, 0, 0].tolist() == [500.0 + i for i in range(12)]
    assert load(tmp_path, "camchain.yaml", text, camera=2).K[0, 0] == 502
    backwards = dict(reversed(_chain(3).items()))
    assert load(tmp_path, "camchain.yaml", yaml.safe_dump(backwards, sort_keys=False)).t[:, 0].tolist() == [0, -2, -6]


def test_kalibr_s_chain_wants_the_camera_before(tmp_path: Path) -> None:
    chain = _chain(4)
    del chain["cam2"]
    with pytest.raises(ValueError, match="cam3, T_cn_cnm1: want cam2, from which it leads, got none"):
        load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))


def test_kalibr_s_cameras_have_no_more_than_is_read(tmp_path: Path) -> None:
    chain = _chain(1)
    chain["cam0"]["k3"] = 0.1
    with pytest.raises(ValueError, match="k3: want a name that is known to hold the lens"):
        load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))
    chain = _chain(1)
    chain["cam0"]["extrinsics"] = np.eye(4).tolist()
    with pytest.warns(UserWarning, match=r"cam0\.extrinsics: a pose that is not read"):
        np.testing.assert_array_equal(poses(load(tmp_path, "camchain.yaml", yaml.safe_dump(chain))), np.eye(4))


MODELS = ["distortion_model", "camera_type", "distortion_type", "lens_model", "lens_type", "projection_model", "model"]
FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
NERF = {"fl_x": 600.0, "fl_y": 610.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "frames": [FRAME]}


@pytest.mark.parametrize("key", [*MODELS, "fisheye"])
def test_a_fisheye_is_one_under_whatever_key_it_is_named(tmp_path: Path, key: str) -> None:
    """Only each format's own key was looked at, and the lens taken for a perspective one, or for none."""
    named = {key: True if key == "fisheye" else "equidistant"}
    for lens in ({}, {"k1": 0.1, "k2": 0.01, "p1": 0.0, "p2": 0.0}):
        with pytest.raises(ValueError, match="want k1 to k4 of the fisheye lens that the file names"):
            load(tmp_path, "plain.json", json.dumps(FOUR | lens | named))
        with pytest.raises(ValueError, match=f"{key}: want OPENCV_FISHEYE as camera_model of a fisheye lens"):
            load(tmp_path, "plain.json", json.dumps(NERF | lens | named))
    lens = {"k1": 0.1, "k2": 0.01, "k3": 0.001, "k4": 0.0}
    assert type(load(tmp_path, "plain.json", json.dumps(FOUR | lens | named)).distortion) is dp.KannalaBrandt
    own = {"camera_model": "OPENCV_FISHEYE"}
    assert type(load(tmp_path, "plain.json", json.dumps(NERF | lens | named | own)).distortion) is dp.KannalaBrandt
    with pytest.raises(ValueError, match="fisheye"):
        load(tmp_path, "plain.json", json.dumps({"class_name": "PinholeCameraIntrinsic"} | OPEN3D | named))


@pytest.mark.parametrize("said", ["Inverse Brown Conrady", "inverse_brown_conrady", "omnidirectional", "fov", "ds"])
def test_a_model_of_other_equations_is_refused_beside_k(tmp_path: Path, said: str) -> None:
    tree = {"camera_matrix": K, "dist_coeffs": D}
    with pytest.raises(ValueError, match=f"model: want a model equal to OpenCV's .* got '{said}'"):
        load(tmp_path, "plain.json", json.dumps(tree | {"model": said}))
    for harmless in ("Logitech C920", "OmniVision OV9281", "color", "none"):
        assert numbers(load(tmp_path, "plain.json", json.dumps(tree | {"model": harmless})))[1] == D
    with pytest.raises(ValueError, match="or take model out where it is what the camera is called"):
        load(tmp_path, "plain.json", json.dumps(tree | {"model": "Fisheye Cam IMX219"}))
    with pytest.raises(ValueError, match="fisheye and of another"):
        load(tmp_path, "plain.json", json.dumps(FOUR | {"model": "fisheye", "lens_model": "brown"}))


OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": [600.0, 0, 0, 0, 610, 0, 320, 240, 1]}
SENSOR = {"camera_intrinsic": K, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}


@pytest.mark.parametrize("key", ["distortion", "dist", "distortion_coefficients", "D", "kc"])
@pytest.mark.parametrize("camera", [SENSOR, {"class_name": "PinholeCameraIntrinsic"} | OPEN3D])
def test_a_lens_beside_a_camera_without_one_is_not_dropped(tmp_path: Path, camera: dict[str, object], key: str) -> None:
    with pytest.raises(ValueError, match=f"{key}: want no lens, as (nuScenes|Open3D) has it, got a list of 5; build"):
        load(tmp_path, "plain.json", json.dumps(camera | {key: D}))
    assert load(tmp_path, "plain.json", json.dumps(camera | {key: [0.0] * 5})).distortion is None


def test_a_lens_as_a_vector_beside_focal_lengths_one_by_one(tmp_path: Path) -> None:
    tree = FOUR | {"width": 640, "height": 480}
    for key in ("distortion_coefficients", "distortion", "dist_coeffs"):
        camera = load(tmp_path, "plain.json", json.dumps(tree | {key: D}))
        assert numbers(camera) == ([600.0, 610.0, 320.0, 240.0], D)
        assert camera.size == (640, 480)
        with pytest.raises(ValueError, match=f"{key}: want 5 coefficients, or the name of the model beside 4"):
            load(tmp_path, "plain.json", json.dumps(tree | {key: D[:4]}))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"skew": 3.0}, "skew: want 0, or the skew in the camera matrix, got 3"),
        ({"d0": 0.1, "d1": 0.2}, "d0: want a n"),
    ],
)
def test_skew_and_coefficients_one_by_one_are_not_dropped(tmp_path: Path, more: dict[str, float], said: str) -> None:
    for tree in (FOUR, {"camera_matrix": K, "dist_coeffs": D}):
        if tree is FOUR or "skew" in more:
            with pytest.raises(ValueError, match=said):
                load(tmp_path, "plain.json", json.dumps(tree | more))
        for none in (0, 1e-12):
            assert load(tmp_path, "plain.json", json.dumps(tree | {"skew": none})).K[0, 1] == 0


def test_k_of_nuscenes_name_without_a_pose_is_a_plain_one(tmp_path: Path) -> None:
    tree = {"camera_intrinsic": np.ravel(K).tolist(), "distortion": D}
    assert numbers(load(tmp_path, "plain.json", json.dumps(tree))) == ([600.0, 610.0, 320.0, 240.0], D)


def test_calibdb_s_rectilinear_lens_is_opencvs(tmp_path: Path) -> None:
    tree = {"camera_matrix": K, "distortion_coefficients": D, "distortion_model": "rectilinear", "img_size": [640, 480]}
    assert numbers(load(tmp_path, "plain.json", json.dumps(tree)))[1] == D


@pytest.mark.parametrize("beside", ["D", "d", "kc", "lens", "dst"])
def test_a_lens_in_an_array_beside_that_of_k_is_not_dropped(tmp_path: Path, beside: str) -> None:
    np.save(tmp_path / f"{beside}.npy", np.array([D]))
    with pytest.raises(ValueError, match=rf"want the lens with its camera matrix, got it in {beside}\.npy beside it"):
        load(tmp_path, "K.npy", npy(np.array(K)))
    (tmp_path / f"{beside}.npy").unlink()
    np.save(tmp_path / "boxes.npy", np.array([10.0, 20.0, 30.0, 40.0]))
    np.save(tmp_path / "labels.npy", np.arange(5))
    assert numbers(load(tmp_path, "K.npy", npy(np.array(K))))[0] == [600.0, 610.0, 320.0, 240.0]


def test_a_second_camera_in_a_document_of_its_own_is_not_dropped(tmp_path: Path) -> None:
    text = SAMPLES["ost.yaml"].decode()
    want = load(tmp_path, "ost.yaml").K
    for again in ("", text, "header: {seq: 2}\n" + text, "camera_matrix: {rows: 3, co"):
        assert (want == load(tmp_path, "ost.yaml", f"{text}---\n{again}").K).all()
    other = text.replace("camera_name: ", "camera_name: other_")
    with pytest.raises(ValueError, match="camera_name: want one document, got another behind '---'; split the file"):
        load(tmp_path, "ost.yaml", f"{text}---\n{other}")


@pytest.mark.parametrize(
    ("name", "known"),
    [("a.yml", "opencv"), ("a.xml", "opencv"), ("a.yaml", "kalibr"), ("a.yaml", "ros"), ("a.npz", "numpy")],
)
def test_a_mirrored_camera_is_not_written_where_no_reader_takes_it(
    tmp_path: Path, name: str, known: FormatName
) -> None:
    """The file was written, and refused when it was to be loaded."""
    flip = np.array([[-1.0, 0, 639], [0, 1, 0], [0, 0, 1]])
    camera = dp.Camera(np.array(K), size=(640, 480)).warped(flip)
    with pytest.raises(ValueError, match=r"K: want positive focal lengths, which .* got a mirrored image; use \.json"):
        dp.save_camera(tmp_path / name, camera, format=known)
    dp.save_camera(tmp_path / "a.json", camera)
    assert dp.load_camera(tmp_path / "a.json").K[0, 0] == -600
