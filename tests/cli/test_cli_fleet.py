"""`diffproj calibrate --fleet`: every camera in its line, whatever happens to others, and no work done twice."""

import importlib.util
import json
import os
import shutil
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

import diffproj as dp
from diffproj.cli import calibrating_fleet, main

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("fleet_benchmark", ROOT / "tests" / "benchmarks" / "fleet.py")
assert _spec is not None
assert _spec.loader is not None
benchmark = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(benchmark)

GIVEN = (*benchmark.GIVEN, "--workers", "1")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        code = main(["calibrate", *map(str, arguments)])
    except SystemExit as error:
        code = int(error.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def lines_of(file: Path) -> dict[str, dict]:
    return {line["name"]: line for line in map(json.loads, file.read_text().splitlines())}


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    """Two cameras, one with too few photographs, and one of a wall."""
    fleet = tmp_path_factory.mktemp("fleet") / "cameras"
    focal = {f"cam{n}": benchmark.render(fleet / f"cam{n}", n, 5, (320, 240)) for n in (2, 10)}
    (fleet / "cam3").mkdir()
    shutil.copy(fleet / "cam2" / "0.png", fleet / "cam3")
    (fleet / "wall").mkdir()
    benchmark.cv2.imwrite(str(fleet / "wall" / "0.png"), np.full((240, 320), 90, np.uint8))
    (fleet / "empty").mkdir()
    (fleet / "readme.txt").write_text("no camera")
    return fleet, focal


@pytest.fixture
def fleet(truth: tuple[Path, dict[str, float]], tmp_path: Path) -> Path:
    shutil.copytree(truth[0], tmp_path / "cameras")
    return tmp_path / "cameras"


def test_each_camera_gets_its_line(fleet, truth, tmp_path, capsys):
    file = tmp_path / "out.jsonl"
    code, out, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert (code, err) == (0, "")
    lines = lines_of(file)
    assert set(lines) == {"cam2", "cam3", "cam10", "wall", "empty"}
    for name, f in truth[1].items():
        found = dp.load_calibration(file, name)
        alone = dp.calibrate(dp.detect(fleet / name, benchmark.BOARD), benchmark.BOARD, "brown4")
        assert found.summary() == alone.summary()
        assert found.unit == "mm"
        assert abs(found.camera.K[0, 0] - f) < 0.01 * f
        assert lines[name]["summary"]["rms"] == pytest.approx(float(alone.rms), rel=1e-9)
        assert lines[name]["verdict"] == alone.verdict
        assert dp.load(file, name).summary() == found.summary()
        assert bool((dp.load_camera(file, camera=name).K == found.camera.K).all())
    assert dp.load_camera(file).batch_shape == (2,)
    one = tmp_path / "one.json"
    assert main(["convert", str(file), str(one), "--camera", "cam10"]) == 0
    assert dp.load_calibration(one).summary() == dp.load_calibration(file, "cam10").summary()  # error bars and all
    assert main(["info", str(file), "--camera", "cam10"]) == 0
    assert "a calibration of 5 views" in capsys.readouterr().out
    assert main(["info", str(file)]) == 0
    assert main(["measure", "--camera", str(file), "--view", "0.png", "--points", "1,2"]) == 1
    assert "--camera: want one camera, got a fleet" in capsys.readouterr().err
    assert lines["wall"]["error"].startswith("photographs: want a board with 8 x 5 inner corners, found none in")
    assert "want a folder with photographs" in lines["empty"]["error"]
    assert "cam3" not in truth[1]
    assert "error" in lines["cam3"]
    assert "2 cameras calibrated, 3 failed" in out
    assert out.strip().splitlines()[-1] == '3 of 5 cameras failed: see "error" in the file, or above'
    assert out.index("cam10") < out.index("wall: ")
    assert "The worst" in out


def test_a_folder_that_cannot_be_looked_into_is_one_camera_s_failure(tmp_path, capsys, monkeypatch):
    """As of another user, or where a photograph goes while its folder is looked through."""
    fleet, file = tmp_path / "cameras", tmp_path / "out.jsonl"
    for name in ("closed", "wall"):
        (fleet / name).mkdir(parents=True)
        benchmark.cv2.imwrite(str(fleet / name / "0.png"), np.full((240, 320), 90, np.uint8))
    listed = Path.iterdir

    def closed(folder):
        if folder.name == "closed":
            raise PermissionError(13, "Permission denied", str(folder))
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", closed)
    code, out, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert (code, err) == (1, "")
    assert "closed: " in out
    lines = lines_of(file)
    assert "Permission denied" in lines["closed"]["error"]
    assert "found none in" in lines["wall"]["error"]


def test_what_is_done_is_not_done_again(fleet, tmp_path, capsys, monkeypatch):
    file = tmp_path / "out.jsonl"
    run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    before = lines_of(file)
    whole = file.read_text().splitlines()
    cam2 = next(line for line in whole if '"cam2"' in line)
    cam10 = next(line for line in whole if '"cam10"' in line)
    file.write_text(cam2 + "\n" + cam10[: len(cam10) // 2])  # as a run leaves it that was killed while it wrote
    assert dp.load_camera(file).batch_shape == ()
    searched, seen = calibrating_fleet.searched, []
    monkeypatch.setattr(calibrating_fleet, "searched", lambda folder: seen.append(folder.path.name) or searched(folder))
    code, out, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file, "--json")
    assert (code, seen) == (0, ["cam3", "cam10", "empty", "wall"])
    assert "1 camera of 5 done before" in err
    told = json.loads(out)
    assert (told["cameras"], told["calibrated"], set(told["failed"])) == (5, 2, {"cam3", "wall", "empty"})
    assert {worst["name"] for worst in told["worst"]} == {"cam2", "cam10"}
    after = lines_of(file)
    assert after["cam2"] == before["cam2"]
    # In a batch of another size sums may differ in their last digits.
    for of in (lambda camera: camera["lens"]["coefficients"], lambda camera: camera["K"][0] + camera["K"][1]):
        assert of(after["cam10"]["camera"]) == pytest.approx(of(before["cam10"]["camera"]), rel=1e-9)
    seen.clear()
    shutil.copytree(fleet / "cam10", fleet / "cam3", dirs_exist_ok=True)  # a failed camera gets its photographs
    code, _, _ = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert (code, seen) == (0, ["cam3", "empty", "wall"])
    assert "camera" in lines_of(file)["cam3"]
    assert len(file.read_text().splitlines()) == 5


def test_photographs_that_came_or_changed_are_noticed(fleet, tmp_path, capsys):
    file = tmp_path / "out.jsonl"
    run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    before = lines_of(file)
    photograph = fleet / "cam2" / "0.png"
    (fleet / "cam2" / "9.png").write_bytes(photograph.read_bytes()[:-1] + b"\0")
    _, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert "1 camera of 5 done before" in err
    assert f"cam2: photographs were added, removed or changed since {file} was written; done anew" in err
    after = lines_of(file)
    assert after["cam2"]["photographs"] == before["cam2"]["photographs"] + 1
    assert after["cam10"] == before["cam10"]
    assert len(file.read_text().splitlines()) == 5
    (fleet / "cam2" / "9.png").unlink()
    about = photograph.stat()
    os.utime(photograph, ns=(about.st_atime_ns, about.st_mtime_ns + 10**9))  # one of the same size, taken again
    (fleet / "cam10" / "notes.txt").write_text("no photograph")
    _, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert "cam2: photographs were added" in err
    assert "cam10" not in err
    _, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert "2 cameras of 5 done before" in err
    assert "photographs were added" not in err


def test_a_camera_that_is_done_anew_stays_till_then(fleet, tmp_path, capsys, monkeypatch):
    file = tmp_path / "out.jsonl"
    run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    before = lines_of(file)
    for name in ("cam2", "cam10"):
        shutil.copy(fleet / name / "0.png", fleet / name / "9.png")
    append = calibrating_fleet.append

    def stopped(path, lines):
        raise KeyboardInterrupt

    def failed(path, lines):  # the line of a failure is behind that of before
        append(path, [{**before["wall"], "name": "cam2"}])
        raise KeyboardInterrupt

    for stop, left in ((stopped, {"cam2", "cam10"}), (failed, {"cam10"})):
        monkeypatch.setattr(calibrating_fleet, "append", stop)
        run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
        cameras = {name for name, line in lines_of(file).items() if "camera" in line}
        assert cameras == left
        assert dp.load_camera(file).batch_shape == ((2,) if len(left) == 2 else ())
        assert dp.load_calibration(file, "cam10").rms == pytest.approx(before["cam10"]["summary"]["rms"])
    monkeypatch.setattr(calibrating_fleet, "append", append)
    _, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert "cam10: photographs were added" in err
    assert len(file.read_text().splitlines()) == 5
    monkeypatch.setattr("diffproj.cli.calibrating_fleet.state_of", lambda folder: "")
    _, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert f"cam10, cam2: cannot be looked into now; what {file} says stays" in " ".join(err.split())
    assert {"cam2", "cam10"} <= {name for name, line in lines_of(file).items() if "camera" in line}


def test_the_document_speaks_of_options_and_tells_notes(fleet, tmp_path, capsys, monkeypatch):
    photograph = benchmark.cv2.imread(str(fleet / "cam10" / "0.png"))
    benchmark.cv2.imwrite(str(fleet / "cam10" / "9.png"), photograph * 0 + 90)
    said = "Weak: 3 world units off; try distortion='brown8' ('auto' compares the lenses)."
    monkeypatch.setattr(dp.Calibration, "verdict", property(lambda _: said))
    code, out, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", tmp_path / "out.jsonl", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert {one["verdict"] for one in told["worst"]} == {
        "Weak: 3 mm off; try --distortion brown8 (auto compares the lenses)."
    }
    assert (told["warnings"], told["unit"]) == ([], "mm")
    assert list(told["notes"]) == ["cam10"]
    assert "9.png: found no board" in told["notes"]["cam10"][0]
    code, out, _ = run(capsys, "--fleet", fleet, *GIVEN, "-o", tmp_path / "out.jsonl")
    assert 'Notes on photographs of cam10: see "notes" in the file' in out


@pytest.mark.parametrize("together", [1, 32], ids=["one by one", "at once"])
def test_a_killed_worker_leaves_what_came_before(fleet, truth, tmp_path, capsys, monkeypatch, together):
    """As where memory runs out: one line says so, and the same command goes on."""
    file, as_done = tmp_path / "out.jsonl", calibrating_fleet.as_done

    def broken(work, items, executor):
        yield next(as_done(work, items, executor))
        raise BrokenProcessPool("A process in the process pool was terminated abruptly")

    monkeypatch.setattr(calibrating_fleet, "TOGETHER", together)
    monkeypatch.setattr(calibrating_fleet, "as_done", broken)
    code, out, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert (code, out) == (1, "")
    assert err == (
        "diffproj: a process that searched photographs was killed, as happens where memory runs out: a smaller "
        f"--workers, or smaller photographs, need less; {file} holds 1 camera of 5, and the same command goes on from "
        "there\n"
    )
    assert list(lines_of(file)) == ["cam2"]
    monkeypatch.setattr(calibrating_fleet, "as_done", as_done)
    code, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert code == 0
    assert "1 camera of 5 done before" in err
    assert len(lines_of(file)) == 5


def test_other_options_are_not_mixed(fleet, tmp_path, capsys):
    file = tmp_path / "out.jsonl"
    run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    text = file.read_text()
    code, _, err = run(capsys, "--fleet", fleet, *GIVEN, "--distortion", "none", "-o", file)
    assert code == 1
    assert "holds cameras with distortion brown4, not none; choose another file, or remove it" in err
    code, _, err = run(capsys, "--fleet", fleet, *GIVEN, "--square", "25.0000004mm", "-o", file)
    assert code == 1
    assert "holds cameras with square 25mm, not 25.0000004mm; choose another file, or remove it" in err
    assert file.read_text() == text
    file.write_text("something else")
    code, _, err = run(capsys, "--fleet", fleet, *GIVEN, "-o", file)
    assert code == 1
    assert "want a file of a fleet" in err
    assert file.read_text() == "something else"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("photos", "--fleet", "cameras"), "--fleet: want it without other photographs"),
        ((), "PHOTO (or --fleet DIR)"),
        (("photos", "--workers", "2"), "--workers: goes with --fleet"),
        (("--fleet", "cameras", "--report", "a.html"), "--report: goes with one camera"),
        (("--fleet", "cameras", "--folds", "3"), "--folds: goes with one camera"),
        (("--fleet", "cameras", "--frames", "3"), "--frames: goes with one camera"),
        (("--fleet", "cameras", "--draw", "a.png"), "--draw: goes with one camera"),
        (("--fleet", "cameras", "-o", "a.json"), "--output: want a .jsonl with --fleet"),
        (("photos", "-o", "a.jsonl"), "--output: want a .json, .yaml"),
        (("--fleet", "cameras", "--workers", "0"), "want a number of processes"),
        (("--fleet", "cameras", "--workers", "2", "--dask", "tcp://a"), "--dask: want it without --workers"),
    ],
)
def test_options_that_do_not_go_together(arguments, said, capsys):
    code, _, err = run(capsys, *arguments, *benchmark.GIVEN)
    assert code == 2
    assert said in " ".join(err.split())


def test_no_folder(tmp_path, capsys):
    code, _, err = run(capsys, "--fleet", tmp_path / "nowhere", *GIVEN, "-o", tmp_path / "a.jsonl")
    assert code == 1
    assert "--fleet: want a folder with a folder of photographs" in err
    code, _, err = run(capsys, "--fleet", tmp_path, *GIVEN, "-o", tmp_path / "a.jsonl")
    assert code == 1
    assert "found no folder in it" in err


def alike(one, other):
    """Whether documents are the same but for rounding, which depends on where in a process's memory numbers lie."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return one == pytest.approx(other, rel=1e-6, abs=1e-9, nan_ok=True)
    return one == other


@pytest.mark.slow
def test_processes_and_a_dask_cluster_give_the_same(fleet, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    alone, files = tmp_path / "alone.jsonl", [tmp_path / "processes.jsonl", tmp_path / "dask.jsonl"]
    run(capsys, "--fleet", fleet, *GIVEN, "-o", alone)
    run(capsys, "--fleet", fleet, *benchmark.GIVEN, "--workers", "2", "-o", files[0])
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        code, _, _ = run(
            capsys, "--fleet", fleet, *benchmark.GIVEN, "--dask", cluster.scheduler_address, "-o", files[1]
        )
    assert code == 0
    for file in files:
        for name, line in lines_of(file).items():
            for key in ("camera", "calibration", "error", "notes"):
                assert alike(line.get(key), lines_of(alone)[name].get(key)), key


def test_a_scheduler_that_does_not_answer_is_refused_soon(tmp_path, capsys, monkeypatch):
    """In words, and not after the half minute that dask waits."""
    monkeypatch.setattr(calibrating_fleet, "CONNECTS", 0.5)
    (tmp_path / "fleet" / "cam1").mkdir(parents=True)
    given = ["--board", "9x6", "--square", "25mm", "--dask", "tcp://127.0.0.1:9", "-o", str(tmp_path / "out.jsonl")]
    assert main(["calibrate", "--fleet", str(tmp_path / "fleet"), *given]) == 1
    assert "--dask: want the address of a scheduler that answers" in capsys.readouterr().err
