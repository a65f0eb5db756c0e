"""The command line as a person uses it: its table, its exit codes and its one-line errors."""

from __future__ import annotations

import csv
import errno
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from numba import njit
from numba.core import serialize
from numpy.typing import NDArray
from run_command import COMMAND, ENVIRONMENT, Done, assert_one_line_error, in_a_process, paceline

from paceline import cli
from paceline.commands.progress_output import compilation_notice
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write

pytestmark = pytest.mark.usefixtures("unrendered_plots")

SPEED = 20.0  # m/s


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small rendered clip of one vehicle, as files."""
    vehicle = Vehicle("v0", speed=SPEED, start_distance=60.0)
    scene = Scene(seed=5, vehicles=(vehicle,), image_size=(640, 480), focal=1400.0, frames=10)
    return write(render(scene), tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def measured(clip: Path) -> tuple[Done, Path]:
    """The command's answer for the clip's folder, and what it wrote."""
    out = clip.parent / "out"
    return in_a_process("speed", clip.parent, "-o", out, "--units", "m/s", "--seed", "1"), out


def test_a_clip_is_measured(measured: tuple[Done, Path]) -> None:
    done, out = measured
    assert done.returncode == 0, done.stderr
    header, row, *_ = done.stdout.splitlines()
    assert header.split("  ")[0].strip() == "vehicle" and "speed, m/s" in header
    assert row.startswith("v0") and "±" in row and row.endswith("measured")
    assert done.stdout.rstrip().endswith(str(out / "report.html"))
    (vehicle,) = json.loads((out / "summary.json").read_text())["vehicles"]
    assert vehicle["verdict"] == "measured"
    assert vehicle["speed_mps"] == pytest.approx(SPEED, rel=0.02)
    assert vehicle["speed_lo_mps"] < vehicle["speed_mps"] < vehicle["speed_hi_mps"]
    with (out / "estimates.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(r["frame"]) for r in rows] == list(range(len(rows))) and len(rows) >= 8
    assert (out / "report.html").stat().st_size > 50_000
    assert (out / "overlay.mp4").stat().st_size > 5_000
    assert not [p for p in out.parent.iterdir() if p.name.startswith(".")]


def test_what_is_compiled_is_a_line_for_people_and_a_line_each_for_programs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with compilation_notice(True):
        for number in (1, 1.0):
            njit(lambda x: x + 1)(number)
    assert capsys.readouterr().err == "compiling, once after an upgrade; it takes up to a minute\n"
    with compilation_notice(False):
        njit(lambda x: x + 2)(1)
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("PACELINE_PROGRESS", "lines")
    with compilation_notice(False):
        for number in (1, 1.0):
            njit(lambda x: x + 3)(number)
    assert capsys.readouterr().err == "progress: compiling 1 ?\nprogress: compiling 2 ?\n"


@pytest.mark.slow
def test_after_a_warm_up_nothing_is_compiled(clip: Path, tmp_path: Path) -> None:
    environment = {**ENVIRONMENT, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PACELINE_PROGRESS": "lines"}

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [*COMMAND, *map(str, arguments)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)

    assert "functions compiled" in run("warm-up").stdout
    assert "nothing to compile" in run("warm-up").stdout
    found = yaml.safe_load((clip.parent / "clip.yaml").read_text()) | {"vehicles": []}
    (clip.parent / "found.yaml").write_text(yaml.safe_dump(found))
    chase = Path(__file__).parents[1] / "examples" / "chase" / "follow.yaml"
    for arguments in (["speed", clip], ["speed", clip.parent / "found.yaml"], ["follow", chase, "--no-overlay"]):
        assert "progress: compiling" not in run(*arguments, "-o", tmp_path / "out").stderr


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are listed by Linux")
def test_with_one_core_a_single_thread_computes(clip: Path, measured: tuple[Done, Path], tmp_path: Path) -> None:
    command = [*COMMAND, "speed", clip, "-o", tmp_path / "out", "--seed", "1", "--quiet", "--cores", "1"]
    process = subprocess.Popen(list(map(str, command)), env=ENVIRONMENT)
    ticks: dict[str, int] = {}
    while process.poll() is None:
        with suppress(OSError):  # threads end
            for file in Path(f"/proc/{process.pid}/task").glob("*/stat"):
                values = file.read_text().rpartition(")")[2].split()
                ticks[file.parent.name] = int(values[11]) + int(values[12])
        time.sleep(0.02)
    of_main = ticks.pop(str(process.pid))
    assert process.returncode == 0 and sum(ticks.values()) < 0.02 * of_main
    assert (tmp_path / "out" / "estimates.csv").read_bytes() == (measured[1] / "estimates.csv").read_bytes()


def test_a_live_survey_needs_two_cores(clip: Path, tmp_path: Path) -> None:
    done = paceline("speed", clip, "-o", tmp_path / "out", "--live", "--cores", "1")
    assert_one_line_error(done, "--cores 1: --live", "expected 2 or more")


def test_the_same_seed_gives_the_same_result(clip: Path, measured: tuple[Done, Path], tmp_path: Path) -> None:
    """In another process than before."""
    done = paceline("speed", clip, "-o", tmp_path / "again", "--seed", "1", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "again" / "estimates.csv").read_bytes() == (measured[1] / "estimates.csv").read_bytes()


def test_options_reach_the_configuration(clip: Path, tmp_path: Path) -> None:
    options = ["--particles", "150", "--feature-parts", "6", "--motion", "free", "--no-refine", "--seed", "3"]
    done = paceline("speed", clip, "-o", tmp_path / "out", *options)
    assert done.returncode in (0, 1), done.stderr
    configuration = json.loads((tmp_path / "out" / "summary.json").read_text())["configuration"]
    expected = {"particles": 150, "parts": 6, "motion": "free", "refine": False, "seed": 3}
    assert {key: configuration[key] for key in expected} == expected
    with (tmp_path / "out" / "estimates.csv").open(newline="") as stream:
        assert {row["refined_speed_mps"] for row in csv.DictReader(stream)} == {""}


def test_a_limit_is_judged_by_the_interval(small_clip: Path, tmp_path: Path) -> None:
    """Stated by the clip for its path, and by the command line, which wins."""
    document = yaml.safe_load(small_clip.read_text())
    document["paths"]["lane0"]["limit"] = "30 m/s"
    stated = small_clip.with_name("stated.yaml")
    stated.write_text(yaml.safe_dump(document))
    for options, shown, compliance in (
        ([], "within 108 km/h", "within"),
        (["--limit", "20 mph"], "over 32.2 km/h", "over"),
    ):
        done = paceline("speed", stated, "-o", tmp_path, "--method", "sift", "--units", "km/h", *options)
        assert done.returncode == 0, done.stderr
        header, row, *_ = done.stdout.splitlines()
        assert row[header.index("limit") :].startswith(shown)
        (vehicle,) = json.loads((tmp_path / "summary.json").read_text())["vehicles"]
        assert vehicle["compliance"] == compliance
        assert shown in (tmp_path / "report.html").read_text()
    assert vehicle["limit_mps"] == pytest.approx(20 * 0.44704)


def test_nothing_measured_is_status_1_with_the_reason(clip: Path, tmp_path: Path) -> None:
    """A vehicle first outlined in the last frame cannot be measured; the outputs say so."""
    document = yaml.safe_load(clip.read_text())
    document["vehicles"][0]["frame"] = 9
    late = clip.parent / "late.yaml"
    late.write_text(yaml.safe_dump(document))
    done = paceline("speed", late, "-o", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    assert "rejected: " in done.stdout
    (vehicle,) = json.loads((tmp_path / "out" / "summary.json").read_text())["vehicles"]
    assert vehicle["verdict"] == "rejected" and vehicle["reason"]
    assert "Rejected: " in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_an_interrupt_leaves_nothing_behind(clip: Path, tmp_path: Path) -> None:
    command = [*COMMAND, "speed", str(clip), "-o", str(tmp_path / "out"), "--particles", "20000"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.iterdir()) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert (process.returncode, stdout, stderr) == (130, "", "paceline: interrupted\n")
    assert list(tmp_path.iterdir()) == []


@njit
def _pair() -> tuple[NDArray[np.float64], float]:
    return np.ones(2), 1.0


@pytest.mark.usefixtures("signals_as_before")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_while_compiled_code_calls_python(
    number: int, status: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Numba asks Python for the type of an array in a tuple that it returns; what is raised there is a SystemError."""

    def ended(data: bytes) -> None:
        signal.raise_signal(number)

    _pair()
    monkeypatch.setattr(serialize, "_unpickled_memo", {})
    monkeypatch.setattr(serialize.cloudpickle, "loads", ended)
    monkeypatch.setattr(cli, "app", lambda **options: _pair())
    with pytest.raises(SystemExit) as exit:
        cli.main()
    assert exit.value.code == status
    assert capfd.readouterr().err == ("paceline: interrupted\n" if status == 130 else "")


@pytest.mark.usefixtures("signals_as_before")
def test_an_error_that_an_interrupt_became_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of compiled code that builds models and asks nobody what was raised within."""

    def building(**options: object) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ValueError("no schema") from None

    monkeypatch.setattr(cli, "app", building)
    with pytest.raises(SystemExit) as exit:
        cli.main()
    assert (exit.value.code, capsys.readouterr().err) == (130, "paceline: interrupted\n")


@pytest.mark.usefixtures("signals_as_before")
@pytest.mark.parametrize(
    "allocate",
    [
        lambda: np.empty(1 << 60, np.uint8),
        lambda: cv2.resize(np.zeros((9, 9), np.uint8), (1 << 29, 1 << 29)),
        lambda: _raise(av.error.MemoryError(errno.ENOMEM, "Cannot allocate memory")),
        lambda: _raise(av.error.BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")),
        lambda: _raise(RuntimeError("can't start new thread")),
    ],
    ids=["NumPy", "OpenCV", "FFmpeg", "FFmpeg's threads", "threads"],
)
def test_memory_that_runs_out_is_one_line(
    allocate: Callable[[], object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", lambda **options: allocate())
    with pytest.raises(SystemExit) as exit:
        cli.main()
    line = "paceline: there is not enough memory; expected more, or a shorter recording\n"
    assert (exit.value.code, capsys.readouterr().err) == (2, line)


def _raise(error: Exception) -> None:
    raise error


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_after_the_work_does_nothing(tmp_path: Path, number: int) -> None:
    program = f"import atexit, signal\nfrom paceline import cli\natexit.register(signal.raise_signal, {number})\n"
    command = [sys.executable, "-c", program + "cli.app = lambda **_: 0\ncli.main()"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_standard_output_that_cannot_be_written_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([*COMMAND, "--version"], env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, timeout=60)
    assert done.returncode == 0
    assert done.stderr == b"paceline: standard output cannot be written (No space left on device)\n"


def test_without_standard_output_nothing_is_printed() -> None:
    shell = f"{shlex.join([*COMMAND, '--version'])} >&-"
    done = subprocess.run(shell, shell=True, env=ENVIRONMENT, capture_output=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_a_reader_that_has_gone_is_no_problem() -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([*COMMAND, "--version"], env=ENVIRONMENT, stdout=write, stderr=subprocess.PIPE, timeout=60)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


def test_another_system_error_is_no_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**options: object) -> None:
        raise SystemError("broken") from ValueError("cause")

    monkeypatch.setattr(cli, "app", broken)
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    with pytest.raises(SystemError, match="broken"):
        cli.main()


def test_an_output_that_is_a_file(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    assert_one_line_error(paceline("speed", clip, "-o", tmp_path / "out"), "out", "is a file")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev")
def test_an_unwritable_output(clip: Path) -> None:
    assert_one_line_error(paceline("speed", clip, "-o", "/dev/full/out"), "/dev/full/out", "cannot be written")


def test_a_clip_that_is_missing(tmp_path: Path) -> None:
    done = paceline("speed", tmp_path / "absent.yaml", "-o", tmp_path / "out")
    assert_one_line_error(done, "absent.yaml")
    assert_one_line_error(paceline("speed", tmp_path, "-o", tmp_path / "out"), "clip.yaml")
    assert list(tmp_path.iterdir()) == []


def test_a_clip_with_an_unknown_key(clip: Path, tmp_path: Path) -> None:
    wrong = clip.parent / "wrong.yaml"
    wrong.write_text(clip.read_text().replace("vehicles:", "vehicels:"))
    assert_one_line_error(paceline("speed", wrong, "-o", tmp_path / "out"), "vehicels", "vehicles")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["command"]),
        (["spede"], ["spede"]),
        (["speed"], ["CLIP"]),
        (["speed", "c"], ["--out"]),
        (["speed", "c", "-o", "o", "--unknown"], ["--unknown"]),
        (["speed", "c", "-o", "o", "--particles", "0"], ["--particles 0", "expected greater"]),
        (["speed", "c", "-o", "o", "--particles", "many"], ["--particles", "integer"]),
        (["speed", "c", "-o", "o", "--seed", "-1"], ["--seed -1", "expected greater"]),
        (["speed", "c", "-o", "o", "--feature-parts", "0"], ["--feature-parts 0", "expected"]),
        (["speed", "c", "-o", "o", "--max-half-width", "0", "--units", "km/h"], ["--max-half-width 0", "km/h above 0"]),
        (["speed", "c", "-o", "o", "--limit", "30"], ["--limit", "expected a speed with its unit, such as 30 mph"]),
        (["speed", "c", "-o", "o", "--motion", "zigzag"], ["--motion", "zigzag", "auto"]),
        (["speed", "c", "-o", "o", "--device", "tpu"], ["--device", "cpu"]),
        (["speed", "c", "-o", "o", "--device", "cuda", "--method", "sift"], ["--device cuda", "use --device cpu"]),
        (["speed", "c", "-o", "o", "--units", "knots"], ["--units", "knots", "mph", "km/h", "m/s"]),
    ],
)
def test_wrong_options(arguments: list[str], words: list[str], tmp_path: Path) -> None:
    assert_one_line_error(paceline(*arguments, folder=tmp_path), *words)
    assert list(tmp_path.iterdir()) == []


def test_version_and_help() -> None:
    from paceline import __version__

    assert in_a_process("--version").stdout == f"paceline {__version__}\n"
    done = paceline("speed", "--help")
    assert done.returncode == 0
    for option in (
        "--particles",
        "--seed",
        "--motion",
        "--device",
        "--units",
        "--feature-parts",
        "--no-refine",
        "--max-half-width",
        "--limit",
    ):
        assert option in done.stdout


def test_help_imports_nothing_heavy() -> None:
    """So that it answers at once."""
    code = "import sys, paceline.cli; sys.exit(any(m in sys.modules for m in ('numpy', 'cv2', 'numba', 'pydantic')))"
    assert subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT).returncode == 0
