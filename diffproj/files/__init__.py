"""Camera files: OpenCV's YAML and XML, and this package's own JSON, which holds a whole calibration.

| format | suffixes | module | holds |
|---|---|---|---|
| `"opencv"` | `.yml`, `.yaml`, `.xml` | `opencv` | one camera: K, lens, size; of a calibration also poses and errors |
| `"json"` | `.json` | `own_json` | any batch of cameras with pose, dtype and lens; whole calibrations |

Each format is a module that offers what `formats.Format` asks for: the suffixes, and a function each to write and to
read. `formats.FORMATS` lists them by name, and `load` and `save` look them up there.

The YAML has the keys that OpenCV's own calibration program writes (`camera_matrix`, `distortion_coefficients`,
`image_width`, `extrinsic_parameters`, ...), and files from there are read. What a format cannot hold is refused, and a
file is written whole or not at all.
"""
