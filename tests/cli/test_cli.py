"""The command line as a whole: help, the version, mistakes, what it needs and what it loads."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import diffproj as dp
from diffproj import __main__, cli
from diffproj.cli.terminal import failure, in_options, rounded, sentence


def test_failures_name_options_of_the_command_line() -> None:
    with pytest.raises(dp.CalibrationError) as caught:
        dp.calibrate(dp.example_views("left"), dp.Chessboard(), max_iterations=1)
    assert failure(caught.value).startswith("--distortion: the error was still falling after 1 steps; choose a lens")
    assert failure(PermissionError(13, "Permission denied", "camera.json")) == (
        "camera.json: Permission denied; choose another place, or change who may use it"
    )


def test_remedies_name_options_of_the_command_line() -> None:
    said = "refine: take shape='free', distortion='auto' or distortion=brown8, or skew=True"
    assert in_options(said) == "take --shape free, --distortion auto or --distortion brown8, or --skew"


@pytest.mark.parametrize(
    ("said", "wanted"),
    [
        (
            'one is not enough; tilt it, or give priors={"focal": (value, deviation)} where it is known roughly',
            "tilt it",
        ),
        (
            "that is the board, give Chessboard(9, 6, ...). Check target, and that",
            "give --board 9x6. Check the board's",
        ),
        ("There is one of the legacy pattern: give legacy=True.", "give --legacy."),
        ("try distortion='brown8' or 'fisheye' ('auto' compares", "--distortion brown8 or fisheye (auto compares"),
        (
            "0.2 % larger: fixed=('k4', 'k5', 'k6') fits as well; fix them, or take a simpler lens",
            "larger; take a simpler",
        ),
    ],
)
def test_advice_that_the_command_line_cannot_take_is_left_out(said: str, wanted: str) -> None:
    told = failure(ValueError(said))
    assert wanted in told
    assert not any(python in told for python in ("priors", "fixed=", "Chessboard", "legacy=", "'fisheye'"))


def test_a_parameter_at_the_beginning_keeps_its_name() -> None:
    assert [sentence(text) for text in ("k4 stands", "f_x is", "the residuals")] == [
        "k4 stands",
        "f_x is",
        "The residuals",
    ]


def test_help_and_module(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["diffproj", "calibrate", "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(__main__.__file__, run_name="__main__")
    out, _ = capsys.readouterr()
    assert "inner corners, columns x rows" in out
    assert all(len(line) <= 80 for line in out.splitlines())
    with pytest.raises(SystemExit, match="0"):
        cli.main(["experiment", "--help"])
    assert "--strict" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        cli.main([])
    assert "COMMAND" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("value", "deviation", "texts"),
    [
        (533.1966, 0.4123, ("533.20", "0.41")),
        (-0.0000743, 0.000121, ("-0.00007", "0.00012")),
        (-16.54, 120.7, ("-17", "121")),
        (320.0, 0.0, ("320", "unknown")),
        (-49457625.0, 5927151112.0, ("-4.95e+07", "5.9e+09")),
    ],
)
def test_values_are_shown_as_far_as_they_are_known(value: float, deviation: float, texts: tuple[str, str]) -> None:
    assert rounded(value, deviation) == texts


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("running", "terminal"):
        monkeypatch.delitem(sys.modules, f"diffproj.cli.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "rich.console", None)
    monkeypatch.setattr(sys, "argv", ["diffproj", "calibrate", "photo.png", "--board", "9x6", "--square", "25"])
    assert __main__.main() == 1
    message = capsys.readouterr().err
    assert message.startswith(
        "diffproj: the command line needs rich: pip install rich, or, in the folder of diffproj's"
    )
    assert message.endswith("pip install '.[cli]'\n")  # as the README has it, for a clone


def test_missing_matplotlib_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr(dp, "figures")
    monkeypatch.delitem(sys.modules, "diffproj.figures")
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    monkeypatch.setattr(sys, "argv", ["diffproj", "experiment", "--output", str(tmp_path / "folder")])
    assert __main__.main() == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "the command line needs matplotlib" in err
    assert not (tmp_path / "folder").exists()


def test_missing_jinja_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    asked = ["calibrate", "photo.png", "--board", "9x6", "--square", "25", "--report", str(tmp_path / "report.html")]
    monkeypatch.setattr(sys, "argv", ["diffproj", *asked])
    assert __main__.main() == 1
    assert "the command line needs jinja2: pip install jinja2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["help"], 0, "find a camera from photographs of a board"),
        (["--help"], 0, "'diffproj help COMMAND' tells more about a command, with examples."),
        (["--version"], 0, f"diffproj {dp.__version__}\n"),
        (["calibrat"], 2, "invalid choice: 'calibrat' (choose from"),
        (["help", "nothing"], 2, "invalid choice: 'nothing'"),
        ([], 2, "the following arguments are required: COMMAND"),
        (["help", "measure"], 0, "The origin is the first inner corner"),
        (["calibrate", "--help"], 0, "Finds a camera from photographs of a board"),
        (["experiment", "--help"], 0, "--strict"),
        (
            ["measure", "photo.png", "--camera", "a.json", "--board", "9x6", "--points", "1,2"],
            2,
            "--square: want the side",
        ),
        (["calibrate", "photo.png", "--board", "9x6", "--square", "25km"], 2, "--square: want one of the units"),
        (["locate", "--help"], 0, "Four landmarks that do not lie on a line are enough"),
    ],
)
def test_help_and_mistakes_wait_for_nothing(arguments: list[str], code: int, text: str) -> None:
    program = (
        "import sys, diffproj; before = set(sys.modules); from diffproj import cli\n"
        f"try: cli.main({arguments})\n"
        "except SystemExit as error: code = error.code\n"
        "loaded = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "print(loaded & {'rich', 'matplotlib', 'torch'})\n"
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == code
    assert text in done.stdout + done.stderr
    assert done.stdout.endswith("set()\n")


def test_help_on_a_command_is_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for arguments in (["help", "measure"], ["measure", "--help"]):
        with pytest.raises(SystemExit, match="0"):
            cli.main(arguments)
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
    assert texts[0].startswith("usage: diffproj measure PHOTO --camera FILE")
