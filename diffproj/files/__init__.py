"""Camera files of the tools that people have, in and out, without losing a lens.

A file is told by its content (`formats.format_of`), read into a tree of plain values where it is text (`trees`), and by
the module of its format into cameras of this package's conventions: integer pixel centres, axes x right, y down, z
forward, poses world to camera, coefficients in OpenCV's order. Readers take what they understand to the last
coefficient, and refuse the rest in one line. What a format cannot hold is refused when written; a file is written whole
or not at all.

| format | files | holds | pixel centres, axes | pose in the file | coefficients | written |
|---|---|---|---|---|---|---|
| `"json"` | `.json` | any batch, pose, lens, dtype; whole calibrations | as here | world to camera | as here | yes |
| `"opencv"` | YAML, XML, JSON of OpenCV; plain YAML and JSON | K, lens, size; stereo: R and T | as here | first camera to second | OpenCV's; 4 need `fisheye_model` or a like key unless OpenCV's programs wrote them | yes, one camera |
| `"ros"` | `ost.yaml`, `ost.txt`, `.ini`, `camera_info` | K and D of the raw image; P of the rectified one aside | as here | none | `plumb_bob` 5, `rational_polynomial` 8, `equidistant` 4 | yes, one camera |
| `"colmap"` | `cameras` and `images`, `.txt` and `.bin` | lens and size; poses in `images` | first centre at 0.5 | world to camera | OpenCV's, by the model's name | `.txt` |
| `"nerfstudio"` | `transforms.json`, also of instant-ngp | a camera a frame | first centre at 0.5; OpenGL's axes | camera to world | by name; r^8 refused | yes |
| `"kalibr"` | `camchain.yaml`, EuRoC's `sensor.yaml` | a chain of cameras | as here | IMU or camera before to camera; `T_imu_cam`, `T_BS` inverse | `radtan` k1 k2 p1 p2, `equidistant` | yes |
| `"numpy"` | `.npz`, `.npy` | arrays of K, lens, size | as here | R and t, if there | OpenCV's; 4 need `camera_model` | `.npz`, one camera |
| `"kitti"` | `calib.txt`, `calib_cam_to_cam.txt` | rectified cameras; raw ones with lens | as here | t = K^-1 P[:, 3]; raw: from camera 0 | OpenCV's 5 | |
| `"nuscenes"` | `calibrated_sensor.json`, Argoverse's | K and pose, no size | as here | sensor to vehicle | none; Argoverse k1 k2 k3 | |
| `"mrcal"` | `.cameramodel` | PINHOLE and OPENCV4 to 12 | as here | reference to camera | OpenCV's | |
| `"matlab"` | toStruct as `.mat` or JSON; Bouguet's `.mat`, `.m` | K, lens, size (height, width) | first centre at 1; Bouguet's as here | none; Bouguet's stereo: left to right | radial and tangential apart | |
| `"metashape"` | XML of cameras, or of one calibration | frame sensors, poses by label | from the middle of the image | camera to chunk, chunk to world | P1 is p2, P2 is p1 | |

Pickles are never opened, and `cv2.FileStorage` reads nothing here. Files of other programs that are known and not read
are named in `foreign`.
"""
