"""Many vehicles at once found without clicking, in good and in bad sight, and an empty road on which none may be found.

python benchmarks/dense_traffic.py [--scenes 48] [--seed 0] [--empty 10] [--count]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from common import head, machine, rms, row
from distractors import Bush, Image, Shade, body, bushes, fill, night, rain, shades
from numpy.typing import NDArray
from vehicles import Speed, speeds, who

from paceline.detection.background_model import RunningMedianBackground
from paceline.detection.finder import VehicleFinder
from paceline.detection.lane_paths import lane_paths_of
from paceline.detection.search import find_vehicles
from paceline.documents.loading import Clip, load_clip
from paceline.recordings.background import background_from
from paceline.recordings.stereo import StereoFrame, open_recording
from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, World, render, write
from paceline.simulation.stereo.scenery import StaticBackground, make_occluder
from paceline.simulation.stereo.textured_planes import TexturedPlane

KINDS = ("plain", "pole", "shadows", "bushes", "rain", "night", "noise", "light")
FRAMES, VISIBLE = 8, 0.97  # in which so much of a face has to be seen in both views, for a vehicle to count,
NEAR, FAR = 8.0, 80.0  # m away,
LARGE = 16.0, 6.0  # px wide and high
SECONDS = 5.0  # of a scene
APART = 18.0  # m between two vehicles in a lane at least
COUNTED = "vehicles", "once", "twice", "missed", "false", "with a speed"
EMPTY_RATE, EMPTY_SIZE = 10.0, (480, 360)
BACKGROUND_S = 30.0  # s of the empty road


def scene(seed: int, kind: str) -> Scene:
    """Two to four vehicles in two lanes, seen from beside or above the road."""
    rng = np.random.default_rng([seed, 31])
    rate, height = float(rng.choice([5.0, 8.0])), rng.uniform(1.8, 4.5)
    vehicles: list[Vehicle] = []
    for lane, receding in ((-1.85, False), (1.85, True)):
        speed = rng.uniform(8, 22)
        at = rng.uniform(50, 90) if not receding else rng.uniform(0, 30)
        for _ in range(int(rng.integers(1, 3))):
            wide = float(rng.choice([0.8, 1.75, 1.8, 1.9, 2.4], p=[0.1, 0.25, 0.25, 0.2, 0.2]))
            tall = {0.8: 0.8, 2.4: 1.6}.get(wide, rng.uniform(0.55, 0.8))
            vehicles.append(
                Vehicle(
                    f"t{len(vehicles)}",
                    speed,
                    acceleration=float(rng.choice([0.0, 0.0, rng.uniform(-0.8, 0.8)])),
                    start_distance=at,
                    lane=lane,
                    lateral=rng.normal(0, 0.2),
                    receding=receding,
                    width=wide,
                    height=tall,
                    texture_seed=int(rng.integers(10**6)),
                    relief=rng.uniform(0, 0.04),
                    glare=kind == "light" and rng.random() < 0.5,
                )
            )
            at += (-1 if receding else 1) * rng.uniform(APART, 2 * APART)
            speed = speed * rng.uniform(0.9, 1.0)  # those behind are no faster
    of = Scene(
        seed,
        tuple(vehicles),
        image_size=(640, 480),
        focal=rng.uniform(1100, 1500),
        camera_height=height,
        tilt=height / 45.0,
        road_direction=rng.uniform(-0.03, 0.03),
        road_offset=rng.uniform(-2.0, 2.0),
        road_depth=40.0,
        rate=rate,
        frames=round(SECONDS * rate),
        noise_sigma=0.0,
        blur_sigma=rng.uniform(0.5, 0.8),
        gain_drift=0.12 if kind == "light" else 0.0,
        occluder=kind == "pole",
    )
    return with_seen(of)


def with_seen(of: Scene) -> Scene:
    """A scene with those of its vehicles that are ever wholly inside both images."""
    return replace(of, vehicles=tuple(v for v in of.vehicles if _is_seen(replace(of, vehicles=(v,)))))


def _is_seen(of: Scene) -> bool:
    try:
        World(of)
    except ValueError:
        return False
    return True


def filmed(of: Scene, kind: str) -> RenderedClip:
    """The clip of a scene with what makes its ``kind`` hard; the sensor's noise comes last."""
    plain, world, rng = render(of), World(of), np.random.default_rng([of.seed, 37])
    noise = rng.uniform(2.0, 3.5) if kind == "noise" else rng.uniform(0.6, 1.5)
    dark = shades(world, rng, of.frames / of.rate) if kind == "shadows" else []
    green = _bushes(world, kind)
    drops = int(rng.integers(100, 400))
    views: list[list[NDArray[np.uint8]]] = []
    for i, pictures in enumerate((plain.left, plain.right)):
        views.append([])
        for k, picture in enumerate(pictures):
            image, t = picture.astype(np.float32), float(world.clocks[i][k])
            _spoil(image, world, i, k, t, dark, green)
            if kind == "rain":
                rain(image, rng, drops)
            if kind == "night":
                night(image, world, i, k)
            views[i].append(_exposed(image, noise, rng))
    return replace(plain, left=views[0], right=views[1])


def _spoil(image: Image, world: World, i: int, k: int, t: float, dark: list[Shade], green: list[Bush]) -> None:
    """Paint shadows, and bushes behind the vehicles that are nearer, on the picture of view ``i``, in place."""
    view = world.views[i]
    for shade in dark:
        shade.cast(image, world.road, view, t)
    for bush in green:
        nearer = np.zeros(image.shape, np.uint8)
        for vehicle, track in zip(world.scene.vehicles, world.poses[i], strict=True):
            if 1.0 < view.depth(track[k].centre) < view.depth(bush.card.corner):
                fill(nearer, view.project(body(vehicle, track[k])))
        behind = image.copy()
        bush.wave(image, view, t)
        image[nearer > 0] = behind[nearer > 0]


def _exposed(image: Image, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    image = image + noise * rng.standard_normal(image.shape, np.float32)
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def countable(of: Scene, kind: str) -> list[str]:
    """The vehicles that are to be found: unhidden, large enough and within range for long enough."""
    world = World(of)
    before = [bush.card for bush in _bushes(world, kind)]
    if of.occluder:  # as the renderer draws it
        before.append(make_occluder(world.road, world.poses[0][0], np.random.default_rng([of.seed, 17])))
    frame_counts: Counter[str] = Counter()
    for k in range(of.frames):
        clear = set(_clear_in(world, 0, k, before)) & set(_clear_in(world, 1, k, before))
        frame_counts.update(clear & {r["vehicle"] for r in world.truth if r["frame"] == k and _in_range(r)})
    return [name for name, frames in frame_counts.items() if frames >= FRAMES]


def _bushes(world: World, kind: str) -> list[Bush]:
    return bushes(world, np.random.default_rng([world.scene.seed, 43])) if kind == "bushes" else []


def _in_range(row: dict[str, object]) -> bool:
    size = np.ptp(np.array(row["left"]), axis=0)
    return bool(row["inside"]) and NEAR <= np.array(row["position"])[2] <= FAR and bool((size >= LARGE).all())


def _clear_in(world: World, i: int, k: int, before: list[TexturedPlane]) -> Iterator[str]:
    """The vehicles of which nothing is hidden in a view by what is nearer."""
    view, nearer = world.views[i], np.zeros(world.scene.image_size[::-1], np.uint8)
    cards = sorted(before, key=lambda card: float(view.depth(card.corner)))
    for vehicle, pose in sorted(
        zip(world.scene.vehicles, (track[k] for track in world.poses[i]), strict=True), key=lambda p: p[1].centre[2]
    ):
        corners = pose.corners(vehicle.width, vehicle.height)
        if view.depth(corners).min() > 1.0:
            while cards and view.depth(cards[0].corner) < view.depth(pose.centre):
                fill(nearer, view.project(cards.pop(0).corners()))
            region = np.zeros_like(nearer)
            fill(region, view.project(corners))
            if region.any() and (region & ~nearer & 1).sum() >= VISIBLE * region.sum():
                yield vehicle.id
            fill(nearer, view.project(body(vehicle, pose)))


@dataclass
class Tally:
    """What came of the scenes of one kind."""

    counts: Counter[str] = field(default_factory=Counter)
    speeds: list[Speed] = field(default_factory=list)

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.counts + other.counts, self.speeds + other.speeds)

    def cells(self) -> list[object]:
        good = [s for s in self.speeds if s.is_measured]
        covered = f"{sum(abs(s.error) <= s.half for s in good)} of {len(good)}"
        return [
            *(self.counts[name] for name in COUNTED),
            f"{len(good)} of {len(self.speeds)}",
            f"{rms([s.error for s in good]):.2f}" if good else "",
            covered,
        ]


def written(rendered: RenderedClip, folder: str) -> Clip:
    """The clip, in a folder, without outlines: where vehicles are first seen those may be too small to be drawn."""
    return load_clip(write(replace(rendered, clip={**rendered.clip, "vehicles": []}), folder))


def play(seed: int, kind: str, tally: Tally, count: bool) -> list[str]:
    """Find the vehicles of a scene, and measure them but for a ``count``; what went wrong."""
    of = scene(seed, kind)
    with tempfile.TemporaryDirectory() as folder:
        rendered = filmed(of, kind)
        clip, truth = written(rendered, folder), rendered.truth
        recording = open_recording(clip)
        search = find_vehicles(clip, recording)
        names = [who(clip, v, truth) for v in search.clip.vehicles]
        times, expected = Counter(name for name in names if name is not None), countable(of, kind)
        both = zip(search.clip.vehicles, names, strict=True)
        real = {n: replace(v, id=n) for v, n in both if n is not None and not count}
        results = speeds(replace(clip, vehicles=list(real.values())), recording, list(real), truth)
        tally.speeds.extend(results.values())
        tally.counts["with a speed"] += sum(s.is_measured for name, s in results.items() if name in expected)
    wrong = {
        "missed": [n for n in expected if times[n] == 0],
        "twice": [n for n, count in times.items() if count > 1],
        "false": ["?"] * names.count(None),
    }
    tally.counts.update(vehicles=len(expected), once=sum(times[n] == 1 for n in expected))
    tally.counts.update({what: len(who) for what, who in wrong.items()})
    wrong["outside its interval"] = [f"{n} {s}" for n, s in results.items() if s.is_measured and abs(s.error) > s.half]
    return [f"{kind} {seed}: {', '.join(names)} {what}" for what, names in wrong.items() if names]


def empty_scene(seed: int) -> Scene:
    return with_seen(replace(scene(seed, "plain"), image_size=EMPTY_SIZE, focal=900.0))


def empty_road(minutes: float, seed: int) -> Iterator[StereoFrame]:
    """A road on which nothing drives but shadows, between bushes in the wind and below trees, in changing light."""
    of = empty_scene(seed)
    world, rng = World(of), np.random.default_rng([seed, 41])
    stills = [StaticBackground(of, world.road, of.seed).draw(view) for view in world.views]
    green, swaying = bushes(world, rng), [s for s in shades(world, rng, 1.0) if s.swing]
    sliding: list[Shade] = []
    for k in range(int(60 * minutes * EMPTY_RATE)):
        t = k / EMPTY_RATE
        if k % 40 == 0:  # each for 8 s at most
            sliding = (
                sliding[-1:]
                + [replace(s, s=s.s - t * s.velocity[0]) for s in shades(world, rng, 4.0) if not s.swing][:1]
            )
        views = []
        for i, still in enumerate(stills):
            image = still * np.float32(1 + 0.15 * np.sin(0.05 * t) + 0.05 * np.sin(0.9 * t))
            for shade in (*swaying, *sliding):
                shade.cast(image, world.road, world.views[i], t)
            for bush in green:
                bush.wave(image, world.views[i], t)
            views.append(_exposed(image, 1.0, rng).astype(np.float32))
        yield StereoFrame(k, t, views[0], views[1], 0.0, duplicate=False)


def nothing(minutes: float, seed: int) -> str:
    """What is found on an empty road after it has been learned."""
    with tempfile.TemporaryDirectory() as folder:
        clip = written(render(empty_scene(seed)), folder)  # for its paths
    frames = empty_road(minutes + BACKGROUND_S / 60, seed)
    learned = [frame for k, frame in enumerate(islice(frames, int(BACKGROUND_S * EMPTY_RATE))) if k % 10 == 0]
    background = background_from(
        *([f.astype(np.float16) for f in views] for views in zip(*((f.left, f.right) for f in learned), strict=True))
    )
    finder = VehicleFinder(lane_paths_of(clip), RunningMedianBackground(background.images))
    seconds, count, found = 0.0, 0, 0
    for frame in frames:
        start_time = time.process_time()
        found += len(finder.process(frame))
        seconds, count = seconds + time.process_time() - start_time, count + 1
    found += len(finder.finish())
    return (
        f"{count} frames of an empty road ({count / EMPTY_RATE / 60:.1f} min, seed {seed}): {found} found, "
        f"{1000 * seconds / count:.0f} ms of processor time for each"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Many vehicles at once found without clicking.")
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--empty", type=float, default=10.0, help="minutes of an empty road")
    parser.add_argument("--count", action="store_true", help="find vehicles, but do not measure them")
    args = parser.parse_args()
    tallies = {kind: Tally() for kind in args.kinds}
    for k in range(args.scenes):
        kind = args.kinds[k % len(args.kinds)]
        for line in play(args.seed + k, kind, tallies[kind], args.count):
            print(line, flush=True)
    print(head("kind", *COUNTED, "measured of all found", "mph rms", "within 95 %"))
    for kind, tally in tallies.items():
        print(row(kind, *tally.cells()))
    print(row("all", *sum(tallies.values(), Tally()).cells()), flush=True)
    if args.empty:
        print(f"\n{nothing(args.empty, args.seed)}")
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
