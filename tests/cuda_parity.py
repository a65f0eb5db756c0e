"""The GPU computes what the CPU computes. On a GPU: ``pytest tests/cuda_parity.py``; elsewhere `test_cuda` runs this
file under CUDA's simulator, where one sample takes 50 µs: so everything here is tiny."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import config, cuda
from numpy.typing import NDArray
from run_command import paceline
from selection import slow_after

from paceline.cameras import Camera, StereoRig
from paceline.documents.loading import Clip, load_clip
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import likelihood, random_numbers
from paceline.speed.filter.batch import TrackerBatch
from paceline.speed.filter.cuda import device as cuda_device
from paceline.speed.filter.cuda import kernels, memory_layout, patch_features, weights
from paceline.speed.filter.cuda import random_numbers as cuda_random_numbers
from paceline.speed.filter.cuda.device import CudaDevice
from paceline.speed.filter.cuda.particle_set import CudaParticleSet
from paceline.speed.filter.device import DeviceFailure
from paceline.speed.filter.estimate import MIN_VISIBLE_SIMILARITY, Estimate
from paceline.speed.filter.likelihood import ObservationModel, PartGrid, pack_views
from paceline.speed.filter.motion_models import CoordinatedTurn, FreeMotion, PathMotion, State
from paceline.speed.filter.particle_set import ParticleSet
from paceline.speed.filter.resampling import Weights
from paceline.speed.filter.tracker import Tracker
from paceline.speed.geometry import paths
from paceline.speed.geometry.path_reconstruction import path_from_document

Array = NDArray[np.float64]

ROUNDING = 1e-9  # of the state, in double precision: a few operations' worth at values of some hundreds
FILTERED = 2e-4  # relative, of estimates by weights that differ by float32 rounding; measured: 1e-6 and less
N = 9
if config.ENABLE_CUDASIM:
    import cuda_simulator

    cuda_simulator.install()
SETTINGS = SpeedConfiguration(parts=4).model_copy(update={"particles": 4})  # fewer than are of any use


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few samples, and so few threads in a block that five particles fill two blocks."""
    monkeypatch.setattr(likelihood, "SAMPLES_PER_REGION", 256)
    monkeypatch.setattr(cuda_device, "MAX_THREADS_PER_BLOCK", 4)
    monkeypatch.setattr(cuda_device, "THREADS_PER_QUANTITY", 2)
    monkeypatch.setattr(cuda_device, "THREADS_PER_BLOCK", 4)
    monkeypatch.setattr(cuda_device, "MAX_BLOCKS_PER_VEHICLE", 2)


@pytest.fixture(params=slow_after(1, ["several blocks", "one block"]))
def sharing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether several blocks share a vehicle's weights and moments, as they do those of many particles."""
    monkeypatch.setattr(cuda_device, "MIN_PARTICLES_PER_THREAD", 1 if request.param == "several blocks" else N)
    monkeypatch.setattr(cuda_device, "MAX_BLOCKS_PER_VEHICLE", 3)


@pytest.fixture(scope="module")
def device() -> CudaDevice:
    return CudaDevice()


def camera(focal: float) -> Camera:
    return Camera((160, 120), np.array([[focal, 0, 79.5], [0, 1.01 * focal, 59.5], [0, 0, 1]]))


def rig() -> StereoRig:
    """A pair whose right camera is turned a little."""
    a, b = 0.02, -0.01
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return StereoRig(camera(300.0), camera(310.0), about_y @ about_x, np.array([-0.5, 0.01, 0.02]))


def path(shape: str) -> paths.Path:
    z = np.linspace(40.0, 8.0, 30)
    bend = 0.004 * (z - 8.0) ** 2 if shape == "curve" else 0.1 * z
    return paths.from_points("lane", shape, np.stack([bend - 2.0, 1.2 + 0.02 * z, z], axis=1))


def motion_model(kind: str) -> PathMotion | FreeMotion:
    free = {"free": FreeMotion, "turn": CoordinatedTurn}
    return free[kind](rig(), SETTINGS) if kind in free else PathMotion(rig(), path(kind), SETTINGS)


def particles(model: PathMotion | FreeMotion, seed: int, n: int = N) -> ParticleSet:
    """``n`` weighted particles, each on a plane of its own that both cameras see."""
    rng = np.random.default_rng(seed)
    k = model.rig
    centre = np.array([0.5, 0.8, 20.0]) + rng.normal(0.0, 0.3, (n, 3))
    normal = np.array([0.1, 0.05, -1.0]) + rng.normal(0.0, 0.05, (n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    corners = np.array([[-0.9, -0.6, 0], [0.9, -0.6, 0], [0.9, 0.6, 0], [-0.9, 0.6, 0]])
    points = centre[:, None] + corners + rng.normal(0.0, 0.02, (n, 4, 3))
    left, right = (q.reshape(n, 4, 2) for q in k.project(points.reshape(-1, 3)))
    velocity = np.array([0.5, 0.1, -11.0]) + rng.normal(0.0, 0.4, (n, 3))
    state = State(
        left=left,
        right=right,
        normal=normal,
        distance=(centre * normal).sum(1),
        speed=np.linalg.norm(velocity, axis=1),
        s=rng.uniform(-3.0, 40.0, n),  # beyond both ends of the path, too
        heading=rng.normal(0.0, 0.02, (n, 2)),
        velocity=velocity,
        turning=rng.normal(0.0, 0.05, (n, 3)),
    )
    return ParticleSet(k, model, state, Weights(rng.normal(0.0, 1.0, n)))


def assert_same(found: ParticleSet, expected: ParticleSet) -> None:
    for name in State.__dataclass_fields__:
        a, b = getattr(found.state, name), getattr(expected.state, name)
        np.testing.assert_allclose(a, b, rtol=ROUNDING, atol=ROUNDING, err_msg=name)
    np.testing.assert_allclose(found.weights.lw, expected.weights.lw, rtol=0, atol=1e-9)


def update_weights(on_device: CudaParticleSet, ll: Array) -> None:
    """Update the weights of ``on_device`` by log p(z | x) ``ll`` (N,)."""
    device = on_device.device
    device.execute()
    half = int(device.commands[on_device.slot, memory_layout.HALF_AFTER])
    device._pool.value[half, memory_layout.LIKELIHOOD_ROW, on_device.first : on_device.first + len(on_device)] = ll
    device._observation_table()[on_device.slot, memory_layout.WEIGHT_UPDATE] = 1
    device._observations.upload(device._observations.host.size)
    device._update_weights([on_device])


# --- random numbers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 3, 4])
@pytest.mark.parametrize("key", [(1, 2), (2**64 - 1, 2**63 + 5), (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)])
def test_counted_numbers_are_those_of_the_cpu(key: tuple[int, int], k: int) -> None:
    """Those of the CPU come from NumPy's own Philox."""
    rng = random_numbers.CounterGenerator(np.random.PCG64(1), np.array(key, np.uint64), calls=7)
    numbers = cuda.device_array((N, k))
    _normals[1, N](cuda.to_device(np.array(rng.key_words, float)), 7, 0.3, numbers)
    np.testing.assert_allclose(numbers.copy_to_host(), rng.normal(0.0, 0.3, (N, k)), rtol=1e-12, atol=1e-14)


@cuda.jit  # type: ignore[untyped-decorator]
def _normals(key: Array, call: int, scale: float, out: Array) -> None:
    p = cuda.threadIdx.x
    cuda_random_numbers.counter_normals(key, call, scale, p, out.shape[1], out[p], 0)


# --- motion --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("counted", slow_after(1, [True, False]))
@pytest.mark.parametrize("kind", slow_after(2, ["curve", "turn", "free", "line"]))
def test_particles_move_as_on_the_cpu(
    device: CudaDevice, kind: str, counted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three steps, a correction by a centre, and a turn of the planes, by the same seed."""
    monkeypatch.setattr(random_numbers, "MAX_SEQUENTIAL_PARTICLES", 0 if counted else 10**9)
    on_host = particles(motion_model(kind), 1)
    on_device = device.particle_set(on_host.to_host())
    generators = (random_numbers.make_generator([2], N) for _ in range(2))
    particle_sets = list(zip((on_host, on_device), generators, strict=True))
    place, covariance = np.array([0.4, 0.75, 19.0]), np.diag([0.01, 0.02, 0.3]) + 0.001
    for dt in (0.2, 0.05, 0.4):
        for particle_set, rng in particle_sets:
            particle_set.propagate(dt, rng)
            particle_set.displace(np.array([0.2, 0.01, -3.0]) * dt)
        assert_same(on_device.to_host(), on_host)
    for particle_set, rng in particle_sets:
        particle_set.ensemble_kalman_update(place, covariance, rng)
    assert_same(on_device.to_host(), on_host)
    for particle_set, rng in particle_sets:
        particle_set.set_plane_normal(np.array([0.0, 0.6, -0.8]))
        particle_set.propagate(0.2, rng)
    assert_same(on_device.to_host(), on_host)


# --- weights -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "n"), [("curve", 1), ("free", 13)])
@pytest.mark.parametrize("restored", slow_after(1, [True, False]))
@pytest.mark.usefixtures("sharing")
def test_the_posterior_is_that_of_the_cpu(device: CudaDevice, kind: str, n: int, restored: bool) -> None:
    on_host = particles(motion_model(kind), 3, n)
    on_device = device.particle_set(on_host)
    assert_same(on_device.to_host(), on_host)
    ll = np.random.default_rng(4).normal(-30.0, 2.0, n)
    on_host.update_weights(ll)
    update_weights(on_device, ll)
    if restored:
        on_host.restore_weights()
        on_device.restore_weights()
    assert_same(on_device.to_host(), on_host)
    here, found = on_host.posterior(), on_device.posterior()
    for name in State.__dataclass_fields__:
        np.testing.assert_allclose(getattr(found.mean, name), getattr(here.mean, name), rtol=1e-10, err_msg=name)
    np.testing.assert_allclose(found.position, here.position, rtol=1e-10)
    np.testing.assert_allclose([found.speed, found.ess], [here.speed, here.ess], rtol=1e-10)
    assert found.speed_std == pytest.approx(here.speed_std, rel=1e-6, abs=1e-9)
    np.testing.assert_allclose(found.particles_left, here.particles_left, rtol=1e-10)
    np.testing.assert_allclose(found.particles_right, here.particles_right, rtol=1e-10)
    assert on_device.image_spread_px() == pytest.approx(on_host.image_spread_px(), rel=1e-6, abs=1e-6)
    for a, b in zip(on_device.centre(), on_host.centre(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)
    for corners, quads in zip(on_device.image_bounds(), on_host.image_bounds(), strict=True):
        flat = quads.reshape(-1, 2)
        np.testing.assert_array_equal(corners.reshape(-1, 2).min(0), flat.min(0))
        np.testing.assert_array_equal(corners.reshape(-1, 2).max(0), flat.max(0))


@pytest.mark.parametrize(("n", "scatter"), slow_after(1, [(9, 30.0), (9, 1.0), (22, 3.0)]))
@pytest.mark.usefixtures("sharing")
def test_the_same_particles_survive(device: CudaDevice, n: int, scatter: float) -> None:
    on_host = particles(motion_model("line"), 5, n)
    on_host.weights = Weights(np.random.default_rng(6).normal(0.0, scatter, n))
    on_device = device.particle_set(on_host.to_host())
    update_weights(on_device, np.zeros(n))
    settings = SETTINGS.model_copy(update={"particles": n})
    for particle_set in (on_host, on_device):
        particle_set.resample(settings, np.random.default_rng(7))
    assert_same(on_device.to_host(), on_host)
    on_host.weights = Weights.equal(n)  # even enough for any bound, whatever the last bit of their size
    numbers = np.random.default_rng(7), np.random.default_rng(7)
    for particle_set, rng in zip((on_host, device.particle_set(on_host.to_host())), numbers, strict=True):
        particle_set.resample(settings, rng)
        assert rng.random() == np.random.default_rng(7).random()
    settings_below = settings.model_copy(update={"resample_below": 0.5})
    before = on_device.to_host()
    update_weights(on_device, np.zeros(n))
    on_device.resample(settings_below, np.random.default_rng(7))
    assert_same(on_device.to_host(), before)


@pytest.mark.parametrize("ll", slow_after(1, [np.nan, -np.inf]))
@pytest.mark.usefixtures("sharing")
def test_vanishing_weights_are_reported(device: CudaDevice, ll: float) -> None:
    on_device = device.particle_set(particles(motion_model("line"), 5))
    update_weights(on_device, np.full(N, ll))
    with pytest.raises(FloatingPointError, match="all particle weights vanish"):
        on_device.posterior()


# --- many clouds ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", slow_after(1, [2, 0, 1, 3]))
@pytest.mark.usefixtures("sharing")
def test_particle_sets_come_and_go_in_any_order(seed: int) -> None:
    """Whatever is done to which cloud, and whoever joins and leaves meanwhile: all are as on the CPU."""
    device, drawing = CudaDevice(), np.random.default_rng([9, seed])
    pairs: list[tuple[ParticleSet, CudaParticleSet, tuple[np.random.Generator, np.random.Generator]]] = []

    def join() -> None:
        n, number = int(drawing.integers(1, 12)), int(drawing.integers(1000))
        on_host = particles(motion_model(str(drawing.choice(["line", "curve", "free", "turn"]))), number, n)
        if drawing.random() < 0.5:
            key = np.array([number, 5], np.uint64)
            here, on_device = (random_numbers.CounterGenerator(np.random.PCG64(number), key) for _ in range(2))
        else:
            here, on_device = np.random.default_rng(number), np.random.default_rng(number)
        pairs.append((on_host, device.particle_set(on_host.to_host()), (here, on_device)))

    join()
    done = ["join", "leave", "propagate", "propagate", "set normal", "correct", "weight", "resample", "look"]
    for _ in range(18):
        what = str(drawing.choice(done))
        if what == "join" or not pairs:
            join()
            continue
        at = int(drawing.integers(len(pairs)))
        if what == "leave":
            pairs.pop(at)
            continue
        on_host, on_device, (rng, same) = pairs[at]
        ll = drawing.normal(0.0, 2.0, len(on_device))
        for particle_set, numbers in ((on_host, rng), (on_device, same)):
            if what == "propagate":
                particle_set.propagate(0.1, numbers)
            elif what == "set normal":
                particle_set.set_plane_normal(np.array([0.0, 0.6, -0.8]))
            elif what == "correct":
                particle_set.ensemble_kalman_update(np.array([0.4, 0.75, 19.0]), np.diag([0.01, 0.02, 0.3]), numbers)
            elif what in ("weight", "resample"):
                if isinstance(particle_set, ParticleSet):
                    particle_set.update_weights(ll)
                else:
                    update_weights(particle_set, ll)
            if what == "resample":
                particle_set.resample(SETTINGS.model_copy(update={"particles": len(on_device)}), numbers)
        if what == "look":
            assert_same(on_device.to_host(), on_host)
    for on_host, on_device, _ in pairs:
        assert_same(on_device.to_host(), on_host)


def test_freed_memory_is_used_again() -> None:
    """A particle set that is freed leaves its columns and its slot to the next that fits."""
    device = CudaDevice()
    first, second, third = (device.particle_set(particles(motion_model("line"), i, n)) for i, n in enumerate((5, 4, 3)))
    columns = device._pool.value.shape[2]
    del second
    another = device.particle_set(particles(motion_model("line"), 7, 4))
    assert (another.slot, another.first, device._pool.value.shape[2]) == (1, 5, columns)
    assert_same(another.to_host(), particles(motion_model("line"), 7, 4))
    for i, (particle_set, n) in enumerate(((first, 5), (third, 3))):
        assert_same(particle_set.to_host(), particles(motion_model("line"), 2 * i, n))


class Counting:
    """A kernel that counts its launches."""

    def __init__(self, kernel: Any, counts: Counter[str], name: str) -> None:
        self.kernel, self.counts, self.name = kernel, counts, name

    def __getitem__(self, configuration: object) -> Any:
        self.counts[self.name] += 1
        return self.kernel[configuration]


KERNELS = [
    (kernels, ("execute", "download", "upload")),
    (weights, ("sum_weights", "cumulate_weights", "average_headings", "reduce_moments", "update_weights", "normalise")),
    (patch_features, ("log_likelihood",)),
]


FRAME_LAUNCHES = {"cumulate_weights": 1, "execute": 2, "reduce_moments": 3, "log_likelihood": 1, "update_weights": 1}
OCCLUDED_FRAME_LAUNCHES = {"execute": 2, "reduce_moments": 4, "log_likelihood": 1, "update_weights": 2}


@pytest.mark.parametrize(("vehicles", "hidden"), slow_after(1, [(2, True), (1, False), (3, False)]))
def test_launches_do_not_grow_with_the_number_of_vehicles(
    vehicles: int, hidden: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: Counter[str] = Counter()
    for module, names in KERNELS:
        for name in names:
            monkeypatch.setattr(module, name, Counting(getattr(module, name), counts, name))
    device, frame, grid = CudaDevice(), textured(8), PartGrid(2, 2, (2, 3))
    each = [device.particle_set(particles(motion_model("curve"), seed, 3)) for seed in range(vehicles)]
    model = observation_model(grid, frame, SETTINGS)
    settings = SETTINGS.model_copy(update={"particles": 3, "resample_below": 1.0})
    rng = np.random.default_rng(1)
    for _ in range(2):
        counts.clear()
        for particle_set in each:
            particle_set.propagate(0.01, rng)
        for particle_set in each:
            particle_set.mean()
            particle_set.ensemble_kalman_update(np.array([0.5, 0.8, 20.0]), np.eye(3), rng)
        views = pack_views(frame, [particle_set.image_bounds() for particle_set in each])
        for particle_set in each:
            particle_set.weight(model, views)
        for particle_set in each:
            particle_set.posterior()
            if hidden:
                particle_set.restore_weights()
        for particle_set in each:
            if hidden:
                particle_set.posterior()
            else:
                particle_set.resample(settings, rng)
            particle_set.set_plane_normal(np.array([0.0, 0.6, -0.8]))
    # the commands of a frame begin with those that the frame before left enqueued
    assert counts == (OCCLUDED_FRAME_LAUNCHES if hidden else FRAME_LAUNCHES)


# --- the likelihood ------------------------------------------------------------------------------------------------


def observation_model(grid: PartGrid, frame: StereoFrame, settings: SpeedConfiguration) -> ObservationModel:
    """A model whose reference is what a particle observes in ``frame``."""
    model = ObservationModel(rig(), grid, settings)
    first = particles(motion_model("line"), 90, 1)
    model.initialize(pack_views(frame, [first.image_bounds()]), first.state)
    return model


def textured(seed: int) -> StereoFrame:
    rng = np.random.default_rng(seed)
    pictures = rng.uniform(0.0, 255.0, (2, 30, 40)).repeat(4, axis=1).repeat(4, axis=2).astype(np.float32)
    return StereoFrame(index=0, time=0.0, left=pictures[0], right=pictures[1], skew=0.0, duplicate=False)


@pytest.mark.parametrize("lambdas", slow_after(1, [((15.0, 20.0),), ((15.0, 1e-9),), ((1e-9, 20.0),)]))
def test_vehicles_are_weighted_together_as_each_on_the_cpu(device: CudaDevice, lambdas: tuple[float, float]) -> None:
    """Three vehicles with grids and numbers of particles of their own; some particles see nothing, or nowhere."""
    settings = SETTINGS.model_copy(update={"lambda_single": lambdas[0], "lambda_cross": lambdas[1]})
    frame, on_host, on_device, models = textured(8), [], [], []
    grids = [PartGrid(2, 2, (2, 3)), PartGrid(4, 1, (2, 2)), PartGrid(1, 4, (3, 2))]
    for seed, (grid, n) in enumerate(zip(grids, (3, 1, 4), strict=True)):
        particle_set = particles(motion_model("line"), seed, n)
        if n > 1:
            particle_set.state.left[0] = particle_set.state.left[0, 0]  # without area
            particle_set.state.right[1, :, 0] += 300.0  # beyond the picture
        particle_set.displace(np.array([0.01, 0.0, -0.02]) * seed)
        on_host.append(particle_set)
        on_device.append(device.particle_set(particle_set))
        models.append(observation_model(grid, frame, settings))
        models[-1].rig = models[-1].rig.displaced(particle_set.displacement)
    views = pack_views(frame, [particle_set.image_bounds() for particle_set in on_host])
    for particle_set, model in zip(on_device, models, strict=True):
        particle_set.weight(model, views)
    for expected, found, model in zip(on_host, on_device, models, strict=True):
        ll = model.log_likelihood(views, expected.state)
        np.testing.assert_allclose(device.log_likelihood(model, views, expected.state), ll, rtol=2e-6, atol=2e-4)
        expected.update_weights(ll)
        np.testing.assert_allclose(found.to_host().weights.lw, expected.weights.lw, rtol=2e-6, atol=4e-4)


# --- whole clips ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A vehicle on a straight road and one on a bend, four frames each, in pictures of 320 × 240."""
    small: dict[str, object] = {"image_size": (320, 240), "focal": 700.0, "click_sigma": 0.15, "line_sigma": 0.12}
    vehicles = (Vehicle("v0", 11.0, start_distance=24.0, texture_seed=1, initial_speed=11.0),)
    scenes = {
        "line": Scene(1, vehicles, frames=4, **small),  # type: ignore[arg-type]
        "curve": Scene(2, vehicles, frames=4, radius=-150.0, road_depth=30.0, skew_s=0.004, **small),  # type: ignore[arg-type]
    }
    folder = tmp_path_factory.mktemp("clips")
    return {name: write(render(scene), folder / name) for name, scene in scenes.items()}


def trackers(clip: Clip, settings: SpeedConfiguration, device: CudaDevice | None, copies: int = 1) -> list[Tracker]:
    """``copies`` of each vehicle, each with random numbers of its own."""
    found = []
    for i in range(copies):
        for v in clip.vehicles:
            drawn = clip.paths[v.path] if v.path and settings.motion != "free" else None
            line = None if drawn is None else path_from_document(drawn, clip.rig)
            named = replace(v, id=f"{v.id}-{i}", speed=11.0)
            offset = 0.0 if drawn is None else drawn.lateral_offset
            found.append(Tracker(clip.rig, named, line, offset, settings, device))
    return found


def track_all(clip: Clip, batch: TrackerBatch, each: list[Tracker], hidden: int = -1) -> list[list[Estimate]]:
    """The estimates, frame by frame; a wall stands before the cameras in the ``hidden`` frame."""
    for tracker in each:
        batch.add(tracker)
    wall = np.random.default_rng(8).uniform(0.0, 255.0, (240, 320)).astype(np.float32)
    frames = list(open_recording(clip).frames(0))
    frames = [replace(f, left=wall, right=wall[:, ::-1]) if f.index == hidden else f for f in frames]
    estimates = []
    for frame in frames:
        active = [t for t in each if t.status == "tracking" and t.vehicle.frame <= frame.index]
        estimates.append([batch.update(t, frame) for t in active])
    return estimates


def assert_same_estimates(found: list[list[Estimate]], expected: list[list[Estimate]]) -> None:
    for frame, reference in zip(found, expected, strict=True):
        assert len(frame) == len(reference)
        for a, b in zip(frame, reference, strict=True):
            assert (a.frame, a.status) == (b.frame, b.status)
            for name in ("speed", "speed_std", "position", "left", "right", "ess", "similarity", "yaw_rate"):
                x, y = getattr(a, name), getattr(b, name)
                np.testing.assert_allclose(x, y, rtol=FILTERED, atol=1e-4, err_msg=f"frame {a.frame}: {name}")
            np.testing.assert_allclose(a.particles_left, b.particles_left, rtol=FILTERED)


def assert_same_numbers(found: list[Tracker], expected: list[Tracker]) -> None:
    """Of all trackers the next random number, and how often any was counted."""
    for a, b in zip(found, expected, strict=True):
        assert getattr(a.rng, "calls", 0) == getattr(b.rng, "calls", 0)
        assert a.rng.random() == b.rng.random()


CASES = [("line", "free", True), ("line", "auto", False), ("curve", "auto", True)]


@pytest.mark.parametrize(("name", "kind", "guided"), slow_after(1, CASES))
def test_the_filter_estimates_what_it_estimates_on_the_cpu(
    device: CudaDevice, clips: dict[str, Path], name: str, kind: str, guided: bool
) -> None:
    clip = load_clip(clips[name])
    settings = SETTINGS.model_copy(update={"motion": kind, "guided": guided})
    copies = 2 if name == "curve" else 1  # weighed in one launch
    here, on_device = (trackers(clip, settings, where, copies) for where in (None, device))
    expected = track_all(clip, TrackerBatch(), here)
    assert_same_estimates(track_all(clip, TrackerBatch(device), on_device), expected)
    assert_same_numbers(on_device, here)


@pytest.mark.slow
def test_vehicles_come_and_end_while_others_continue(device: CudaDevice, clips: dict[str, Path]) -> None:
    clip = load_clip(clips["line"])

    def three(where: CudaDevice | None) -> list[Tracker]:
        first, late, ending = trackers(clip, SETTINGS, where, copies=3)
        late.vehicle = replace(late.vehicle, frame=1)
        rig = ending.rig  # a smaller picture, which the vehicle has left by the second frame
        ending.rig = replace(rig, left=replace(rig.left, image_size=(40, 40)))
        return [ending, first, late]

    here, on_device = three(None), three(device)
    expected = track_all(clip, TrackerBatch(), here)
    assert [[e.status for e in frame] for frame in expected[1:]] == [
        ["ended", *2 * ["tracking"]],
        *2 * [2 * ["tracking"]],
    ]
    assert_same_estimates(track_all(clip, TrackerBatch(device), on_device), expected)
    assert_same_numbers(on_device, here)


@pytest.mark.slow
def test_an_occluded_vehicle_is_awaited_as_on_the_cpu(device: CudaDevice, clips: dict[str, Path]) -> None:
    clip = load_clip(clips["line"])
    expected = track_all(clip, TrackerBatch(), trackers(clip, SETTINGS, None), hidden=2)
    assert expected[2][0].similarity < MIN_VISIBLE_SIMILARITY
    assert expected[2][0].ess == pytest.approx(SETTINGS.particles)
    assert_same_estimates(track_all(clip, TrackerBatch(device), trackers(clip, SETTINGS, device), hidden=2), expected)


@pytest.mark.parametrize(
    ("where", "breaks_at", "counted"),
    slow_after(
        1,
        [
            ("weight", 0, True),
            ("reduce_moments", 2, False),
            ("execute", 6, True),
            ("restore_weights", 0, False),
            ("download", 0, False),
        ],
    ),  # fmt: skip
)
def test_the_cpu_carries_on_from_the_same_frame(
    clips: dict[str, Path], breaks_at: int, where: str, counted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever breaks, and whenever: the estimates are those of the CPU, and a note says from which frame on."""
    clip, calls = load_clip(clips["line"]), []

    class CudaAPIError(Exception):
        pass

    CudaAPIError.__module__ = "numba.cuda.cudadrv.driver"
    working = getattr(CudaDevice, where)

    def breaking(self: object, *given: object) -> object:
        calls.append(where)
        if len(calls) > breaks_at:
            raise CudaAPIError("[719] Call to cuCtxSynchronize results in CUDA_ERROR_LAUNCH_FAILED")
        return working(self, *given)

    hidden = 2 if where == "restore_weights" else -1
    monkeypatch.setattr(random_numbers, "MAX_SEQUENTIAL_PARTICLES", 0 if counted else 10**9)
    here = trackers(clip, SETTINGS, None)
    expected = track_all(clip, TrackerBatch(), here, hidden)
    monkeypatch.setattr(CudaDevice, where, breaking)
    device = CudaDevice()
    batch, on_device = TrackerBatch(device, fall_back_to_cpu=True), trackers(clip, SETTINGS, device)
    assert_same_estimates(track_all(clip, batch, on_device, hidden), expected)
    assert_same_numbers(on_device, here)
    assert len(calls) == breaks_at + 1
    frame = int(batch.notices[0].split("frame ")[1].split()[0])
    assert 1 <= frame <= 3
    assert batch.notices == [
        f"computed on the CPU from frame {frame} on: the GPU failed ([719] Call to cuCtxSynchronize results in "
        "CUDA_ERROR_LAUNCH_FAILED)"
    ]
    if where == "weight":
        with pytest.raises(DeviceFailure, match="^--device cuda: the GPU failed .*; --device cpu computes"):
            track_all(clip, TrackerBatch(device), trackers(clip, SETTINGS, device))


@pytest.mark.slow
def test_the_command_gives_the_same_tables(clips: dict[str, Path], tmp_path: Path) -> None:
    command = ["speed", clips["line"], "--particles", "20", "--parts", "4", "--seed", "3", "--quiet", "--no-refine"]
    done, tables = {}, {}
    for device in ("cpu", "cuda"):
        done[device] = paceline(*command, "--device", device, "-o", tmp_path / device)
        tables[device] = np.genfromtxt(tmp_path / device / "estimates.csv", delimiter=",", skip_header=1)
    assert done["cuda"] == done["cpu"]
    np.testing.assert_allclose(tables["cuda"], tables["cpu"], rtol=FILTERED, atol=1e-4)
