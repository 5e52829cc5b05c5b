"""What the lenses that can be fitted are called, apart from them: the command line's help needs no more."""

from typing import Literal

LensModel = Literal["none", "brown4", "brown5", "brown8", "brown12", "brown14", "fisheye"]
"""The lenses that can be fitted: none, Brown-Conrady by its number of coefficients, Kannala-Brandt."""
