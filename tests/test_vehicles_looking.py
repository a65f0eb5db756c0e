"""How frames are looked through: many cards at once, what stands and what lies, and what is one vehicle over time."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_road import TWO, scene

from paceline.documents import VehicleDocument
from paceline.live_views import RawPair
from paceline.recordings import StereoFrame
from paceline.simulation.backdrops import Backdrop
from paceline.simulation.planar import RenderedClip, World, render
from paceline.speed.paths import from_points
from paceline.vehicles import live
from paceline.vehicles.agreement import Texture, correlation, counting, stands
from paceline.vehicles.finding import as_seen, found_on, in_step
from paceline.vehicles.live import APART, ENOUGH, thinned
from paceline.vehicles.plane import Aligned
from paceline.vehicles.sheets import Sheets
from paceline.vehicles.sightings import GRID, REFRESHED, SEARCH, SEARCH_WINDOW, WINDOW, Lookout, Sighting
from paceline.vehicles.tracks import Track, likeness
from paceline.vehicles.ways import Grid, Way, laid_out, pyramid

Image = NDArray[np.float32]


@cache
def clip() -> RenderedClip:
    return render(scene(*TWO))


@cache
def world() -> World:
    return World(scene(*TWO))


@cache
def way(lane: float = -1.85) -> Way:
    """The middle of a lane as it is, no matter how it was drawn."""
    points = world().road.point(np.array([80.0, 12.0]), lane)
    return Way("lane0", world().rig, from_points("lane0", "line", points))


@cache
def empty() -> tuple[Image, Image]:
    left, right = (Backdrop(world().scene, world().road, world().scene.seed).draw(view) for view in world().views)
    return left, right


def frame(index: int) -> StereoFrame:
    left, right = (np.asarray(pictures[index], np.float32) for pictures in (clip().left, clip().right))
    return StereoFrame(index, float(clip().times[index]), left, right, 0.0, duplicate=False)


# --- sheets ----------------------------------------------------------------------------------------------------------


def test_cards_on_sheets_are_those_laid_out_one_by_one() -> None:
    stations = way().stations()[::7]
    homographies = [way().homographies(s) for s in stations]
    sheets, views = Sheets(homographies, SEARCH, SEARCH_WINDOW), [pyramid(i) for i in (frame(2).left, frame(2).right)]
    assert sorted(np.concatenate(sheets.batches)) == list(range(len(stations)))
    for batch in sheets.batches:
        for view in (0, 1):
            cards = sheets.cards(sheets.lay_out(views[view], view, batch))
            for card, k in zip(cards, batch, strict=True):
                alone = laid_out(views[view], homographies[k][view], SEARCH)
                assert np.abs(card - alone).mean() < 0.5  # grey levels; positions are rounded to 1/32 px in one of them


def test_neighbours_on_a_sheet_do_not_mix() -> None:
    """What counts on a card is the same on a sheet as alone, up to its edges."""
    stations = way().stations()[10::9]
    homographies = [way().homographies(s) for s in stations]
    sheets = Sheets(homographies, SEARCH, SEARCH_WINDOW)
    views, scenes = ([pyramid(i) for i in pair] for pair in ((frame(2).left, frame(2).right), empty()))
    for batch in sheets.batches:
        now, before = ([sheets.lay_out(v, i, batch) for i, v in enumerate(pair)] for pair in (views, scenes))
        now_on, before_on = ([Texture(p, SEARCH_WINDOW) for p in pair] for pair in (now, before))
        together = sheets.cards(counting(now_on, before_on, 2.0))
        for k, counts in enumerate(together):
            a, b = ([Texture(sheets.cards(p)[k].copy(), SEARCH_WINDOW) for p in pair] for pair in (now, before))
            assert np.abs(counts - counting(a, b, 2.0)).max() < 2e-3


def test_the_coarse_look_misses_nothing_that_a_fine_one_at_all_stations_sees() -> None:
    """The first sighting lies where, of all stations, most counts on the fine card."""
    lookout, stations = Lookout([way()]), way().stations()
    for index in (0, 4, 8):
        sighting = lookout.see(frame(index), empty())[0]
        views, scenes = ([pyramid(i) for i in pair] for pair in ((frame(index).left, frame(index).right), empty()))
        areas = []
        for s in stations:
            now, before = (
                [Texture(laid_out(v, H, GRID), WINDOW) for v, H in zip(pair, way().homographies(s), strict=True)]
                for pair in (views, scenes)
            )
            areas.append(counting(now, before, 2.0).sum())
        best = int(np.argmax(areas))
        assert stations[best - 1] <= sighting.s <= stations[best + 1]


def test_the_empty_scene_is_taken_anew_as_it_changes() -> None:
    """Something that stood in the empty scene and is gone is no change any more once the scene is taken anew."""
    lookout, still = Lookout([way()]), StereoFrame(0, 0.0, *empty(), 0.0, duplicate=False)
    assert lookout.see(still, (frame(2).left, frame(2).right)) == []  # the views agree on nothing new
    later = replace(frame(2), time=2 * REFRESHED)
    assert lookout.see(later, (frame(2).left, frame(2).right)) == []
    assert lookout.see(replace(later, time=4 * REFRESHED), empty())


# --- what stands -----------------------------------------------------------------------------------------------------


def painted(lying: bool, s: float) -> tuple[Image, Image]:
    """Both views of a blot at station ``s``: on the road 3 m behind it, or upright."""
    texture = cv2.GaussianBlur(np.random.default_rng(2).normal(0, 250, (60, 60)), (0, 0), 3.0).astype(np.float32)
    source = np.array([[0, 0], [59, 0], [59, 59], [0, 59]], np.float32)
    pictures = []
    for view, picture in enumerate(empty()):
        if lying:
            ends = [way().place(s + away, x, 0.0) for away, x in ((7.0, -0.8), (7.0, 0.8), (3.0, 0.8), (3.0, -0.8))]
            corners = way().rig.project(np.array(ends))[view]
        else:
            corners = way().pixels(s, np.array([[-0.8, 1.3], [0.8, 1.3], [0.8, 0.3], [-0.8, 0.3]]))[view]
        H = cv2.getPerspectiveTransform(source, corners.astype(np.float32))
        pictures.append(picture + cv2.warpPerspective(texture, H, picture.shape[::-1]))
    return pictures[0], pictures[1]


@pytest.mark.parametrize("lying", [False, True])
def test_what_lies_on_the_road_is_told_from_what_stands(lying: bool) -> None:
    s = float(way().stations()[40])
    pictures = painted(lying, s)
    views, scenes = ([pyramid(np.asarray(i, np.float32)) for i in pair] for pair in (pictures, empty()))
    left, right = way().homographies(s)
    road = way().over_road(s) @ left
    seen, upright, flat = (
        Texture(laid_out(views[side], H, GRID), WINDOW) for side, H in ((0, left), (1, right), (1, road))
    )
    before = [Texture(laid_out(v, H, GRID), WINDOW) for v, H in zip(scenes, (left, right), strict=True)]
    counts = counting([seen, upright], before, 1.0)
    assert counts.sum() > 0
    assert (stands(counts, correlation(seen, flat)) < 1.0) == lying
    sightings = Lookout([way()]).see(replace(frame(0), left=pictures[0], right=pictures[1]), empty())
    assert len(sightings) == (0 if lying else 1)


# --- over time -------------------------------------------------------------------------------------------------------


def sighting(time: float, s: float, x: tuple[float, float] = (-0.9, 0.9), of: StereoFrame | None = None) -> Sighting:
    crops = (empty() if of is None else (of.left, of.right), np.zeros((2, 2)))
    return Sighting(round(10 * time), time, way(), s, x, (0.2, 1.5), 1.5, *crops)


def test_a_start_out_of_step_is_not_taken() -> None:
    times = np.arange(8) / 5
    aligned = [Aligned(sighting(t, 5 + 14 * t), 5 + 14 * t, np.zeros(2), 0.8) for t in times]
    assert in_step(aligned) == aligned
    wrong = [replace(aligned[0], s=9.0), *aligned[1:]]
    assert in_step(wrong) == aligned[1:]
    assert in_step(aligned[:2]) == aligned[:2]


@given(speed=st.floats(-30, 30), n=st.integers(4, 30), seed=st.integers(0, 1000))
def test_travel_is_the_way_that_was_driven(speed: float, n: int, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(0, 0.02, n)
    track = Track(way_s=(speed * 0.1 * np.arange(n) + noise).tolist())
    assert track.travel == pytest.approx(speed * 0.1 * (n - 1), abs=0.2 + 0.05 * abs(speed))


def test_frames_without_a_sighting_are_counted_only_between_sightings() -> None:
    track = Track()
    for time, unseen in ((0.0, 0), (0.3, 2), (0.4, 0)):
        track.unseen = unseen
        track.add(sighting(time, 10 + time))
    track.unseen = 5
    assert track.missed == 2


def test_a_face_is_known_again_within_a_wider_sighting() -> None:
    at = next(r for r in clip().truth if r["vehicle"] == "v0" and r["frame"] == 3)
    s = way().path.nearest(np.array(at["position"]))
    narrow = sighting(0.6, s, (-0.9, 0.9), frame(3))
    wide = sighting(0.6, s, (-0.9, 2.9), frame(3))
    assert likeness(narrow, wide) > 0.95 and likeness(wide, narrow) > 0.95
    assert likeness(narrow, sighting(0.6, s + 12.0, (-0.9, 0.9), frame(3))) < 0.6


@given(n=st.integers(1, 400), rate=st.floats(2.0, 60.0))
def test_no_more_pairs_are_measured_on_than_needed_and_none_far_apart(n: int, rate: float) -> None:
    blank = np.zeros((1, 1), np.uint8)
    pairs = [RawPair(k, k / rate, blank, blank, 0.0) for k in range(n)]
    chosen = thinned(pairs)
    apart = np.diff([pair.time for pair in chosen])
    assert chosen[0] is pairs[0]
    assert (apart <= max(1.1 * APART, 1 / rate) + 1e-9).all()
    assert len(chosen) <= ENOUGH or np.allclose(apart, apart[0])
    if n <= ENOUGH:
        assert chosen == pairs


def test_a_grid_knows_its_cells() -> None:
    grid = Grid(left=-1.0, top=2.0, bottom=0.5, cell=0.25)
    assert grid.size == (len(grid.x), len(grid.y)) == (9, 7)
    assert (grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]) == (-1.0, 1.0, 2.0, 0.5)


# --- the desk --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OneClip:
    """What the desk changes of a clip."""

    vehicles: list[VehicleDocument]


class Slow:
    """A measuring process that answers only when asked to: outlines as given, and a measurement for each clip."""

    def __init__(self, outlines: dict[int, VehicleDocument | None]) -> None:
        self.outlines = outlines
        self.jobs: list[Any] = []

    def submit(self, job: Any, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.jobs.append((future, job, arguments))
        return future

    def work(self) -> None:
        jobs, self.jobs = self.jobs, []
        for future, job, arguments in jobs:
            if job is found_on:
                track = arguments[0]
                vehicle = self.outlines[track.first.frame]
                future.set_result(replace(as_seen(track, "" if vehicle else "smooth"), vehicle=vehicle))
            else:
                future.set_result((arguments[0].vehicles[0].id, [pair.index for pair in arguments[1]]))


def seen_at(index: int) -> Track:
    track = Track()
    track.add(replace(sighting(0.1 * index, 10.0), frame=index))
    return track


def outlined(index: int) -> VehicleDocument:
    quad = np.zeros((4, 2))
    return VehicleDocument("", "lane0", index, quad, quad, "front", None)


def test_vehicles_are_told_in_order_and_only_those_outlined_are_numbered() -> None:
    blank = np.zeros((1, 1), np.uint8)
    told: list[Any] = []
    recent = [RawPair(k, 0.1 * k, blank, blank, 0.0) for k in range(5, 15)]
    process = Slow({6: outlined(7), 8: None, 9: outlined(9), 2: outlined(2)})
    desk = live._Desk(OneClip([]), None, process, lambda *said: told.append(said))  # type: ignore[arg-type]
    for index in (6, 8, 9, 2):
        desk.take(seen_at(index), recent)
    desk.tell()
    assert told == []  # nothing is known yet, and nobody has waited for it
    for _ in range(2):
        process.work()
        desk.tell()
    names = [found.vehicle and found.vehicle.id for found, _, _ in told]
    assert names == ["v0", None, "v1", "v2"]
    assert [measurement for _, measurement, _ in told] == [
        ("v0", list(range(7, 15))),
        None,
        ("v1", list(range(9, 15))),
        None,
    ]
    assert [reason for _, _, reason in told] == ["", "smooth", "", live.FORGOTTEN]


def test_vehicles_that_come_too_fast_are_told_without_a_measurement() -> None:
    blank = np.zeros((1, 1), np.uint8)
    told: list[Any] = []
    recent = [RawPair(k, 0.1 * k, blank, blank, 0.0) for k in range(20)]
    process = Slow({3: None})
    desk = live._Desk(None, None, process, lambda *said: told.append(said))  # type: ignore[arg-type]
    for _ in range(live.BACKLOG + 2):
        desk.take(seen_at(3), recent)
    process.work()
    desk.tell()
    assert [reason for _, _, reason in told] == ["smooth"] * live.BACKLOG + [live.BUSY] * 2
