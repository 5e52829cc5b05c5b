"""The work of `diffproj convert`: camera files from one program's format to another's."""

import argparse
from typing import Any

from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.cli.inputs import check_not_the_same, check_writable
from diffproj.cli.scene import posed_view
from diffproj.cli.terminal import as_json, note, result
from diffproj.files import colmap, nerfstudio, own_json
from diffproj.files.document import Document
from diffproj.files.formats import format_to_write
from diffproj.files.found import Found
from diffproj.files.load import content_of, found_in
from diffproj.files.save import save_camera
from diffproj.geometry.camera import Camera
from diffproj.lens.models import model_of

WHOLE = Calibration | RigCalibration
"""What has error bars."""

REMEDIES = (
    ("or save camera.without_pose()", "or give --without-pose"),
    ("or without_pose()", "or give --without-pose"),
    ("use .json, or save them one by one", "write .json, or choose one by --camera"),
    ("Camera(..., size=(width, height))", "give --size WxH"),
    ("Camera(..., size=(w, h))", "give --size WxH"),
    ("camera: want", "--camera: want"),
)
"""What Python's users are advised to, and what those of the command line are instead."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    check_writable("OUT", options.output)
    check_not_the_same("OUT", options.output, [options.input])
    try:
        document = Document.read(options.input)
        found = _wanted(options, document)
        save_camera(options.output, found, options.to)
    except ValueError as error:
        said = str(error)
        for python, remedy in REMEDIES:
            said = said.replace(python, remedy)
        if options.view is not None:
            said = said.replace("give --without-pose", "leave out --view")
        raise ValueError(said) from error
    told = _told(options, found)
    own = format_to_write(options.output, options.to) is own_json
    if own_json.holds_whole(document) and not (own and isinstance(found, WHOLE)):
        pose = "" if options.view is None else f" at {options.view}"
        note(
            f"{options.output} holds the camera{pose} alone: error bars, views and unit of {options.input} stay there, "
            "and what is measured with the camera alone has error bars that are too small"
            + (isinstance(found, Calibration) and not own)
            * "; --view NAME takes the camera where it stood, into a format that holds a pose"
        )
    if options.view is not None and format_to_write(options.output, options.to) in (colmap, nerfstudio):
        note(f"{options.output} calls the image 000000.png: put the name of the photograph there")
    if options.json:
        as_json(told)
    elif isinstance(found, RigCalibration):
        result(f"{options.output}: a rig of {', '.join(found.names)}")
    else:
        many = "one camera" if told["cameras"] is None else f"{told['cameras']} cameras"
        size = "of unknown size" if told["size"] is None else "of {} x {} px".format(*told["size"])
        camera = found.camera if isinstance(found, Calibration) else found
        lens = "no lens" if camera.distortion is None else type(camera.distortion).__name__
        result(f"{options.output}: {many} {size}, {lens}")
    return 0


def _told(options: argparse.Namespace, found: Camera | Calibration | RigCalibration) -> dict[str, Any]:
    """What was written."""
    told = {"input": str(options.input), "output": str(options.output), "warnings": options.warned}
    if isinstance(found, RigCalibration):
        return {**told, "rig": list(found.names), "cameras": len(found.names), "size": None, "lens": None}
    camera = found.camera if isinstance(found, Calibration) else found
    return {
        **told,
        "rig": None,
        "cameras": camera.batch_shape.numel() if camera.batch_shape else None,
        "size": None if camera.size is None else list(camera.size),
        "lens": model_of(camera.distortion).name,
    }


def _wanted(options: argparse.Namespace, document: Document) -> Camera | Calibration | RigCalibration:
    """What to write: a whole calibration or rig where nothing of it is to change."""
    if options.view is not None:
        return _sized(_at_view(options, document), options)
    plain = options.source is None and options.size is None and not options.without_pose
    if plain and options.camera is None:
        found = content_of(document)
    else:
        among = found_in(document, options.source)
        try:
            one = named(among, options.camera)
            found = among.chosen(one)
            if plain and own_json.holds_fleet(document):
                found = content_of(document, name_in(among, one))
        except ValueError as error:
            raise ValueError(f"{options.input}: {error}") from error
    return found if isinstance(found, Calibration | RigCalibration) else _sized(found, options)


def _at_view(options: argparse.Namespace, document: Document) -> Camera:
    """The camera of a calibration at the pose of one of its views.

    Raises:
        ValueError: the file holds no calibration of one camera, or not that view.
    """
    one = None
    if options.camera is not None:
        among = found_in(document, options.source)
        among.chosen(which := named(among, options.camera))
        one = name_in(among, which) if own_json.holds_fleet(document) else None
    found = content_of(document, one) if options.source in (None, "json") else None
    if not isinstance(found, Calibration) or found.camera.batch_shape:
        raise ValueError(
            f"--view: want a .json with a whole calibration of one camera, got another file in {options.input}"
        )
    return found.cameras[posed_view(options.input, found, options.view)]


def named(found: Found, name: str | None) -> str | int | None:
    """The camera that is asked for: by a name that the file has, or else by its number."""
    if name is None or not name.isdecimal():
        return name
    return name if name in found.cameras or name in found.aside else int(name[:9])


def name_in(found: Found, one: str | int | None) -> str | None:
    """The name of a camera that a file has, of its name or its number."""
    return list(found.cameras)[one] if isinstance(one, int) else one


def _sized(camera: Camera, options: argparse.Namespace) -> Camera:
    if options.without_pose:
        camera = camera.without_pose()
    if options.size is None:
        return camera
    if camera.size is not None and camera.size != options.size:
        width, height = camera.size
        raise ValueError(
            f"--size: want {width}x{height} as {options.input} says, got another; in Python, camera.resized(...) and "
            "camera.cropped(...) change it"
        )
    return Camera(camera.K, camera.R, camera.t, camera.distortion, options.size)
