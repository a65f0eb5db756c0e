"""What a case does in each area: its command, the files that it may write, and the numbers that it states."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .cases import Case
from .judgement import Outcome, Reading, contents
from .processes import Ended, run, run_command, small_disk
from .sources import BOARD, Truth, source

COVERAGE_95 = 1.96  # half a 95 % interval in standard deviations
WRONG_FRAMES_SHARE = 0.05  # of the tracked frames whose range may be far outside its interval by chance
SPEED_OUTPUT = {"estimates.csv", "vehicles.csv", "summary.json", "report.html", "overlay.mp4", "plots"}
FOLLOW_OUTPUT = {"track.csv", "summary.json", "report.html"}
LIVE_OUTPUT = {"estimates.csv", "vehicles.csv", "summary.json", "report.html"}
USERS_FILE = "notes.txt"  # in the output folder; no run may touch it


@dataclass(frozen=True)
class Command:
    """A command in the folder of a case: its ``arguments``, the files that a run of it has ``written`` beside each
    other, and which files of its ``input`` it may change where it ends with status 0."""

    arguments: tuple[str, ...]
    written: frozenset[str]
    changes: tuple[str, ...] = ()
    adds: str = "(?!)"  # the names that it may add to the input, a regular expression


def command_of(case: Case) -> Command:
    rng = case.rng(2)
    match case.area:
        case "speed":
            more = ["--particles", str(int(rng.choice([100, 400])))]
            return Command(("speed", "clip", "-o", "disk/out", *more), frozenset(SPEED_OUTPUT))
        case "follow":
            overlay = rng.random() < 0.5
            output = FOLLOW_OUTPUT | ({"overlay.mp4"} if overlay else set())
            options = [] if overlay else ["--no-overlay"]
            return Command(("follow", "clip", "-o", "disk/out", *options), frozenset(output))
        case "calibrate":
            arguments = ("calibrate", "clip/left", "clip/right", "--board", BOARD, "-o", "disk/out/rig.yaml")
            return Command(arguments, frozenset({"rig.yaml", "rig.json", "rig.png"}))
        case "lanes":
            if rng.random() < 0.5:
                return Command(("lanes", "clip", "--in-place"), frozenset(), ("clip.yaml",), r"lanes-(left|right)\.png")
            written = {"site.yaml", "site-left.png", "site-right.png"}
            return Command(("lanes", "clip", "-o", "disk/out/site.yaml"), frozenset(written))
        case "vehicles":
            choice = rng.random()
            if choice < 0.6:
                return Command(("speed", "clip", "-o", "disk/out"), frozenset(SPEED_OUTPUT))
            if choice < 0.8:
                return Command(("vehicles", "clip", "--in-place"), frozenset(), ("clip.yaml",), r"vehicle-.*\.png")
            return Command(("vehicles", "clip"), frozenset())
        case "live":
            options = ("--live", "--background-seconds", "1.2")
            return Command(("speed", "clip", "-o", "disk/out", *options), frozenset(LIVE_OUTPUT))
    raise ValueError(case.area)


def run_case(case: Case, folder: Path, mounts: bool) -> Outcome:
    """Prepares, runs and looks at a command's case in an empty ``folder``."""
    recording, truth = source(case.area, case.scene_seed)
    prepared = folder / "prepared.json"

    def prepare() -> None:
        for k, fault in enumerate(case.faults):
            fault.apply(recording, case.rng(10 + k))
        recording.write(folder / "clip")
        prepared.write_text(json.dumps([recording.shown, recording.coding]))

    made = run(prepare, folder)
    if made.status:
        raise RuntimeError(f"{case}: the case itself failed:\n{made.stderr}")
    shown, _ = json.loads(prepared.read_text())
    command = command_of(case)
    disk = folder / "disk"
    disk.mkdir()
    full = case.disturbance.kind == "full disk" and mounts
    with small_disk(disk, case.disturbance.size) if full else nullcontext():
        if case.earlier_output:
            (disk / "out").mkdir()
            for name in (USERS_FILE, *sorted(command.written)[: case.area != "live"]):
                (disk / "out" / name).write_text("earlier")
        before = contents(folder / "clip"), contents(disk)
        ended = run_command(list(command.arguments), folder, case.disturbance)
        after = contents(folder / "clip"), contents(disk)
        readings: Sequence[Reading] = ()
        if ended.status in (0, 1) and not ended.hung:
            readings = READERS[case.area](ended, disk / "out", shown, truth)
    new, changed = changes(case, command, ended, before, after)
    new += [f"tmp/{name}" for name in contents(folder / "tmp")]
    complete = all(f"out/{name}" in after[1] for name in command.written)
    return Outcome(ended, tuple(readings), tuple(new), tuple(changed), complete)


Contents = tuple[dict[str, str], dict[str, str]]


def changes(
    case: Case, command: Command, ended: Ended, before: Contents, after: Contents
) -> tuple[list[str], list[str]]:
    """What is new and should not be, and what is no longer as it was and should be."""
    done = ended.status in (0, 1)
    new, changed = [], []
    for name in after[0].keys() - before[0].keys():
        if not (ended.status == 0 and re.fullmatch(command.adds, name)):
            new.append(f"clip/{name}")
    changed += [
        f"clip/{name}"
        for name, digest in before[0].items()
        if after[0].get(name) != digest and not (ended.status == 0 and name in command.changes)
    ]
    for name in after[1].keys() - before[1].keys():
        kept = case.area == "live" and name.startswith("out") and ".partial" not in name
        if not kept and (not done or ".partial" in name or not name.startswith("out")):
            new.append(name)
    for name, digest in before[1].items():
        replaced = done and name.removeprefix("out/") in command.written
        if after[1].get(name) != digest and not replaced:
            changed.append(name)
    return sorted(new), sorted(changed)


# --- what a run states ---------------------------------------------------------------------------------------------


def _read_speeds(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    """The measured speeds, beside the true mean speeds between the first and the last picture that was tracked."""
    vehicles, rows = _summary_vehicles(out), _rows(out / "estimates.csv")
    readings = []
    for vehicle in vehicles:
        tracked = {
            shown[0][int(row["frame"])]
            for row in rows
            if row["vehicle"] == vehicle["vehicle"] and row["status"] == "tracking"
        }
        pictures = sorted(k for k in tracked if np.isfinite(truth.speeds[k]))
        if vehicle["verdict"] == "measured":
            readings.append(_speed_reading(vehicle, mean_speed(truth, pictures)))
    return readings


def mean_speed(truth: Truth, pictures: Sequence[int]) -> float:
    """The mean speed (m/s) between the first and the last of the ``pictures``."""
    span = [k for k in range(pictures[0], pictures[-1] + 1) if np.isfinite(truth.speeds[k])] if pictures else []
    if len(span) < 2:
        return float(np.nanmean(truth.speeds))
    t, v = np.array(truth.times)[span], np.array(truth.speeds)[span]
    return float(np.trapezoid(v, t) / (t[-1] - t[0]))


def _read_live(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    """The measured speeds, each beside the nearest true one."""
    return [
        _speed_reading(v, min((speed for _, speed in truth.values), key=lambda true: abs(true - v["speed_mps"])))
        for v in _summary_vehicles(out)
        if v["verdict"] == "measured"
    ]


def _speed_reading(vehicle: dict[str, object], true: float) -> Reading:
    value, low, high = (float(str(vehicle[f"speed{key}_mps"])) for key in ("", "_lo", "_hi"))
    return Reading(f"speed of {vehicle['vehicle']}, m/s", value, low, high, true)


def _summary_vehicles(out: Path) -> list[dict[str, object]]:
    try:
        summary = json.loads((out / "summary.json").read_text())
    except (OSError, ValueError):
        return []
    return list(summary["vehicles"])


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def _read_ranges(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    """The worst range where more are wrong than chance explains."""
    if not (out / "track.csv").exists():
        return []
    readings = []
    for row in _rows(out / "track.csv"):
        if row["status"] == "tracking":
            z, half = float(row["z_m"]), COVERAGE_95 * float(row["z_std_m"])
            frame = int(row["frame"])
            readings.append(Reading(f"range in frame {frame}, m", z, z - half, z + half, truth.ranges[shown[0][frame]]))
    wrong = [reading for reading in readings if reading.wrong]
    if len(wrong) <= max(1, WRONG_FRAMES_SHARE * len(readings)):
        return [reading for reading in readings if not reading.wrong]
    return [max(wrong, key=lambda reading: abs(reading.value - reading.true))]


def _read_calibration(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    """The distance between the cameras, which scales every speed."""
    found = re.search(r"distance apart, m\s+([\d.]+)\s+±\s+([\d.]+)", ended.stdout)
    if found is None:
        return []
    ((name, true),) = truth.values
    value, half = map(float, found.groups())
    return [Reading(name, value, value - half, value + half, true)]


def _read_lanes(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    readings = []
    for text, spread in re.findall(r"^lane\S*\s+\S+–\S+\s+([\d.]+)\s+±\s+([\d.]+)", ended.stdout, re.MULTILINE):
        value, half = float(text), float(spread)
        true = min((width for _, width in truth.values), key=lambda width: abs(width - value))
        readings.append(Reading("lane width, m", value, value - half, value + half, true))
    return readings


def _read_vehicles(ended: Ended, out: Path, shown: list[list[int]], truth: Truth) -> list[Reading]:
    return _read_speeds(ended, out, shown, truth) if (out / "estimates.csv").exists() else []


Reader = Callable[[Ended, Path, list[list[int]], Truth], Sequence[Reading]]
READERS: dict[str, Reader] = {
    "speed": _read_vehicles,
    "follow": _read_ranges,
    "calibrate": _read_calibration,
    "lanes": _read_lanes,
    "vehicles": _read_vehicles,
    "live": _read_live,
}
