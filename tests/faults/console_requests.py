"""Hostile requests to the console's HTTP routes, over folders whose recordings and documents are damaged."""

from __future__ import annotations

import io
import json
import sys
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .cases import Case
from .documents import HOSTILE, TEXTS
from .judgement import Outcome, contents
from .processes import run
from .sources import source

REQUESTS = 14  # in a case
MAX_STATUS = 499  # what a client has done wrong; more is the server's own failure
VALUES: tuple[Any, ...] = (
    *(value for value in HOSTILE if not isinstance(value, float) or np.isfinite(value)),
    "road", "chase", "../secret", "road/../../secret", "road\0", "%2e%2e", "v0", "left", "right", 3, 4, 0.5, "speed",
)  # fmt: skip
Request = tuple[str, str, dict[str, Any], bytes]  # method, path, query and body


def run_console_case(case: Case, folder: Path) -> Outcome:
    """Asks the console of a damaged folder what a hostile page would ask."""

    def prepare() -> None:
        root = folder / "clips"
        root.mkdir()
        for area, name in (("speed", "road"), ("follow", "chase")):
            recording, _ = source(area, case.scene_seed)
            for k, fault in enumerate(case.faults):
                if area in fault.areas:
                    fault.apply(recording, case.rng(10 + k))
            recording.write(root / name)
        (folder / "secret").mkdir()
        (folder / "secret" / "secret.txt").write_text("secret")

    made = run(prepare, folder)
    if made.status:
        raise RuntimeError(f"{case}: the case itself failed:\n{made.stderr}")
    before = contents(folder / "clips"), contents(folder / "secret")
    ended = run(lambda: _ask(folder / "clips", requests(case)), folder)
    after = contents(folder / "clips"), contents(folder / "secret")
    left = [name for name in after[0].keys() - before[0].keys() if ".partial" in name or ".paceline-import" in name]
    recorded = [name for name in before[0] if not name.endswith(".yaml")]
    changed = [f"clips/{name}" for name in recorded if before[0][name] != after[0].get(name)]
    changed += [f"secret/{name}" for name in before[1] if before[1][name] != after[1].get(name)]
    left += [f"tmp/{name}" for name in contents(folder / "tmp")]
    return Outcome(ended, (), tuple(left), tuple(changed), complete=True)


def _ask(root: Path, asked: list[Request]) -> None:
    from console_client import SAME, open_client

    with open_client(root.resolve()) as client:
        key = ""
        for method, path, query, body in asked:
            path = path.replace("KEY", key or "none")
            try:
                answer = client.request(method, path, params=query, content=body, headers=SAME)
            except Exception:
                traceback.print_exc()
                print(f"{method} {path} {str(query)[:200]} {body[:200]!r}")
                sys.exit(1)
            print(answer.status_code, method, path, str(query)[:100], answer.text[:100].replace("\n", " "))
            if answer.status_code > MAX_STATUS or answer.text == "secret":
                print(f"Traceback: status {answer.status_code} of {method} {path} {query}", file=sys.stderr)
            if path == "/api/import" and answer.status_code == 200:
                key = answer.json()["key"]


def requests(case: Case) -> list[Request]:
    """Requests of a case: some begin, fill and finish an upload, the others are of any kind."""
    rng = case.rng(3)
    kinds = list(KINDS)
    return [KINDS[kinds[int(rng.integers(len(kinds)))]](rng) for _ in range(REQUESTS)]


def _any(rng: np.random.Generator) -> Any:
    return VALUES[int(rng.integers(len(VALUES)))]


def _mostly(rng: np.random.Generator, *usual: Any) -> Any:
    """One of the ``usual`` values, or any other."""
    return usual[int(rng.integers(len(usual)))] if rng.random() < 0.7 else _any(rng)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _query(rng: np.random.Generator, **usual: tuple[Any, ...]) -> dict[str, str]:
    return {
        key: _text(_mostly(rng, *values))[:2000].encode("utf-8", "replace").decode()
        for key, values in usual.items()
        if rng.random() < 0.95
    }


def _json(rng: np.random.Generator, value: Any) -> bytes:
    if rng.random() < 0.1:
        return TEXTS[int(rng.integers(len(TEXTS)))].encode("utf-8", "replace")
    return json.dumps(value).encode()


CLIPS = "road", "chase"
SQUARE = [[300, 200], [360, 200], [360, 240], [300, 240]]


def _path(rng: np.random.Generator) -> Any:
    line = [[100, 300], [200, 250], [300, 220]]
    return _mostly(
        rng, {"shape": _mostly(rng, "line", "curve"), "left": _mostly(rng, line), "right": _mostly(rng, line)}
    )


def _vehicle(rng: np.random.Generator) -> Any:
    entry = {"id": _mostly(rng, "v0"), "frame": _mostly(rng, 0, 1), "left": _mostly(rng, SQUARE), "right": SQUARE}
    if rng.random() < 0.5:
        entry["path"] = _mostly(rng, "lane0")
    return _mostly(rng, entry)


def _setup(rng: np.random.Generator) -> Any:
    return _mostly(
        rng,
        {
            "paths": _mostly(rng, {"lane0": _path(rng)}),
            "vehicles": _mostly(rng, [_vehicle(rng)]),
            "revision": _mostly(rng, "x"),
        },
    )


def _frame(rng: np.random.Generator) -> Request:
    return "GET", "/api/frame", _query(rng, clip=CLIPS, view=(0, 1), frame=(0, 1, 5)), b""


def _thumbnail(rng: np.random.Generator) -> Request:
    return "GET", "/api/thumbnail", _query(rng, clip=CLIPS), b""


def _epipolar(rng: np.random.Generator) -> Request:
    return "GET", "/api/epipolar", _query(rng, clip=CLIPS, view=(0, 1), x=(10, 1e300), y=(20, -5)), b""


def _snap(rng: np.random.Generator) -> Request:
    query = _query(rng, clip=CLIPS, view=(0, 1), frame=(0, 1), x=(10, 300), y=(20, 200), reach=(5, 1e8, -1))
    return "GET", "/api/snap", query, b""


def _get_setup(rng: np.random.Generator) -> Request:
    return "GET", str(rng.choice(["/api/setup", "/api/target"])), _query(rng, clip=CLIPS), b""


def _put_setup(rng: np.random.Generator) -> Request:
    return "PUT", "/api/setup", _query(rng, clip=CLIPS), _json(rng, _setup(rng))


def _check(rng: np.random.Generator) -> Request:
    return "POST", "/api/check", _query(rng, clip=CLIPS), _json(rng, _setup(rng))


def _propose(rng: np.random.Generator) -> Request:
    body = {"view": _mostly(rng, 0, 1), "frame": _mostly(rng, 0, 2)}
    body["entry"] = _mostly(rng, _vehicle(rng), _path(rng))
    if rng.random() < 0.5:
        body["path"] = _path(rng)
    return "POST", "/api/propose", _query(rng, clip=CLIPS), _json(rng, body)


def _begin(rng: np.random.Generator) -> Request:
    return "POST", "/api/import", {}, _json(rng, {"name": _mostly(rng, "new", "road"), "kind": _mostly(rng, "chase")})


def _send(rng: np.random.Generator) -> Request:
    slot = str(rng.choice(["left", "right", "rig", "video", "camera", "target", "x"]))
    name = str(
        rng.choice(["a.png", "a.zip", "rig.yaml", "../../a.png", "a.mp4", ".png", "camera.yaml", "x" * 300 + ".png"])
    )
    content = rng.bytes(int(rng.integers(300)))
    if rng.random() < 0.3:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for member in ("../../b.png", "/etc/c.png", "d.png", "e/" * 200 + "f.png"):
                archive.writestr(member, content)
        content = buffer.getvalue()[: int(rng.choice([-1, 100, 100000]))]
    elif rng.random() < 0.3:
        content = TEXTS[int(rng.integers(len(TEXTS)))].encode("utf-8", "replace")
    return "PUT", f"/api/import/KEY/{slot}", {"name": name}, content


def _finish(rng: np.random.Generator) -> Request:
    return str(rng.choice(["POST", "DELETE"])), "/api/import/KEY", {}, _json(rng, {"rate": _mostly(rng, 5, 25.0)})


def _rig(rng: np.random.Generator) -> Request:
    text = TEXTS[int(rng.integers(len(TEXTS)))]
    return "PUT", "/api/rig", _query(rng, clip=CLIPS), text.encode("utf-8", "replace")


def _run(rng: np.random.Generator) -> Request:
    """Requests that are refused, or ask about a run; none is begun."""
    if rng.random() < 0.5:
        body = {"kind": _any(rng), "options": _mostly(rng, {"particles": _any(rng)})}
        return "POST", "/api/run", _query(rng, clip=("none",)), _json(rng, body)
    return str(rng.choice(["GET", "DELETE"])), "/api/run", _query(rng, clip=CLIPS, number=(1, 2)), b""


def _results(rng: np.random.Generator) -> Request:
    clip, name = str(rng.choice(["cm9hZA", "Li4", "%%%", "w6Q", "AAAA"])), str(rng.choice(["report.html", "..", "x"]))
    place = str(
        rng.choice(
            [f"/results/{clip}/1/{name}", f"/results/{clip}/-1/pictures/..%2f.jpg", "/api/live", "/api/proposed"]
        )
    )
    return "GET", place, _query(rng, clip=CLIPS, number=(1,), frame=(0,), view=(0, 1)), b""


def _target(rng: np.random.Generator) -> Any:
    corners = {"a": [-1, -1], "b": [1, -1], "c": [1, 1], "d": [-1, 1]}
    segments = [["a", "b"], ["b", "c"], ["c", "d"], ["d", "a"]]
    usual = {"name": _mostly(rng, "van"), "nominal_range": _mostly(rng, 10.0)}
    return _mostly(rng, {**usual, "corners": _mostly(rng, corners), "segments": _mostly(rng, segments)})


def _start(rng: np.random.Generator) -> Any:
    return _mostly(rng, {"frame": _mostly(rng, 0), "center": _mostly(rng, [120, 120]), "scale": _mostly(rng, 1.0)})


def _put_target(rng: np.random.Generator) -> Request:
    body = {"target": _target(rng), "start": _start(rng), "revision": _mostly(rng, "x")}
    method, path = [("PUT", "/api/target"), ("POST", "/api/outline")][int(rng.integers(2))]
    return method, path, _query(rng, clip=("chase",)), _json(rng, body)


def _learn(rng: np.random.Generator) -> Request:
    body = {"frame": _mostly(rng, 0), "box": _mostly(rng, [90, 80, 160, 150], [0, 0, 1, 1], [1e8] * 4)}
    body |= {"width": _mostly(rng, 2.0, -1.0), "name": _mostly(rng, "van")}
    return "POST", "/api/learn", _query(rng, clip=("chase",)), _json(rng, body)


def _model(rng: np.random.Generator) -> Request:
    text = json.dumps(_target(rng)) if rng.random() < 0.5 else TEXTS[int(rng.integers(len(TEXTS)))]
    return "POST", "/api/model", _query(rng, clip=("chase",), frame=(0, 1)), text.encode("utf-8", "replace")


KINDS: dict[str, Callable[[np.random.Generator], Request]] = {
    f.__name__: f
    for f in (
        _frame, _thumbnail, _epipolar, _snap, _get_setup, _put_setup, _check, _propose, _begin, _send, _send, _finish,
        _rig, _run, _results, _put_target, _learn, _model,
    )
}  # fmt: skip
