"""`write_report`: a calibration as one page for people, from the verdict to the code that loads the camera."""

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, cast, get_args

from diffproj._core.arguments import called, choice, file_path, whole_number
from diffproj._core.atomic import write_whole
from diffproj.calibration.results.advice import POSES_ONLY
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.calibration.validation import CrossValidation
from diffproj.targets.images import Orientation, Source
from diffproj.targets.target import Target, points_of

if TYPE_CHECKING:  # it loads Jinja2
    from diffproj.report.pictures import Pictures

TITLE = "Calibration of a camera"
FOLDS = 5


def write_report(
    path: str | os.PathLike[str],
    calibration: Calibration,
    photographs: Source | Iterable[Source] | None = None,
    folds: CrossValidation | int | None = FOLDS,
    target: Target | None = None,
    *,
    orientation: Orientation | str = "sensor",
    title: str = TITLE,
    camera_file: str = "camera.json",
) -> None:
    """Write what a calibration found, and how far to trust it, as one HTML file that needs nothing else.

    In this order: whether it is good enough, for what, what to photograph next and what not to trust; the photographs
    with their corners; the residuals; coverage; the lens and, after `distortion="auto"`, the others; the parameters
    with deviations and correlations; how surely pixels are put back, over the image and over the board's plane; the
    board's shape; views held out; code that loads the camera; and with photographs a page that measures in one of them,
    as `write_measuring_page` writes it. It opens from disk in any browser, in light and dark, on a telephone and on
    paper, and asks no network for anything.

    Args:
        path: the file, such as `"report.html"`; one that is there is replaced, whole or not at all.
        calibration: of one camera, from `calibrate` or `refine`, or from a file by `load_calibration`. One that did not
            converge (`throw=False`) is told as that.
        photographs: those that the corners were detected in, as `detect` takes them; each belongs to the view of its
            name, or where no name fits and there are as many as views, in their order. Without them the corners stand
            alone.
        folds: a `CrossValidation` of the same views; or how many folds to make one of, with the lens, shape, skew and
            objective of the calibration (at most as many as views); `None` for none.
        target: that of the calibration, for the folds; its points, as the calibration has them, if left out.
        orientation: how the files' pixels are counted, as it was given to `detect`.
        title: of the page.
        camera_file: the name of the calibration's file, for the code to copy.

    Raises:
        TypeError: it is no calibration, or an argument is of the wrong kind.
        ValueError: many cameras, a rig, poses of a known camera, or a size that is not known; photographs of other
            views or another size; fewer than 2 folds.
        FileNotFoundError: a photograph is missing.
        OSError: the file cannot be written.

    Example:
        >>> import pathlib, tempfile
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     report = pathlib.Path(folder, "report.html")
        ...     dp.write_report(report, calibration)
        ...     "Good: the camera is known well" in report.read_text(encoding="utf-8")
        True
    """
    write_whole(
        file_path("path", path), report(calibration, photographs, folds, target, orientation, title, camera_file)
    )


def report(
    calibration: Calibration,
    photographs: "Source | Iterable[Source] | Pictures | None" = None,
    folds: CrossValidation | int | None = FOLDS,
    target: Target | None = None,
    orientation: Orientation | str = "sensor",
    title: str = TITLE,
    camera_file: str = "camera.json",
) -> str:
    """The text of the report; see `write_report`."""
    known = _one_camera(calibration)
    for name, value in (("title", title), ("camera_file", camera_file)):
        if not isinstance(value, str):
            raise TypeError(f"{name}: want a string, got {called(value)}")
    way = cast(Orientation, choice("orientation", orientation, get_args(Orientation)))
    if not isinstance(folds, CrossValidation | None):
        folds = whole_number("folds", folds, "a whole number of at least 2, a dp.CrossValidation or None", least=2)
    if target is not None and len(points_of(target)) != len(known.nominal):
        raise ValueError(
            f"target: want the calibration's, with {len(known.nominal)} points, got {len(points_of(target))}"
        )
    from diffproj.report.contents import contents  # here, for it loads Jinja2

    return contents(known, photographs, folds, target, way, title, camera_file)


def _one_camera(calibration: Any) -> Calibration:
    """A calibration of one camera, whose intrinsics were found.

    Raises:
        TypeError: it is none.
        ValueError: many cameras, or poses only.
    """
    if isinstance(calibration, RigCalibration):
        names = ", ".join(map(repr, calibration.names[:3]))
        raise ValueError(  # noqa: TRY004  # a calibration, of more than one
            f"calibration: want one camera, got a rig of {len(calibration.names)}; write one for each, of rig[name] "
            f"(its cameras are {names}{', ...' * (len(calibration.names) > 3)})"
        )
    if not isinstance(calibration, Calibration):
        raise TypeError(
            f"calibration: want a dp.Calibration, got {called(calibration)}; dp.calibrate and dp.load_calibration give "
            "one"
        )
    if calibration.views.batch_shape:
        shape = tuple(calibration.views.batch_shape)
        raise ValueError(f"calibration: want one camera, got batch shape {shape}; index it")
    if calibration.judgement.word == POSES_ONLY:
        raise ValueError(
            "calibration: want one that found the camera, got poses of a known camera, as dp.locate finds them; write "
            "the report of the calibration that the camera came from"
        )
    return calibration
