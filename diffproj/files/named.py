"""Cameras by the names that K, lens and size have in files: those of OpenCV's programs, and those of the wild.

Several cameras of one file have a label in front of or behind the name: `M1 D1 M2 D2`, `left_K`, `cam1_intrinsics`.
A key that looks as if it held a lens and is not understood is an error: a lens is never dropped.
"""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from diffproj.files import poses_beside
from diffproj.files.found import Found
from diffproj.files.lenses import MODELS, Kind, brown, lens_of, told
from diffproj.files.numbers import camera_of, described, image_size, intrinsics, matrix, shape_of
from diffproj.geometry.camera import Camera
from diffproj.lens.brown_conrady import BrownConrady


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


MATRICES = _words(
    "cameramatrix cameramat cammatrix cammat cammtx mtx matrix k kmatrix cm m intrinsic intrinsics intrinsicmatrix "
    "intrinsicsmatrix intrinsicparameters cameraintrinsic cameraintrinsics cameraintrinsicmatrix"
)
"""Names of K in lower case, without what stands between words."""

LENSES = _words(
    "distortioncoefficients distortioncoefficient distortioncoefficents distortioncoeffs distortioncoeff distcoeffs "
    "distcoeff distcoefs distcoef dist d distortion distortions distorsion distortionvector distortionparameters "
    "distortioncoeficients distcoefficients kc"
)
SIZES = _words("cameraresolution imagesize imgsize resolution size framesize imageresolution")
SIDES = (("imagewidth", "imageheight"), ("imgwidth", "imgheight"), ("width", "height"))
LEAST_SKEW = 1e-6
"""In px, up to which a skew is what is left of none."""
OMNIDIRECTIONAL = _words("xi mirrorparameters alpha gamma1 gamma2")
COEFFICIENTS = _words("k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4 taux tauy r1 r2 t1 t2 d0 d1 d2 d3 d4 d5 d6 d7")

_LABEL = re.compile(
    r"(?:(?P<front>left|right|cam\d*|camera\d+|proj|projector|rgb|colou?r|depth|ir|l|r)_)?"
    r"(?P<core>.+?)"
    r"(?:_?(?P<back>\d+|left|right)|_(?P<side>l|r))?"
)


def read(mapping: dict[str, Any], four_is_brown: bool = True) -> Found:
    """The cameras of a mapping.

    Args:
        mapping: of a file; values as in `numbers.matrix`.
        four_is_brown: whether 4 coefficients under the name of OpenCV's own programs are Brown-Conrady where nothing
            names the model: these programs write it where it is another.

    Raises:
        ValueError: there is none, or something about it is not understood.
    """
    matrices: dict[str, tuple[str, Any]] = {}
    lenses: dict[str, tuple[str, Any]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for key, value in mapping.items():
        label, core = _parted(key)
        if _is_matrix(label, core, value):
            _once(matrices, label, key, value)
        elif core in LENSES:
            _once(lenses, label, key, value)
        elif core in SIZES and (size := _size(key, value)) is not None:
            sizes[label] = size
        else:
            check_no_lens_key(key, value)
            check_no_lens(value, [])
    if not lenses:
        for key, value in mapping.items():
            _check_no_vector(key, value)
    if not matrices:
        raise ValueError(_nothing(mapping))
    size, kind = _sides(mapping), _kind(mapping)
    found = {}
    for label, (name, value) in sorted(matrices.items(), key=lambda item: _by_number(item[0])):
        K = intrinsics(name, value)
        lens = _lens(lenses, label, len(matrices), kind, four_is_brown)
        found[label or "camera"] = camera_of(K, lens, _plausible(sizes.get(label, sizes.get("", size)), K))
    strays = [name for label, (name, _) in lenses.items() if label not in matrices]
    if strays:
        raise ValueError(
            f"{strays[0]}: want a camera matrix to this lens, got {', '.join(n for n, _ in matrices.values())}"
        )
    cameras, keys = posed(found, mapping)
    remarks = parts_of_an_image(mapping)
    if len(found) == 1:
        remarks += other_focal_lengths(mapping, *found.values())
    return Found(cameras, unread=tuple(poses_beside.unread(mapping, keys)), remarks=remarks)


def parts_of_an_image(fields: dict[str, Any]) -> tuple[str, ...]:
    """What ROS's keys say of an image that is a part of the one which was calibrated; empty where it is the whole one.

    Args:
        fields: the mapping of a camera.
    """
    for key in ("binning_x", "binning_y"):
        if fields.get(key) is not None and not (isinstance(fields[key], int | float) and fields[key] in (0, 1)):
            return (
                f"{key}: want 0 or 1, got {fields[key]}: K is of the image before binning; remove the key, and give "
                "camera.resized(...) the size after it",
            )
    roi = fields.get("roi")
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset", "width", "height")):
        whole = [roi.get("x_offset", 0), roi.get("y_offset", 0), roi.get("width"), roi.get("height")]
        size = list(_sides(fields) or whole[2:])
        if whole != [0, 0, *size]:
            return (
                f"roi: want the whole image, got {whole}: K is of the image before cropping; remove the key, and cut "
                "by camera.cropped(left, top, width, height)",
            )
    return ()


def other_focal_lengths(fields: dict[str, Any], camera: Camera) -> tuple[str, ...]:
    """What is said of a K, or of fx and fy, beside those that were read; empty where they agree to 1 %.

    Args:
        fields: the mapping of the camera.
        camera: as it was read.
    """
    read = camera.K.diagonal().numpy()[:2]
    beside = [(key, value) for key, value in fields.items() if _is_matrix(*_parted(key), value)]
    for names, value in [*beside, ("fx, fy", [fields.get("fx"), fields.get("fy")])]:
        try:
            found = matrix(names, value)
        except ValueError:
            continue
        focal = found.ravel()[[0, 4]] if found.size == 9 else found.ravel()
        if focal.shape == (2,) and not np.allclose(focal, read, rtol=0.01):
            return (
                f"{names}: focal lengths {focal[0]:g} and {focal[1]:g} beside those that were read, {read[0]:g} and "
                f"{read[1]:g}: take the wrong ones out of the file",
            )
    return ()


def holds_matrix(mapping: dict[str, Any]) -> bool:
    """Whether K stands in a mapping under one of the names."""
    return any(_is_matrix(*_parted(key), value) for key, value in mapping.items())


def holds_lens(mapping: dict[str, Any]) -> bool:
    """Whether a lens stands in a mapping under one of the names."""
    return any(_parted(key)[1] in LENSES and hasattr(value, "__len__") for key, value in mapping.items())


def names_lens(key: str) -> bool:
    """Whether a key, or the stem of a file's name, is that of a lens."""
    plain = re.sub(r"[^a-z0-9]", "", key.lower())
    return _parted(key)[1] in LENSES or re.search("dist|coef|lens", plain) is not None


def misfit(mapping: dict[str, Any]) -> str:
    """What stands under a name of K and is none, in words; empty where there is nothing of the kind."""
    for key, value in mapping.items():
        core = _parted(key)[1]
        if core in MATRICES and len(core) > 2 and (value is None or isinstance(value, str | int | float)):
            return f"{key}: want 3 x 3 numbers, got {described(value)}"
    return ""


def _is_matrix(label: str, core: str, value: Any) -> bool:
    """Whether a key and what it holds may be K; lists of mappings are cameras of other programs."""
    if core not in MATRICES or (core == "m" and not label):
        return False
    return isinstance(value, dict | np.ndarray) or (
        isinstance(value, list) and not any(isinstance(x, dict) for x in value)
    )


def check_no_lens(tree: Any, read_elsewhere: list[Any]) -> None:
    """Refuse a tree in which a lens stands that nobody reads.

    Args:
        tree: what to look through.
        read_elsewhere: the mappings in it that are read.

    Raises:
        ValueError: it holds a key that looks like a lens.
    """
    if isinstance(tree, dict) and not any(tree is known for known in read_elsewhere):
        for key, value in tree.items():
            if _parted(key)[1] in LENSES and isinstance(value, list | dict | str):
                raise ValueError(f"{key}: want the lens in the same mapping as its camera matrix, got it elsewhere")
            check_no_lens_key(key, value)
    for item in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        if isinstance(item, dict | list) and not any(item is known for known in read_elsewhere):
            check_no_lens(item, read_elsewhere)


def check_without_lens(fields: dict[str, Any], read: Iterable[str], what: str) -> None:
    """Refuse a lens beside a camera of a format that has none, or has it elsewhere; one of zeros may be there.

    Args:
        fields: the mapping of the camera.
        read: the keys that are read.
        what: the format.

    Raises:
        ValueError: there is one, or the name of one that is not perspective.
    """
    others = {key: value for key, value in fields.items() if key not in read}
    for kind, key in told(others).items():
        if kind == "fisheye":
            raise ValueError(f"{key}: want a camera without a fisheye lens, as {what} has it, got {others[key]!r}")
    for key, value in others.items():
        if isinstance(value, list) and not np.any(value):
            continue
        if _parted(key)[1] in LENSES and isinstance(value, list | dict):
            raise ValueError(
                f"{key}: want no lens, as {what} has it, got {described(value)}; build dp.Camera.from_opencv(K, dist)"
            )
        check_no_lens_key(key, value)


def _parted(key: str) -> tuple[str, str]:
    """The label of a key, and its name in lower case without what stands between words."""
    words = re.sub(r"(?<=[a-z])([LR])$", r"_\1", key.strip())  # cameraMatrixL
    words = re.sub(r"[\s.\-]+", "_", words).lower()
    parts = _LABEL.fullmatch(words)
    core = words.replace("_", "")
    if parts is None or core in MATRICES | LENSES | SIZES:
        return "", core
    label = parts["front"] or parts["back"] or parts["side"] or ""
    return label, parts["core"].replace("_", "")


def _by_number(label: str) -> list[tuple[int, str]]:
    """What labels are sorted by: 2 before 10, where text would be the other way."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", label)]


def _once(known: dict[str, tuple[str, Any]], label: str, key: str, value: Any) -> None:
    if label in known:
        raise ValueError(f"{key}: want one of the kind, got {known[label][0]} too; leave one out")
    known[label] = key, value


def check_no_lens_key(key: str, value: Any) -> None:
    """Refuse a key that looks as if it held something of the lens."""
    plain = re.sub(r"[^a-z0-9]", "", key.lower())
    if plain in MODELS or re.search("std|dev|err|undistort|distance(?!coef)|sigma|covariance", plain):
        return
    if plain in OMNIDIRECTIONAL:
        raise ValueError(
            f"{key}: want a perspective or fisheye lens of OpenCV, got the parameters of an omnidirectional model; "
            "calibrate again with one of them"
        )
    if plain in ("skew", "cameraskew") and isinstance(value, int | float | np.number) and abs(value) > LEAST_SKEW:
        raise ValueError(
            f"{key}: want 0, or the skew in the camera matrix, got {value} beside one without; "
            "dp.Camera(K, ...) takes it"
        )
    looks = re.search("dist|coef|radial|tangential|lens", plain) or plain == "kc"
    if (looks and isinstance(value, list | dict | np.ndarray | float)) or (
        plain in COEFFICIENTS and not hasattr(value, "__len__")
    ):
        raise ValueError(
            f"{key}: want a name that is known to hold the lens, such as distortion_coefficients, got "
            f"{described(value)} under this one; rename it, or build dp.Camera.from_opencv(K, dist)"
        )


def _check_no_vector(key: str, value: Any) -> None:
    """Refuse a vector of as many numbers as a lens has, under a name that nobody knows, where no lens was found."""
    plain = re.sub(r"[^a-z0-9]", "", key.lower())
    harmless = re.search("std|dev|err|roi|quat|rot|orient|vec|rms|time", plain) or _parted(key)[1] in MATRICES | SIZES
    if harmless or not isinstance(value, list | dict | np.ndarray):
        return
    try:
        found = matrix(key, value)
    except ValueError:
        return
    if found.size in BrownConrady.counts and found.size == max(found.shape):
        raise ValueError(
            f"{key}: want the lens under a name that is known, such as distortion_coefficients, got {found.size} "
            "numbers under this one, as a lens has; rename it, or take it out of the file where it is none"
        )


def _kind(mapping: dict[str, Any]) -> Kind | None:
    """The lens that the file names; `None` where it names none."""
    kinds = told(mapping)
    if len(kinds) > 1:
        raise ValueError(f"{' and '.join(kinds.values())}: want one lens model, got {' and '.join(kinds)}")
    return next(iter(kinds), None)


def _lens(lenses: dict[str, tuple[str, Any]], label: str, count: int, kind: Kind | None, four_is_brown: bool) -> Any:
    if label not in lenses:
        if lenses and count > 1:
            raise ValueError(f"camera {label}: want its distortion, as another camera of the file has, got none")
        if kind == "fisheye":
            raise ValueError("distortion: want the coefficients of the fisheye lens that the file names, got none")
        return None
    name, value = lenses[label]
    found = matrix(name, value)
    if found.size and found.size != max(found.shape):
        raise ValueError(f"{name}: want one row or column of coefficients, got {shape_of(found)}")
    numbers = found.ravel().tolist()
    if len(numbers) == 4 and kind is None:
        own = four_is_brown and _parted(name)[1] == "distortioncoefficients"
        if not own and any(numbers):
            raise ValueError(
                f"{name}: want 5 coefficients, or the name of the model beside 4: they may be k1 k2 p1 p2 or a "
                "fisheye's k1 to k4; add fisheye_model: 0 or 1, or build dp.Camera.from_opencv(K, dist, fisheye=...)"
            )
        return brown(numbers)
    return lens_of(kind or "brown", numbers)


def _size(key: str, value: Any) -> tuple[int, int] | None:
    """A size given as width and height in one, by their names or in this order."""
    if isinstance(value, dict) and "rows" not in value:
        return image_size(value.get("width"), value.get("height"), key)
    if isinstance(value, str) and re.search(r"\d", value):
        raise ValueError(f"{key}: want width and height as numbers, got {described(value)}")
    if not isinstance(value, list | dict | np.ndarray):
        return None
    sides = matrix(key, value).ravel().tolist()
    if len(sides) != 2:
        raise ValueError(f"{key}: want width and height, got {len(sides)} numbers")
    return image_size(sides[0], sides[1], key)


def _sides(mapping: dict[str, Any]) -> tuple[int, int] | None:
    plain = {re.sub(r"[^a-z0-9]", "", key.lower()): value for key, value in mapping.items()}
    for width, height in SIDES:
        if (width in plain and height in plain) or (width.startswith("im") and (width in plain or height in plain)):
            return image_size(plain.get(width), plain.get(height), width.removesuffix("width") or "size")
    return None


def _plausible(size: tuple[int, int] | None, K: np.ndarray) -> tuple[int, int] | None:
    """The size, unless the principal point is beyond (height, width), or far off: see `image_sizes` for the rest."""
    x, y = float(K[0, 2]), float(K[1, 2])
    if size is not None and not (-size[0] < x < 2 * size[0] and -size[1] < y < 2 * size[1]):
        raise ValueError(
            f"size: want that of the image, got {size}, far from which the principal point is: ({x:g}, {y:g})"
        )
    if size is not None and not (x < size[0] and y < size[1]) and 0 <= x < size[1] and 0 <= y < size[0]:
        raise ValueError(
            f"size: want width and height, got {size}, which looks like height and width: c is ({x:g}, {y:g})"
        )
    return size


def posed(
    cameras: dict[str, Camera], mapping: dict[str, Any], apart: bool = False
) -> tuple[dict[str, Camera], set[str]]:
    """The second of two cameras at its place beside the first, or the only one at its pose, and the keys of the pose.

    Where the names of two cameras do not tell which is the first, there is no pose.

    Args:
        cameras: by name.
        mapping: where the pose may stand.
        apart: whether the cameras stand in mappings of their own, as for `poses_beside.of_pair`.

    Raises:
        ValueError: the pose is none, or there in part.
    """
    pose, keys = poses_beside.of(len(cameras), mapping, apart)
    if pose is None:
        return cameras, set()
    order = list(cameras) if len(cameras) == 1 else poses_beside.in_order(list(cameras))
    if order is None:
        return cameras, set()
    last = order[-1]
    camera = cameras[last]
    return cameras | {last: camera_of(camera.K.numpy(), camera.distortion, camera.size, pose)}, keys


def _nothing(mapping: dict[str, Any]) -> str:
    keys = [str(key) for key in mapping if not str(key).startswith("<")]
    listed = ", ".join(keys[:6]) + " and more" * (len(keys) > 6)
    return f"want the key camera_matrix, or another name of K that is known, got {listed or 'no keys at all'}"
