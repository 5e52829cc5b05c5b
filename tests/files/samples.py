"""A small file of every format that is read, by the name that it should have: what the tests read, and damage."""

import io
import struct
import zipfile
import zlib

import numpy as np

OPENCV_YAML = """%YAML:1.0
---
calibration_time: "Wed 14 Feb 2018"
image_width: 1280
image_height: 960
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.8415526980092864e+02, 0., 6.4163537587632698e+02, 0.,
       6.8415526980092864e+02, 4.9707746072335209e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -3.1574774054416294e-01, 1.1387402413470069e-01,
       2.1826949536692391e-04, -2.4065597340833163e-05,
       -1.9785582487726050e-02 ]
avg_reprojection_error: 0.2
"""

OPENCV_STEREO = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 534.8, 0., 335.7, 0., 534.8, 240.7, 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.29, 0.1, 0., 0., 0. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 536.8, 0., 334.6, 0., 536.8, 242.1, 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.17, -0.11, 0., 0., 0. ]
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 0.6, -0.8, 0., 0.8, 0.6, 0., 0., 0., 1. ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -3.3, 0.04, 0.02 ]
"""

OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage>
<calibrationDate>"Thu 09 Feb 2023"</calibrationDate>
<cameraResolution>
  1280 720</cameraResolution>
<cameraMatrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    1092.5 0. 644.9 0. 1092.5 392.2 0. 0. 1.</data></cameraMatrix>
<cameraMatrix_std_dev type_id="opencv-matrix">
  <rows>4</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    0. 6.2 3.4 3.1</data></cameraMatrix_std_dev>
<dist_coeffs type_id="opencv-matrix">
  <rows>1</rows>
  <cols>5</cols>
  <dt>d</dt>
  <data>
    0.0786 -0.0831 -0.0070 0.0016 0.</data></dist_coeffs>
</opencv_storage>
"""

PLAIN_YAML = """calibration_time: '2025-05-19 12:17:20'
camera_matrix:
- - 220.1
  - 0.0
  - 308.4
- - 0.0
  - 221.2
  - 252.7
- - 0.0
  - 0.0
  - 1.0
dist_coeffs:
- - -0.1026
  - 0.0126
  - -0.0018
  - 0.0004
  - -0.0009
height: 0.1148
image_height: 480
image_width: 640
"""

PLAIN_JSON = """{"resolution": {"width": 320.0, "height": 240.0},
 "cameraIntrinsics": {"rows": 3, "cols": 3, "type": 6,
  "data": [353.7, 0.0, 163.6, 0.0, 340.8, 119.9, 0.0, 0.0, 1.0]},
 "distCoeffs": {"rows": 1, "cols": 5, "type": 6, "data": [0.103, -0.289, 0.0041, 2.6E-4, -1.462]}}
"""

ROS = """image_width: 640
image_height: 480
camera_name: 08144361026320a0
camera_matrix:
  rows: 3
  cols: 3
  data: [470.198924, 0.000000, 313.486113, 0.000000, 475.088069, 278.916646, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.031195, 0.001359, 0.030395, -0.005189, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.000000, 0.000000, 0.000000, 0.000000, 1.000000, 0.000000, 0.000000, 0.000000, 1.000000]
projection_matrix:
  rows: 3
  cols: 4
  data: [489.753143, 0.000000, 310.291505, 0.000000, 0.000000, 479.500427, 293.983280, 0.000000, 0.000000, 0.000000, 1.000000, 0.000000]
"""

ROS_INI = """# oST version 5.0 parameters
[image]

width
640

; comment
height
480

[mono_left]

camera matrix
369.344588 0.000000 320.739078
0.000000 367.154330 203.592450
0.000000 0.000000 1.000000

distortion
0.189544 -0.018229 -0.000630 0.000054 -0.000212

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
262.927429 0.000000 320.984481 0.000000
0.000000 302.056213 188.592437 0.000000
0.000000 0.000000 1.000000 0.000000
"""

COLMAP_CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
1 OPENCV 640 480 603.46 602.86 318.84 239.21 0.129 -0.251 -0.0020 -0.0019
2 OPENCV 640 480 608.56 608.53 321.32 243.76 0.139 -0.308 -0.0002 -0.0004
"""

COLMAP_IMAGES = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
1 0.9659258262890683 0.0 0.25881904510252074 0.0 0.1 0.2 3.0 1 left/a b.png
320.5 240.5 -1 100.0 50.0 7
2 0.5 0.5 0.5 0.5 -1.0 0.5 2.0 2 right.png

"""

NERFSTUDIO = """{"camera_model": "OPENCV", "fl_x": 1072.0, "fl_y": 1068.0, "cx": 1504.0, "cy": 1000.0, "w": 3008, "h": 2000,
 "k1": 0.0312, "k2": 0.0051, "p1": 0.0006, "p2": 0.0003,
 "frames": [
  {"file_path": "images/frame_00001.jpeg",
   "transform_matrix": [[0.6, 0.0, 0.8, 1.0], [0.0, 1.0, 0.0, 2.0], [-0.8, 0.0, 0.6, 3.0], [0.0, 0.0, 0.0, 1.0]]},
  {"file_path": "images/frame_00002.jpeg", "fl_x": 1073.0, "cx": 1505.0,
   "transform_matrix": [[1.0, 0.0, 0.0, -1.0], [0.0, 0.8, -0.6, 0.5], [0.0, 0.6, 0.8, 4.0], [0.0, 0.0, 0.0, 1.0]]}]}
"""

KALIBR = """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [0.0, 0.0, 1.0, 0.02]
  - [1.0, 0.0, 0.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.034
cam1:
  T_cn_cnm1:
  - [0.8, -0.6, 0.0, -0.11]
  - [0.6, 0.8, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.001]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05]
  distortion_model: radtan
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""

KITTI = """P0: 7.070493e+02 0.0 6.040814e+02 0.0 0.0 7.070493e+02 1.805066e+02 0.0 0.0 0.0 1.0 0.0
P1: 7.070493e+02 0.0 6.040814e+02 -3.797842e+02 0.0 7.070493e+02 1.805066e+02 0.0 0.0 0.0 1.0 0.0
P2: 7.070493e+02 0.0 6.040814e+02 4.575831e+01 0.0 7.070493e+02 1.805066e+02 -3.454157e-01 0.0 0.0 1.0 4.981016e-03
P3: 7.070493e+02 0.0 6.040814e+02 -3.341081e+02 0.0 7.070493e+02 1.805066e+02 2.330660e+00 0.0 0.0 1.0 3.201153e-03
R0_rect: 0.9999128 0.01009263 -0.008511932 -0.01012729 0.9999406 -0.004037671 0.008470675 0.004123522 0.9999556
Tr_velo_to_cam: 0.0069 -0.9999 -0.0027 -0.0245 -0.0011 0.0027 -0.9999 -0.0612 0.9999 0.0069 -0.0011 -0.3321
"""

KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 1.392000e+03 5.120000e+02
K_02: 9.597910e+02 0.0 6.960217e+02 0.0 9.569251e+02 2.241806e+02 0.0 0.0 1.0
D_02: -3.691481e-01 1.968681e-01 1.353473e-03 5.677587e-04 -6.770705e-02
R_02: 0.8 -0.6 0.0 0.6 0.8 0.0 0.0 0.0 1.0
T_02: 5.954406e-02 -7.675338e-04 3.582565e-03
S_rect_02: 1.242000e+03 3.750000e+02
R_rect_02: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0
P_rect_02: 7.215377e+02 0.0 6.095593e+02 4.485728e+01 0.0 7.215377e+02 1.728540e+02 2.163791e-01 0.0 0.0 1.0 2.745884e-03
"""

NUSCENES = """[
{"token": "f4d2a6c2", "sensor_token": "a89643a5", "translation": [0.943713, 0.0, 1.84023],
 "rotation": [0.7077955119163518, -0.006492242056004365, 0.010646214713995808, -0.7063073142877817], "camera_intrinsic": []},
{"token": "75ad8e2a", "sensor_token": "1e9136bb", "translation": [1.5752559464, 0.500519383135, 1.50696032589],
 "rotation": [0.6812088525125634, -0.6687507165046241, 0.2101702448905517, -0.21108161122114324],
 "camera_intrinsic": [[1257.8625342125129, 0.0, 827.2410631095686], [0.0, 1257.8625342125129, 450.915498205774], [0.0, 0.0, 1.0]]}
]
"""

ARGOVERSE = """{"camera_data_": [{"key": "image_raw_ring_rear_left", "value": {"focal_length_x_px_": 1393.3,
 "focal_length_y_px_": 1393.3, "focal_center_x_px_": 967.2, "focal_center_y_px_": 613.2, "skew_": 0.0,
 "distortion_coefficients_": [-0.172, 0.119, -0.028], "vehicle_SE3_camera_": {"rotation":
 {"coefficients": [0.6080562809978379, -0.6173801180951946, -0.351462214144603, 0.35437785251982055]},
 "translation": [1.1058, 0.2462, 1.3735]}}}]}
"""

MRCAL = """{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1761.181055, 1761.250444, 1965.706996, 1087.518797, -0.01266096516, 0.03590794372, -0.0002547045941, 0.0005275929652, 0.01968883397, 0.01482863541, -0.0562239888, 0.0500223357,],

    # extrinsics are rt_fromref
    'extrinsics': [ 2e-2, -3e-1, -1e-2,  1., 2, -3., ],

    'imagersize': [ 4000, 2200 ]
}
"""

OPEN3D = """{"width": 640, "height": 480, "intrinsic_matrix": [525.0, 0, 0, 0, 526.0, 0, 319.5, 239.5, 1]}"""

OPEN3D_POSED = """{"class_name": "PinholeCameraParameters", "extrinsic": [0.8, 0.6, 0, 0, -0.6, 0.8, 0, 0, 0, 0, 1, 0, 1.5, 2.5, 3.5, 1],
 "intrinsic": {"height": 480, "intrinsic_matrix": [525.0, 0, 0, 0, 526.0, 0, 319.5, 239.5, 1], "width": 640},
 "version_major": 1, "version_minor": 0}"""

ORB_SLAM = """%YAML:1.0

# Camera Parameters
Camera.type: "PinHole"
Camera1.fx: 458.654
Camera1.fy: 457.296
Camera1.cx: 367.215
Camera1.cy: 248.375
Camera1.k1: -0.28340811
Camera1.k2: 0.07395907
Camera1.p1: 0.00019359
Camera1.p2: 1.76187114e-05
Camera.width: 752
Camera.height: 480
Tbc: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
Viewer.PointSize:2
"""

STELLA = """Camera:
  name: "LUMIX 8mm fisheye"
  setup: "monocular"
  model: "fisheye"
  fx: 441.73
  fy: 442.52
  cx: 480.36
  cy: 275.49
  k1: -3.07e-02
  k2: -3.34e-03
  k3: -2.88e-03
  k4: -5.92e-04
  cols: 960
  rows: 540
Feature:
  scale_factor: 1.2
"""

VINS = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 752
image_height: 480
projection_parameters:
   k2: -1.6e-03
   k3: 2.4e-02
   k4: -3.6e-02
   k5: 2.0e-02
   mu: 461.5
   mv: 460.1
   u0: 356.4
   v0: 231.2
"""

MATLAB_JSON = """{"cameraParams": {"RadialDistortion": [-0.35, 0.15], "TangentialDistortion": [0.001, -0.002], "ImageSize": [480, 640],
 "WorldUnits": "mm", "EstimateSkew": false,
 "IntrinsicMatrix": [[700.0, 0.0, 0.0], [0.0, 701.0, 0.0], [321.0, 242.0, 1.0]], "Version": {"Major": 9}}}
"""

BOUGUET = """% Intrinsic and Extrinsic Camera Parameters
fc = [ 657.302804801291540 ; 657.744296340400240 ];
cc = [ 302.716587683502560 ; 242.333978595866210 ];
alpha_c = 0.000000000000000;
kc = [ -0.255835306110116 ; 0.127586460640411 ; -0.000208179573960 ; 0.000034221152914 ; 0.000000000000000 ];
nx = 640;
ny = 480;
omc_1 = [ 1.654809e+00 ; 1.651909e+00 ; -6.699106e-01 ];
"""

METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="FC6310" type="frame">
        <resolution width="5472" height="3648"/>
        <property name="focal_length" value="8.8"/>
        <property name="layer_index" value="0"/>
        <bands>
          <band label="Red"/>
          <band label="Green"/>
        </bands>
        <calibration type="frame" class="initial">
          <resolution width="5472" height="3648"/>
          <f>3600</f>
        </calibration>
        <calibration type="frame" class="adjusted">
          <resolution width="5472" height="3648"/>
          <f>3668.1</f>
          <cx>-7.4</cx>
          <cy>11.5</cy>
          <b1>0.25</b1>
          <b2>0.5</b2>
          <k1>0.0027</k1>
          <k2>-0.0119</k2>
          <k3>0.0117</k3>
          <p1>-0.0006</p1>
          <p2>0.0004</p2>
        </calibration>
      </sensor>
    </sensors>
    <cameras next_id="3" next_group_id="0">
      <camera id="0" sensor_id="0" label="DJI_0001">
        <transform>0.8 0.6 0 1.5 0.6 -0.8 0 2.5 0 0 -1 3.5 0 0 0 1</transform>
      </camera>
      <camera id="1" sensor_id="0" label="DJI_0002"/>
    </cameras>
    <transform>
      <rotation locked="false">0 -1 0 1 0 0 0 0 1</rotation>
      <translation locked="false">100 200 300</translation>
      <scale locked="false">2.5</scale>
    </transform>
  </chunk>
</document>
"""


def mat(variables: dict[str, object], compressed: bool = False) -> bytes:
    """A `.mat` file of version 5 with matrices of numbers and structs."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)

    def matrix(name: str, value: object) -> bytes:
        if isinstance(value, dict):
            names = b"".join(key.encode().ljust(32, b"\0") for key in value)
            head, shape = 2, (1, 1)
            body = (
                struct.pack("<HHI", 5, 4, 32)
                + element(1, names)
                + b"".join(matrix("", item) for item in value.values())
            )
        else:
            array = np.atleast_2d(np.asarray(value, dtype=np.float64))
            head, shape, body = 6, array.shape, element(9, array.tobytes("F"))
        parts = (
            element(6, struct.pack("<II", head, 0)) + element(5, struct.pack("<ii", *shape)) + element(1, name.encode())
        )
        return element(14, parts + body)

    content = b""
    for name, value in variables.items():
        one = matrix(name, value)
        packed = zlib.compress(one)
        content += struct.pack("<II", 15, len(packed)) + packed if compressed else one
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + content


def npz(**arrays: np.ndarray) -> bytes:
    """The bytes of `numpy.savez`."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def npy(array: np.ndarray) -> bytes:
    """The bytes of `numpy.save`."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def npz_of(members: list[tuple[str, bytes]]) -> bytes:
    """A zip of files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members:
            archive.writestr(name, content)
    return buffer.getvalue()


def colmap_cameras() -> bytes:
    """`cameras.bin` with one camera of the model OPENCV and one of OPENCV_FISHEYE."""
    first = struct.pack("<IiQQ8d", 1, 4, 640, 480, 603.46, 602.86, 318.84, 239.21, 0.129, -0.251, -0.002, -0.0019)
    second = struct.pack("<IiQQ8d", 2, 5, 640, 480, 303.46, 302.86, 318.84, 239.21, 0.129, -0.051, 0.002, -0.0019)
    return struct.pack("<Q", 2) + first + second


def colmap_images() -> bytes:
    """`images.bin` with two images, of which the first has two points."""
    first = struct.pack("<I7dI", 1, 0.8, 0.0, 0.6, 0.0, 0.1, 0.2, 3.0, 1) + b"left/a b.png\0"
    points = struct.pack("<QddQddQ", 2, 320.5, 240.5, 2**64 - 1, 100.0, 50.0, 7)
    second = struct.pack("<I7dI", 2, 0.5, 0.5, 0.5, 0.5, -1.0, 0.5, 2.0, 1) + b"right.png\0" + struct.pack("<Q", 0)
    return struct.pack("<Q", 2) + first + points + second


K = np.array([[579.76, 0, 337.5], [0, 580.1, 241.0], [0, 0, 1]])
DIST = np.array([[0.05, -0.0078, -0.0071, 0.002, 0.01]])

SAMPLES: dict[str, bytes] = {
    "opencv.yml": OPENCV_YAML.encode(),
    "stereo.yml": OPENCV_STEREO.encode(),
    "opencv.xml": OPENCV_XML.encode(),
    "plain.yaml": PLAIN_YAML.encode(),
    "plain.json": PLAIN_JSON.encode(),
    "ost.yaml": ROS.encode(),
    "ost.txt": ROS_INI.encode(),
    "cameras.txt": COLMAP_CAMERAS.encode(),
    "images.txt": COLMAP_IMAGES.encode(),
    "cameras.bin": colmap_cameras(),
    "images.bin": colmap_images(),
    "transforms.json": NERFSTUDIO.encode(),
    "camchain.yaml": KALIBR.encode(),
    "calib.txt": KITTI.encode(),
    "calib_cam_to_cam.txt": KITTI_RAW.encode(),
    "calibrated_sensor.json": NUSCENES.encode(),
    "vehicle_calibration_info.json": ARGOVERSE.encode(),
    "camera.cameramodel": MRCAL.encode(),
    "open3d.json": OPEN3D.encode(),
    "EuRoC.yaml": ORB_SLAM.encode(),
    "stella.yaml": STELLA.encode(),
    "cam0_kb.yaml": VINS.encode(),
    "view.json": OPEN3D_POSED.encode(),
    "matlab.json": MATLAB_JSON.encode(),
    "Calib_Results.m": BOUGUET.encode(),
    "cameras.xml": METASHAPE.encode(),
    "calibration.npz": npz(camMatrix=K, distCoef=DIST, rVector=np.zeros((3, 3, 1))),
    "matrix.npy": npy(K),
}
"""By file name."""
