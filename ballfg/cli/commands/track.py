"""Implements `ballfg track`, which turns videos of calibrated cameras into tracks."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ballfg.progress import counted, print_notes, progress

if TYPE_CHECKING:
    from ballfg.dynamics import AnalyticModel, Surfaces
    from ballfg.simulation.balls import BallKind
    from ballfg.vision import Camera
    from ballfg.vision.detection.detections import Detections
    from ballfg.vision.detection.detector import Colour
    from ballfg.vision.tracking.dataset import Streams
    from ballfg.vision.tracking.pipeline import Tracking


def track(
    recordings: Annotated[
        list[str],
        typer.Argument(
            metavar="VIDEO",
            help="Videos or folders of images, each named as its camera or as NAME=PATH; or one detections.csv.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Output folder of the dataset: new or empty.")],
    cameras: Annotated[
        Path | None, typer.Option(help="File of the calibrated cameras (cameras.yaml); without: one moving camera.")
    ] = None,
    court: Annotated[
        str, typer.Option(help="Without --cameras: table-tennis, or a YAML file of a court.")
    ] = "table-tennis",
    corners: Annotated[
        Path | None, typer.Option(help="Without --cameras: the court's corners, a table frame,u,v (px).")
    ] = None,
    candidates: Annotated[
        Path | None, typer.Option(help="Without --cameras: candidates of another detector, a table t,u,v,score.")
    ] = None,
    stamps: Annotated[
        list[str] | None,
        typer.Option(help="Frame stamps of a camera, NAME=FILE.csv with a column t; may be repeated."),
    ] = None,
    without: Annotated[list[str] | None, typer.Option(help="Camera to leave out; may be repeated.")] = None,
    time_offsets: Annotated[
        bool, typer.Option("--time-offsets", help="Estimate each camera's time offset from the first camera.")
    ] = False,
    colour: Annotated[Literal["white", "orange"] | None, typer.Option(help="Ball colour; by default any.")] = None,
    detector: Annotated[str | None, typer.Option(help="Custom detector, FILE.py:NAME.")] = None,
    ball: Annotated[str, typer.Option(help="Ball: table-tennis, tennis, or a ball file (YAML).")] = "table-tennis",
    table_height: Annotated[
        float | None, typer.Option(help="Height of the table's surface, m.", show_default="that of the ball's table")
    ] = None,
    table: Annotated[
        str | None,
        typer.Option(
            help="Ends of the table in the cameras' world, m, as x=-1.37..1.37,y=-0.76..0.76.",
            show_default="those of calibrate-cameras for one camera, else found later",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Dataset name.", show_default="the folder's")] = None,
    overlay: Annotated[bool, typer.Option(help="Overlay video.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of processes.", show_default="one per camera, or core")
    ] = None,
) -> None:
    """Turn videos of calibrated cameras into a dataset of tracks, with pictures to check them.

    Example: ballfg track left.mp4 middle.mp4 right.mp4 --cameras cameras.yaml --out shots

    Example: ballfg track rally.mp4 --out rally

    The dataset holds tracks.csv, detections.csv (all candidates) and cameras.yaml; of one camera states.csv and
    events.csv in place of tracks.csv.
    overlay.mp4 shows the views with what was found, contact_sheet.png each track.
    """
    # FFmpeg and OpenCV print messages on a file, unless switched off before the import of OpenCV.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    from ballfg.estimation.one_camera import track_one_camera
    from ballfg.estimation.rally.tables import event_columns, state_columns
    from ballfg.files.whole_folder import reserved
    from ballfg.simulation.balls import ball_kind
    from ballfg.tracks.detections_file import EVENTS_FILE
    from ballfg.tracks.info import DatasetInfo
    from ballfg.vision.calibration.table_points import table_ends
    from ballfg.vision.camera_file import read_cameras
    from ballfg.vision.detection.detections import read_detections
    from ballfg.vision.tracking import pipeline
    from ballfg.vision.tracking.dataset import STATES, check_result_folder, write_tracking

    kind = ball_kind(ball)
    if cameras is None:
        given: dict[str, object] = {"stamps": stamps, "without": without, "colour": colour, "detector": detector}
        given |= {"table-height": table_height, "table": table, "time-offsets": time_offsets}
        _refuse("without --cameras", given)
        _moving_camera(recordings, out, kind, court, corners, candidates, name, jobs=jobs, force=force)
        return
    if (corners, candidates) != (None, None):
        raise ValueError("--corners and --candidates are for a moving camera, without --cameras. Leave them out.")
    height = kind.surfaces.table_height if table_height is None else table_height
    with reserved(out):  # refuses an unusable folder before the search
        check_result_folder(out, [cameras, *(Path(text) for text in recordings)], force=force)
        files = " ".join(Path(text).name for text in recordings)
        info = DatasetInfo(name or out.resolve().name, height, kind.ball, source=f"ballfg track {files}")
        rig = pipeline.without(read_cameras(cameras), without or ())
        floor = kind.surfaces.floor_height
        floor = None if floor is None else floor + height - kind.surfaces.table_height
        surfaces = replace(kind.surfaces, table_height=height, floor_height=floor)
        if table is not None:
            info = replace(info, table_extent=table_ends(table))
            surfaces = replace(surfaces, extent=info.table_extent)
        if len(rig) != 1:
            pipeline.check_rig(rig)
        elif time_offsets:
            raise ValueError("--time-offsets needs two cameras: they are relative to the first. Leave it out.")
        streams: Streams | None = None
        if len(recordings) == 1 and recordings[0].lower().endswith(".csv"):
            videos_only = {"stamps": stamps, "colour": colour, "detector": detector}
            _refuse("with detections: it is about videos", videos_only)
            detections, notes = read_detections(Path(recordings[0]), rig, without or ())
            print_notes(notes)
        else:
            detections, streams = _from_videos(recordings, rig, stamps or (), colour, detector, jobs, without or ())
        tables: dict[str, list[dict[str, Any]]] | None = None
        if len(rig) == 1:
            strokes = track_one_camera(detections[0], rig[0], kind.model, surfaces, watch=progress)
            tracking, tables = strokes.tracking, {}
            if strokes.estimates:
                tables[EVENTS_FILE] = [event_columns(strokes.events)]
                tables[STATES] = [state_columns(estimate) for estimate in strokes.estimates]
            print_notes(strokes.doubts)
            info = replace(info, table_extent=surfaces.extent)
        else:
            tracking = pipeline.track_detections(detections, rig)
        if time_offsets and tracking.balls:
            tracking = _on_one_clock(tracking, kind.model, surfaces)
        print_notes([*pipeline.blind_cameras(tracking), *pipeline.uncertain_cameras(tracking)])
        if (doubt := pipeline.disagreement(tracking)) is not None:
            print_notes([doubt])
        info = replace(info, rate=tracking.rate)
        written = write_tracking(
            out, tracking, info, table=surfaces.extent, streams=streams, tables=tables, overlay=overlay, watch=progress
        )
        if not tracking.balls:
            pictures = [one for one in written if not one.endswith((".csv", ".yaml"))]
            raise ValueError(
                f"{pipeline.no_ball(tracking)} {out} holds an empty dataset; look at {', '.join(pictures)} there."
            )
        points = sum(len(ball.times) for ball in tracking.balls)
        print(
            f"{out}: {counted(len(tracking.balls), 'track')} of {counted(points, 'point')}; wrote {', '.join(written)}"
        )
        print(*pipeline.summary(tracking), sep="\n")


def _moving_camera(
    recordings: Sequence[str],
    out: Path,
    kind: "BallKind",
    court: str,
    corners: Path | None,
    candidates: Path | None,
    name: str | None,
    *,
    jobs: int | None,
    force: bool,
) -> None:
    """Tracks the ball in one video of a camera that pans and zooms."""
    import numpy as np

    from ballfg.estimation.rally.tables import write_rally
    from ballfg.estimation.rally.video import Rally, surfaces_of, track_moving_camera
    from ballfg.files.whole_folder import reserved
    from ballfg.machine import usable_cores
    from ballfg.parallel.parts import with_jobs
    from ballfg.tracks.info import DatasetInfo
    from ballfg.vision.broadcast.court import TABLE_TENNIS, read_corners, read_court
    from ballfg.vision.broadcast.files import FILES, TRACKED
    from ballfg.vision.broadcast.pictures import read_candidates
    from ballfg.vision.detection.video import open_video
    from ballfg.vision.tracking.dataset import check_result_folder

    if len(recordings) != 1 or recordings[0].lower().endswith(".csv"):
        raise ValueError(
            f"without --cameras exactly one video must be given; got {len(recordings)} recordings, "
            f"{recordings[0]} the first. Give one video, or --cameras."
        )
    path, given = Path(recordings[0]), [file for file in (corners, candidates) if file is not None]
    with reserved(out):
        check_result_folder(out, [path, *given], force=force, files=FILES)
        video, ground = open_video(path), read_court(court)
        own = None if candidates is None else partial(read_candidates, candidates)
        marked = None if corners is None else read_corners(corners)

        def tracked(count: int) -> Rally:
            return track_moving_camera(
                video.frames, ground, kind.model, count=count, corners=marked, candidates=own, watch=progress
            )

        found = with_jobs(jobs or usable_cores(), tracked, video.count)
        print_notes(found.notes)
        if not found.strokes:
            raise ValueError(
                f"{path} must show strokes of a ball on the court; none was found. Give candidates of a better "
                "detector with --candidates, or check --court."
            )
        rate = float(f"{1.0 / np.median(np.diff(found.motion.times)):.6g}")
        info = DatasetInfo(
            name or out.resolve().name,
            surfaces_of(ground).table_height,
            kind.ball,
            rate=rate,
            source=TRACKED + path.name,
            table_extent=surfaces_of(ground).extent,
        )
        text = "" if court == TABLE_TENNIS else Path(court).read_text(encoding="utf-8")
        written = write_rally(out, info, found.motion, found.shots, found.events, found.strokes, text)
        bounces = sum(event.kind == "bounce" for event in found.events)
        print(
            f"{out}: {counted(len(found.strokes), 'stroke')}, {counted(bounces, 'bounce')}; wrote {', '.join(written)}"
        )


def _refuse(where: str, options: Mapping[str, object]) -> None:
    """Raises ValueError for an option that is given where it has no use."""
    for name, value in options.items():
        if value not in (None, False):
            got = "" if value is True else f"; got {value}"
            raise ValueError(f"--{name} must not be given {where}{got}. Leave it out.")


def _from_videos(
    recordings: Sequence[str],
    rig: "Sequence[Camera]",
    stamps: Sequence[str],
    colour: "Colour | None",
    detector: str | None,
    jobs: int | None,
    without: Sequence[str],
) -> "tuple[list[Detections], Streams]":
    """The detections, and a function that gives each video's frames again."""
    from ballfg.vision.detection.detect import learn_detector, load_detector
    from ballfg.vision.detection.detector import DetectorSettings
    from ballfg.vision.detection.video import open_video
    from ballfg.vision.tracking.pipeline import detect_videos, match_videos, stamp_files

    videos, files = match_videos(recordings, rig, without), stamp_files(stamps, rig)
    if detector is not None and colour is not None:
        raise ValueError("--colour must not be given with --detector: it is about ballfg's own. Leave one of them out.")
    settings = DetectorSettings(colour=colour)
    make = partial(learn_detector, settings=settings) if detector is None else load_detector(detector)
    found = detect_videos(videos, rig, make, stamps=files, jobs=jobs or len(rig), watch=progress)
    return found, [open_video(path, files.get(name)).frames for name, path in videos.items()]


def _on_one_clock(tracking: "Tracking", model: "AnalyticModel", surfaces: "Surfaces") -> "Tracking":
    """The same candidates with time offsets of the cameras estimated from the balls."""
    from ballfg.estimation import Settings, estimate_time_offsets, sighted_track
    from ballfg.vision.tracking.pipeline import disagreement, track_detections

    pairs = zip(tracking.names, tracking.balls, strict=True)
    tracks = [sighted_track(name, ball.sightings, tracking.cameras) for name, ball in pairs]
    found = estimate_time_offsets(tracks, model, surfaces, Settings.for_measured(model))
    if not found.settled:
        print_notes(["the time offsets did not settle and are left as they were"])
        return tracking
    corrected = track_detections(tracking.detections, found.cameras)
    if disagreement(corrected) is not None:
        print_notes(["with time offsets the cameras still disagree; they are left as they were"])
        return tracking
    for camera, sigma in list(zip(found.cameras, found.sigmas.tolist(), strict=True))[1:]:
        late = f"{1e3 * camera.time_offset:.3f} ± {1e3 * sigma:.3f} ms"
        print(f"  {camera.name}: stamps late by {late} against {found.cameras[0].name}")
    return corrected
