"""What a recording tells of its cameras that its files do not state: the time between the views, and how they turn.

It is estimated once, before anything is measured, so that all methods see the same frames: those of cameras that do
not turn, each at its time. What remains uncertain, the refinement estimates further, together with the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import norm

from paceline.arrays import Array, Image, Indices
from paceline.blas import on_one_blas_thread
from paceline.cameras import VIEW_NAMES, Quantity, StereoRig
from paceline.documents.loading import Clip, VehicleDocument, require_same_part
from paceline.errors import UnusableInput
from paceline.imaging.camera_rotation import MIN_KNOWN_SHARE, CameraRotations, estimate_rotations, expected_rotations
from paceline.imaging.epipolar_fit import MIN_RATE_STD, EpipolarFit, fit_epipolar_residuals
from paceline.imaging.feature_matches import InstantFeatures, match_static, middle_of, velocity_step
from paceline.imaging.frame_lag import estimate_lag
from paceline.imaging.frame_times import FrameTimes, estimate_frame_times
from paceline.imaging.lasting_turns import LastingTurn, lasting_turn
from paceline.imaging.moving_features import moving_features
from paceline.imaging.outline_motion import displacement_between_exposures, followed, motion_by_depth
from paceline.number_format import format_uncertain
from paceline.progress import Progress
from paceline.recordings.stereo import StereoFrame, StereoRecording, counted_frames
from paceline.units import COVERAGE_95
from paceline.verdicts import Message, message

# Readout of a camera whose shutter nothing is said of: of ordinary rolling shutters it is 8 to 30 ms, of global ones 0
READOUT_STD_S = 0.012
# By which one camera's clock gains on the other's: quartz oscillators are within 20 to 50 ppm of their frequency
CLOCK_RATE_STD = 5e-5
MIN_OFFSET_SIGMA = 3.0  # standard deviations at which an offset between the views is reported
MAX_RIG_SHIFT_SIGMA = 4.0  # prior standard deviations (Mahalanobis distance) at which a calibration is called stale


@dataclass(frozen=True, eq=False)
class RecordedCameras:
    """A ``clip`` and its ``recording`` as seen by cameras that do not turn, each frame at its time.

    ``rotations`` are those of the cameras as they recorded, and ``fit`` is what matches between the views tell of the
    rig and of the time between their exposures. ``lag`` (s) is that by which two videos were paired anew, 0 where they
    were not. ``rate`` (s/s) is that by which the offset grows, None where it is stated. ``frame_times`` say when the
    frames of both views were taken, where that is not as stated.
    """

    clip: Clip
    recording: StereoRecording
    rotations: CameraRotations
    fit: EpipolarFit
    lag: float = 0.0
    rate: Quantity | None = None
    frame_times: FrameTimes | None = None

    def as_recorded(self, frame: Indices, pixels: Array, side: int) -> Array:
        """Where ``pixels`` (N, …, 2) of the frames (N,) are in the pictures as recorded, free of distortion."""
        if self.recording.rotations is None:
            return pixels
        n = np.searchsorted(self.recording.indices, frame)
        vectors = self.recording.rotations[n, side]
        camera = self.recording.rig.cameras[side]
        return camera.turned(pixels, vectors.reshape(len(frame), *(1,) * (pixels.ndim - 2), 3))

    def with_recorded_outlines(self, clip: Clip, recorded: StereoRecording) -> Clip:
        """``clip`` with the outlines of its vehicles, found in this recording, where the pictures of the ``recorded``
        one show them, in its pairs: as a clip.yaml holds them."""
        vehicles = []
        for v in clip.vehicles:
            frames = np.array([v.frame])
            left, right = (self.as_recorded(frames, o[None], side)[0] for side, o in enumerate((v.left, v.right)))
            vehicles.append(replace(v, left=left, right=right))
        clip = replace(clip, vehicles=vehicles)
        return with_outlines_in_pairs(clip, self.recording, recorded) if self.lag else clip

    def with_vehicles(self, clip: Clip) -> RecordedCameras:
        """The same for the vehicles of ``clip``, with how far each moves from the left exposure of its frame to the
        right one."""
        vehicles = [replace(v, displacement=displacement_of(v, clip.rig, self.recording)) for v in clip.vehicles]
        return replace(self, clip=replace(clip, vehicles=vehicles))

    @property
    def notices(self) -> list[Message]:
        """What a user should know about the cameras."""
        notices, offset = [*self._rotation_notices(), *self._time_notices()], self.clip.offset
        shift, epipolar = self.fit.rig_shift_sigma, self.fit.epipolar_px
        if epipolar is not None and shift > MAX_RIG_SHIFT_SIGMA:
            notices.append(message("calibration_stale", epipolar_px=epipolar.value, shift=shift))
        if offset is not None and offset.source == "estimated" and abs(offset.value) > MIN_OFFSET_SIGMA * offset.std:
            milliseconds = format_uncertain(1e3 * offset.value, 1e3 * COVERAGE_95 * offset.std)
            notices.append(message("views_not_simultaneous", offset=milliseconds))
        return notices

    @cached_property
    def _lasting_turns(self) -> list[tuple[LastingTurn, float]]:
        """What lasts of each view's rotations, as far as they are known, and when (s) it was knocked."""
        turns: list[tuple[LastingTurn, float]] = [(LastingTurn(), np.nan)] * 2
        if (corrected := self.recording.rotations) is None:
            return turns
        times = self.recording.times if self.frame_times is None else self.frame_times.times
        for side, camera in enumerate(self.clip.rig.cameras):
            if not corrected[:, side].any():
                continue
            order = np.argsort(times, kind="stable")
            order = order[self.rotations.is_known[order, side]]
            turn = lasting_turn(times[order], camera.K[0, 0] * self.rotations.vectors[order, side, :2])
            turns[side] = turn, float(times[order][max(turn.knocked, 0) :][:2].mean())
        return turns

    @property
    def _knocks(self) -> list[dict[str, Any]]:
        """The lasting changes of pose in mid-recording, as in summary.json."""
        return [
            {"time_s": time, "view": view, "px": turn.knock_px}
            for view, (turn, time) in zip(VIEW_NAMES, self._lasting_turns, strict=True)
            if turn.knock_px
        ]

    def _rotation_notices(self) -> list[Message]:
        """What of the rotations is not known, and so not corrected, and what of them lasts."""
        known, turning = self.rotations.is_known, self.recording.rotations
        frames, notices = len(known), []
        for side, (view, count) in enumerate(zip(VIEW_NAMES, known.sum(axis=0).tolist(), strict=True)):
            if count < MIN_KNOWN_SHARE * frames:
                notices.append(message("cameras_travel", view=view, known=count, frames=frames))
            elif turning is not None and turning[:, side].any() and count < frames:
                notices.append(message("rotation_unknown", view=view, unknown=frames - count, frames=frames))
        return [*notices, *(message("knock", view=k["view"], time_s=k["time_s"], px=k["px"]) for k in self._knocks)]

    def _time_notices(self) -> list[Message]:
        """What is wrong with the frames' times and order."""
        notices: list[Message] = []
        if (found := self.frame_times) is None:
            return notices
        if found.gaps:
            gaps = ", ".join(f"{count} between frames {a} and {b}" for a, b, count in found.gaps)
            notices.append(message("frames_missing_estimated", gaps=gaps))
        if len(found.unordered):
            notices.append(message("frames_out_of_order", frames=counted_frames(found.unordered)))
        if not found.clear.all():
            frames = counted_frames(found.indices[~found.clear])
            notices.append(message("frame_times_unclear", frames=frames))
        if len(found.repeated):
            frames = counted_frames(found.repeated)
            notices.append(message("frames_repeated", source="left and right", frames=frames))
        return notices

    def summary(self) -> dict[str, Any]:
        """What was estimated of both cameras beside the exposures, as in summary.json."""
        rig, rotations, epipolar = self.clip.rig, self.recording.rotations, self.fit.epipolar_px
        views = {}
        for side, (name, camera) in enumerate(zip(VIEW_NAMES, rig.cameras, strict=True)):
            moved = np.zeros((1, 2)) if rotations is None else rotations[:, side, :2] * camera.K[0, 0]
            sway, drift = float(np.sqrt((moved**2).sum(-1).mean())), self._lasting_turns[side][0].drift_px_per_min
            views[name] = {"sway_px_rms": sway, "drift_px_per_min": drift}
        return {
            **views,
            "knocks": self._knocks,
            "epipolar_px": None if epipolar is None else {"value": epipolar.value, "std": epipolar.std},
            "assumed": ["rig"] if rig.uncertainty is not None and rig.uncertainty.is_assumed else [],
        }


@on_one_blas_thread
def estimate_cameras(clip: Clip, recording: StereoRecording, progress: Progress | None = None) -> RecordedCameras:
    """What ``recording`` tells of the cameras of ``clip``, and both corrected for it.

    Two videos of which nothing is stated are paired anew where what moves lags in one of them. Of cameras that travel,
    as on a vehicle, neither rotations nor the frames' times are corrected. Raises UnusableInput for a ``drawn_on`` that
    is no frame, an ``offset`` by which other frames belong together, or outlines that are of no one part of a vehicle.
    """
    interval = recording.pairing.interval
    if clip.offset is not None and abs(clip.offset.value) > interval:
        raise UnusableInput(
            f"{clip.path}: offset: expected at most the {interval:.3g} s between frames, as those of about the same "
            f"time in the files belong together, found {clip.offset.value:g}"
        )
    lag = 0.0
    if clip.offset is None and all(source.times is not None for source in recording.sources):
        lag = estimate_lag(recording)
    if lag:
        recorded, recording = recording, recording.with_lag(lag)
        clip = with_outlines_in_pairs(clip, recorded, recording)
    rig = with_readouts(clip.rig)
    rotations = estimate_rotations(recording, reference_frame(clip, recording, lag), progress)
    vectors = expected_rotations(rotations) if rotations.is_stationary else np.zeros_like(rotations.vectors)
    steady = recording.corrected(0.0, vectors if vectors.any() else None)
    frame_times, of_instants = None, InstantFeatures(steady)
    if rotations.is_stationary:
        features = of_instants.passing(moving_features(steady.rig, steady.frames()))
        frame_times = estimate_frame_times(steady, features, [v.frame for v in clip.vehicles], progress)
        if not frame_times.kept.all() or frame_times.gaps:
            steady = steady.retimed(frame_times.times, frame_times.kept)
            clip = with_kept_frames(clip, frame_times)
            of_instants = InstantFeatures(steady)
    if clip.offset is not None and rig.uncertainty is None:  # matches could tell nothing that is not known
        fit = EpipolarFit(rig, 0.0, None, None)
    else:
        expected = clip.offset or Quantity(0.0, interval / 2, "assumed")
        static, moving = match_static(steady), of_instants.matches()
        rate_std = CLOCK_RATE_STD if clip.offset is None else MIN_RATE_STD
        fit = fit_epipolar_residuals(rig, static, moving, expected, readout_difference_std(rig), rate_std)
    offset = clip.offset or (fit.offset if lag and fit.offset else expected_offset(fit.offset, interval))
    late, rate = np.full(len(steady), offset.value), None
    if clip.offset is None:
        rate, since_middle = expected_rate(fit.rate), steady.times - middle_of(steady.times)
        late += rate.value * since_middle
        offset = replace(offset, std=float(np.hypot(offset.std, growth_std(rate, steady.times))))
    steady = steady.corrected(late, steady.rotations)
    offset = replace(offset, value=lag + offset.value)
    clip = replace(clip, rig=fit.rig, offset=offset)
    cameras = RecordedCameras(clip, steady, rotations, fit, lag, rate, frame_times)
    cameras = cameras.with_vehicles(with_steady_outlines(cameras))
    for i, vehicle in enumerate(cameras.clip.vehicles):
        require_same_part(clip.path, fit.rig, i, vehicle)
    return cameras


def reference_frame(clip: Clip, recording: StereoRecording, lag: float = 0.0) -> StereoFrame:
    """The frame on which paths were drawn, the first one where the ``clip`` states none. Raises UnusableInput.

    After a ``lag`` (s) was found that frame may have no partner: then it is the next one that has.
    """
    n = clip.drawn_on
    frame = next(recording.frames() if n is None else recording.frames(n, None if lag else n + 1), None)
    if frame is not None:
        return frame
    if n is None:
        raise UnusableInput(f"{clip.path}: left and right: no two frames that belong together can be decoded")
    raise UnusableInput(
        f"{clip.path}: drawn_on: frame {n} cannot be used; expected one from {recording.indices[0]} to "
        f"{recording.indices[-1]} that is whole in both views"
    )


def expected_offset(estimate: Quantity | None, interval: float) -> Quantity:
    """The offset (s) of cameras of which half are triggered together and half are not: then it is anywhere within
    half a frame ``interval`` (s).

    ``estimate`` is what moving points tell, None where they do not. The refinement estimates the offset anew, so its
    standard deviation is that from either case.
    """
    if estimate is None:
        return Quantity(0.0, interval / 2, "assumed")
    density = float(norm.pdf(estimate.value, scale=estimate.std))
    value = estimate.value / (1.0 + interval * density)
    return Quantity(value, float(np.hypot(estimate.std, estimate.value - value)), "estimated")


def expected_rate(estimate: Quantity | None) -> Quantity:
    """The rate (s/s) by which the offset grows, of cameras of which half run by one clock and half by two.

    ``estimate`` is what moving points tell, None where they do not; where that is little, as in a short recording, it
    is left alone.
    """
    if estimate is None or estimate.std > 0.5 * CLOCK_RATE_STD:
        return Quantity(0.0, CLOCK_RATE_STD, "assumed")
    of_one, of_two = (
        norm.logpdf(estimate.value, scale=std) for std in (estimate.std, np.hypot(estimate.std, CLOCK_RATE_STD))
    )
    value = float(estimate.value * expit(of_two - of_one))
    return Quantity(value, float(np.hypot(estimate.std, estimate.value - value)), "estimated")


def growth_std(rate: Quantity, times: Array) -> float:
    """Standard deviation (s), RMS over frames at ``times`` (N,), of what the offset has grown by since the middle of
    the recording at this ``rate`` (s/s)."""
    return rate.std * float(np.sqrt(((times - middle_of(times)) ** 2).mean()))


def with_assumed_exposures(clip: Clip, interval: float) -> Clip:
    """The clip of cameras of which nothing was estimated, at a frame ``interval`` (s): what it does not state of their
    exposures is assumed."""
    offset = clip.offset or expected_offset(None, interval)
    return replace(clip, rig=with_readouts(clip.rig), offset=offset)


def with_readouts(rig: StereoRig) -> StereoRig:
    """A rig of cameras whose readouts are assumed where they are not known."""
    assumed = Quantity(0.0, READOUT_STD_S, "assumed")
    left, right = (replace(camera, readout=camera.readout or assumed) for camera in rig.cameras)
    return replace(rig, left=left, right=right)


def readout_difference_std(rig: StereoRig) -> float:
    """Standard deviation (s) of the right readout minus the left one."""
    left, right = (0.0 if camera.readout is None else camera.readout.std for camera in rig.cameras)
    return max(float(np.hypot(left, right)), 1e-9)


def with_kept_frames(clip: Clip, frame_times: FrameTimes) -> Clip:
    """The clip with its vehicles outlined on the frames that are kept of those that show the same."""
    kept_frame = dict(zip(frame_times.indices.tolist(), frame_times.kept_frame.tolist(), strict=True))
    vehicles = [replace(v, frame=kept_frame[v.frame]) if kept_frame.get(v.frame, -1) >= 0 else v for v in clip.vehicles]
    return replace(clip, vehicles=vehicles)


def with_steady_outlines(cameras: RecordedCameras) -> Clip:
    """The clip with the outlines of its vehicles, each drawn on a picture as recorded, where cameras that do not turn
    see them."""
    vectors, clip = cameras.recording.rotations, cameras.clip
    if vectors is None:
        return clip
    index_of = {int(frame): n for n, frame in enumerate(cameras.recording.indices)}
    vehicles = []
    for vehicle in clip.vehicles:
        if (n := index_of.get(vehicle.frame)) is not None:
            left, right = (
                camera.turned(outline, -vector)
                for camera, outline, vector in zip(
                    cameras.recording.rig.cameras, (vehicle.left, vehicle.right), vectors[n], strict=True
                )
            )
            vehicle = replace(vehicle, left=left, right=right)
        vehicles.append(vehicle)
    return replace(clip, vehicles=vehicles)


def with_outlines_in_pairs(clip: Clip, recorded: StereoRecording, paired: StereoRecording) -> Clip:
    """The clip with the outlines of its vehicles, each drawn on frames that were ``recorded`` as a pair, in the frames
    that are ``paired``.

    That is the left frame, or the next one that has a partner, and its partner: each outline is followed there.
    """
    vehicles = []
    for vehicle in clip.vehicles:
        before = int(np.searchsorted(recorded.indices, vehicle.frame))
        after = int(np.searchsorted(paired.indices, vehicle.frame))
        if before < len(recorded) and recorded.indices[before] == vehicle.frame and after < len(paired):
            pairs = zip(
                recorded.pairing.numbers[:, before].tolist(), paired.pairing.numbers[:, after].tolist(), strict=True
            )
            outlines = [
                followed(pictures_between(recorded, side, *numbers), outline)
                for side, (outline, numbers) in enumerate(zip((vehicle.left, vehicle.right), pairs, strict=True))
            ]
            frame = int(paired.indices[after])
            vehicle = replace(vehicle, frame=frame, left=outlines[0], right=outlines[1])
        vehicles.append(vehicle)
    return replace(clip, vehicles=vehicles)


def pictures_between(recording: StereoRecording, side: int, first: int, last: int) -> list[Image]:
    """Pictures of one view from the ``first`` number in its file to the ``last``, at velocity steps or less."""
    low, high = min(first, last), max(first, last)
    numbers = list(range(low, high, velocity_step(recording)))
    pictures = [p for p in recording.view(side, [*numbers, high]) if p is not None]
    return pictures if first < last else pictures[::-1]


def displacement_of(vehicle: VehicleDocument, rig: StereoRig, recording: StereoRecording) -> Array:
    """How far (3,) m a ``vehicle`` moves from the left exposure of its frame to the right one.

    That is by the motion of its left outline within the next frames or, at the end of a recording, those before.
    """
    n = int(np.searchsorted(recording.indices, vehicle.frame))
    if n == len(recording) or recording.indices[n] != vehicle.frame or not recording.skews[n]:
        return np.zeros(3)
    step = velocity_step(recording)
    numbers = recording.indices[[n, n + step if n + step < len(recording) else max(n - step, 0)]]
    frames = {frame.index: frame for frame in recording.frames(int(numbers.min()), int(numbers.max()) + 1)}
    if len(frames) < 2:
        return np.zeros(3)  # one of them cannot be decoded
    first, second = (frames[number] for number in numbers.tolist())
    motion = motion_by_depth(rig, first.left, second.left, vehicle.left, second.time - first.time)
    return displacement_between_exposures(rig, vehicle.left, vehicle.right, first.skew, motion)
