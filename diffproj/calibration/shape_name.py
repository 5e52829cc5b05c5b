"""`Shape`: what a target's points are taken for. Loads nothing, for the command line."""

from typing import Literal

Shape = Literal["flat", "bow", "free"]
"""What is taken of a target's shape: its points are where it says, or bent to a paraboloid, or each free."""
