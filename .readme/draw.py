"""Draws the README's pictures again: `python .readme/draw.py [FOLDER]`, by default beside this file."""

import sys
from dataclasses import replace
from pathlib import Path

import measuring_page  # beside this file, as the next two
import mounting
import report

import diffproj as dp
from diffproj import figures

views = dp.example_views("left")
experiment = dp.run_experiment(views[:8], views[8:], dp.Chessboard(axes="paper"))
experiment = replace(experiment, fit=replace(experiment.fit, unit="mm"))
calibration = dp.calibrate(views, dp.Chessboard())
pictures = {
    "fig7.png": figures.png(figures.fig7(experiment), dpi=80),
    "mounting.png": figures.png(mounting.figure(), dpi=80),
    "accuracy.png": figures.png(figures.accuracy(dp.AccuracyMap.over_image(calibration, view=0), unit="mm"), dpi=90),
    **measuring_page.pictures(calibration),
}
if first_screen := report.screenshot(replace(calibration, unit="mm")):
    pictures["report.png"] = first_screen
else:
    print("report.png: no Chromium, not drawn")
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
folder.mkdir(parents=True, exist_ok=True)
for name, content in pictures.items():
    (folder / name).write_bytes(content)
