"""Camera files of the tools that people have, in and out, without losing a lens.

A file is told by its content (`formats`), read into a tree of plain values where it is text (`trees`), and by the
module of its format into cameras of this package's conventions: whole numbers at pixel centres, axes x right, y down, z
forward, poses world to camera, coefficients in OpenCV's order. Readers take what they understand to the last
coefficient, and refuse the rest in one line. What a format cannot hold is refused when written; a file is written whole
or not at all.

| format | files | holds | written |
|---|---|---|---|
| `"json"` | `.json`; `.jsonl` of a fleet | any batch of cameras; whole calibrations and rigs | yes |
| `"opencv"` | YAML, XML, JSON of OpenCV; plain YAML, JSON | K, lens, size; R and T of a pair | a camera, a pair |
| `"ros"` | `ost.yaml`, `ost.txt`, `.ini`, `camera_info` | raw camera by K and D; rectified one by P | one camera |
| `"colmap"` | `cameras`, `images`, `rigs`: `.txt`, `.bin` | lens, size; poses in `images`, a rig in `rigs` | yes |
| `"nerfstudio"` | `transforms.json`, also of instant-ngp | a camera for each frame | yes |
| `"kalibr"` | `camchain.yaml`, EuRoC's `sensor.yaml` | a chain of cameras | yes |
| `"numpy"` | `.npz`, `.npy` | arrays of K, lens, size, R and t | `.npz`, one camera |
| `"kitti"` | `calib.txt`, `calib_cam_to_cam.txt` | rectified cameras; raw ones with lens | |
| `"nuscenes"` | `calibrated_sensor.json`; Argoverse's | K and pose, no size | |
| `"open3d"` | `PinholeCameraIntrinsic`, `...Parameters` | K, size, pose; no lens | |
| `"settings"` | ORB-SLAM, stella, VINS: `fx`, `k1`, ... one by one | K, lens, size; a stereo pair | |
| `"mrcal"` | `.cameramodel` | PINHOLE, OPENCV4 to 12, with pose | |
| `"matlab"` | `toStruct` in `.mat`, JSON; Bouguet's | K, lens, size; a stereo pair | |
| `"metashape"` | XML of cameras, or of one calibration | frame sensors, poses by label | |

What each says, where it differs from here:

| format | pixel centres, axes | direction of the pose | coefficients |
|---|---|---|---|
| `"json"` | | | |
| `"opencv"` | | first camera to second | 4 are a fisheye's where the file says so |
| `"ros"` | | none; P: left to right | by `distortion_model`: 5, 8, or 4 of a fisheye |
| `"colmap"` | first centre at 0.5 | `rigs`: rig to camera | by the model's name |
| `"nerfstudio"` | first centre at 0.5; OpenGL's axes | camera to world | by name; k4 is r^8 |
| `"kalibr"` | | IMU, or the camera before, to camera | `radtan` 4, `equidistant` 4 |
| `"numpy"` | | | 4 need `camera_model` |
| `"kitti"` | | t = K^-1 P[:, 3]; raw: camera 0 to camera | none; raw: 5 |
| `"nuscenes"` | | sensor to vehicle | none; nuImages: 5; Argoverse: k1 k2 k3 |
| `"open3d"` | | | matrices column by column |
| `"settings"` | | second camera to first; none in a body | by the type; VINS's fisheye k2 to k5 |
| `"mrcal"` | | reference to camera | |
| `"matlab"` | first centre at 1; Bouguet's as here | of a pair: left to right | radial, tangential |
| `"metashape"` | from the image's middle | camera to chunk to world | P1 is p2, P2 is p1 |

Pickles are never opened, and `cv2.FileStorage` reads nothing here. Files of other programs that are known and not read
are named in `foreign`.
"""
