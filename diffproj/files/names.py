"""The names of the formats, apart from their readers, so that the command line's help need not wait for these."""

from typing import Literal

FormatName = Literal[
    "json",
    "numpy",
    "colmap",
    "mrcal",
    "kitti",
    "matlab",
    "metashape",
    "nerfstudio",
    "nuscenes",
    "open3d",
    "kalibr",
    "ros",
    "settings",
    "opencv",
]
