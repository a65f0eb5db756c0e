"""Follows a target through a recording and writes its tables, plots, video and report, in one pass."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from paceline.blas import on_one_blas_thread
from paceline.documents.loading import FollowClip
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.following import follow, result_of
from paceline.follow.history import History, Tally
from paceline.follow.results import FollowEstimate, FollowResult
from paceline.progress import Progress, Stage, frame_stage, no_stage
from paceline.recordings.monocular import CameraFrame, CameraRecording, open_camera
from paceline.reports.common.output_folder import OutputFolder
from paceline.reports.common.video import VideoWriter
from paceline.reports.follow.overlay import StillSelection, draw_frame
from paceline.reports.follow.page import write_follow_page
from paceline.reports.follow.plots import follow_plots
from paceline.reports.follow.tables import TrackTable, write_summary

VIDEO_CRF = 23  # magnified noise compresses badly
LIVE_FRAME_INTERVAL_S = 1 / 25  # nominal: live frames keep their own times


@on_one_blas_thread
def follow_and_report(
    clip: FollowClip,
    out: str | Path,
    configuration: FollowConfiguration | None = None,
    *,
    overlay: bool = True,
    progress: Progress | None = None,
) -> FollowResult:
    """Follows the target of ``clip``; tables, plots, overlay and page appear in ``out``, whole or not at all.

    A live source needs a single pass, so that measuring and writing go together. Raises UnusableInput.
    """
    with OutputFolder(out) as folder:
        return write_follow_files(clip, open_camera(clip), folder, configuration, overlay, frame_stage(progress))[0]


def write_follow_files(
    clip: FollowClip,
    recording: CameraRecording,
    folder: Path,
    configuration: FollowConfiguration | None = None,
    overlay: bool = True,
    stage: Stage = no_stage,
    on_frame: Callable[[CameraFrame, FollowEstimate], None] | None = None,
) -> tuple[FollowResult, Tally]:
    """As `follow_and_report`, straight into an existing ``folder``, in the stages ``following`` and ``writing``;
    ``on_frame`` is called with every frame and its estimate as it is made. Memory does not grow with the recording."""
    begun = time.perf_counter()
    history, stills = History(), StillSelection()
    with ExitStack() as stack:
        progress = stack.enter_context(stage("following"))
        table = stack.enter_context(TrackTable(folder / "track.csv"))
        video = stack.enter_context(_open_video(folder, clip, recording)) if overlay else None
        seen: NDArray[np.uint8] = np.zeros(clip.camera.image_size[::-1], np.uint8)
        for frame, estimate in follow(clip, recording, configuration):
            table.add(estimate)
            history.add(estimate)
            if on_frame is not None:
                on_frame(frame, estimate)
            stills.add(frame.image, estimate)
            if video is not None:  # without an image the last one is repeated
                seen = seen if frame.image is None else frame.image
                video.add(draw_frame(frame, seen, estimate), frame.time)
            if progress is not None:
                progress(frame.index + 1, recording.total)
    tally = history.tally
    result = result_of(clip, recording, configuration, history, time.perf_counter() - begun)
    if video is not None:
        result = replace(result, notices=result.notices + video.notices)
    write_summary(result, tally, folder / "summary.json")
    with stage("writing") as progress:
        plots = follow_plots(result, progress)
    (folder / "plots").mkdir()
    for plot in plots:
        (folder / "plots" / f"{plot.name}.png").write_bytes(plot.png)
    page = folder / "report.html"
    write_follow_page(result, tally, page, plots=plots, stills=stills.selected, overlay=overlay)
    return result, tally


def _open_video(folder: Path, clip: FollowClip, recording: CameraRecording) -> VideoWriter:
    step = LIVE_FRAME_INTERVAL_S if clip.rate is None else 1 / clip.rate
    return VideoWriter(folder / "overlay.mp4", step, VIDEO_CRF, fragmented=recording.live)
