"""Rigs of other programs: the same rig, written as each of them writes it, comes out as it went in."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from run_command import assert_one_line_error, paceline

from paceline.calibration.importers import ImportOptions, import_rig
from paceline.cameras import Camera, StereoRig
from paceline.documents.loading import load_rig
from paceline.errors import UnusableInput

SIZE = (1280, 960)
SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def truth() -> StereoRig:
    left = Camera(
        SIZE, np.array([[1400.0, 0, 630], [0, 1402, 470], [0, 0, 1]]), np.array([-0.2, 0.1, 1e-3, -5e-4, 0.02])
    )
    right = Camera(
        SIZE, np.array([[1390.0, 0, 642], [0, 1391, 481], [0, 0, 1]]), np.array([-0.21, 0.11, 2e-4, 3e-4, 0.01])
    )
    return StereoRig(left, right, cv2.Rodrigues(np.array([0.01, -0.03, 0.005]))[0], np.array([-0.5, 0.004, 0.01]))


def same(a: StereoRig, b: StereoRig, lenses: bool = True) -> None:
    for x, y in zip(a.cameras, b.cameras, strict=True):
        assert x.image_size == y.image_size
        np.testing.assert_allclose(x.K, y.K, rtol=1e-9)
        if lenses:
            np.testing.assert_allclose(x.distortion, y.distortion, atol=1e-9)
    np.testing.assert_allclose(a.R, b.R, atol=1e-8)
    np.testing.assert_allclose(a.t, b.t, atol=1e-8)


# --- OpenCV --------------------------------------------------------------------------------------------------------


def write_opencv(file: Path, **matrices: np.ndarray | int) -> Path:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in matrices.items():
        storage.write(name, value)
    storage.release()
    return file


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencvs_two_files(tmp_path: Path, truth: StereoRig, suffix: str) -> None:
    a = write_opencv(
        tmp_path / f"intrinsics{suffix}",
        M1=truth.left.K, D1=truth.left.distortion[None], M2=truth.right.K, D2=truth.right.distortion[None],
    )  # fmt: skip
    b = write_opencv(tmp_path / f"extrinsics{suffix}", R=truth.R, T=truth.t[:, None], P1=np.eye(3, 4), Q=np.eye(4))
    found, kind = import_rig([a, b], ImportOptions(size=SIZE))
    assert kind == "OpenCV"
    same(found, truth)


def test_opencvs_one_file_with_its_size_and_millimetres(tmp_path: Path, truth: StereoRig) -> None:
    file = write_opencv(
        tmp_path / "stereo.yml",
        cameraMatrix1=truth.left.K, distCoeffs1=truth.left.distortion, cameraMatrix2=truth.right.K,
        distCoeffs2=truth.right.distortion, R=truth.R, T=1000 * truth.t, image_width=SIZE[0], image_height=SIZE[1],
    )  # fmt: skip
    same(import_rig([file], ImportOptions(unit=0.001))[0], truth)
    with pytest.raises(UnusableInput, match="are these millimetres.*--translation-unit mm"):
        import_rig([file], ImportOptions())


# --- Kalibr --------------------------------------------------------------------------------------------------------


def kalibr(truth: StereoRig) -> dict[str, dict[str, object]]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = truth.R, truth.t
    chain: dict[str, dict[str, object]] = {}
    for name, camera in (("cam0", truth.left), ("cam1", truth.right)):
        K = camera.K
        chain[name] = {
            "camera_model": "pinhole",
            "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            "distortion_model": "radtan",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "resolution": list(SIZE),
            "rostopic": f"/{name}/image_raw",
        }
    chain["cam1"]["T_cn_cnm1"] = T.tolist()
    return chain


def test_kalibrs_chain(tmp_path: Path, truth: StereoRig) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(yaml.safe_dump(kalibr(truth)))
    found, kind = import_rig([file], ImportOptions())
    assert kind == "Kalibr"
    same(found, truth, lenses=False)
    np.testing.assert_allclose(found.left.distortion, truth.left.distortion[:4])


def test_two_cameras_of_a_longer_chain(tmp_path: Path, truth: StereoRig) -> None:
    """cam0 to cam2 is cam0 to cam1, and cam1 to cam2."""
    chain = kalibr(truth)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = cv2.Rodrigues(np.array([0, 0.1, 0]))[0], [-0.2, 0, 0]
    chain["cam2"] = {**chain["cam1"], "T_cn_cnm1": turn.tolist()}
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    found = import_rig([tmp_path / "camchain.yaml"], ImportOptions(cameras=(0, 2)))[0]
    np.testing.assert_allclose(found.R, turn[:3, :3] @ truth.R, atol=1e-9)
    np.testing.assert_allclose(found.t, turn[:3, :3] @ truth.t + turn[:3, 3], atol=1e-9)


# --- ROS -----------------------------------------------------------------------------------------------------------


def write_ros(folder: Path, truth: StereoRig) -> list[Path]:
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        truth.left.K, truth.left.distortion, truth.right.K, truth.right.distortion, SIZE, truth.R, truth.t[:, None]
    )
    files = []
    for name, camera, R, P in (("left", truth.left, R1, P1), ("right", truth.right, R2, P2)):

        def block(M: np.ndarray) -> dict[str, object]:
            return {"rows": M.shape[0], "cols": M.shape[1], "data": M.ravel().tolist()}

        info = {
            "image_width": SIZE[0], "image_height": SIZE[1], "camera_name": name, "camera_matrix": block(camera.K),
            "distortion_model": "plumb_bob", "distortion_coefficients": block(camera.distortion[None]),
            "rectification_matrix": block(np.asarray(R)), "projection_matrix": block(np.asarray(P)),
        }  # fmt: skip
        files.append(folder / f"{name}.yaml")
        files[-1].write_text(yaml.safe_dump(info))
    return files


def test_ros_unrectified_is_the_rig_itself(tmp_path: Path, truth: StereoRig) -> None:
    found, kind = import_rig(write_ros(tmp_path, truth), ImportOptions(rectified=False))
    assert kind == "ROS"
    same(found, truth)


def test_ros_rectified_sees_the_same_points_in_rectified_pictures(tmp_path: Path, truth: StereoRig) -> None:
    found = import_rig(write_ros(tmp_path, truth), ImportOptions())[0]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        truth.left.K, truth.left.distortion, truth.right.K, truth.right.distortion, SIZE, truth.R, truth.t[:, None]
    )
    X = np.array([[1.0, 0.5, 20], [-2, -1, 35], [0.2, 0.1, 6]])  # in the true left camera's axes
    left, right = found.project(X @ np.asarray(R1).T)
    for pixels, P in ((left, P1), (right, P2)):
        x = np.column_stack([X @ np.asarray(R1).T, np.ones(3)]) @ np.asarray(P).T
        np.testing.assert_allclose(pixels, x[:, :2] / x[:, 2:], atol=1e-9)
    in_right = truth.to_right(X) @ np.asarray(R2).T
    np.testing.assert_allclose(found.to_right(X @ np.asarray(R1).T), in_right, atol=1e-9)


# --- KITTI ---------------------------------------------------------------------------------------------------------


def kitti(truth: StereoRig) -> str:
    def line(key: str, values: object) -> str:
        return f"{key}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}"

    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    for k, (camera, R, t) in enumerate(((truth.left, np.eye(3), np.zeros(3)), (truth.right, truth.R, truth.t))):
        P = np.column_stack([K, [-350.0 * k, 0, 0]])
        lines += [
            line(f"S_{k:02d}", SIZE), line(f"K_{k:02d}", camera.K), line(f"D_{k:02d}", camera.distortion),
            line(f"R_{k:02d}", R), line(f"T_{k:02d}", t), line(f"S_rect_{k:02d}", (1242, 375)),
            line(f"P_rect_{k:02d}", P),
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def test_kittis_raw_recordings(tmp_path: Path, truth: StereoRig) -> None:
    file = tmp_path / "calib_cam_to_cam.txt"
    file.write_text(kitti(truth))
    same(import_rig([file], ImportOptions(rectified=False))[0], truth)
    found, kind = import_rig([file], ImportOptions())
    assert kind == "KITTI"
    assert found.left.image_size == (1242, 375)
    np.testing.assert_allclose(found.t, [-0.5, 0, 0])
    np.testing.assert_array_equal(found.R, np.eye(3))
    assert not found.left.has_distortion


def test_kittis_projection_matrices_need_a_size(tmp_path: Path) -> None:
    file = tmp_path / "000000.txt"
    file.write_text("P0: 707 0 604 0 0 707 180 0 0 0 1 0\nP1: 707 0 604 -379.8 0 707 180 0 0 0 1 0\n")
    with pytest.raises(UnusableInput, match="expected --size"):
        import_rig([file], ImportOptions())
    np.testing.assert_allclose(import_rig([file], ImportOptions(size=(1242, 375)))[0].t, [-379.8 / 707, 0, 0])


def test_the_shared_recordings_rig_is_kittis(tmp_path: Path) -> None:
    folder = SHARED / "kitti_crossing"
    if not folder.exists():
        pytest.skip(f"{folder} is absent")
    found = import_rig([folder / "calib_cam_to_cam.txt"], ImportOptions(cameras=(2, 3)))[0]
    same(found, load_rig(folder / "rig.yaml"))
    raw = import_rig([folder / "calib_cam_to_cam.txt"], ImportOptions(cameras=(2, 3), rectified=False))[0]
    assert raw.baseline == pytest.approx(found.baseline, rel=1e-3)  # the same cameras, before and after rectifying


# --- the command ---------------------------------------------------------------------------------------------------


def test_the_command_writes_a_rig_that_is_read(tmp_path: Path, truth: StereoRig) -> None:
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(kalibr(truth)))
    out = tmp_path / "new" / "rig.yaml"
    done = paceline("rig", "import", tmp_path / "camchain.yaml", "-o", out)
    assert done.returncode == 0, done.stderr
    assert "Kalibr: 1280 × 960 pixels, focal length 1400.0 px, cameras 0.5001 m apart" in done.stdout
    assert "states no uncertainty" in done.stderr
    same(load_rig(out), truth, lenses=False)
    assert "uncertainty:" not in out.read_text()
    assert (assumed := load_rig(out).uncertainty) is not None and assumed.is_assumed


def test_a_place_that_is_no_folder_is_one_plain_line(tmp_path: Path, truth: StereoRig) -> None:
    (file := tmp_path / "camchain.yaml").write_text(yaml.safe_dump(kalibr(truth)))
    done = paceline("rig", "import", file, "-o", file / "rig.yaml")
    assert_one_line_error(done, str(file / "rig.yaml"), "cannot be written")


BAD: list[tuple[str, str, list[str], str]] = [
    ("notes.yaml", "a: 1\n", [], "is not known; expected an OpenCV stereo calibration"),
    ("notes.yaml", "[1, 2\n", [], "is not valid YAML"),
    ("notes.yaml", "42\n", [], "is not known"),
    ("camchain.yaml", "cam0: {camera_model: omni}\ncam1: {}\n", [], "T_cn_cnm1: expected 4 × 4 finite numbers"),
    ("camchain.yaml", "cam0: {camera_model: pinhole}\n", [], "cam1 is missing"),
    ("calib.txt", "P0: 1 2 3\nP1: 4\n", ["--size", "1242x375"], "P0: expected 12 numbers"),
    ("calib.txt", "P0: 1 2 3\n", ["--unrectified"], "holds the rectified cameras alone"),
    ("stereo.yml", "%YAML:1.0\n---\nM1: 3\n", [], "M1 is missing"),
    ("left.yaml", "camera_matrix: {data: [1, 2]}\n", [], "is one camera's camera_info"),
    ("camchain.yaml", "cam0: {}\n", ["--cameras", "1"], "--cameras 1: expected two numbers"),
    ("camchain.yaml", "cam0: {}\n", ["--size", "big"], "--size big: expected WIDTHxHEIGHT"),
    ("camchain.yaml", "cam0: {}\n", ["-o", "rig.txt"], "expected the name of a YAML file"),
]


@pytest.mark.parametrize(("name", "content", "options", "said"), BAD)
def test_a_file_that_is_no_rig_is_one_plain_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: str, options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(content)
    assert_one_line_error(paceline("rig", "import", name, "-o", "rig.yaml", *options), said)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("distortion_model", "equidistant", "'equidistant' is not supported; expected radtan or none"),
        ("camera_model", "omni", "'omni' is not supported; expected pinhole"),
        ("intrinsics", [1.0, 2.0], "intrinsics: expected 4 finite numbers"),
        ("resolution", None, "resolution: expected 2 finite numbers"),
        ("distortion_coeffs", [0.1, 0.2, 0.3], "coefficients of distortion, found 3"),
        ("T_cn_cnm1", np.zeros((4, 4)).tolist(), "is not a rotation"),
    ],
)
def test_a_chain_that_cannot_be_used_names_the_key(
    tmp_path: Path, truth: StereoRig, key: str, value: object, said: str
) -> None:
    chain = kalibr(truth)
    chain["cam1"][key] = value
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    with pytest.raises(UnusableInput) as refused:
        import_rig([tmp_path / "camchain.yaml"], ImportOptions())
    assert said in str(refused.value)
    assert str(tmp_path / "camchain.yaml") in str(refused.value)
