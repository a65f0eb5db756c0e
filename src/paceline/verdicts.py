"""Every verdict and notice: its code, message, severity and advice.

A code is stable: programs may rely on it. A message may change, except that a rejection keeps the words before its
colon; it names the tested quantity, its value and its limit. Advice is found by code, never by words of a message.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """What a message means for a result."""

    REJECTED = "rejected"  # the verdict on a vehicle
    UNMEASURED = "unmeasured"  # a vehicle was detected, but could not be measured
    NOTHING = "nothing"  # nothing was measured or found at all, or a check failed: exit status 1
    WARNING = "warning"  # affects a result, or how far it can be relied on
    INFO = "info"


@dataclass(frozen=True)
class Verdict:
    """One row of the table: ``message`` is a format string, ``advice`` one or more whole sentences, or empty."""

    severity: Severity
    message: str
    advice: str = ""


class Message(str):
    """The text of a verdict or notice, with its ``code``; the empty one, with an empty code, means that there is none.

    It is a string wherever it is shown or written.
    """

    code: str

    def __new__(cls, text: str, code: str) -> Message:
        self = super().__new__(cls, text)
        self.code = code
        return self

    def __reduce__(self) -> tuple[type[Message], tuple[str, str]]:
        return Message, (str(self), self.code)

    @property
    def advice(self) -> str:
        """What usually helps; empty where nothing is to be done."""
        return advice_for(self.code)

    def after(self, prefix: str) -> Message:
        """The same message with ``prefix`` and a colon before it."""
        return Message(f"{prefix}: {self}", self.code)


NO_REASON = Message("", "")


def message(code: str, /, **values: object) -> Message:
    """The message of ``code`` with ``values`` for the fields of its format."""
    return Message(VERDICTS_BY_CODE[code].message.format(**values), code)


def advice_for(code: str) -> str:
    """What usually helps where ``code`` is the reason; empty for a code that is not in the table."""
    return VERDICTS_BY_CODE[code].advice if code in VERDICTS_BY_CODE else ""


def plural(count: int, noun: str) -> str:
    """``count`` and the ``noun``, with an s where there is not exactly one."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


_OUTLINE_ADVICE = "Outline a flat, detailed part of the vehicle: grille, lamps and plate, not the windscreen or bonnet."
_SAME_PART = "Check that both outlines mark the same part of the vehicle, and that nothing hides it in that frame."
_CALIBRATION_ADVICE = (
    "Check the cameras with `paceline rig check`; calibrate them anew if they have moved, or state a larger "
    "`uncertainty` in rig.yaml."
)
_NARROWER_INTERVAL_ADVICE = (
    "Where the random part is the larger one: more frames, a nearer vehicle or a larger outline. Where it is the "
    "systematic part: a better calibration, a wider baseline or a longer focal length."
)
_DRAW_PATH_ADVICE = "Draw the path by hand: the same road line in both views."
_SYNCHRONISE_ADVICE = "Trigger both cameras in hardware, or give each view's true times in times.csv."
_PAIRING_ADVICE = "Check that the frames are paired correctly; times.csv states when each was taken."

_REJECTION_ROWS = {
    "no_motion_fits": (
        "residuals: no motion fits the images: {test}",
        f"{_OUTLINE_ADVICE} Look for glare, for a pole in front of the vehicle, and for a path that belongs to another "
        "lane.",
    ),
    "image_residual_too_large": (
        "residuals: the images lie {offset_px:.2f} px rms off the fitted motion (limit {max_offset_px:g}) and "
        "{unexplained:.0%} of their contrast is unexplained (limit {max_unexplained:.0%})",
        f"{_OUTLINE_ADVICE} Check that both outlines mark the same part. Glare and poles in front of the vehicle do "
        "harm.",
    ),
    "too_few_consistent_frames": (
        "residuals: only {consistent} of {frames} frames show the vehicle where the fitted motion puts it "
        "(at least {min_share:.0%} and {min_frames} needed)",
        "Choose a stretch of road where nothing stands between the cameras and the vehicle.",
    ),
    "first_frames_inconsistent": (
        "residuals: none of the first {frames} frames shows the vehicle where the fitted motion puts it (at least 1 "
        "needed)",
        "Outline the vehicle in another frame, or check that the outline is on the vehicle and not on what hides it.",
    ),
    "too_little_texture": (
        "residuals: the region has too little texture: {test}",
        "Outline grille, lamps and plate instead of a plain surface; of a dark vehicle, use a longer exposure.",
    ),
    "views_disagree": (
        "views disagree: they lie {offset_px:.1f} px apart across the epipolar lines (limit {max_offset_px:g})",
        "Outline the same corners in both views. If they are the same, the cameras have moved: `paceline rig check`.",
    ),
    "calibration_inconsistent": (
        "calibration: image evidence is {deviation:.1f} σ from rig.yaml (limit {max_deviation:g})",
        _CALIBRATION_ADVICE,
    ),
    "calibration_inconsistent_jointly": (
        "calibration: image evidence of {vehicles} vehicles together is {deviation:.1f} σ from rig.yaml "
        "(limit {max_deviation:g})",
        _CALIBRATION_ADVICE,
    ),
    "calibration_differs_between_vehicles": (
        "calibration: image evidence of this vehicle is {deviation:.1f} σ from that of the others "
        "(limit {max_deviation:g})",
        "Check this vehicle's outline in both views: the other vehicles agree on the calibration.",
    ),
    "speed_implausible": (
        "implausible: the speed is {speed_mps:.1f} m/s (limits 0 and {max_speed_mps:g} m/s)",
        "Check that both views show the same vehicle and the same road line, and that `rate` or the time stamps are "
        "right.",
    ),
    "time_unclear": (
        "time: how many pictures are missing before frame {frame}, in the middle of its track, cannot be told",
        "State when each frame was taken in times.csv.",
    ),
    "motion_implausible": (
        "implausible: the vehicle {motion} with at least {acceleration:.1f} m/s² (95 %; limit {max_acceleration:g})",
        "Check that no pictures are missing, repeated or out of order and that the time stamps are right, and look in "
        "the overlay whether the outline stays on the vehicle.",
    ),
    "methods_disagree": (
        "estimates disagree: tracked corners move with {corners_mps:.2f} m/s and the grey values of the whole outline "
        "with {grey_values_mps:.2f}, {difference_mps:.3g} m/s apart (limit {max_difference_mps:.3g})",
        "Look in the overlay whether the outline holds one vehicle and nothing else, and for reflections that move "
        "over it; outline another part of it.",
    ),
    "path_deviation_implausible": (
        "implausible: the track deviates from the path by {deviation:.1f} σ of ordinary driving (limit "
        "{max_deviation:g}), on a region with a contrast of {contrast:.1f} grey levels (at least {min_contrast:g} "
        "needed to rely on such a track)",
        "Outline another, brighter part of the vehicle, or use a longer exposure.",
    ),
    "outline_inconsistent": (
        "outline: the tracked region lies {offset_px:.1f} px off the right outline (limit {max_offset_px:.1f})",
        f"{_SAME_PART} Corners should be right to half a pixel; `click_sigma` of the configuration states another "
        "precision.",
    ),
    "on_the_road_surface": (
        "outline: what it shows stands still and lies flat on the road (log likelihood ratio {log_ratio:.0f} against "
        "an upright face, limit {max_log_ratio:g})",
        "Outline the front, the rear or a side of a vehicle, the same part in both views.",
    ),
    "appearance_lost_from_start": (
        "unlike itself: only {similar} of {frames} frames look like the outlined region (at least {min_frames} needed)",
        "Check the outline in both views; state about how fast the vehicle drives with `speed`, or outline it where it "
        "is larger.",
    ),
    "left_image_early": (
        "too few frames: the vehicle left the image after {frames} of at least {min_frames}",
        "Outline the vehicle in an earlier frame, or aim the cameras so that it stays in both views for longer.",
    ),
    "lost_early": (
        "too few frames: the vehicle was lost after {frames} of at least {min_frames}",
        "Check the outline, and find the moment in the overlay at which it leaves the vehicle.",
    ),
    "seen_briefly": (
        "too few frames: the vehicle was seen for only {frames} of at least {min_frames}",
        "Let the clip show the vehicle for longer, or record more frames per second.",
    ),
    "interval_too_wide": (
        "interval too wide: ± {relative:.1%} of the speed (limit {max_relative:.1%})",
        _NARROWER_INTERVAL_ADVICE,
    ),
    "interval_too_wide_random": (
        "interval too wide: ± {relative:.1%} of the speed without the calibration's part (limit {max_relative:.1%})",
        "More frames, a nearer vehicle or a larger outline narrow the interval.",
    ),
    "speed_unknown": (
        "interval too wide: the speed is not known: ± {half_width_mps:.1f} m/s about {speed_mps:.1f} m/s (limit "
        "{max_half_width_mps:.2f} m/s)",
        _NARROWER_INTERVAL_ADVICE,
    ),
    "tolerance_exceeded": (
        "interval too wide: ± {half_width_mps:.3g} m/s, {ratio:.2f} times the tolerance (limit {tolerance_mps:.3g} "
        "m/s)",
        f"Ask for a larger `--max-half-width`. {_NARROWER_INTERVAL_ADVICE}",
    ),
}

_UNMEASURED_ROWS = {
    "no_planar_face": (
        "no flat part of its front or rear looks alike in both views and over time",
        "Outline the vehicle by hand; film it from nearer, and with sharper images.",
    ),
    "face_never_clear": (
        "its front or rear is never at least {min_width_px:g} × {min_height_px:g} px large and wholly in both views",
        "Use a longer focal length, or aim the cameras so that the vehicle stays inside both views.",
    ),
    "may_be_shadow": (
        "it may be a shadow on the road: both views match {upright_ratio:.1f} times better if it stands upright than "
        "if it lies there (at least {min_upright_ratio:g} needed)",
        "Outline it by hand if it is a vehicle; film from higher up or from nearer, and with less noise.",
    ),
    "queue_full": (
        "vehicles come faster than this computer measures them ({waiting} are waiting, limit {max_waiting})",
        "Record fewer frames per second, use a faster computer, or raise `live.queue` where vehicles come in bursts.",
    ),
    "frames_expired": (
        "it was in view for longer than frames are kept (limit {max_pairs} pairs of frames)",
        "Raise `live.buffer_pairs`, or record fewer frames per second, so that the frames kept span a longer time.",
    ),
    "input_unusable": ("{problem}", "Correct what the message names."),
}

_NOTHING_FOUND_ROWS = {
    "no_vehicle_detected": (
        "nothing that could be measured drives along the paths",
        "Check that the paths lie on the lanes in both views; record for longer.",
    ),
    "detector_saw_none": (
        "the detector saw a vehicle in none of {images} images",
        "Try the network on one image with the program that it comes from: it may know no such vehicles, see them too "
        "small, or expect another range of grey.",
    ),
    "detector_none_on_paths": (
        "the detector saw a vehicle in {detected} of {images} images, but nothing that could be measured drives along "
        "the paths",
        "Look at the paths: the detector's boxes lie beside them, on what stands still, or in one view only.",
    ),
    "background_too_few_frames": (
        "only {frames} frames, too few to separate moving vehicles from the road (at least {min_frames} needed)",
        "Make a longer recording.",
    ),
    "background_unstable": (
        "{unstable:.0f} % of the images never settle (limit {max_unstable:.0f} %); the cameras must stand still, and "
        "the road be empty now and then",
        "Fix the cameras, and record some seconds of empty road.",
    ),
    "no_ground": (
        "no ground was found: the two views do not match below the cameras; check the rig first",
        "Check the cameras with `paceline rig check`.",
    ),
    "no_painted_lines": ("nothing on the ground looks like painted lines in both views", _DRAW_PATH_ADVICE),
    "lines_too_short": ("no painted line runs along the road for long enough in both views", _DRAW_PATH_ADVICE),
    "lines_along_baseline": (
        "the painted lines run along the line between the cameras, so the two views do not determine them in space; "
        "film the road more along its course",
        "Film more along the road, so that its lines run away from the cameras.",
    ),
    "no_lane_between_lines": (
        "no two neighbouring lines that both views determine are a lane's width apart",
        _DRAW_PATH_ADVICE,
    ),
    "rig_moved": (
        "the rig has moved: points lie {offset_px:.2f} px off their lines (chance otherwise: {chance:.1g}, limit "
        "{min_chance:g}); calibrate it again{alternative}",
        "Calibrate the cameras again, or, where it is offered, correct their rotation with `paceline rig check "
        "--correct-rotation`.",
    ),
    "rig_differs_from_file": (
        "the rig does not stand as its file says: points lie {offset_px:.2f} px off their lines (chance otherwise: "
        "{chance:.1g}, limit {min_chance:g}); calibrate it again{alternative}",
        "Calibrate the cameras again, or, where it is offered, correct their rotation with `paceline rig check "
        "--correct-rotation`.",
    ),
    "rotation_unexplained": (
        "no correction: a rotation explains {explained_px:.2f} px of this and leaves {unexplained_px:.2f} px, which is "
        "more than {max_share:.0%} of all: something else is wrong",
        "Calibrate the cameras again; check that the pictures are rectified and cropped as at the calibration.",
    ),
    "rotation_ambiguous": (
        "no correction: a change of all focal lengths together explains this about as well as a rotation (odds "
        "{odds:.2g}, at least {min_odds:.0f} needed), and with it speeds are others",
        "Calibrate the cameras again; check that the videos are not cropped, zoomed or stabilised.",
    ),
    "rotation_uncertain": (
        "no correction: it would leave speeds at {distance_m:.0f} m unsure by ± {share:.0%} (limit {max_share:.0%})",
        "Calibrate the cameras again.",
    ),
    "rig_unchecked": (
        "cannot be decided: only {points} points of the scene match, in too few places; film something with more "
        "texture",
        "Film a scene with more texture.",
    ),
}

_WARNING_ROWS = {
    "rig_uncertainty_missing": (
        "{rig} states no uncertainty: that of an ordinary, careful calibration is assumed; state its own, or "
        "`uncertainty: exact`",
        "State `uncertainty` in rig.yaml; `paceline calibrate` writes it.",
    ),
    "rig_corrected": (
        "the rig's rotation was corrected by {points} points of a scene, which show no error of all focal lengths "
        "together and of the distance between the cameras",
        "Calibrate the cameras again when you can.",
    ),
    "path_undetermined": (
        "path {path}: {cause}; its vehicles are measured without it",
        "Draw another road line, in both views: one that does not run sideways through the images.",
    ),
    "path_not_followed": (
        "does not drive along path {path} as far as its drawing determines it: measured without it",
        "Draw the road line along which it drives, in both views, or give the vehicle no path.",
    ),
    "outline_beside_vehicle": (
        "about {share:.0%} of the outline's width, at {side}, does not move with the vehicle, whose middle is less "
        "certain for it: on a bend its sides differ in speed",
        "Draw the outline around one side of the vehicle, such as its front, and nothing else.",
    ),
    "occluded_frames": ("hidden or unlike itself in {frames}", "Find these frames in the overlay."),
    "lost_at_frame": ("lost at frame {frame}", "The frames before count; find the moment in the overlay."),
    "not_refined": (
        "not refined: the interval is the filter's own spread, which does not include its bias",
        "Leave `--no-refine` out.",
    ),
    "baseline_interval": ("a baseline: the interval comes from scatter alone and holds no systematic part", ""),
    "vehicle_not_measured": ("a vehicle on {path} from {start:.2f} to {end:.2f} s is not measured: {reason}", ""),
    "vehicles_not_told_apart": (
        "what was detected on {path} from {start:.2f} to {end:.2f} s may be two vehicles side by side that could not "
        "be told apart, and counts as one",
        "Look at it in the overlay, and outline both by hand.",
    ),
    "views_skewed": ("{frames} are taken {skew}", _SYNCHRONISE_ADVICE),
    "views_not_simultaneous": (
        "right frames are exposed {offset} ms after the left ones, by what moves in them, which is allowed for",
        "Trigger both cameras in hardware, or state `offset` in clip.yaml.",
    ),
    "calibration_stale": (
        "static points are {epipolar_px:.1f} px off their epipolar lines, {shift:.1f} standard deviations of the "
        "calibration, which is corrected for as far as it shows",
        "Calibrate anew; `paceline rig check` says how the cameras have moved.",
    ),
    "cameras_travel": (
        "{view}: most of the picture only turns in {known} of {frames} frames (at least half needed): the cameras "
        "travel, or little stands still in them; they are taken not to turn",
        "Fix the cameras, or aim them so that more of what stands still is in the picture.",
    ),
    "rotation_unknown": (
        "{view}: the camera turns, but in {unknown} of {frames} frames too little stands still to tell how; there it "
        "is taken not to turn",
        "Fix the cameras, or aim them so that more of what stands still is in the picture.",
    ),
    "knock": (
        "{view}: the camera was knocked at {time_s:.2f} s: its picture has been moved by {px:.1f} px since, which is "
        "corrected for",
        "Fix the cameras; `paceline rig check` says how they have moved against each other.",
    ),
    "no_common_clock": (
        "no common clock: frames that come together are taken as exposed together",
        _SYNCHRONISE_ADVICE,
    ),
    "views_start_apart": ("{right}: its time stamps begin {delay} those of {left}", _PAIRING_ADVICE),
    "frames_unmatched": ("{view}: {frames} left out, without a {other} frame {match}", _PAIRING_ADVICE),
    "frames_missing": ("{gap} instead of {usual_s:.3f} s", ""),
    "frames_missing_estimated": (
        "by what moves in them, frames are missing of which no file tells: {gaps}; the times are corrected for it",
        "Check why the recorder loses frames, or state when each was taken in times.csv.",
    ),
    "frame_times_unclear": (
        "{frames} left out: what moves does not tell how long before or after the others they were taken",
        "State when each frame was taken in times.csv.",
    ),
    "frames_out_of_order": (
        "by what moves in them, {frames} not taken in the order of the recording, and left out",
        "Check the names or the numbers of the pictures.",
    ),
    "frames_repeated": (
        "{source}: {frames} a copy of the frame before",
        "Check the frame rate of the recorder: it may repeat frames to reach it.",
    ),
    "frames_undecodable": ("{frames}: cannot be decoded and left out", "Check the file for damage."),
    "frame_numbers_no_counters": (
        "{source}: the numbers in the names count no frames; a missing one cannot be noticed",
        "State when each frame was taken in times.csv.",
    ),
    "frame_numbers_offset": (
        "left images count from {left} and right ones from {right}; paired in order",
        _PAIRING_ADVICE,
    ),
    "bit_depth_suspect": (
        "{image}: looks like a 12-bit recording in 16-bit images; set bit_depth",
        "Set `bit_depth: 12`.",
    ),
    "bit_depth_ignored": (
        "{source}: bit_depth {bit_depth} does not apply, because the images have 8 bits",
        "Take `bit_depth` out.",
    ),
    "video_truncated": ("{video}: is cut short; it ends after frame {frame} at {time_s:.3f} s", "Copy the file again."),
    "no_time_stamps": (
        "{source}: carries no time stamps; frames are dated by their arrival",
        "Use a source that sends time stamps.",
    ),
    "frames_restamped": (
        "{video}: {frames} left out, whose time stamps repeat or are out of order",
        "Look at how the recorder or the joining program sets time stamps.",
    ),
    "times_backward": ("{source}: times go back by {back_s:.3f} s at frame {frame}; counted on", ""),
    "frames_dropped_live": (
        "{frames} frames were dropped: they came faster than this computer looks through them",
        "Lower the cameras' frame rate.",
    ),
    "background_partly_unstable": (
        "in {unstable:.0f} % of the images nothing stands still (limit {max_unstable:.0f} %)",
        "Look at the pictures before you use the lanes.",
    ),
    "board_moved": (
        "the two images do not show the board in one place ({error_px:.2f} px; {usual_px:.2f} is usual): it moved "
        "between the exposures, or they do not belong together",
        "Hold the board still while both cameras take a picture.",
    ),
    "corners_scatter": (
        "the corners in the {view} image scatter by {error_px:.2f} px ({usual_px:.2f} is usual): blurred, or mistaken",
        "Take sharper pictures of the board.",
    ),
    "few_views": (
        "only {views} views are used; {min_views} to 30 make the calibration better and its uncertainty surer",
        "Add views of the board.",
    ),
    "few_tilted_views": (
        "{tilted} of {views} views are tilted by more than {tilt:.0f} degrees; tilt the board to all sides",
        "Add views of the board tilted to all sides.",
    ),
    "image_part_uncovered": (
        "the {view} camera has no corner at the {parts} (the other camera need not see it)",
        "Add views with the board in these parts of the image.",
    ),
    "target_not_symmetric": (
        "only {percent:.0f} % of the lines, by length, are mirrored about the middle (at least {limit:.0f} % of those "
        "of a vehicle's rear are)",
        "Look at the lines in the picture: is the whole rear in the box, and nothing else? Draw the box again, or "
        "learn from a picture in which the vehicle is seen straight from behind.",
    ),
    "target_faint": (
        "half of the lines have less than {contrast:.0f} grey levels of contrast (expected {limit:g} or more)",
        "Choose a picture in which the vehicle is better lit, or nearer.",
    ),
    "target_scale_uncertain": (
        "one image determines the distance only to ± {percent:.1f} % by these lines (expected ± {limit:.0f} % or less)",
        "Choose a picture in which the vehicle is nearer, or a camera with a longer focal length.",
    ),
    "adjustment_unsettled": (
        "the adjustment had not settled; more varied views would help it",
        "Add more varied views of the board.",
    ),
}

_INFORMATION_ROWS = {
    "lines_not_beside_each_other": (
        "lines {first} and {second} run beside each other for {shared_m:.1f} m (at least {min_shared_m:g} needed)",
        "",
    ),
    "lane_width_implausible": (
        "lines {first} and {second} lie {width_m:.2f} m apart: no lane is that wide or narrow (limits {min_width_m:g} "
        "and {max_width_m:g})",
        "",
    ),
    "lines_uncertain": (
        "lines {first} and {second} are known to {max_std_m:g} m for {known_m:.1f} m only (at least {min_known_m:g} "
        "needed)",
        "",
    ),
    "lane_known": ("the lane between lines {first} and {last} is not added: path {path} runs along it", ""),
    "lane_outside_views": (
        "path {path}: too little of it is in both views ({length_px:.0f} px, at least {min_length_px:g} needed)",
        "",
    ),
    "lane_not_reconstructible": ("{problem}", ""),
    "gpu_fallback": ("computed on the CPU from frame {frame} on: {problem}", ""),
    "rate_ignored": (
        "{clip}: rate is not used, because {source} own time stamps",
        "Take `rate` out, or write `rate: {value: …, override: true}` where these are wrong, as of slow motion.",
    ),
    "rate_overrides": (
        "{video}: timed by {rate:g} frames/s in place of its own time stamps, which lie {usual_s:.4g} s apart",
        "Take `override` out where the time stamps are true.",
    ),
    "width_uncertainty_assumed": (
        "the width is taken as known to ± {percent:g} % (95 %), as nothing is stated of it",
        "State it beside the width, as in 1.7±0.05: every distance is as uncertain.",
    ),
    "lines_beyond_sides": (
        "vertical lines lie up to {distance_px:.1f} px outside the vehicle's sides, which are {width} px apart by the "
        "box and the edges beside it; the ranges go by the sides",
        "Look at these lines in the picture and delete those on a shadow or the background. If they are the sides, "
        "draw the box again.",
    ),
    "source_ended": ("{source}: the source ended{problem}", "If it should go on, check the camera."),
    "source_silent": ("{source}: the source ended (nothing came for {limit_s:.0f} s)", "Check the camera."),
    "video_codec_fallback": (
        "overlay.mp4 is MPEG-4 because no H.264 encoder was found; a browser may not play it.",
        "Install FFmpeg's libx264 or libopenh264.",
    ),
    "renderer_slow": (
        "LLVM {version} was not found (Debian: libllvm{version}; elsewhere set DRJIT_LIBLLVM_PATH): rendering takes "
        "about five times as long",
        "Install LLVM of this version.",
    ),
    "board_not_seen": ("no board is seen in {views}", ""),
    "pairs_thinned": ("{used} of {pairs} pairs are used, evenly spread", ""),
}

VERDICTS_BY_CODE = {
    code: Verdict(severity, *row)
    for severity, rows in (
        (Severity.REJECTED, _REJECTION_ROWS),
        (Severity.UNMEASURED, _UNMEASURED_ROWS),
        (Severity.NOTHING, _NOTHING_FOUND_ROWS),
        (Severity.WARNING, _WARNING_ROWS),
        (Severity.INFO, _INFORMATION_ROWS),
    )
    for code, row in rows.items()
}
