"""What files tell of the photographs that a calibration's intrinsics were found from."""

from diffproj.calibration.results.calibration import Calibration
from diffproj.targets.exif import Told


def told_of_intrinsics(known: Calibration) -> tuple[Told, ...]:
    """What files tell of the photographs that intrinsics were found from; empty where those are not known.

    The views of a calibration whose intrinsics were held, as `locate` holds them, are others.
    """
    if known.calibrated_on is not None:
        return known.calibrated_on
    held = known.lens_region is not None or (known.has_covariance and not known.knows_intrinsics)
    return () if held else known.views.told
