"""The part on using the camera: code to copy, in Python and for OpenCV, with its numbers."""

from pathlib import Path

import torch

from diffproj.lens.models import MODELS
from diffproj.report import svg
from diffproj.report.document import Part, render
from diffproj.report.facts import Facts


def usage_part(facts: Facts, camera_file: str) -> Part:
    """How to load the camera."""
    calibration = facts.calibration
    camera = calibration.camera.detach().to("cpu", torch.float64)
    lens = calibration.parameters.lens
    html = render(
        "usage.html",
        file=repr(camera_file),
        whole=Path(camera_file).suffix.lower() == ".json",
        name=facts.names[facts.usual_view],
        view=facts.usual_view,
        z=facts.plane_z,
        board=facts.planar,
        K=_rows(camera.K.tolist()),
        coefficients="" if lens == "none" else _row(camera.distortion.coefficients.tolist()),  # type: ignore[union-attr]
        kind=type(camera.distortion).__name__,
        size=facts.size,
        fisheye=lens == "fisheye",
        skewed=bool(camera.K[0, 1] != 0),
        names=" ".join(MODELS[lens].coefficient_names),
        converged=facts.converged,
    )
    return Part("Use the camera", "use", html, svg.STYLE)


def _row(values: list[float]) -> str:
    """A list with all digits that count, three numbers a line."""
    texts = [repr(value) for value in values]
    return _lines([", ".join(texts[i : i + 3]) for i in range(0, len(texts), 3)])


def _rows(values: list[list[float]]) -> str:
    """A matrix with all digits that count, a row a line."""
    return _lines([f"[{', '.join(map(repr, row))}]" for row in values])


def _lines(parts: list[str]) -> str:
    """A list whose parts have a line each, so that a narrow page shows all of it."""
    return "".join(["[\n", *(f"    {part},\n" for part in parts), "]"])
