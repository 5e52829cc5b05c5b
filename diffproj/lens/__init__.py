"""Lens models: from directions in the camera frame to distorted points on the normalised plane, and exactly back."""

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt
from diffproj.lens.protocol import Lens

__all__ = ["BrownConrady", "KannalaBrandt", "Lens"]
