"""Camera files of other programs that are not read, each with what it is and what to do instead."""

import re
from collections.abc import Callable

from diffproj.files import named
from diffproj.files.document import Document

CANNOT = "; build dp.Camera(K, R, t, lens, size) from its numbers"

KINDS = {str: "text", list: "list", dict: "mapping without keys"} | dict.fromkeys((int, float, bool), "number alone")
KINDS[type(None)] = "file without content"


def _text(pattern: str) -> Callable[[Document], bool]:
    return lambda document: re.search(pattern, document.text or "", re.MULTILINE) is not None


KNOWN: tuple[tuple[Callable[[Document], bool], str], ...] = (
    (_text(r"<lensdatabase"), "a lensfun database, whose lens models are of other equations" + CANNOT),
    (
        _text(r'"camera_path"\s*:'),
        "a camera path of nerfstudio, for pictures that it renders; give the transforms.json of the photographs",
    ),
    (_text(r'"camera_type"\s*:\s*"'), "a calibration of Basalt; export it from there as Kalibr's camchain"),
    (_text(r"^\s*cam0\s*=\s*\["), "a Middlebury calib.txt, of rectified images: K is cam0, without a lens" + CANNOT),
    (_text(r"^\[cam_?\d+\]"), "an anipose calibration.toml" + CANNOT),
    (
        _text(r'"?projection_type"?\s*:|^\s*"?FOCAL"?\s*:'),
        "cameras of OpenSfM, in units of the image's longer side" + CANNOT,
    ),
    (_text(r"\bxi\b.*:|\bMEI\b"), "an omnidirectional camera (xi), which is neither perspective nor OpenCV's fisheye"),
    (_text(r"xcr:"), "a camera of RealityCapture, whose focal length is that of 35 mm film" + CANNOT),
    (_text(r"\ANVM_V\d|\A# Bundle file"), "a model of VisualSFM or Bundler, of other axes and lenses" + CANNOT),
    (_text(r'"sfm_data_version"\s*:'), "a scene of OpenMVG" + CANNOT),
    (_text(r'"ppx"\s*:'), "intrinsics of RealSense, fx fy ppx ppy, and coeffs of the model that it names" + CANNOT),
    (_text(r"^\s*-\s*camera\s*:"), "a camera rig of SVO; export it as Kalibr's camchain, or" + CANNOT[1:]),
    (_text(r"^\s*(rvec|tvec|R|T|Tr)\b|<rvec|<R\b"), "a pose alone, without K; give the file with the camera matrix"),
)


def explanation(document: Document) -> str:
    """What a file is that no format recognises, as the rest of a message."""
    if document.text is None:
        return "want a camera file, got a binary one of an unknown kind"
    try:
        tree = document.tree
    except ValueError as error:
        tree, problem = None, str(error)
    else:
        problem = ""
    for matches, what in KNOWN:
        if matches(document):
            return f"want a format that is read here, got {what}"
    wrong = named.misfit(document.mapping)
    if wrong:
        return wrong
    if problem:
        return f"want a camera file, got one that is no format known here: {problem}"
    keys = [str(key) for key in tree if not str(key).startswith("<")] if isinstance(tree, dict) else []
    got = f"the keys {', '.join(keys[:8])}{' and more' * (len(keys) > 8)}" if keys else f"a {KINDS[type(tree)]}"
    wanted = "want a camera matrix under a known name, such as camera_matrix"
    return f"{wanted}, got {got}; build dp.Camera.from_opencv(K, dist)"
