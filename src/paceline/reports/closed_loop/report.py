"""Runs a closed loop and writes its tables, plots, video and report while it runs."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import yaml

from paceline.follow.tracker import warm_up
from paceline.progress import Progress
from paceline.reports.closed_loop.overlay import draw_step
from paceline.reports.closed_loop.page import write_drive_page
from paceline.reports.closed_loop.plots import drive_plots
from paceline.reports.closed_loop.tables import DriveTable, write_drive_summary
from paceline.reports.common.output_folder import OutputFolder
from paceline.reports.common.video import VideoWriter
from paceline.reports.follow.overlay import StillSelection
from paceline.simulation.closed_loop.drive_yaml import drive_document
from paceline.simulation.closed_loop.loop import ClosedLoop
from paceline.simulation.closed_loop.requirements import DriveStatistics, check_requirements
from paceline.simulation.closed_loop.results import DriveLog, DriveResult
from paceline.version import versions

VIDEO_CRF = 25


def drive_and_report(
    loop: ClosedLoop, out: str | Path, *, overlay: bool = True, progress: Progress | None = None
) -> DriveResult:
    """Drives ``loop`` to its end; tables, plots, video and page appear in ``out``, whole or not at all."""
    with OutputFolder(out) as folder:
        return write_drive_files(loop, folder, overlay, progress)


def write_drive_files(
    loop: ClosedLoop, folder: Path, overlay: bool = True, progress: Progress | None = None
) -> DriveResult:
    """As `drive_and_report`, straight into an existing ``folder``; memory does not grow with the drive."""
    start_time = time.perf_counter()
    warm_up()
    figures, log, stills, notices = DriveStatistics(), DriveLog(), StillSelection(), list[str]()
    rate, width = loop.scene.chase_scene.rate, loop.scene.world.body.width
    with ExitStack() as stack:
        table = stack.enter_context(DriveTable(folder / "drive.csv"))
        video = stack.enter_context(VideoWriter(folder / "overlay.mp4", 1 / rate, VIDEO_CRF)) if overlay else None
        for step in loop.steps():
            table.add(step)
            figures.add(step, width)
            log.add(step)
            stills.add(step.image, step.estimate)
            if video is not None:
                video.add(draw_step(step, loop.vehicle), step.time)
            if progress is not None:
                progress(step.frame + 1, loop.frames)
    if video is not None:
        notices += video.notices
    result = DriveResult(
        scene=loop.model.name,
        seed=loop.seed,
        throttle=loop.model.throttle,
        target=loop.scene.chase_scene.kind,
        latency=loop.latency,
        duration=loop.frames / rate,
        figures=figures,
        requirements=check_requirements(loop.model, figures),
        log=log,
        document=drive_document(loop.model),
        configuration=loop.settings(),
        versions=versions(),
        notices=notices,
    )
    result = replace(result, seconds=time.perf_counter() - start_time)
    write_drive_summary(result, folder / "summary.json")
    (folder / "drive.yaml").write_text(
        yaml.safe_dump(result.document, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )
    plots = drive_plots(log)
    (folder / "plots").mkdir()
    for plot in plots:
        (folder / "plots" / f"{plot.name}.png").write_bytes(plot.png)
    write_drive_page(result, folder / "report.html", plots=plots, stills=stills.selected, overlay=overlay)
    return result
