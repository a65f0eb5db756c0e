"""What else a person does in the browser: follow a vehicle, survey live, draw by keys, come back to a draft."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny_chase
import yaml
from chromium import Tab
from console_served import CTRL, SHIFT, Console, consoled, needs_chromium, on_screen
from test_console_target_model import box_of
from test_survey_live import SPEEDS, survey_file
from tiny_clips import put_clip, rendered

from paceline.number_format import format_number
from paceline.units import COVERAGE_95

pytestmark = needs_chromium
EDITOR = "document.querySelector('pl-editor')"
# All that a page shows of a run under way, which may be over in a moment.
WATCHED = """(() => {
  window.scenes = [];
  const note = () => {
    const scene = document.querySelector('pl-live-view')?.getAttribute('scene');
    if (scene) window.scenes.push(scene);
  };
  const all = { subtree: true, childList: true, attributes: true, attributeFilter: ['scene'] };
  new MutationObserver(note).observe(document.body, all);
})()"""


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    with consoled(tmp_path_factory.mktemp("console")) as console:
        yield console


def complaints(tab: Tab) -> list[str]:
    """Of the browser, but for answers that a test means to get and prompts that nobody sees here."""
    return [c for c in tab.complaints() if not any(word in c for word in ("409", "422", "beforeunload"))]


def setup_of(tab: Tab) -> Any:
    return json.loads(tab.run(f"JSON.stringify([{EDITOR}.model.paths, {EDITOR}.model.vehicles])"))


@pytest.mark.slow
def test_a_vehicle_ahead_is_learned_from_a_box_and_followed(tmp_path: Path, console: Console) -> None:
    root, address, new = console
    tiny_chase.write(tmp_path, 40)
    tab = new()
    tab.size(1280, 800)
    tab.open(address)
    tab.click("Import a clip")
    tab.click("One camera behind a vehicle")
    images = sorted((tmp_path / "frames").iterdir())
    tab.drop_files("document.querySelector('pl-import dialog')", *images, tmp_path / "camera.yaml")
    tab.wait("document.querySelectorAll('.pl-slot.full').length === 2")
    tab.run("(() => { const i = document.querySelector('pl-import'); i.name.value = 'drive'; i.rate.value = '15';"
            " i.show(); })()")  # fmt: skip
    tab.click("Import")
    tab.wait_for("Drag a box tightly around the rear")
    tab.wait("!!document.querySelector('pl-target').views[0].image")
    x0, y0, x1, y1 = box_of(0)
    corners = [on_screen(tab, 0, p, "pl-target") for p in ([x0, y0], [x0 + 9, y0 + 9], [x1, y1])]
    tab.drag(*corners)
    assert tab.run("document.querySelector('pl-target').width.value") == ""
    tab.click("Learn the lines in the box")
    tab.wait_for("Enter the true width of the vehicle first")
    tab.run("Object.assign(document.querySelector('pl-target').width, { value: '2.0' })")
    tab.run("Object.assign(document.querySelector('pl-target').halfWidth, { value: '0.05' })")
    tab.click("Learn the lines in the box")
    tab.wait_for("lines learned")
    z = tiny_chase.truth(0)[2]
    tab.wait(f"Math.abs(document.querySelector('pl-target').projection?.range_m - {z}) < {0.02 * z}")

    before = tab.run("document.querySelector('pl-target').model.start.center")
    middle = [(x0 + x1) / 2, (y0 + y1) / 2]
    tab.drag(*(on_screen(tab, 0, [middle[0] + k, middle[1] + k], "pl-target") for k in (0, 4, 10)))
    moved = tab.run("document.querySelector('pl-target').model.start.center")
    assert np.subtract(moved, before) == pytest.approx([10, 10], abs=0.3)
    tab.key("z", CTRL)
    tab.key("ArrowRight", SHIFT)
    tab.key("]", SHIFT)
    nudged = tab.run("document.querySelector('pl-target').model.start")
    assert nudged["center"][0] == pytest.approx(before[0] + 2) and nudged["scale"] == pytest.approx(1.02)
    for _ in range(2):
        tab.click("Undo")
    count = len(tab.run("document.querySelector('pl-target').model.target.segments"))
    tab.key("n")
    tab.key("Delete")
    assert len(tab.run("document.querySelector('pl-target').model.target.segments")) == count - 1
    tab.click("Undo")
    tab.click("Save")
    tab.wait_for("Saved in follow.yaml. Next: follow.")
    saved = yaml.safe_load((root / "drive" / "follow.yaml").read_text())
    assert saved["target"] == "target.yaml" and saved["start"] == {"frame": 0, "center": before, "scale": 1.0}

    tab.click("Follow…")
    other = new()
    other.open(f"{address}/runs?clip=drive")
    tab.wait_for("Nothing measured yet")
    tab.run(WATCHED)
    tab.click("Start")
    tab.wait_for("Open the report")
    scenes = [json.loads(text) for text in tab.run("window.scenes")]
    assert scenes
    for scene in scenes:
        distance = float(scene["vehicles"][0]["label"].removeprefix("vehicle ahead").removesuffix("m"))
        assert distance == pytest.approx(tiny_chase.truth(scene["frame"])[2], abs=0.35)
    other.wait_for("Open the report")
    summary = json.loads((root / "drive" / "runs" / "0001" / "out" / "summary.json").read_text())
    distances = [tiny_chase.truth(k)[2] for k in range(40)]
    assert summary["tracked_share"] > 0.9
    for key, value in (("min", min(distances)), ("max", max(distances)), ("mean", np.mean(distances))):
        assert summary["range_m"][key] == pytest.approx(value, rel=0.03)
        assert format_number(summary["range_m"][key], 1) in tab.text()
    tab.wait("document.querySelectorAll('.pl-chart canvas').length > 0")
    tab.open(address)
    tab.wait_for("follows the vehicle ahead, 1 run")
    assert complaints(tab) == complaints(other) == []


@pytest.mark.slow
def test_a_survey_runs_until_it_is_stopped(console: Console) -> None:
    root, address, new = console
    survey_file(root / "survey")
    shutil.copytree(root / "survey", root / "gate")
    given = yaml.safe_load((root / "gate" / "clip.yaml").read_text())
    del given["rate"]
    (root / "gate" / "clip.yaml").write_text(yaml.safe_dump({**given, "left": "rtsp://me:secret@127.0.0.1:9/x"}))
    tab = new()
    tab.open(f"{address}/runs?clip=survey")
    tab.wait_for("vehicles are detected")
    tab.run("document.querySelector('.pl-settings .q-item').click()")
    tab.wait_for("Play it as a live stream")
    tab.run("document.querySelector('.q-checkbox').click()")
    tab.wait_for("This recording lasts 17.5 s, and 30 s of them would be used to estimate the background")
    tab.click("Start")
    assert not (root / "survey" / "runs").exists()
    field = "[...document.querySelectorAll('input')].find((e) => e.getAttribute('aria-label')?.startsWith('Estimate'))"
    tab.wait(f"{field}.offsetParent && ({field}.focus(), {field}.select(), true)")
    tab.call("Input.insertText", text="4")
    tab.wait("!document.querySelector('.pl-warning').offsetParent")
    tab.click("Start")
    tab.wait_for("Estimating the background")
    tab.wait("document.querySelector('pl-live-view')?.drawn")
    tab.wait("document.querySelectorAll('tbody tr').length > 0")
    tab.wait("[...document.querySelectorAll('.pl-recent img')].some((e) => e.naturalHeight === 240)")
    shown = "document.querySelector('pl-live-view').views[0].image"
    assert tab.run(f"[{shown}.width, {shown}.height]") == [480, 360]
    tab.click("Stop")
    tab.wait_for("Summary (JSON)")
    run = root / "survey" / "runs" / "0001"
    assert json.loads((run / "run.json").read_text())["state"] == "measured"
    vehicles = json.loads((run / "out" / "summary.json").read_text())["vehicles"]
    assert vehicles and "Open the report" in tab.text()
    assert len(vehicles) == tab.run("document.querySelector('tbody').children.length")
    for vehicle in vehicles:
        assert vehicle["reason"] or min(abs(speed - vehicle["speed_mps"]) for speed in SPEEDS) < 0.2
        assert f"{vehicle['seen_from_s']:.1f} to {vehicle['seen_to_s']:.1f}" in tab.text()

    tab.open(f"{address}/setup?clip=gate")
    tab.wait_for("The cameras are live")
    tab.open(f"{address}/runs?clip=gate")
    tab.wait_for("Live, from rtsp://127.0.0.1:9/x")
    tab.click("Start")
    tab.wait_for("could not be measured")
    tab.wait_for("rtsp://127.0.0.1:9/x: cannot be opened")
    assert "secret" not in tab.text()

    summary = json.loads((run / "out" / "summary.json").read_text())
    summary["vehicles"] = [{**vehicles[0], "vehicle": f"v{k}"} for k in range(1200)]
    summary["unmeasured"] = [{"reason": "<i>too small</i>"}] * 2
    (run / "out" / "summary.json").write_text(json.dumps(summary))
    pictures = run / "out" / "pictures"
    for k in (1197, 1198, 1199):
        shutil.copyfile(pictures / f"{vehicles[-1]['vehicle']}.jpg", pictures / f"v{k}.jpg")
    tab.open(f"{address}/runs?clip=survey")
    tab.wait_for("The last 1000 of 1200 vehicles; the files hold all of them.")
    assert "2 vehicles were seen, but not measured: <i>too small</i>" in tab.text() and "v1199" in tab.text()
    (run / "out" / "summary.json").write_text("[")
    tab.open(f"{address}/runs?clip=survey")
    tab.wait_for("survey/runs/0001/out/summary.json: is no summary of a measurement")
    assert str(root) not in tab.text() and complaints(tab) == []


def test_drafts_are_restored_and_conflicts_resolved(console: Console) -> None:
    root, address, new = console
    file = put_clip(root, "draft") / "clip.yaml"
    tab = new()
    tab.open(f"{address}/setup?clip=draft")
    tab.wait_for("width × height")
    tab.run(f"{EDITOR}.model.change((m) => {{ m.vehicles[0].speed = 17; }})")
    tab.reload()
    tab.wait_for("What you had drawn and not saved is back")
    assert setup_of(tab)[1][0]["speed"] == 17
    file.write_text(file.read_text() + "# a note\n")  # nothing that is drawn: it is saved beside it
    tab.key("s", CTRL)
    tab.wait_for("Saved in clip.yaml")
    assert "speed: 17" in file.read_text() and "# a note" in file.read_text()

    def changed_there(speed: int) -> None:
        file.write_text(file.read_text().replace("speed: 18", "speed: 17").replace("speed: 17", f"speed: {speed}"))

    tab.run(f"{EDITOR}.model.change((m) => {{ m.vehicles[0].speed = 18; }})")
    changed_there(21)
    before = file.read_bytes()
    tab.reload()  # the draft is of the file as it was before
    tab.wait_for("not saved is back")
    tab.key("s", CTRL)
    tab.wait_for("vehicle v0: changed in the file, changed here")
    tab.click("Decide later")
    assert file.read_bytes() == before and setup_of(tab)[1][0]["speed"] == 18
    tab.key("s", CTRL)
    tab.click("Take theirs")
    tab.wait_for("Undo brings back what you had drawn")
    assert setup_of(tab)[1][0]["speed"] == 21 and tab.run(f"!{EDITOR}.model.dirty")
    tab.wait("!document.querySelector('.pl-dialog')")  # keys are the dialog's until it has gone
    tab.key("z", CTRL)
    tab.wait(f"{EDITOR}.model.vehicles[0].speed === 18")
    changed_there(22)
    file.write_text(file.read_text().replace("speed: 21", "speed: 22"))
    tab.key("s", CTRL)
    tab.click("Keep mine")
    tab.wait_for("Saved in clip.yaml")
    assert "speed: 18" in file.read_text() and "speed: 22" not in file.read_text() and "# a note" in file.read_text()
    assert complaints(tab) == []


def test_a_vehicle_beside_its_lane_is_assigned_to_another_or_its_lane_centre_is_set(console: Console) -> None:
    """Each by one click; which side of the line the centre is on depends on the direction of travel."""
    root, address, new = console
    file = put_clip(root, "lanes") / "clip.yaml"
    given = yaml.safe_load(file.read_text())
    path = given["paths"]["lane0"]
    centre = path["lateral_offset"]
    given["paths"] = {"lane0": {**deepcopy(path), "lateral_offset": 0.0}, "lane1": path}
    file.write_text(yaml.safe_dump(given))
    tab = new()
    tab.size(1280, 800)
    tab.open(f"{address}/setup?clip=lanes")
    tab.wait_for("beside its lane centre")
    tab.click("Assign to lane1")
    tab.wait("!document.body.innerText.includes('Assign to')")
    assert setup_of(tab)[1][0]["path"] == "lane1" and "Set lane centre" not in tab.text()
    tab.click("Undo")
    tab.wait_for("Assign to lane1")
    (text,) = (line for line in tab.text().splitlines() if line.startswith("Set lane centre") and "approaching" in line)
    tab.click(text)
    tab.wait("!document.body.innerText.includes('Set lane centre')")
    offset = setup_of(tab)[0]["lane0"]["lateral_offset"]
    assert offset == pytest.approx(centre, abs=0.4) and f"Set lane centre to {format_number(offset, 2)} m" in text
    assert "beside its lane centre\n0.00 m" in tab.text()
    tab.click("Save")
    tab.wait_for("Saved in clip.yaml")
    assert yaml.safe_load(file.read_text())["paths"]["lane0"]["lateral_offset"] == offset and complaints(tab) == []


def test_pictures_fit_a_window_that_changes_its_size(console: Console) -> None:
    """The whole picture stays whole, and of a part the same remains in view."""
    root, address, new = console
    put_clip(root, "window")
    tab = new()
    tab.size(1280, 800)
    tab.open(f"{address}/setup?clip=window")
    tab.wait(f"!!{EDITOR}?.views?.[1].image")
    view = f"{EDITOR}.views[1]"
    for width, height in ((820, 700), (1500, 900)):
        before = tab.run(f"{view}.width")
        tab.size(width, height)
        tab.wait(f"{view}.width !== {before} && {view}.scale === {view}.fitting")
        corners = tab.run(f"[{view}.toScreen([-0.5, -0.5]), {view}.toScreen([639.5, 479.5])]")
        assert np.min(corners) > -1 and (np.array(corners[1]) < tab.run(f"[{view}.width + 1, {view}.height + 1]")).all()
    tab.run(f"{EDITOR}.show({{kind: 'vehicle', id: 0}})")
    tab.wait(f"{view}.fitted === {view}.fitting")  # what the vehicle's fields take of the page is done, too
    zoom, centre = tab.run(f"[{view}.scale / {view}.fitted, {view}.centre]")
    assert zoom > 2
    tab.size(1100, 760)
    tab.wait(f"{view}.fitted === {view}.fitting && {view}.width < 400")
    assert tab.run(f"{view}.scale / {view}.fitted") == pytest.approx(zoom)  # whatever size comes next
    assert tab.run(f"{view}.centre") == centre and complaints(tab) == []


def test_the_chart_draws_speeds_unrounded_on_an_axis_that_their_interval_deserves(console: Console) -> None:
    """And the outlines of a vehicle stand above the table, at their size."""
    root, address, new = console
    clip = put_clip(root, "chart")
    out = clip / "runs" / "0001" / "out"
    for folder in ("pictures", "outlines"):
        (out / folder).mkdir(parents=True)
        cv2.imwrite(str(out / folder / "v_0.jpg"), np.full((60, 120, 3), 90, np.uint8))
    record = {"clip": "", "number": 1, "kind": "speed", "options": [], "state": "measured", "created": 1.0}
    (out.parent / "run.json").write_text(json.dumps(record))
    measured = {"vehicle": "v 0", "speed_mps": 20.0, "speed_lo_mps": 19.9, "speed_hi_mps": 20.1, "verdict": "measured"}
    fast = {"vehicle": "v1", "speed_mps": 30.0, "speed_lo_mps": 29.9, "speed_hi_mps": 30.1, "verdict": "measured"}
    vehicles = [{**measured, "picture": "pictures/v_0.jpg"}, {**fast, "picture": None}]
    (out / "summary.json").write_text(json.dumps({"vehicles": vehicles, "notices": []}))
    speeds = [20 + 1e-4 * k for k in range(5)]
    rows = [f"{name},{k},{v},0.05,{v},0.05" for name, add in (("v 0", 0), ("v1", 10)) for k, v in enumerate(speeds)
            for v in (v + add,)]  # fmt: skip
    header = "vehicle,time_s,speed_mps,speed_std_mps,refined_speed_mps,refined_std_mps"
    (out / "estimates.csv").write_text("\n".join([header, *rows]) + "\n")
    tab = new()
    tab.size(1280, 1000)
    tab.open(f"{address}/runs?clip=chart&unit=m/s")
    tab.wait("document.querySelectorAll('.pl-chart canvas').length > 0")
    assert tab.wait("document.querySelector('.pl-outlines img')?.naturalWidth") == 120
    above = "document.querySelector('.pl-outlines').getBoundingClientRect().bottom"
    assert tab.run(f"{above} <= document.querySelector('table').getBoundingClientRect().top")
    assert tab.run("document.querySelector('.pl-outlines').innerText") == "v 0: 20.00 ± 0.10 m/s"
    chart = "getElement(Number(document.querySelector('.pl-chart').id.slice(1))).chart"
    drawn = tab.wait(f"{chart}?.getOption().series[2].data.map((point) => point[1])")
    assert drawn == speeds
    extent = f"{chart}.getModel().getComponent('yAxis').axis.scale.getExtent()"
    low, high = tab.run(extent)
    assert low < 19.9 and high > 30.1
    assert high - low == pytest.approx(1.1 * (10.0004 + 2 * 0.05 * COVERAGE_95))
    tab.run(f"{chart}.dispatchAction({{ type: 'legendUnSelect', name: 'v1' }})")
    low, high = tab.run(extent)
    assert high - low == pytest.approx(4 * 0.05 * COVERAGE_95) and (low + high) / 2 == pytest.approx(20.0002)
    assert complaints(tab) == []


def test_settings_show_their_default_range_and_unit(console: Console) -> None:
    """And beside a value that cannot be used, why; nothing is started with one."""
    root, address, new = console
    clip = put_clip(root, "settings")
    tab = new()
    tab.size(1280, 1100)
    tab.open(f"{address}/runs?clip=settings")
    tab.wait_for("Nothing measured yet")
    tab.run("document.querySelector('.pl-settings .q-item').click()")
    for hint in (
        "default: 400; at least 20, at most 1 000 000",
        "default: 0; at least 0",
        "default: along their paths",
        "default: none; above 0 mph",
        "default: that of the files, if any; above 0, at most 336 mph",
        "Play it as a live stream (default: no)",
        "default: mph",
    ):
        tab.wait_for(hint)
    for label, text, problem in (("Particles", "5", "equal to 20"), ("Largest", "0", "expected greater than 0"),
                                 ("Speed limit", "30", "expected a speed with its unit")):  # fmt: skip
        tab.run(f"document.querySelector('input[aria-label^=\"{label}\"]').focus()")
        tab.call("Input.insertText", text=text)
        tab.wait_for(problem)
    tab.click("Start")
    tab.wait_for("particles: expected greater than or equal to 20")
    assert not (clip / "runs").exists()
    tab.run("document.querySelector('.q-checkbox').click()")
    tab.wait_for("default: 30 s; at least 0, at most 3 600 s")
    tab.run("document.querySelectorAll('.q-select')[1].click()")
    tab.wait("!!document.querySelector('.q-menu')")
    tab.run("[...document.querySelectorAll('.q-menu .q-item')].find((e) => e.innerText === 'km/h').click()")
    tab.wait("document.querySelector('input[aria-label^=Largest]').getAttribute('aria-label').endsWith('km/h')")
    assert complaints(tab) == []


def test_a_search_is_resumed_after_a_reload(console: Console) -> None:
    """One that has ended meanwhile; and what it proposed is a draft like any other."""
    root, address, new = console
    file = put_clip(root, "search") / "clip.yaml"
    where = root / "search" / "runs" / "0007"
    (where / "asked" / "search").mkdir(parents=True)
    record = {"clip": "search", "number": 7, "kind": "vehicles", "options": [], "state": "measured", "created": 1.0}
    (where / "run.json").write_text(json.dumps(record))
    shutil.copyfile(file, where / "asked" / "search" / "clip.yaml")
    given = yaml.safe_load(file.read_text())
    (found,) = given.pop("vehicles")
    file.write_text(yaml.safe_dump(given))
    before = file.read_bytes()
    tab = new()
    tab.open(f"{address}/setup?clip=search")
    tab.wait_for("Now outline each vehicle")
    tab.run("sessionStorage.setItem('paceline search in search', JSON.stringify(['vehicles', 7]))")
    tab.call("Page.reload")
    tab.wait_for("1 proposed. Look at each outline closely")
    (drawn,) = setup_of(tab)[1]
    assert (drawn["frame"], drawn["left"], drawn["right"]) == (found["frame"], found["left"], found["right"])
    tab.reload()
    tab.wait_for("not saved is back")
    assert setup_of(tab)[1] == [drawn] and file.read_bytes() == before
    assert tab.run("sessionStorage.getItem('paceline search in search')") is None
    assert complaints(tab) == []


def test_leaving_an_import_asks_for_confirmation_and_removes_its_files(tmp_path: Path, console: Console) -> None:
    root, address, new = console
    (tmp_path / "cam.mp4").write_bytes(bytes(1000))
    tab = new()
    tab.open(address)
    tab.click("Import a clip")
    tab.run("window.XMLHttpRequest.prototype.send = () => {}")  # one that takes for ever
    for side in ("left", "right"):
        tab.choose_files(f"[data-slot={side}] input", tmp_path / "cam.mp4")
    tab.click("Import")
    tab.wait("document.querySelector('pl-import').key")
    assert list(root.glob(".paceline-import.*"))
    tab.reload()
    tab.wait("!document.querySelector('pl-import')?.key")
    end = time.monotonic() + 30
    while list(root.glob(".paceline-import.*")):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert any(e.get("method") == "Page.javascriptDialogOpening" for e in tab.events)
    assert complaints(tab) == []


def test_a_vehicle_is_outlined_by_keys_alone(console: Console) -> None:
    root, address, new = console
    file = put_clip(root, "keys") / "clip.yaml"
    given = yaml.safe_load(file.read_text())
    del given["vehicles"]
    file.write_text(yaml.safe_dump(given))
    corners = next(r for r in rendered().truth if r["frame"] == 0)["left"]
    tab = new()
    tab.size(1280, 800)
    tab.open(f"{address}/setup?clip=keys")
    tab.wait_for("direction known to")
    tab.wait(f"!!{EDITOR}.views[0].image")
    tab.key("s")
    tab.key("r")
    for corner in corners:
        tab.key("ArrowUp")
        for fine, least in ((0, 8.5), (SHIFT, 0.7)):
            while True:
                off = tab.run(f"[0, 1].map((i) => ({json.dumps(corner)}[i] - {EDITOR}.keyboard.cross.place[i])"
                              f" * {EDITOR}.views[0].scale)")  # fmt: skip
                axis = int(np.argmax(np.abs(off)))
                if abs(off[axis]) < least:
                    break
                names = ("ArrowLeft", "ArrowRight") if axis == 0 else ("ArrowUp", "ArrowDown")
                tab.key(names[off[axis] > 0], fine)
        tab.key(" ")
        tab.wait(f"({EDITOR}.draft?.points.length ?? 0) > 0 || {EDITOR}.model.vehicles.length > 0")
    tab.wait_for("width × height")
    (vehicle,) = setup_of(tab)[1]
    pixel = 1 / tab.run(f"{EDITOR}.views[0].scale")
    assert np.abs(np.array(vehicle["left"]) - corners).max() < 0.7 * pixel + 0.01
    tab.key("v")
    tab.key("n")
    tab.key("ArrowDown")
    assert setup_of(tab)[1][0]["left"][0][1] == pytest.approx(vehicle["left"][0][1] + 0.25)
    assert complaints(tab) == []


def test_a_read_only_folder_can_be_viewed(tmp_path: Path) -> None:
    """By an owner without the right to write, as on a disk that is mounted to be read."""
    before = []
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("the superuser may write everywhere")
        before = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]
    clips = tmp_path / "clips"
    put_clip(clips)
    out = clips / "road" / "runs" / "0001" / "out"
    out.mkdir(parents=True)
    record = {"clip": "road", "number": 1, "kind": "speed", "options": [], "state": "measured", "created": 1.0}
    (out.parent / "run.json").write_text(json.dumps(record))
    vehicle = {"vehicle": "v0", "speed_mps": 18.0, "speed_lo_mps": 17.9, "speed_hi_mps": 18.1, "frames": 5}
    vehicle["interval_from"] = "scatter"
    summary = {"vehicles": [{**vehicle, "verdict": "measured", "reason": ""}], "notices": []}
    (out / "summary.json").write_text(json.dumps(summary))
    (out / "estimates.csv").write_text("vehicle,time_s,speed_mps,speed_std_mps,refined_speed_mps,refined_std_mps\n")
    folders = [clips, *(p for p in clips.rglob("*") if p.is_dir())]
    for folder in folders:
        folder.chmod(0o500)
    try:
        with consoled(tmp_path, *before) as (_, address, new):
            tab = new()
            tab.open(address)
            tab.wait_for("1 vehicle, 1 path, 1 run")
            assert "This folder cannot be written" in tab.text() and "Import a clip" not in tab.text()
            tab.open(f"{address}/setup?clip=road")
            tab.wait_for("width × height")
            shown = set(tab.text().split("\n"))
            assert {"Results…", "Play"} <= shown and not {"Save", "Vehicle", "Propose lanes"} & shown
            tab.run(f"{EDITOR}.model.change((m) => {{ m.vehicles[0].speed = 9; }})")
            assert "speed" not in setup_of(tab)[1][0]
            tab.open(f"{address}/runs?clip=road")
            tab.wait_for("40.26 ± 0.22")
            assert "interval from scatter alone" in tab.text() and "95 %" not in tab.text()
            assert "Start" not in tab.text().split("\n")
            for method, where, body in (("POST", "run", {"kind": "speed"}), ("POST", "import", {"name": "x"}),
                                        ("PUT", "setup", {}), ("PUT", "target", {}), ("PUT", "rig", {})):  # fmt: skip
                asked = f"fetch('/api/{where}?clip=road', {{method: '{method}', body: '{json.dumps(body)}'}})"
                reason = tab.run(f"{asked}.then((a) => a.json()).then((a) => a.reason)")
                assert "cannot be written" in reason
            assert complaints(tab) == []
    finally:
        for folder in folders:
            folder.chmod(0o700)
