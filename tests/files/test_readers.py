"""Every format that is read, against an independent parse of the same numbers and the geometry that the format means."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import diffproj as dp
from diffproj.files.formats import CONVENTIONS, FORMATS, Format, FormatName
from tests.files.samples import DIST, OPENCV_STEREO, OPENCV_YAML, PLAIN_YAML, ROS, SAMPLES, K, mat, npy, npz

D = torch.float64


def load(folder: Path, name: str, content: str | bytes | None = None, **asked: str | int) -> dp.Camera:
    """The camera of a sample, or of other content under its name."""
    data = SAMPLES[name] if content is None else content
    (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
    return dp.load_camera(folder / name, **asked)


def numbers(camera: dp.Camera) -> tuple[list[float], list[float]]:
    """`f_x f_y c_x c_y`, and the coefficients."""
    lens = [] if camera.distortion is None else camera.distortion.coefficients.tolist()
    return [camera.K[0, 0].item(), camera.K[1, 1].item(), camera.K[0, 2].item(), camera.K[1, 2].item()], lens


def poses(camera: dp.Camera) -> np.ndarray:
    return np.vstack([np.column_stack([camera.R.numpy(), camera.t.numpy()]), [0, 0, 0, 1]])


@pytest.mark.parametrize("name", SAMPLES)
def test_each_sample_is_told_by_its_content(tmp_path: Path, name: str) -> None:
    named = load(tmp_path, name, camera=0)
    binary = name.endswith(".bin")
    other = tmp_path / f"unnamed{'.bin' if binary else ''}"
    if name not in ("images.txt", "images.bin", "cameras.bin"):  # whose cameras stand in the file beside
        other.write_bytes(SAMPLES[name])
        assert torch.equal(dp.load_camera(other, camera=0).K, named.K)
    assert named.dtype == D


@pytest.fixture(autouse=True)
def _cameras_beside(tmp_path: Path) -> None:
    for name in ("cameras.txt", "cameras.bin"):
        (tmp_path / name).write_bytes(SAMPLES[name])


def test_opencv_yaml_as_file_storage_reads_it(tmp_path: Path) -> None:
    camera = load(tmp_path, "opencv.yml")
    storage = cv2.FileStorage(OPENCV_YAML, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    np.testing.assert_array_equal(camera.K.numpy(), storage.getNode("camera_matrix").mat())
    want = storage.getNode("distortion_coefficients").mat()
    np.testing.assert_array_equal(camera.distortion.coefficients.numpy(), want.ravel())
    assert camera.size == (1280, 960)


def test_a_stereo_pair_stands_as_r_and_t_say(tmp_path: Path) -> None:
    both = load(tmp_path, "stereo.yml")
    assert both.batch_shape == (2,)
    storage = cv2.FileStorage(OPENCV_STEREO, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    for i, name in enumerate("12"):
        camera = load(tmp_path, "stereo.yml", camera=name)
        np.testing.assert_array_equal(camera.K.numpy(), storage.getNode(f"M{name}").mat())
        np.testing.assert_array_equal(camera.distortion.coefficients.numpy(), storage.getNode(f"D{name}").mat().ravel())
        assert torch.equal(camera.K, both[i].K)
    np.testing.assert_array_equal(both[0].R.numpy(), np.eye(3))
    np.testing.assert_array_equal(both[1].R.numpy(), storage.getNode("R").mat())
    np.testing.assert_array_equal(both[1].t.numpy(), storage.getNode("T").mat().ravel())


def test_opencv_xml_with_the_names_of_opencvs_interactive_program(tmp_path: Path) -> None:
    camera = load(tmp_path, "opencv.xml")
    assert numbers(camera) == ([1092.5, 1092.5, 644.9, 392.2], [0.0786, -0.0831, -0.0070, 0.0016, 0.0])
    assert camera.size == (1280, 720)


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_what_file_storage_writes_is_read(tmp_path: Path, suffix: str) -> None:
    storage = cv2.FileStorage(str(tmp_path / f"a{suffix}"), cv2.FILE_STORAGE_WRITE)
    storage.write("cameraMatrix", K)
    storage.write("distCoeffs", DIST)
    storage.write("rvecs", np.zeros((5, 3)))
    storage.release()
    camera = dp.load_camera(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(camera.K.numpy(), K)
    np.testing.assert_array_equal(camera.distortion.coefficients.numpy(), DIST.ravel())


PAIRS = [
    ("camera_matrix", "distortion_coefficients"),
    ("cameraMatrix", "distCoeffs"),
    ("Camera_Matrix", "Distortion_Coefficients"),
    ("K", "D"),
    ("mtx", "dist"),
    ("camMatrix", "distCoef"),
    ("intrinsic", "distortion"),
    ("camera_matrix", "dist_coeff"),
    ("camera_matrix", "distortion_coefficents"),
    ("matrix", "distortion"),
    ("M1", "D1"),
    ("CM1", "D1"),
    ("cam_K", "cam_kc"),
    ("cam1_intrinsics", "cam1_distorsion"),
    ("left_K", "left_D"),
    ("cameraMatrixL", "distCoeffsL"),
    ("camera_matrix_right", "dist_coeffs_right"),
]


@pytest.mark.parametrize(("matrix", "lens"), PAIRS)
def test_names_of_the_wild(tmp_path: Path, matrix: str, lens: str) -> None:
    tree = {matrix: K.tolist(), lens: DIST.tolist(), "image_Width": 640, "image_Height": 480, "rms": 0.3}
    for name, text in (("a.json", json.dumps(tree)), ("a.yaml", yaml.safe_dump(tree))):
        camera = load(tmp_path, "plain.yaml", text) if name == "a.yaml" else load(tmp_path, "plain.json", text)
        np.testing.assert_array_equal(camera.K.numpy(), K)
        np.testing.assert_array_equal(camera.distortion.coefficients.numpy(), DIST.ravel())
        assert camera.size == (640, 480)


def test_plain_yaml_as_pyyaml_reads_it(tmp_path: Path) -> None:
    camera, tree = load(tmp_path, "plain.yaml"), yaml.safe_load(PLAIN_YAML)
    assert camera.K.tolist() == tree["camera_matrix"]
    assert [camera.distortion.coefficients.tolist()] == tree["dist_coeffs"]
    assert camera.size == (640, 480)  # and not the height of 0.1148 m


def test_a_fisheye_is_one_only_where_the_file_says_so(tmp_path: Path) -> None:
    tree = {"camera_matrix": K.tolist(), "distortion_coefficients": [0.1, 0.01, 0.002, 0.001]}
    kinds = {
        "fisheye_model": (1, dp.KannalaBrandt),
        "distortion_model": ("equidistant", dp.KannalaBrandt),
        "camera_model": ("fisheye", dp.KannalaBrandt),
        "model_type": ("KANNALA_BRANDT", dp.KannalaBrandt),
        "lens_model": ("plumb_bob", dp.BrownConrady),
    }
    for key, (value, kind) in kinds.items():
        assert type(load(tmp_path, "plain.json", json.dumps(tree | {key: value})).distortion) is kind
    assert type(load(tmp_path, "plain.json", json.dumps(tree)).distortion) is dp.BrownConrady
    with pytest.raises(ValueError, match="add fisheye_model: 0 or 1"):  # the names of cv2.fisheye
        load(tmp_path, "plain.json", json.dumps({"K": K.tolist(), "D": [0.1, 0.01, 0.002, 0.001]}))


def test_ros_has_a_raw_and_a_rectified_camera(tmp_path: Path) -> None:
    tree = yaml.safe_load(ROS)
    raw, rectified = load(tmp_path, "ost.yaml"), load(tmp_path, "ost.yaml", camera="rectified")
    np.testing.assert_array_equal(raw.K.flatten().numpy(), tree["camera_matrix"]["data"])
    np.testing.assert_array_equal(raw.distortion.coefficients.numpy(), tree["distortion_coefficients"]["data"])
    np.testing.assert_array_equal(rectified.K.numpy(), np.reshape(tree["projection_matrix"]["data"], (3, 4))[:, :3])
    assert rectified.distortion is None
    assert raw.size == rectified.size == (640, 480)
    assert not raw.t.any()
    assert not rectified.t.any()


def test_ros_stereo_shifts_the_rectified_right_camera(tmp_path: Path) -> None:
    P = "489.753143, 0.000000, 310.291505, 0.000000"
    right = load(tmp_path, "ost.yaml", ROS.replace(P, "489.753143, 0.0, 310.291505, -48.9753143"), camera="rectified")
    np.testing.assert_allclose(right.t.numpy(), [-0.1, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("model", "count", "kind"),
    [("plumb_bob", 5, "brown"), ("rational_polynomial", 8, "brown"), ("equidistant", 4, "fisheye")],
)
def test_ros_models(tmp_path: Path, model: str, count: int, kind: str) -> None:
    data = [0.01 * i for i in range(1, count + 1)]
    text = ROS.replace("plumb_bob", model).replace("cols: 5", f"cols: {count}")
    text = text.replace("[0.031195, 0.001359, 0.030395, -0.005189, 0.000000]", str(data))
    lens = load(tmp_path, "ost.yaml", text).distortion
    assert lens.coefficients.tolist() == data
    assert type(lens) is (dp.BrownConrady if kind == "brown" else dp.KannalaBrandt)


def test_ros_files_of_before_models_were_named(tmp_path: Path) -> None:
    """Five coefficients are those of plumb_bob; so are they under a misspelt name. Four may be of a fisheye lens."""
    path = tmp_path / "ost.yaml"
    path.write_text(ROS)
    want = dp.load_camera(path)
    for text in (
        ROS.replace("distortion_model: plumb_bob\n", ""),
        ROS.replace("distortion_coefficients", "distortion_coefficents"),
    ):
        assert text != ROS
        path.write_text(text)
        found = dp.load_camera(path)
        assert torch.equal(found.distortion.coefficients, want.distortion.coefficients)  # type: ignore[union-attr]
        assert torch.equal(found.K, want.K)


def test_ros_ini_says_the_same_as_yaml(tmp_path: Path) -> None:
    camera = load(tmp_path, "ost.txt")
    assert numbers(camera)[0] == [369.344588, 367.154330, 320.739078, 203.592450]
    assert numbers(camera)[1] == [0.189544, -0.018229, -0.000630, 0.000054, -0.000212]
    assert camera.size == (640, 480)
    assert numbers(load(tmp_path, "ost.txt", camera="rectified")) == (
        [262.927429, 302.056213, 320.984481, 188.592437],
        [],
    )


def test_colmap_takes_half_a_pixel_off(tmp_path: Path) -> None:
    both = load(tmp_path, "cameras.txt")
    assert both.batch_shape == (2,)
    assert numbers(load(tmp_path, "cameras.txt", camera="2")) == (
        [608.56, 608.53, 321.32 - 0.5, 243.76 - 0.5],
        [0.139, -0.308, -0.0002, -0.0004],
    )
    posed = load(tmp_path, "images.txt", camera="left/a b.png")
    turn = cv2.Rodrigues(np.array([0, np.deg2rad(30), 0]))[0]
    np.testing.assert_allclose(
        poses(posed), np.vstack([np.column_stack([turn, [0.1, 0.2, 3]]), [0, 0, 0, 1]]), atol=1e-12
    )
    assert numbers(load(tmp_path, "images.txt", camera="right.png"))[0][0] == 608.56


def test_colmap_binary_says_the_same_as_text(tmp_path: Path) -> None:
    assert torch.equal(load(tmp_path, "cameras.bin", camera="1").K, load(tmp_path, "cameras.txt", camera="1").K)
    assert type(load(tmp_path, "cameras.bin", camera="2").distortion) is dp.KannalaBrandt
    posed = load(tmp_path, "images.bin")
    assert posed.batch_shape == (2,)
    np.testing.assert_allclose(posed[0].R[0].numpy(), [1 - 2 * 0.36, 0, 2 * 0.6 * 0.8], atol=1e-12)
    assert posed[1].t.tolist() == [-1.0, 0.5, 2.0]


def test_nerfstudio_turns_opengls_axes(tmp_path: Path) -> None:
    both = load(tmp_path, "transforms.json")
    assert both.batch_shape == (2,)
    frame = json.loads(SAMPLES["transforms.json"])["frames"][0]["transform_matrix"]
    want = np.linalg.inv(np.array(frame) @ np.diag([1, -1, -1, 1]))
    np.testing.assert_allclose(poses(both[0]), want, atol=1e-12)
    assert numbers(both[0]) == ([1072.0, 1068.0, 1503.5, 999.5], [0.0312, 0.0051, 0.0006, 0.0003])
    assert numbers(both[1])[0] == [1073.0, 1068.0, 1504.5, 999.5]  # the frame's own keys


def test_nerfstudio_takes_the_focal_length_from_the_angle(tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    camera = load(
        tmp_path, "transforms.json", json.dumps({"camera_angle_x": 0.8, "w": 800, "h": 600, "frames": [frame]})
    )
    focal = 400 / np.tan(0.4)
    np.testing.assert_allclose(numbers(camera)[0], [focal, focal, 399.5, 299.5])
    assert camera.distortion is None


def test_kalibr_chains_its_cameras(tmp_path: Path) -> None:
    both, tree = load(tmp_path, "camchain.yaml"), yaml.safe_load(SAMPLES["camchain.yaml"])
    first = np.array(tree["cam0"]["T_cam_imu"])
    np.testing.assert_allclose(poses(both[0]), first)
    np.testing.assert_allclose(poses(both[1]), np.array(tree["cam1"]["T_cn_cnm1"]) @ first, atol=1e-12)
    assert numbers(both[1])[0] == [457.587, 456.134, 379.999, 255.238]
    assert both.size == (752, 480)
    turned = SAMPLES["camchain.yaml"].decode().replace("T_cam_imu", "T_imu_cam")
    np.testing.assert_allclose(
        poses(load(tmp_path, "camchain.yaml", turned, camera=0)), np.linalg.inv(first), atol=1e-12
    )


def test_kitti_divides_by_k(tmp_path: Path) -> None:
    both = load(tmp_path, "calib.txt")
    P = np.array(
        [[float(x) for x in line.split()[1:]] for line in SAMPLES["calib.txt"].decode().splitlines()[:4]]
    ).reshape(-1, 3, 4)
    assert both.batch_shape == (4,)
    assert both.size is None
    np.testing.assert_allclose(both[2].t.numpy(), [0.06046, -0.00176, 0.00498], atol=1e-5)
    X = np.array([2.0, -1.0, 15.0])
    for i, camera in enumerate(both):
        u, v, w = P[i] @ [*X, 1]
        np.testing.assert_allclose(camera.project(torch.tensor(X)[None])[0][0].numpy(), [u / w, v / w], atol=1e-9)


def test_kitti_raw_has_lenses_and_poses(tmp_path: Path) -> None:
    camera = load(tmp_path, "calib_cam_to_cam.txt")
    assert numbers(camera)[1] == [-3.691481e-01, 1.968681e-01, 1.353473e-03, 5.677587e-04, -6.770705e-02]
    assert camera.size == (1392, 512)
    assert camera.t.tolist() == [5.954406e-02, -7.675338e-04, 3.582565e-03]
    assert load(tmp_path, "calib_cam_to_cam.txt", camera="P_rect_02").size == (1242, 375)


def test_nuscenes_inverts_the_pose(tmp_path: Path) -> None:
    camera = load(tmp_path, "calibrated_sensor.json")
    sensor = json.loads(SAMPLES["calibrated_sensor.json"])[1]
    assert camera.K.tolist() == sensor["camera_intrinsic"]
    np.testing.assert_allclose(camera.center.numpy(), sensor["translation"], atol=1e-12)
    forward = camera.R[2].numpy()  # the optical axis in the vehicle: ahead and to the left
    assert forward[0] > 0.5
    assert forward[1] > 0.5
    assert abs(forward[2]) < 0.05


def test_argoverse_has_three_radial_coefficients(tmp_path: Path) -> None:
    camera = load(tmp_path, "vehicle_calibration_info.json", camera="image_raw_ring_rear_left")
    assert numbers(camera)[1] == [-0.172, 0.119, 0.0, 0.0, -0.028]
    np.testing.assert_allclose(camera.center.numpy(), [1.1058, 0.2462, 1.3735], atol=1e-12)


def test_settings_have_numbers_one_by_one(tmp_path: Path) -> None:
    orb = load(tmp_path, "EuRoC.yaml")
    assert numbers(orb) == ([458.654, 457.296, 367.215, 248.375], [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
    assert orb.size == (752, 480)
    stella, vins = load(tmp_path, "stella.yaml"), load(tmp_path, "cam0_kb.yaml")
    assert numbers(stella) == ([441.73, 442.52, 480.36, 275.49], [-3.07e-02, -3.34e-03, -2.88e-03, -5.92e-04])
    assert numbers(vins) == ([461.5, 460.1, 356.4, 231.2], [-1.6e-03, 2.4e-02, -3.6e-02, 2.0e-02])
    assert isinstance(stella.distortion, dp.KannalaBrandt)
    assert isinstance(vins.distortion, dp.KannalaBrandt)
    assert stella.size == (960, 540)


def test_settings_of_a_stereo_pair(tmp_path: Path) -> None:
    text = SAMPLES["EuRoC.yaml"].decode().replace("PinHole", "KannalaBrandt8").replace("p1", "k3").replace("p2", "k4")
    second = "".join(line.replace("Camera1", "Camera2") + "\n" for line in text.splitlines() if "Camera1" in line)
    pose = text[text.index("Tbc") : text.index("Viewer")].replace("Tbc", "Stereo.T_c1_c2")
    both = load(tmp_path, "EuRoC.yaml", text + second + pose)
    assert both.batch_shape == (2,)
    assert both.t.tolist() == [[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]]
    assert isinstance(both.distortion, dp.KannalaBrandt)


def test_open3d_runs_column_by_column(tmp_path: Path) -> None:
    for name in ("open3d.json", "view.json"):
        camera = load(tmp_path, name)
        assert numbers(camera) == ([525.0, 526.0, 319.5, 239.5], [])
        assert camera.size == (640, 480)
    np.testing.assert_array_equal(
        poses(camera), [[0.8, -0.6, 0, 1.5], [0.6, 0.8, 0, 2.5], [0, 0, 1, 3.5], [0, 0, 0, 1]]
    )


def test_mrcal_is_reference_to_camera(tmp_path: Path) -> None:
    camera = load(tmp_path, "camera.cameramodel")
    np.testing.assert_allclose(camera.R.numpy(), cv2.Rodrigues(np.array([2e-2, -3e-1, -1e-2]))[0], atol=1e-15)
    assert camera.t.tolist() == [1.0, 2.0, -3.0]
    assert len(numbers(camera)[1]) == 8
    X = torch.tensor([[1.1316275232135746, -2.416378929785561, 5.901620007664578]], dtype=D)
    want = [2158.554977866744, 763.406885017728]  # of mrcal 2.2
    np.testing.assert_allclose(camera.project(X)[0][0].numpy(), want, atol=1e-9)
    assert camera.size == (4000, 2200)


def test_matlab_is_transposed_and_one_based(tmp_path: Path) -> None:
    camera = load(tmp_path, "matlab.json")
    assert numbers(camera) == ([700.0, 701.0, 320.0, 241.0], [-0.35, 0.15, 0.001, -0.002])
    assert camera.size == (640, 480)
    bouguet = load(tmp_path, "Calib_Results.m")
    assert numbers(bouguet)[0] == [657.302804801291540, 657.744296340400240, 302.716587683502560, 242.333978595866210]
    assert bouguet.size == (640, 480)


@pytest.mark.parametrize("compressed", [False, True])
def test_mat_files_of_a_struct_of_its_fields_and_of_bouguet(tmp_path: Path, compressed: bool) -> None:
    matrix = np.array([[700.0, 0, 321], [0, 701, 242], [0, 0, 1]])
    lens = {"RadialDistortion": [-0.35, 0.15, 0.01], "TangentialDistortion": [0.001, -0.002], "ImageSize": [480, 640]}
    old, new = lens | {"IntrinsicMatrix": matrix.T}, lens | {"K": matrix}
    for variables in ({"cameraParams": old}, old, new, {"other": [1, 2], "p": new}):
        camera = load(tmp_path, "a.mat", mat(variables, compressed))
        assert numbers(camera) == ([700.0, 701.0, 320.0, 241.0], [-0.35, 0.15, 0.001, -0.002, 0.01])
        assert camera.size == (640, 480)
    kc = [[-0.25], [0.12], [0.001], [0.002], [0.0]]
    bouguet = {"fc": [[657], [658]], "cc": [[302], [242]], "kc": kc, "alpha_c": 0.5, "nx": 640, "ny": 480}
    camera = load(tmp_path, "a.mat", mat(bouguet, compressed))
    assert camera.K.tolist() == [[657.0, 328.5, 302.0], [0.0, 658.0, 242.0], [0.0, 0.0, 1.0]]
    pair = {f"{key}_{side}": bouguet[key] for key in ("fc", "cc", "kc", "alpha_c") for side in ("left", "right")}
    both = load(tmp_path, "a.mat", mat(pair | {"om": [0, 0, np.pi / 2], "T": [-100, 1, 2]}, compressed))
    np.testing.assert_allclose(both[1].R.numpy(), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert both[1].t.tolist() == [-100.0, 1.0, 2.0]
    data = mat({"cameraParams": old}, compressed)
    for length in (130, len(data) // 2, len(data) - 9):
        with pytest.raises(ValueError, match=r"a\.mat"):
            load(tmp_path, "a.mat", data[:length])


def test_metashape_projects_as_its_manual_says(tmp_path: Path) -> None:
    camera = load(tmp_path, "cameras.xml", camera="DJI_0001")
    w, h, f, cx, cy, b1, b2 = 5472, 3648, 3668.1, -7.4, 11.5, 0.25, 0.5
    k1, k2, k3, p1, p2 = 0.0027, -0.0119, 0.0117, -0.0006, 0.0004
    chunk = np.eye(4)
    chunk[:3, :3] = 2.5 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    chunk[:3, 3] = 100, 200, 300
    transform = np.array([[0.8, 0.6, 0, 1.5], [0.6, -0.8, 0, 2.5], [0, 0, -1, 3.5], [0, 0, 0, 1]])
    for X in ([0.3, -0.2, 2.0], [-0.5, 0.4, 3.0]):  # in the camera
        x, y = X[0] / X[2], X[1] / X[2]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        xd = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        yd = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        u, v = w / 2 + cx + xd * f + xd * b1 + yd * b2 - 0.5, h / 2 + cy + yd * f - 0.5
        world = (chunk @ transform @ [*X, 1])[:3]
        np.testing.assert_allclose(camera.project(torch.tensor(world)[None])[0][0].numpy(), [u, v], atol=1e-9)
    assert load(tmp_path, "cameras.xml", camera="FC6310").size == (5472, 3648)


def test_metashape_has_components_unused_sensors_and_labels_that_several_share(tmp_path: Path) -> None:
    text = SAMPLES["cameras.xml"].decode()
    place = text[text.index("    <transform>\n") : text.index("  </chunk>")]
    other = place.replace("100 200 300", "7 8 9").replace("2.5<", "4<")
    components = f'<components><component id="3" label="Component 1">{other}</component></components>'
    sensor = '<sensor id="1" label="FC6310" type="frame"><resolution width="100" height="80"/></sensor>'
    camera = text[text.index('<camera id="0"') : text.index('<camera id="1"')]
    third = camera.replace('id="0" sensor_id', 'id="2" component_id="3" sensor_id')
    text = text.replace("    </sensors>", f"{sensor}</sensors>{components}").replace(
        "    </cameras>", f"{third}</cameras>"
    )
    of_chunk, of_component = (load(tmp_path, "cameras.xml", text, camera=f"DJI_0001 {i}") for i in (0, 2))
    center = np.array([1.5, 2.5, 3.5]) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # transposed
    np.testing.assert_allclose(of_chunk.center.numpy(), 2.5 * center + [100, 200, 300], atol=1e-9)
    np.testing.assert_allclose(of_component.center.numpy(), 4 * center + [7, 8, 9], atol=1e-9)
    assert load(tmp_path, "cameras.xml", text, camera="FC6310 0").size == (5472, 3648)
    with pytest.raises(ValueError, match="sensor FC6310 1: want a calibration with f"):  # a camera that needs it
        load(tmp_path, "cameras.xml", text.replace('component_id="3" sensor_id="0"', 'component_id="3" sensor_id="1"'))
    with pytest.raises(ValueError, match=r"camera DJI_0001: want the sensor_id of a sensor, got 5"):
        load(
            tmp_path,
            "cameras.xml",
            SAMPLES["cameras.xml"].decode().replace('sensor_id="0" label="DJI_0001"', 'sensor_id="5" label="DJI_0001"'),
        )
    with pytest.raises(ValueError, match="camera DJI_0002: want an id of its own, got 0"):
        load(tmp_path, "cameras.xml", SAMPLES["cameras.xml"].decode().replace('camera id="1"', 'camera id="0"'))


def test_metashape_s_calibration_of_one_sensor(tmp_path: Path) -> None:
    text = """<calibration><projection>frame</projection><width>640</width><height>480</height>
      <f>500</f><cx>1</cx><cy>-2</cy><k1>0.1</k1></calibration>"""
    assert numbers(load(tmp_path, "sensor.xml", text)) == ([500.0, 500.0, 320.5, 237.5], [0.1, 0.0, 0.0, 0.0, 0.0])
    for old, new, message in (
        ("frame", "fisheye", "type: want a frame sensor, got 'fisheye'"),
        ("<width>640</width><height>480</height>", "", "want the size of the image, from whose middle"),
        ("<f>500</f>", "<fx>500</fx><fy>500</fy>", "want f, got none; export with Metashape 1.3"),
        ("<k1>", "<k4>0.5</k4><k1>", "k4: want"),
    ):
        with pytest.raises(ValueError, match=message):
            load(tmp_path, "sensor.xml", text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</chunk>", "</chunk><chunk/>", "chunk: want one, got several"),
        (">2.5</scale>", ">0</scale>", "scale: want a positive number, got 0"),
        ('<resolution width="5472"', '<resolution width="wide"', "width: want a number, got 'wide'"),
        ("<f>3668.1</f>", "<f>3668.1</f><f>3000</f>", "f: want"),
        ("<f>3668.1</f>", "", "sensor FC6310: want a calibration with f"),
        ("0.8 0.6 0 1.5", "0.8 0.6 0", "camera DJI_0001, transform"),
        ('<sensors next_id="1">', '<sensors next_id="1"/><nothing>', "want sensors in the chunk|want XML"),
    ],
)
def test_metashape_s_faults_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load(tmp_path, "cameras.xml", SAMPLES["cameras.xml"].decode().replace(old, new))


@pytest.mark.parametrize(
    ("matrix", "lens"),
    [("camMatrix", "distCoef"), ("cameraMatrix", "distCoeffs"), ("mtx", "dist"), ("camera_matrix", "distortion_coeff")],
)
def test_npz_pairs(tmp_path: Path, matrix: str, lens: str) -> None:
    views = {"rvecs": np.zeros((3, 3, 1)), "tvecs": np.zeros((3, 3, 1)), "newcameramtx": K * 0.9, "roi": np.arange(4)}
    camera = load(tmp_path, "calibration.npz", npz(**{matrix: K, lens: DIST}, **views))
    np.testing.assert_array_equal(camera.K.numpy(), K)
    np.testing.assert_array_equal(camera.distortion.coefficients.numpy(), DIST.ravel())
    with pytest.raises(ValueError, match="want 5 coefficients, or the name of the model"):  # of cv2.fisheye
        load(tmp_path, "calibration.npz", npz(**{matrix: K, lens: DIST[0, :4, None]}))


def test_cameras_in_mappings_of_their_own(tmp_path: Path) -> None:
    both = {side: {"K": K.tolist(), "D": DIST.tolist()} for side in ("left", "right")}
    assert load(tmp_path, "plain.json", json.dumps(both)).batch_shape == (2,)
    assert load(tmp_path, "plain.json", json.dumps(both), camera="right").batch_shape == ()
    with pytest.raises(ValueError, match="want the lens in the same mapping as its camera matrix"):
        load(tmp_path, "plain.json", json.dumps({"a": {"K": K.tolist()}, "dist": DIST.tolist()}))


def test_one_camera_of_several_is_asked_for(tmp_path: Path) -> None:
    differing = SAMPLES["cameras.txt"].decode().replace("2 OPENCV 640 480", "2 OPENCV 660 480")
    with pytest.raises(ValueError, match=r"want the name of one camera, for the 2 of the file differ.*they are 1, 2"):
        load(tmp_path, "cameras.txt", differing)
    assert load(tmp_path, "cameras.txt", differing, camera=1).size == (660, 480)
    for asked in ("3", 2, -3):
        with pytest.raises(ValueError, match="camera: want"):
            load(tmp_path, "cameras.txt", camera=asked)


@pytest.mark.plain
def test_a_camera_is_asked_for_by_name_or_number(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"camera: want the name or the number of a camera, got 1.5"):
        load(tmp_path, "cameras.txt", camera=1.5)
    with pytest.raises(ValueError, match="format: want 'json' or"):
        load(tmp_path, "cameras.txt", format="nothing")


def test_formats_are_of_one_kind_and_told_of() -> None:
    assert all(isinstance(module, Format) for module in FORMATS.values())
    assert set(FORMATS) == set(CONVENTIONS) == set(FormatName.__args__)
    from diffproj import files

    assert all(f'`"{name}"`' in (files.__doc__ or "") for name in FORMATS)


def test_rotations_of_few_digits_are_taken_to_the_nearest(tmp_path: Path) -> None:
    turn = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0]
    rows = [f"  - [{', '.join(f'{x:.5f}' for x in row)}, 0.5]" for row in turn]
    lines = SAMPLES["camchain.yaml"].decode().splitlines()[:13]
    lines[2:5] = rows
    R = load(tmp_path, "camchain.yaml", "\n".join(lines)).R
    np.testing.assert_allclose((R.mT @ R).numpy(), np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R.numpy(), turn, atol=1e-5)


def test_a_pickle_stays_closed(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a pickle; it is never opened"):
        load(tmp_path, "matrix.npy", b"\x80\x04\x95" + b"\0" * 20)
    with pytest.raises(ValueError, match="a pickle, which is never opened"):
        load(tmp_path, "calibration.npz", npz(mtx=np.array([1, "a"], dtype=object)))
    with pytest.raises(ValueError, match="want a camera matrix of 3 x 3"):
        load(tmp_path, "matrix.npy", npy(np.array([[1, "a"]], dtype=object)))
