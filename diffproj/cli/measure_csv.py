"""What `diffproj measure` found, as one table for spreadsheets: a line for each point, length and area."""

import csv
import io
from typing import Any

AXES = "xyz"
COLUMNS = (
    "what",
    "name",
    "u",
    "v",
    *AXES,
    *(f"{axis}_deviation" for axis in AXES),
    "value",
    "deviation",
    "low_95",
    "high_95",
    "unit",
    "remark",
)
"""Points fill the columns up to `z_deviation`, lengths and areas those from `value` on; what is not known is empty."""

DOUBTFUL = "DOUBTFUL"
"""What is remarked on every number where the camera is perhaps not that of the photograph, or the pose another."""


def as_csv(document: dict[str, Any]) -> str:
    """The table, its titles in the first line."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    unit, doubts = document["unit"] or "", [DOUBTFUL] * bool(document["doubts"])
    for row in document["points"]:
        u, v = row["pixel"]
        cells = {"what": "point", "name": row["name"], "u": u, "v": v, "unit": unit, "remark": row["reason"] or ""}
        if row["valid"]:
            cells |= dict(zip(AXES, row["world"], strict=True))
            cells |= {f"{axis}_deviation": value for axis, value in zip(AXES, row["deviation"], strict=True)}
            cells["remark"] = ", ".join(["EXTRAPOLATED"] * bool(row["extrapolated"]) + doubts)
        writer.writerow(cells)
    for length in document["lengths"]:
        writer.writerow({"what": "length", "unit": unit, **_quantity(length, doubts)})
    if document["area"] is not None:
        writer.writerow({"what": "area", "unit": unit and f"{unit}^2", **_quantity(document["area"], doubts)})
    return text.getvalue()


def _quantity(found: dict[str, Any], doubts: list[str]) -> dict[str, Any]:
    low, high = found["interval_95"] or (None, None)
    remark = ["NOT SIGNIFICANT"] * (found["significant"] is False) + doubts * (found["value"] is not None)
    return {
        "name": found["name"],
        "value": found["value"],
        "deviation": found["deviation"],
        "low_95": low,
        "high_95": high,
        "remark": ", ".join(remark),
    }
