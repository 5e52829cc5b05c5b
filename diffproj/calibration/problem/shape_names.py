"""The names of a target's shapes: apart, so that the command line can list them without PyTorch."""

from typing import Literal

Shape = Literal["flat", "bow", "free"]
"""What is taken of a target's shape: its points are where it says, or bent to a paraboloid, or each free."""
