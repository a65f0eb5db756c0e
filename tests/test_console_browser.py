"""The whole way in a real browser, against the real command: import, set up, measure, read; and many tabs at once."""

from __future__ import annotations

import csv
import itertools
import json
import signal
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from console_served import CTRL, SHIFT, Console, consoled, halted, needs_chromium, on_screen, serving
from run_command import assert_one_line_error, paceline
from tiny_clips import put_clip, rendered

from paceline.reports.common.formatting import format_speed, format_speed_number


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return put_clip(tmp_path_factory.mktemp("recording"))


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    with consoled(tmp_path_factory.mktemp("console")) as console:
        yield console


@needs_chromium
def test_from_import_to_report(recording: Path, console: Console) -> None:
    (root, address, new), truth = console, next(r for r in rendered().truth if r["frame"] == 0)
    tab = new()
    tab.size(1280, 800)
    tab.open(address)
    tab.wait_for("There is no clip in this folder yet")

    tab.click("Import a clip")
    for side in ("left", "right"):
        tab.choose_files(f"[data-slot={side}] input", *sorted((recording / side).iterdir()))
    tab.drop_files("document.querySelector('[data-slot=rig]')", recording / "rig.yaml")
    tab.wait("document.querySelectorAll('.pl-slot.full').length === 3")
    evil = "<img src=x onerror=alert(1)>"
    for name in (evil, "north"):  # the first is refused, for its < and >
        tab.run(f"(() => {{ const i = document.querySelector('pl-import'); i.name.value = {json.dumps(name)};"
                " i.rate.value = '5'; i.show(); })()")  # fmt: skip
        tab.click("Import")
        if name == evil:
            tab.wait("document.querySelector('.pl-error').innerText.includes('expected at most')")
    tab.wait_for("Draw a road line that the vehicles follow")
    assert yaml.safe_load((root / "north" / "clip.yaml").read_text()) == {
        "left": "left", "right": "right", "rate": 5, "rig": "rig.yaml",
    }  # fmt: skip

    line = rendered().clip["paths"]["lane0"]["left"]
    tab.wait("!!document.querySelector('pl-editor').views[1].image")
    tab.key("s")  # the points go where they are put
    tab.click("Road line")
    for point in sorted(line, key=lambda p: -p[1])[::4]:
        tab.drag(on_screen(tab, 0, point))
    tab.key("Enter")
    tab.wait_for("Proposed in the right view")
    tab.wait_for("direction known to")
    tab.key("r")
    corners = truth["left"]
    tab.run("document.querySelector('pl-editor').show({kind: 'path', id: 'lane0'})")
    for point in corners:
        tab.drag(on_screen(tab, 0, point))
    tab.wait_for("width × height")
    tab.key("v")
    tab.drag(on_screen(tab, 0, corners[0]))
    tab.key("ArrowLeft", SHIFT)
    nudged = tab.run("document.querySelector('pl-editor').model.vehicles[0].left[0]")
    assert nudged[0] == pytest.approx(corners[0][0] - 2, abs=0.7)
    tab.key("z", CTRL)
    tab.key("s", CTRL)
    tab.wait_for("Saved in clip.yaml. Next: measure.")
    assert "primary" in tab.run("document.querySelector('pl-editor').measureButton.className")
    saved = yaml.safe_load((root / "north" / "clip.yaml").read_text())
    (vehicle,) = saved["vehicles"]
    assert vehicle["path"] == "lane0" and vehicle["frame"] == 0
    for side in ("left", "right"):
        assert np.abs(np.array(vehicle[side]) - truth[side]).max() < 1.5

    tab.click("Measure…")
    tab.wait_for("Nothing measured yet")
    other = new()
    other.open(f"{address}/runs?clip=north")
    other.wait_for("Nothing measured yet")
    tab.drag(tab.place("document.querySelector('.pl-settings .q-item')"))
    tolerance = "document.querySelector('input[aria-label^=Largest]')"
    tab.wait(f"{tolerance}?.offsetHeight > 0")
    tab.run(f"{tolerance}.focus()")
    tab.call("Input.insertText", text="5")
    tab.run("document.querySelector('input[aria-label^=\"Speed limit\"]').focus()")
    tab.call("Input.insertText", text="30 mph")
    tab.click("Start")
    other.wait_for("Cancel")  # every tab sees it
    with halted(root / "north", lambda: "Close-up of v0" in other.text()):
        tab.call("Page.reload")
        tab.wait_for("Close-up of v0")
        tab.wait_for("Cancel")
        scenes = [
            json.loads(t.run("document.querySelector('pl-live-view').getAttribute('scene')")) for t in (tab, other)
        ]
        other.click("Close-up of v0")
    tab.wait_for("Open the report")
    other.wait_for("measured")
    with (root / "north" / "runs" / "0001" / "out" / "estimates.csv").open(newline="") as stream:
        filtered = {int(row["frame"]): row for row in csv.DictReader(stream)}
    for scene in scenes:
        (shown,), row = scene["vehicles"], filtered[scene["frame"]]
        speed = format_speed_number(float(row["speed_mps"]), "mph") if row["speed_mps"] else ""
        assert shown["label"] == f"v0  {speed} mph" if speed else "v0"
        corners = [[float(row[f"left_{axis}{k}"]) for axis in "xy"] for k in (1, 2, 3, 4)]
        assert np.abs(np.array(shown["outlines"][0]) - corners).max() < 0.06
        assert np.abs(np.array(shown["particles"][0]) - np.mean(corners, axis=0)).max() < 5
    summary = json.loads((root / "north" / "runs" / "0001" / "out" / "summary.json").read_text())
    assert summary["configuration"]["tolerance"] == pytest.approx(5 * 0.44704, rel=1e-3)
    (entry,) = summary["vehicles"]
    assert entry["verdict"] == "measured" and entry["speed_mps"] == pytest.approx(18.0, abs=0.5)
    tab.wait("[...document.querySelectorAll('.pl-thumbnail')].some((i) => i.naturalWidth > 0)")
    assert "approaching" in tab.text() and "lane0" in tab.text() and "Every vehicle (CSV)" in tab.text()
    assert entry["compliance"] == "over" and "over 30 mph" in tab.text()
    text = format_speed(*(entry[key] for key in ("speed_mps", "speed_lo_mps", "speed_hi_mps")), "mph")
    assert str(text) in tab.text() and text.ends in tab.text()
    tab.wait("document.querySelectorAll('.pl-chart canvas').length > 0")
    report = tab.run("[...document.links].find((a) => a.innerText === 'Open the report').href")
    tab.open(report)
    tab.wait_for("v0")
    assert f"{entry['speed_mps'] / 0.44704:.1f}" in tab.text()
    tab.open(address)
    tab.wait_for("last run")

    complaints = [c for t in (tab, other) for c in t.complaints() if "422" not in c]
    assert complaints == []
    asked = {a for t in (tab, other) for a in t.addresses() if not a.startswith(("data:", "blob:", "about:"))}
    assert asked and all(a.startswith(address) for a in asked)
    assert sorted(p.name for p in root.iterdir()) == ["north"]


@needs_chromium
def test_text_from_files_is_escaped(console: Console) -> None:
    """Names of vehicles, paths and folders, and reasons made from YAML, are shown as they are and never run."""
    evil = "<img src=x onerror=window.hit=1>"
    root, address, new = console
    clip = put_clip(root, f"a {evil}")
    given = yaml.safe_load((clip / "clip.yaml").read_text())
    path = given["paths"]["lane0"]
    given["vehicles"][0] |= {"id": evil, "path": evil}
    (clip / "clip.yaml").write_text(yaml.safe_dump(given | {"paths": {evil: path}}))
    broken = put_clip(root, "broken")
    (broken / "clip.yaml").write_text(yaml.safe_dump({**given, evil: 1}))
    out = clip / "runs" / "0001" / "out"
    out.mkdir(parents=True)
    record = {"clip": "", "number": 1, "kind": "speed", "options": [], "state": "measured", "created": 1.0}
    (out.parent / "run.json").write_text(json.dumps(record))
    vehicle = {"vehicle": evil, "speed_mps": 20.0, "speed_lo_mps": 19.0, "speed_hi_mps": 21.0, "frames": 5}
    summary = {"vehicles": [vehicle | {"verdict": "measured", "reason": evil}], "notices": [evil]}
    (out / "summary.json").write_text(json.dumps(summary))
    header = "vehicle,time_s,speed_mps,speed_std_mps,refined_speed_mps,refined_std_mps\n"
    (out / "estimates.csv").write_text(header + f"{evil},0,20,1,20,1\n{evil},1,20,1,20,1\n")
    (out / "report.html").write_text("<script>document.title = 'hit'</script><p>report</p>")
    tab = new()
    tab.open(address)
    tab.wait("document.querySelectorAll('.pl-card').length >= 2 && document.body.innerText.includes('unreadable')")
    assert tab.text().count(evil) >= 2
    links = tab.run("[...document.querySelectorAll('.pl-card')].map((a) => a.href)")
    tab.open(next(link for link in links if "/runs" in link and "onerror" in link))
    tab.wait("document.querySelectorAll('.pl-chart canvas').length > 0")
    assert tab.text().count(evil) >= 4
    tab.mouse("mouseMoved", tab.place("document.querySelector('.pl-chart')"))
    time.sleep(0.3)
    assert not tab.run("window.hit || document.querySelectorAll('img[src=x]').length")
    report = tab.run("[...document.links].find((a) => a.innerText === 'Open the report').href")
    tab.click("Set up")
    tab.wait(f"document.body.innerText.includes('width × height') && {json.dumps(evil)}")
    tab.run("document.querySelectorAll('.ed-item button')[1].click()")
    assert not tab.run("window.hit || document.querySelectorAll('img[src=x]').length")
    tab.open(report)
    tab.wait_for("report")
    assert tab.run("document.title") != "hit"


@needs_chromium
def test_corners_clicked_in_any_order_are_sorted(console: Console) -> None:
    _, address, new = console
    tab = new()
    tab.open(address)
    tab.wait_for("Clips")
    quads = [
        [[10, 10], [50, 12], [49, 31], [11, 30]],
        [[0, 0], [9, 4], [9, 50], [0, 60]],
        [[5, 0], [9, 1], [6, 9], [1, 8]],
    ]
    for quad in quads:
        for order in itertools.permutations(quad):
            script = f"import('/static/model.js').then((m) => m.sortedCorners({json.dumps(order)}))"
            assert tab.run(script) == quad, order


def test_a_console_is_served_with_a_token_and_ends_cleanly(tmp_path: Path) -> None:
    root = tmp_path / "clips"
    root.mkdir()
    with serving(root, "--host", "0.0.0.0", cwd=root) as (printed, process):
        where, token = printed.split("/?token=")
        port = where.rsplit(":", 1)[1]
        assert len(token) >= 32
        for query, status in (("", 403), ("?token=no", 403), (f"?token={token}", 200)):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/{query}") as answer:
                    assert answer.status == status and "paceline-token" in answer.headers["set-cookie"]
            except urllib.error.HTTPError as error:
                assert error.code == status
        done = paceline("console", "--no-browser", tmp_path, "--port", port, "--host", "0.0.0.0")
        assert_one_line_error(done, f"--port {port}", "cannot be used")
        assert_one_line_error(paceline("console", "--no-browser", root, "--port", 0), "another console serves")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert list(root.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], ["nowhere", "is no folder"]),
        (["x" * 300], ["xxx", "cannot be read"]),
        ([".", "--host", "192.0.2.1"], ["--host 192.0.2.1", "cannot be used"]),
        ([".", "--host", "no such host"], ["--host no such host", "cannot be used"]),
        ([".", "--port", "70000"], ["--port", "65535"]),
    ],
)
def test_an_unusable_folder_or_address_is_a_one_line_error(
    tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    assert_one_line_error(paceline("console", "--no-browser", *arguments, folder=tmp_path), *words)


def test_a_cycle_of_links_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert_one_line_error(paceline("console", "--no-browser", tmp_path / "loop"), "loop", "cannot be read")


def test_without_nicegui_the_error_names_the_package_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)  # as where it is not installed
    done = paceline("console", "--no-browser", folder=tmp_path)
    assert_one_line_error(done, "the console needs NiceGUI; install it with: pip install 'paceline[console]'")


def test_the_static_files_are_in_the_package() -> None:
    from importlib import resources

    names = {file.name for file in (resources.files("paceline.console") / "static").iterdir()}
    assert {"console.css", "editor.js", "importer.js"} <= names
