"""OpenCV's YAML and XML: one camera, under the keys that OpenCV's own calibration program writes."""

from pathlib import Path

import cv2
import numpy as np

from diffproj.calibration.result import Calibration
from diffproj.geometry.camera import Camera
from diffproj.lens.kannala_brandt import KannalaBrandt

SUFFIXES: tuple[str, ...] = (".yml", ".yaml", ".xml")


def dumps(path: Path, item: Camera | Calibration) -> str:
    """A camera as the text of a file, XML where the suffix is `.xml`; of a calibration also poses and errors.

    Raises:
        ValueError: a batch of cameras, a pose, skew or a lens that OpenCV does not have.
    """
    camera = item.camera if isinstance(item, Calibration) else item
    if camera.batch_shape:
        raise ValueError(
            f"{path}: OpenCV's formats hold one camera, got batch shape {tuple(camera.batch_shape)}; use .json"
        )
    K, dist, rvec, tvec = camera.to_opencv()
    if rvec.any() or tvec.any():
        remedy = "camera.without_pose()"
        if not np.array_equal(K, camera.K.numpy(force=True)):  # of a turned image: OpenCV's camera is turned instead
            remedy = "camera.upright().without_pose(), whose axes are those of the turned image"
        raise ValueError(f"{path}: OpenCV's formats hold no pose; use .json, or save {remedy}")
    suffix = ".xml" if path.suffix.lower() == ".xml" else ".yml"
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if camera.size is not None:
        storage.write("image_width", camera.size[0])
        storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", K)
    storage.write("fisheye_model", int(isinstance(camera.distortion, KannalaBrandt)))
    if dist.size:
        storage.write("distortion_coefficients", dist.reshape(-1, 1))
    if isinstance(item, Calibration):
        _, _, rvecs, tvecs = item.cameras.to_opencv()
        storage.write("nframes", len(item.views))
        storage.write("extrinsic_parameters", np.concatenate([rvecs, tvecs], axis=-1))
        storage.write("avg_reprojection_error", float(item.rms))
        storage.write("per_view_reprojection_errors", item.view_rms.numpy().reshape(-1, 1))
    return storage.releaseAndGetString()


def read_camera(path: Path) -> Camera:
    """The camera of a file that OpenCV's calibration program or this package wrote, in float64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not what it should be.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise ValueError(f"{path}: want a YAML or XML file that OpenCV reads, got something else") from error
    try:
        K, dist = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
        width, height = (int(storage.getNode(key).real()) for key in ("image_width", "image_height"))
        fisheye = bool(storage.getNode("fisheye_model").real())
    except (cv2.error, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: want a camera as OpenCV writes it, got other values under its keys") from error
    finally:
        storage.release()
    if K is None:
        raise ValueError(f"{path}: want the key camera_matrix, got a file without it")
    try:
        return Camera.from_opencv(K, dist, size=(width, height) if width and height else None, fisheye=fisheye)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
