"""Camera files: OpenCV's YAML, and an own JSON that holds a whole calibration.

| format | suffix | holds |
|---|---|---|
| `"opencv"` | `.yml`, `.yaml`, `.xml` | one camera: K, lens, size; of a calibration also the views' poses and errors |
| `"json"` | `.json` | any batch of cameras with pose, dtype and lens; of a calibration also the corners and the board |

The YAML has the keys that OpenCV's own calibration program writes (`camera_matrix`, `distortion_coefficients`,
`image_width`, `extrinsic_parameters`, ...), and files from there are read. What a format cannot hold is refused, and a
file is written whole or not at all.
"""
