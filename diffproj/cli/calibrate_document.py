"""What `diffproj calibrate` found, as one JSON document."""

import argparse
import math
from typing import Any

from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.validation import CrossValidation
from diffproj.cli.terminal import in_words
from diffproj.lens.models import model_of


def document(options: argparse.Namespace, found: Calibration, folds: CrossValidation | None) -> dict[str, Any]:
    """Everything that was found.

    Args:
        options: of the command.
        found: the calibration.
        folds: the errors on views left out, where they were asked for.
    """
    camera = found.camera
    deviations = found.covariance.deviations if found.has_covariance else {}
    shape = found.displacements
    return {
        "output": str(options.output),
        "drawn": None if options.draw is None else str(options.draw),
        "report": None if options.report is None else str(options.report),
        "unit": found.unit,
        "size": None if camera.size is None else list(camera.size),
        "lens": model_of(camera.distortion).name,
        "parameters": {
            name: {"value": value, "deviation": float(deviations.get(name, math.nan))}
            for name, value in zip(found.parameters.few_names, found.shared.tolist(), strict=False)
        },
        "rms": float(found.rms),
        "pixel_sigma": None if found.pixel_sigma is None else float(found.pixel_sigma),
        "corners": int(found.used.sum()),
        "views": _views(found),
        "board_off_the_grid_rms": None if shape is None else shape.square().mean(0).sqrt().tolist(),
        "lenses_compared": None if found.comparison is None else found.comparison.to_dict(),
        "folds": None if folds is None else folds.to_dict(),
        "status": Status(int(found.status)).name,
        "message": in_words(found.message, found.unit),
        "verdict": in_words(found.verdict, found.unit),
        "warnings": options.warned,
    }


def _views(found: Calibration) -> list[dict[str, Any]]:
    """Each view with its corners, and those that were rejected: numbers and pixels."""
    rows = []
    for view, name in enumerate(found.views.names):
        numbers = found.rejected[view].nonzero().flatten().tolist()
        places = found.views.pixels[view, numbers].tolist()
        count = int(found.used[view].sum())
        rows.append(
            {
                "name": name,
                "corners": int(found.views.visible[view].sum()),
                "used": count,
                "rms": float(found.view_rms[view]) if count else None,
                "rejected": [{"number": n, "pixel": place} for n, place in zip(numbers, places, strict=True)],
            }
        )
    return rows
