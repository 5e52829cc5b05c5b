"""Warnings that point at the line of the user's code, however deep in the package they arise."""

import sys
import warnings


def warn_caller(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn as if at the line that called into this package; by default Python shows it once there."""
    package, level = __name__.partition(".")[0], 2
    frame = sys._getframe(1)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level)
