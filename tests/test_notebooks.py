"""Every notebook runs from top to bottom, says nothing on stderr, and ends with the figures that it claims."""

import json
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"


def stored(name: str) -> nbformat.NotebookNode:
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def outcome(name: str, monkeypatch: pytest.MonkeyPatch, folder: Path, **expressions: str) -> dict[str, Any]:
    """Execute a notebook in an empty folder and evaluate expressions behind its last cell."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # two threads beside another busy process are ten times slower than one
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)  # measured, they would take twice as long
    notebook = stored(name)
    values = ", ".join(f"{key!r}: {expression}" for key, expression in expressions.items())
    notebook.cells.append(nbformat.v4.new_code_cell(f"import json; print(json.dumps({{{values}}}))"))
    NotebookClient(notebook, timeout=500, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    complaints = [
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and output.name == "stderr"
    ]
    assert not complaints
    assert not any(folder.iterdir())
    return json.loads(notebook.cells[-1].outputs[0].text)


@pytest.mark.parametrize("name", sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")))
def test_outputs_are_kept_from_one_clean_run(name: str) -> None:
    cells = [cell for cell in stored(name).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert all(output.output_type != "error" and output.get("name") != "stderr" for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3
    text = json.dumps(outputs)
    assert "site-packages" not in text
    assert not any(f"/{folder}/" in text for folder in ("home", "root", "tmp", "Users"))


def test_notebooks_use_public_names_only() -> None:
    for path in NOTEBOOKS.glob("*.ipynb"):
        code = "\n".join(cell.source for cell in stored(path.stem).cells if cell.cell_type == "code")
        assert not re.search(r"\._[a-z]| import _[a-z]", code)


@pytest.mark.slow  # tests of the experiment itself, and of the command that runs it, take seconds
def test_the_paper_experiment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = outcome(
        "01_paper_experiment",
        monkeypatch,
        tmp_path,
        route="route_difference",
        means="{name: max(e.rows[-1].mean) for name, e in experiments.items()}",
        off_plane="max(float(e.errors[e.measured][:, 2].max()) for e in experiments.values())",
    )
    assert found["route"] < 1e-9
    assert set(found["means"]) == {"left", "right", "synthetic"}
    assert all(mean < 0.1 for mean in found["means"].values())  # millimetres; the paper: 0.37
    assert found["off_plane"] < 1e-9


@pytest.mark.slow
def test_refining_a_calibration(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = outcome(
        "02_refine_a_calibration",
        monkeypatch,
        tmp_path,
        opencv="rms_difference_to_opencv",
        coverage="coverage_95",
        derivative="derivative_error",
        bow="bow_error_sigma",
    )
    assert abs(found["opencv"]) < 1e-9
    assert 0.93 < found["coverage"] < 0.97
    assert found["derivative"] < 1e-5
    assert found["bow"] < 2


@pytest.mark.slow
def test_training_finds_the_camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = outcome(
        "03_training_pipeline",
        monkeypatch,
        tmp_path,
        start="camera_error(wrong).tolist()",
        rotation="rotation_error",
        focal="focal_error",
        improvement="improvement",
    )
    assert found["start"][0] == pytest.approx(3, abs=1e-3)
    assert found["start"][1] == pytest.approx(5, abs=1e-3)
    assert found["rotation"] < 0.2  # degrees
    assert found["focal"] < 0.5  # per cent
    assert found["improvement"] > 5


def test_from_landmarks_to_the_ground(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = outcome(
        "04_from_landmarks_to_the_ground",
        monkeypatch,
        tmp_path,
        beach="beach_difference",
        inside="inside",
        river="river_focal",
        tilt="colony_tilt",
        height="float(everything.mounting.height)",
        told="list(adjusted)",
        missing="missing",
    )
    assert found["beach"] < 0.005  # metres, from the demonstration's own
    assert found["inside"] >= 4
    assert found["river"] == pytest.approx(1556.5, abs=0.1)
    assert found["tilt"] == pytest.approx(90 - 83.48, abs=0.02)
    assert found["height"] == pytest.approx(20.47, abs=0.02)
    assert "horizon" not in found["told"]
    assert len(found["told"]) == 5
    assert found["missing"].startswith("height: no evidence")


@pytest.mark.slow
def test_a_birds_eye_view_learns_its_tilts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = outcome(
        "05_birds_eye_view_from_six_cameras",
        monkeypatch,
        tmp_path,
        tilt="tilt_error",
        overlaps="overlaps",
        difference="difference",
        ratio="ratio",
    )
    assert found["tilt"] < 0.4  # degrees, of 4; .14 was measured
    assert found["overlaps"]["wrong tilt, learned"] > found["overlaps"]["wrong tilt, frozen"] + 0.4  # .68 and .00
    assert found["overlaps"]["true tilt"] > 0.7  # .80
    assert found["difference"] < 1e-4
    assert found["ratio"] < 3  # 1.1 to 1.2, of times on a busy machine
