"""Detectors of the user's own: what they put out, read as boxes, and vehicles that are found and measured in them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from run_command import assert_one_line_error, paceline
from tiny_road import TWO, scene

from paceline.detection.background_model import BOX_MARGIN_SHARE, DetectorBackground
from paceline.detection.detector import Detection, PlaneSweepDetector
from paceline.detection.onnx_detector import OnnxDetector
from paceline.detection.onnx_outputs import MAX_BOXES
from paceline.detection.search import find_vehicles
from paceline.documents.loading import load_clip
from paceline.errors import UnusableInput
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.simulation.stereo.clip import RenderedClip, render, write

Image = NDArray[np.float32]

SIZE = (320, 160)  # of the input of a small network, which sees a picture of 640 × 480 px at a third of its size
CELLS = 40 * 20 + 20 * 10 + 10 * 5  # of 8, 16 and 32 px
BOX = np.array([20.0, 10.0, 60.0, 40.0])  # in the input; left, top, right, bottom
SHOWN = 3 * BOX  # in the picture
CAR = {0: "person", 1: "Police car", 2: "car wheel"}


# --- networks --------------------------------------------------------------------------------------------------------


def saved(
    file: Path,
    nodes: list[onnx.NodeProto],
    constants: dict[str, NDArray[Any]],
    outputs: dict[str, tuple[int, list[int | str]]],
    inputs: dict[str, tuple[int, list[int | str]]],
    names: object = None,
) -> Path:
    graph = helper.make_graph(
        nodes,
        "detector",
        [helper.make_tensor_value_info(name, *of) for name, of in inputs.items()],
        [helper.make_tensor_value_info(name, *of) for name, of in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    if names is not None:
        helper.set_model_props(model, {"names": repr(names)})
    onnx.checker.check_model(model)
    onnx.save(model, file)
    return file


def bright(
    file: Path,
    tables: dict[str, NDArray[Any]],
    scores: dict[str, tuple[int, ...]],
    names: object = None,
    kind: int = TensorProto.FLOAT,
    shape: tuple[int | str, ...] = (1, 3, SIZE[1], SIZE[0]),
) -> Path:
    """A network whose outputs are ``tables``, with the mean of its input at ``scores``."""
    nodes = [
        helper.make_node("Cast", ["picture"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["numbers"], ["mean"], keepdims=0),
    ]
    constants: dict[str, NDArray[Any]] = {}
    for name, table in tables.items():
        if name not in scores:
            constants[f"{name}0"] = table
            nodes.append(helper.make_node("Identity", [f"{name}0"], [name]))
            continue
        there = np.zeros(table.shape, np.float32)
        there[scores[name]] = 1.0
        constants |= {f"{name}0": table, f"{name}1": there}
        nodes.append(helper.make_node("Mul", [f"{name}1", "mean"], [f"{name}2"]))
        nodes.append(helper.make_node("Add", [f"{name}0", f"{name}2"], [name]))
    outputs = {name: (helper.np_dtype_to_tensor_dtype(t.dtype), list(t.shape)) for name, t in tables.items()}
    return saved(file, nodes, constants, outputs, {"picture": (kind, list(shape))}, names)


def centred(box: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([(box[:2] + box[2:]) / 2, box[2:] - box[:2]])


def rows(file: Path, **more: Any) -> Path:
    """As end-to-end detectors put out: a car, as a car wheel, too low a score."""
    table = np.zeros((1, 5, 6), np.float32)
    table[0, 0] = [*BOX, 0.0, 1]
    table[0, 1] = [*BOX + 50, 0.9, 2]
    table[0, 2] = [*BOX + 70, 0.2, 1]
    return bright(file, {"output0": table}, {"output0": (0, 0, 4)}, **{"names": CAR, **more})


def classes(file: Path, **more: Any) -> Path:
    """Rows of a centre, a size and a score for each class, one below the other."""
    table = np.zeros((1, 7, 50), np.float32)
    table[0, :4, 8] = centred(BOX)
    table[0, :, 9] = [*centred(BOX + 50), 0.9, 0.8, 0.1]
    return bright(file, {"output0": table}, {"output0": (0, 5, 8)}, **{"names": CAR, **more})


def objects(file: Path, **more: Any) -> Path:
    """A score for there being anything, and of COCO's classes, without names: a lorry, a person."""
    table = np.zeros((1, 3 * CELLS, 85), np.float32)
    table[0, 8, :4] = centred(BOX)
    table[0, 8, 5 + 7] = 1.0
    table[0, 9, :6] = [*centred(BOX + 50), 0.9, 0.9]
    return bright(file, {"output": table}, {"output": (0, 8, 4)}, **more)


def one_class(file: Path, **more: Any) -> Path:
    """As `objects`, of a single class: six columns, too."""
    table = np.zeros((1, 3 * CELLS, 6), np.float32)
    table[0, 8] = [*centred(BOX), 0.0, 1.0]
    return bright(file, {"output": table}, {"output": (0, 8, 4)}, **more)


def lists(file: Path, **more: Any) -> Path:
    """Boxes, labels and scores apart, of a picture without the axis of a batch."""
    tables = {
        "scores": np.array([0.0, 0.9, 0.1], np.float32),
        "boxes": np.stack([BOX, BOX + 50, BOX + 70]).astype(np.float32),
        "labels": np.array([1, 0, 1]),
    }
    shape = (3, SIZE[1], SIZE[0])
    return bright(file, tables, {"scores": (0,)}, **{"names": CAR, "shape": shape, **more})


def by_cell(file: Path, **more: Any) -> Path:
    """Places within cells and logarithms of sizes in them: of a cell of 16 px in its second row and third column."""
    table = np.zeros((1, CELLS, 7), np.float32)
    table[0, :, 2:4] = -1.0
    x, y, width, height = centred(BOX) / 16
    table[0, 40 * 20 + 20 + 2] = [x - 2, y - 1, np.log(width), np.log(height), 0.0, 0.1 / 255, 1.0 / 255]
    return bright(file, {"output": table}, {"output": (0, 40 * 20 + 20 + 2, 4)}, **more)


def decoded(file: Path, **more: Any) -> Path:
    """As `by_cell`, but with places and sizes in pixels."""
    table = np.ones((1, CELLS, 7), np.float32)
    table[0, :, 4:] = 0.0
    table[0, 8] = [*centred(BOX), 0.0, 0.1 / 255, 1.0 / 255]
    return bright(file, {"output": table}, {"output": (0, 8, 4)}, **more)


def something(file: Path, **more: Any) -> Path:
    """As `decoded`, of a network that sees something everywhere, and white as 1."""
    table = np.ones((1, CELLS, 7), np.float32)
    table[0, :, 5:] = 0.0
    table[0, 8, :4] = centred(BOX)
    return bright(file, {"output": table}, {"output": (0, 8, 6)}, **more)


def shares(file: Path, **more: Any) -> Path:
    """As `rows`, but shares of the input's size; and what is no box."""
    table = np.zeros((1, 7, 6), np.float32)
    table[0, 0] = [*BOX / np.tile(SIZE, 2), 0.0, 1]
    for k, box in enumerate(
        [[0.2, 0.2, 0.2, 0.4], [0.4, 0.2, 0.2, 0.4], [np.nan, 0, 1, 1], [0, 0, np.inf, 1]], start=1
    ):
        table[0, k] = [*box, 0.9, 1]
    table[0, 5] = [0, 0, 1, 1, np.nan, 1]
    return bright(file, {"output0": table}, {"output0": (0, 0, 4)}, **{"names": CAR, **more})


Network = Callable[..., Path]


@pytest.mark.parametrize("network", [rows, classes, objects, one_class, lists, by_cell, decoded, something, shares])
@pytest.mark.parametrize("kind", [TensorProto.FLOAT, TensorProto.FLOAT16])
def test_boxes_are_read_from_every_layout(tmp_path: Path, network: Network, kind: int) -> None:
    """Each finds its box where the picture, of other proportions than its input, has at least a quarter of white."""
    detect = OnnxDetector(network(tmp_path / "model.onnx", kind=kind))
    padding = 114 / 2  # fills the right half of the input
    for grey, found in ((0, 0), (128, 1)):
        assert ((grey / 2 + padding) / 255 >= 0.25) == bool(found)
        boxes = detect(np.full((480, 480), grey, np.float32))
        np.testing.assert_allclose(boxes, np.reshape([SHOWN] * found, (-1, 4)), rtol=2e-3, atol=0.1)


def test_an_input_of_any_size_is_as_large_as_usual(tmp_path: Path) -> None:
    detect = OnnxDetector(rows(tmp_path / "model.onnx", shape=("batch", 3, "height", "width")))
    np.testing.assert_allclose(detect(np.full((640, 1280), 200, np.float32)), [2 * BOX])
    assert detect.name.startswith("model.onnx (SHA-256 ")


def test_without_names_every_class_counts_where_none_is_known(tmp_path: Path) -> None:
    detect = OnnxDetector(rows(tmp_path / "model.onnx", names=None))
    assert len(detect(np.full((480, 640), 200, np.float32))) == 2  # the wheel, too


def test_of_countless_boxes_those_count_that_score_best(tmp_path: Path) -> None:
    table = np.zeros((1, 5, 20_000), np.float32)
    table[0, :4] = np.tile(centred(BOX), (20_000, 1)).T
    table[0, 4] = np.linspace(0.3, 0.9, 20_000)
    table[0, :2, -1] += 8.0  # the best one lies elsewhere
    boxes = OnnxDetector(bright(tmp_path / "model.onnx", {"output0": table}, {}))(np.zeros((480, 960), np.float32))
    np.testing.assert_allclose(boxes, [SHOWN + 24.0] + [SHOWN] * (MAX_BOXES - 1), rtol=1e-5)


def contrast(file: Path, gain: float, side: int = 320, box: float = 24.0) -> Path:
    """A network that boxes, ``box`` px wide, every cell of 8 px of its input whose contrast is large enough."""
    count = side // 8
    y, x = np.mgrid[:count, :count].reshape(2, 1, 1, -1) * 8.0 + 4.0
    sizes = np.full((1, 2, count**2), box)
    pool = {"kernel_shape": [8, 8], "strides": [8, 8]}
    nodes = [
        helper.make_node("ReduceMean", ["picture"], ["grey"], axes=[1], keepdims=1),
        helper.make_node("AveragePool", ["grey"], ["mean"], **pool),
        helper.make_node("Mul", ["grey", "grey"], ["squares"]),
        helper.make_node("AveragePool", ["squares"], ["square"], **pool),
        helper.make_node("Mul", ["mean", "mean"], ["of mean"]),
        helper.make_node("Sub", ["square", "of mean"], ["variance"]),
        helper.make_node("Mul", ["variance", "gain"], ["score"]),
        helper.make_node("Reshape", ["score", "shape"], ["scores"]),
        helper.make_node("Concat", ["boxes", "scores"], ["output0"], axis=1),
    ]
    constants = {
        "gain": np.float32(gain),
        "shape": np.array([1, 1, count**2]),
        "boxes": np.concatenate([x, y, sizes], axis=1).astype(np.float32),
    }
    outputs = {"output0": (TensorProto.FLOAT, [1, 5, count**2])}
    return saved(file, nodes, constants, outputs, {"picture": (TensorProto.FLOAT, [1, 3, side, side])}, {0: "car"})


def test_boxes_lie_in_the_picture_where_the_network_saw_them(tmp_path: Path) -> None:
    detect = OnnxDetector(contrast(tmp_path / "model.onnx", 100.0, box=8.0))
    picture = np.full((480, 640), 114, np.float32)
    picture[192:320, 400:528] += 100 * np.random.default_rng(1).choice([-1, 1], (128, 128))
    boxes = detect(picture)
    np.testing.assert_allclose([*boxes[:, :2].min(0), *boxes[:, 2:].max(0)], [400, 192, 528, 320], atol=17)  # a cell
    assert len(boxes) >= 60
    np.testing.assert_array_equal(detect(picture), boxes)
    fewer = OnnxDetector(tmp_path / "model.onnx", min_score=4.0)(picture)
    assert 0 < len(fewer) < len(boxes)


# --- what cannot be used ---------------------------------------------------------------------------------------------


def unlike(file: Path) -> Path:
    return bright(file, {"heat": np.zeros((1, 20, 40, 2), np.float32)}, {"heat": (0, 0, 0, 0)})


def with_inputs(file: Path, **inputs: tuple[int, list[int | str]]) -> Path:
    nodes = [helper.make_node("Identity", ["rows0"], ["rows"])]
    table = np.zeros((1, 5, 6), np.float32)
    return saved(file, nodes, {"rows0": table}, {"rows": (TensorProto.FLOAT, [1, 5, 6])}, inputs)


def named(file: Path, text: str) -> Path:
    """A detector with a ``text`` for its names."""
    model = onnx.load(rows(file, names=None))
    helper.set_model_props(model, {"names": text})
    onnx.save(model, file)
    return file


def parted(file: Path) -> Path:
    """A detector whose numbers lay in another file."""
    model = onnx.load(rows(file))
    onnx.save(model, file, save_as_external_data=True, location="numbers.bin", size_threshold=0)
    file.with_name("numbers.bin").unlink()
    return file


def cut(file: Path) -> Path:
    whole = rows(file).read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    return file


PICTURE: tuple[int, list[int | str]] = (TensorProto.FLOAT, [1, 3, 160, 320])
UNUSABLE: dict[str, tuple[Network, list[str]]] = {
    "missing": (lambda file: file, ["no such file", "ONNX"]),
    "not ONNX": (lambda file: file.write_text("left: left.mp4\n") and file, ["cannot be read", "ONNX"]),
    "outputs": (unlike, ["heat (1, 20, 40, 2)", "expected one output (1, N, 6)", "boxes (N, 4)"]),
    "two inputs": (
        lambda file: with_inputs(file, images=PICTURE, sizes=(TensorProto.INT64, [1, 2])),
        ["images (1, 3, 160, 320) float, sizes (1, 2) int64", "expected one picture", "(1, 3, height, width)"],
    ),
    "flat input": (lambda file: with_inputs(file, images=(1, [1, 1000])), ["images (1, 1000)", "expected one picture"]),
    "no input": (with_inputs, ["inputs none", "expected one picture"]),
    "bytes": (
        lambda file: with_inputs(file, images=(TensorProto.UINT8, PICTURE[1])),
        ["images (1, 3, 160, 320) uint8", "floating-point"],
    ),
    "more classes": (lambda file: classes(file, names=["car"]), ["names 1 classes", "outputs have 3"]),
    "four pictures": (
        lambda file: with_inputs(file, images=(1, [4, 3, 160, 320])),
        ["(4, 3, 160, 320)", "one picture"],
    ),
    "colours last": (
        lambda file: with_inputs(file, images=(1, [1, "height", "width", 3])),
        ["(1, height, width, 3)", "(1, 3, height, width)"],
    ),
    "endless": (lambda file: with_inputs(file, images=(1, [1, 3, 10**6, 10**6])), ["(1, 3, 1000000", "one picture"]),
    "folder": (lambda file: file.mkdir() or file, ["is no file", "ONNX"]),
    "empty": (lambda file: file.write_bytes(b"") or file, ["cannot be read", "ONNX"]),
    "cut": (cut, ["cannot be read", "ONNX"]),
    "parted": (parted, ["cannot be read", "numbers.bin"]),
    "text": (lambda file: named(file, "person, car"), ["names: person, car: expected such as {0: 'person', 1: 'car'}"]),
    "nest": (lambda file: named(file, "-" * 100_000), ["names: ---", "expected such as"]),
    "infinite": (lambda file: named(file, "{1e999: 'car'}"), ["names: {1e999", "expected such as"]),
    "long": (lambda file: named(file, repr(["cat\x1b" * 9999])), ["names: catcat", "…; expected some vehicles"]),
    "no vehicle": (lambda file: rows(file, names=["cat", "dog"]), ["names: cat, dog", "expected some vehicles"]),
}


@pytest.mark.parametrize("network, words", UNUSABLE.values(), ids=list(UNUSABLE))
def test_file_without_a_detector_is_refused_in_one_line(tmp_path: Path, network: Network, words: list[str]) -> None:
    file = network(tmp_path / "model.onnx")
    done = paceline("speed", clip_file(tmp_path / "clip"), "-o", tmp_path / "out", "--detector", file)
    assert_one_line_error(done, "model.onnx", *words)
    assert not (tmp_path / "out").exists()


def test_lists_of_different_lengths_are_refused(tmp_path: Path) -> None:
    """Of a bright picture this one puts out fewer scores than boxes."""
    tables = {"boxes": np.tile(BOX, (9, 1)).astype(np.float32), "labels": np.ones(9, int)}
    nodes = [helper.make_node("Identity", [f"{name}0"], [name]) for name in tables]
    nodes += [
        helper.make_node("ReduceMean", ["picture"], ["mean"], keepdims=0),
        helper.make_node("Less", ["mean", "half"], ["dark"]),
        helper.make_node("Where", ["dark", "all", "few"], ["count"]),
        helper.make_node("Slice", ["scores0", "none", "count"], ["scores"]),
    ]
    counts = {"none": np.array([0]), "few": np.array([4]), "all": np.array([9])}
    constants = {f"{name}0": table for name, table in tables.items()}
    constants |= {"scores0": np.ones(9, np.float32), "half": np.float32(0.6), **counts}
    outputs: dict[str, tuple[int, list[int | str]]] = {
        "boxes": (TensorProto.FLOAT, [9, 4]),
        "labels": (TensorProto.INT64, [9]),
        "scores": (TensorProto.FLOAT, ["N"]),
    }
    detect = OnnxDetector(saved(tmp_path / "model.onnx", nodes, constants, outputs, {"picture": PICTURE}))
    assert len(detect(np.zeros((480, 960), np.float32))) == 9
    with pytest.raises(UnusableInput, match=r"model\.onnx: outputs .*scores \(4\).*unlike those for a plain picture"):
        detect(np.full((480, 960), 255, np.float32))


def test_without_onnx_runtime_the_message_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UnusableInput, match=r"needs ONNX Runtime; install it with: pip install 'paceline\[detector\]'"):
        OnnxDetector(rows(tmp_path / "model.onnx"))


def test_outlines_leave_nothing_to_detect(tmp_path: Path) -> None:
    file = write(two(), tmp_path / "clip")
    done = paceline("speed", file, "-o", tmp_path / "out", "--detector", rows(tmp_path / "model.onnx"))
    assert_one_line_error(done, "clip.yaml", "vehicles", "--detector", "expected none")


# --- the scene -------------------------------------------------------------------------------------------------------


def test_background_in_a_box_is_inverted() -> None:
    rng = np.random.default_rng(2)
    views = [rng.uniform(0, 255, (60, 80)).astype(np.float32) for _ in range(2)]
    boxes = [np.array([[20.0, 10.0, 40.0, 30.0]]), np.array([[60.0, 40.0, 120.0, 55.0], [5.0, 9.0, 2.0, 3.0]])]
    expected = [np.s_[9:31, 19:41], np.s_[39:56, 57:80]]  # a twentieth larger on every side, within the picture
    assert BOX_MARGIN_SHARE == 0.05
    given = iter(boxes)
    before = DetectorBackground(lambda picture: next(given)).background(
        StereoFrame(0, 0.0, views[0], views[1], 0.0, False)
    )
    for view, then, part in zip(views, before.images, expected, strict=True):
        changed = np.zeros(view.shape, bool)
        changed[part] = True
        np.testing.assert_array_equal(view[~changed], then[~changed])
        assert np.corrcoef(view[changed], then[changed])[0, 1] == pytest.approx(-1.0, abs=1e-5)
        assert then[changed].mean() == pytest.approx(view[changed].mean(), abs=0.01)


def test_the_noise_is_that_between_two_frames() -> None:
    rng = np.random.default_rng(3)
    still = rng.uniform(0, 255, (480, 640)).astype(np.float32)
    frames = [
        StereoFrame(k, 0.1 * k, (still + rng.normal(0, 2.5, still.shape)).astype(np.float32), still, 0.0, False)
        for k in range(2)
    ]
    seen = DetectorBackground(lambda picture: np.zeros((0, 4)))
    assert "in none of 0 images" in seen.no_vehicle_reason
    assert seen.background(frames[0]).noise is None
    seen.update(frames[0])
    assert seen.background(frames[1]).noise == pytest.approx(2.5, rel=0.05)


# --- whole clips -----------------------------------------------------------------------------------------------------


@cache
def one() -> RenderedClip:
    return render(scene())


@cache
def two() -> RenderedClip:
    return render(scene(*TWO))


def clip_file(folder: Path, rendered: RenderedClip | None = None, **keys: Any) -> Path:
    """A clip of two vehicles without outlines."""
    file = write(rendered or two(), folder)
    document = {**yaml.safe_load(file.read_text(encoding="utf-8")), **keys}
    for key in ("vehicles", *(["times"] if "rate" in keys else [])):
        document.pop(key, None)
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    return file


def summary_of(out: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary


@pytest.mark.usefixtures("unrendered_plots")
def test_a_vehicle_in_boxes_is_found_and_measured(tmp_path: Path) -> None:
    file, model, out = clip_file(tmp_path / "clip", one()), contrast(tmp_path / "model.onnx", 300.0), tmp_path / "out"
    done = paceline("speed", file, "-o", out, "--detector", model)
    assert done.returncode == 0, done.stderr
    summary = summary_of(out)
    (vehicle,) = summary["vehicles"]
    assert vehicle["verdict"] == "measured" and vehicle["speed_lo_mps"] < 16.0 < vehicle["speed_hi_mps"]
    assert summary["configuration"]["detector"].startswith("model.onnx (SHA-256 ")
    assert summary["versions"]["onnxruntime"]


def test_where_nothing_is_boxed_nothing_is_measured(tmp_path: Path) -> None:
    file, model, out = clip_file(tmp_path / "clip"), contrast(tmp_path / "model.onnx", 1e-3), tmp_path / "out"
    done = paceline("speed", file, "-o", out, "--detector", model)
    assert done.returncode == 1, done.stderr
    why = f"no vehicle was found: the detector saw a vehicle in none of {2 * len(two().left)} images"
    assert "no vehicle was found" in done.stdout and why in done.stderr
    assert summary_of(out)["vehicles"] == [] and why in summary_of(out)["notices"] and (out / "report.html").exists()


def test_boxes_in_which_nothing_moves_have_a_reason_of_their_own(tmp_path: Path) -> None:
    clip = load_clip(clip_file(tmp_path / "clip"))
    views = iter([np.array([[0.0, 0.0, 9.0, 9.0]]), np.zeros((0, 4))] * len(two().left))
    reason = find_vehicles(clip, open_recording(clip), detect=lambda picture: next(views)).reason
    count = len(two().left)
    assert reason.startswith(f"the detector saw a vehicle in {count} of {2 * count} images, but nothing that")


def test_noise_of_the_first_frame_comes_from_the_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, given = load_clip(clip_file(tmp_path / "clip")), []

    def detect(self: PlaneSweepDetector, frame: StereoFrame, empty: object, noise: float | None) -> list[Detection]:
        given.append(noise)
        return []

    monkeypatch.setattr(PlaneSweepDetector, "detect", detect)
    find_vehicles(clip, open_recording(clip), detect=lambda picture: np.zeros((0, 4)))
    assert len(given) == len(two().left) and given[0] == given[1] and None not in given


def test_what_is_found_in_boxes_is_outlined_in_the_clip(tmp_path: Path) -> None:
    file, model = clip_file(tmp_path / "clip", one()), contrast(tmp_path / "model.onnx", 300.0)
    done = paceline("vehicles", file, "--in-place", "--detector", model)
    assert done.returncode == 0, done.stderr
    assert [vehicle.id for vehicle in load_clip(file).vehicles] == ["v0"]
    nothing = contrast(tmp_path / "nothing.onnx", 1e-3)
    done = paceline("vehicles", clip_file(tmp_path / "again", one()), "--detector", nothing)
    assert done.returncode == 1 and "the detector saw a vehicle in none of" in done.stdout


def test_a_vehicle_without_a_box_in_one_view_is_not_found(tmp_path: Path) -> None:
    """And what has one in both is found where the recording is too short to estimate the background."""
    first = {side: getattr(two(), side)[:4] for side in ("left", "right", "times", "right_times")}
    clip = load_clip(clip_file(tmp_path / "clip", replace(two(), **first)))
    everywhere, nowhere = np.array([[0.0, 0.0, *clip.rig.left.image_size]]), np.zeros((0, 4))
    for right, found in ((everywhere, True), (nowhere, False)):
        views = iter([everywhere, right] * 4)
        search = find_vehicles(clip, open_recording(clip), detect=lambda picture: next(views))  # noqa: B023
        assert bool(search.detected) == found and next(views, None) is None
    assert "only 4 frames" in find_vehicles(clip, open_recording(clip)).reason


@pytest.mark.slow
def test_live_with_a_detector_needs_no_background(tmp_path: Path) -> None:
    file, out = clip_file(tmp_path / "clip", rate=2.0), tmp_path / "out"
    model = contrast(tmp_path / "model.onnx", 300.0)
    done = paceline("speed", file, "-o", out, "--live", "--detector", model)
    assert done.returncode == 0, done.stderr
    assert "estimating" not in done.stdout and "2 of 2 vehicles measured" in done.stdout
    summary = summary_of(out)
    configuration = summary["configuration"]
    assert configuration["background"]["seconds"] == configuration["learn"] == 0.0
    speeds = sorted(v["speed_mps"] for v in summary["vehicles"])
    assert speeds == pytest.approx([13.0 * 2 / 5, 16.0 * 2 / 5], abs=0.1)  # m/s, at two frames a second instead of five
    assert summary["configuration"]["detector"].startswith("model.onnx (SHA-256 ")
    assert summary["versions"]["onnxruntime"] and summary["notices"] == []
    nothing = contrast(tmp_path / "nothing.onnx", 1e-3)
    done = paceline("speed", file, "-o", tmp_path / "nothing", "--live", "--detector", nothing)
    assert done.returncode == 1 and "no vehicle was found: the detector saw a vehicle in none of" in done.stderr
    done = paceline("speed", file, "-o", tmp_path / "again", "--live", "--detector", model, "--background-seconds", "5")
    assert_one_line_error(done, "--background-seconds", "--detector")
