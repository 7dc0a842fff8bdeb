"""Implements `ballfg live`, which answers measured positions with states and predictions in real time."""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg import deferred, progress
from ballfg.cli import inputs
from ballfg.interrupts import heeded
from ballfg.progress import print_notes

if TYPE_CHECKING:
    from ballfg.dynamics import BallModel, Surfaces
    from ballfg.estimation import Settings
    from ballfg.live.session import Session, Watcher
    from ballfg.live.sources.source import Inbox, Source
    from ballfg.tracks import Dataset

MCAP, SQLITE = ".mcap", ".db3"


def live(
    model: inputs.ModelFile = None,
    ball: Annotated[
        str | None,
        typer.Option(
            help="Known ball, by its name in ballfg balls, or a ball file (YAML).", show_default="table_tennis"
        ),
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(help="Dataset, or rosbag2 / MCAP, to replay in place of standard input.")
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help="Take lines from tcp://HOST:PORT or udp://HOST:PORT; without HOST, from this machine alone."),
    ] = None,
    idle: Annotated[
        float, typer.Option(help="A TCP sender that has sent no line for so long is dropped, s.", show_default="300")
    ] = 300.0,
    speed: Annotated[float, typer.Option(help="Speed of a replay: 1 is real time, 0 as fast as possible.")] = 1.0,
    topic: Annotated[str | None, typer.Option(help="Topic of positions in a bag.")] = None,
    plane: Annotated[
        str | None, typer.Option(help="Plane whose crossing is predicted, such as x=2.0 or z=3.05,down (m).")
    ] = None,
    horizon: Annotated[float, typer.Option(help="How far ahead events are predicted, s.")] = 1.0,
    lag: Annotated[float, typer.Option(help="By how much stamps may be late, s.")] = 0.1,
    patience: Annotated[
        float, typer.Option(help="A live line that has waited longer gets no prediction, s; the states catch up.")
    ] = 0.1,
    like: Annotated[
        Path | None, typer.Option(help="Dataset whose ball, table and noise the stream has.", show_default=False)
    ] = None,
    table: Annotated[float | None, typer.Option(help="Height of the table's surface, m.", show_default="0")] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Standard deviation of a coordinate, m.", show_default="as the balls show"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Recording to begin or continue: JSON lines, or .mcap for ROS 2.", show_default="standard output"
        ),
    ] = None,
    group: inputs.GroupName = None,
    viewer: Annotated[bool, typer.Option("--viewer", help="Show it live in rerun (extra: viewer).")] = False,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
) -> None:
    """States with covariances, next bounce, apex and the crossing of a plane for each position, in real time.

    A line in is t,x,y,z (s, m), or JSON with t and x, y, z or positions; a line out is JSON with its latency. New balls
    are found by themselves, several at once are kept apart. Ctrl-C ends it; latencies and counts are told on stderr.

    Example: ballfg live --replay data/aimy --plane x=2.0 --out states.jsonl
    """
    from ballfg.checks import check_number, check_range
    from ballfg.files.whole_file import check_file
    from ballfg.live.session import Session, Wanted, warm_up
    from ballfg.live.sources.source import Inbox
    from ballfg.live.tracker import Tracker
    from ballfg.prediction.plane import Plane

    check_range("speed", speed, 0.0, 1e6)
    wanted = Wanted(
        check_number("horizon", horizon, "s", above=0.0, limit=60.0),
        None if plane is None else Plane.parse(plane),
        check_range("patience", patience, 0.0, float("inf")),
    )
    if replay is not None and listen is not None:
        raise ValueError(f"listen must stand alone; got it with --replay {replay}. Leave one of them out.")
    if out is not None:
        check_file(out)
        if out.suffix == SQLITE:
            raise ValueError(
                f"out must be JSON lines or a bag in MCAP; got {out}. Let its name end in .jsonl or .mcap."
            )
    inputs.know(effects_file, observations_file)
    bag = replay is not None and (replay.suffix in (MCAP, SQLITE) or (replay / "metadata.yaml").is_file())
    data = _dataset(like if bag or replay is None else replay)
    known, surfaces, settings = _scene(data, model, ball, table, noise, group)
    stated = data is not None or noise is not None or known.states_position_noise
    tracker = Tracker(known, surfaces, settings, lag=lag, shown_noise=not stated)
    with (
        contextlib.closing(_source(replay, bag, listen, idle, speed, topic, data)) as source,
        _output(out, source) as write,
        _watchers(out, viewer, wanted.horizon) as watchers,
    ):
        warm_up(tracker, wanted)
        trust = f"; {source.trust}" if source.trust else ""
        print(f"ballfg live: reading {source.name}{trust}", file=sys.stderr, flush=True)
        inbox = Inbox(source)
        session = Session(tracker, inbox, write, wanted, watchers)
        with progress.idle():  # it waits for lines
            _run(session, inbox)
    for line in session.summary():
        print(f"ballfg live: {line}", file=sys.stderr)


def _dataset(folder: Path | None) -> "Dataset | None":
    """The dataset of a replay, or the one named as similar to the stream."""
    if folder is None:
        return None
    from ballfg.estimation.observations.registry import tables_of_readings
    from ballfg.tracks import read_dataset

    data = read_dataset(folder)
    print_notes(data.info.doubts)  # stdout holds the records
    unused = "is not used: live estimates are made from positions alone"
    print_notes(f"{name} {unused}" for name in tables_of_readings(folder))
    return data


def _scene(
    data: "Dataset | None",
    model: Path | None,
    named: str | None,
    table: float | None,
    noise: float | None,
    group: str | None,
) -> "tuple[BallModel, Surfaces, Settings]":
    """Ball, surfaces, noise and the group of shots: the dataset's, or the options'."""
    from dataclasses import replace

    from ballfg.checks import check_number
    from ballfg.dynamics import Surfaces

    if data is not None:
        from ballfg.estimation import dataset_settings, dataset_surfaces

        ball = inputs.open_model(data, model, named)
        surfaces, settings = dataset_surfaces(data), dataset_settings(data, ball)
    else:
        deferred.on_one_thread()
        ball, settings = inputs.model_alone(model, named)
        surfaces = Surfaces.table_tennis(0.0)
    if not ball.measures_plainly:
        raise ValueError(
            "model must have no measurement effects here: they are undone from whole tracks, as estimate and predict "
            "do. Empty its section measurement."
        )
    if table is not None:
        surfaces = Surfaces.table_tennis(check_number("table", table, "m", limit=50.0, instead="mm"))
    if noise is not None:
        sigma = check_number("noise", noise, "m", above=0.0, limit=1.0, instead="mm")
        settings = replace(settings, position_noise=(sigma,) * 3)
    spins = ball.spins
    if group is not None:
        settings = replace(settings, spins=spins, group=group)
    elif spins is not None and settings.group is None:
        if data is None:
            settings = replace(settings, spins=spins.with_unseen(settings.spin_prior))
        print_notes([f"the stream names no group ({spins.by}): balls get {spins.of_others}. --group NAME gives one"])
    return ball, surfaces, settings


def _source(
    replay: Path | None,
    bag: bool,
    listen: str | None,
    idle: float,
    speed: float,
    topic: str | None,
    data: "Dataset | None",
) -> "Source":
    from ballfg.checks import check_number
    from ballfg.live.sources.bag import bag_samples
    from ballfg.live.sources.sockets import listen as listened
    from ballfg.live.sources.source import Pipe, Replay, dataset_samples

    check_number("idle", idle, "s", above=0.0, limit=1e9)
    if replay is not None and bag:
        return Replay(bag_samples(replay, topic), speed, str(replay))
    if topic is not None:
        raise ValueError(f"topic must come with a bag to replay; got {topic!r} without one. Add --replay BAG.mcap.")
    if replay is not None and data is not None:
        return Replay(dataset_samples(data), speed, str(replay))
    return Pipe() if listen is None else listened(listen, idle)


@contextlib.contextmanager
def _output(out: Path | None, source: "Source") -> Iterator[Callable[[bytes], None]]:
    """The output of lines: standard output, a recording, or none beside a bag."""
    if out is None:
        stream = sys.stdout.buffer

        def write(line: bytes) -> None:
            stream.write(line)
            stream.flush()

        yield write
    elif out.suffix == MCAP:
        yield lambda line: None
    else:
        from ballfg.live.recording import lines_recording

        with lines_recording(out, source.repeats) as recording:
            yield recording.append


@contextlib.contextmanager
def _watchers(out: Path | None, viewer: bool, horizon: float) -> "Iterator[list[Watcher]]":
    with contextlib.ExitStack() as stack:
        found: list[Watcher] = []
        if out is not None and out.suffix == MCAP:
            from ballfg.live.bag_writer import BagWriter

            found.append(stack.enter_context(BagWriter(out, horizon)))
        if viewer:
            from ballfg.live.viewer import Viewer

            found.append(stack.enter_context(contextlib.closing(Viewer(horizon))))
        yield found


def _run(session: "Session", inbox: "Inbox") -> None:
    """Runs until the input ends, the output closes, or a signal comes: the first finishes the present sample."""

    def stop(number: int, frame: object) -> None:
        inbox.interrupt()
        signal.signal(number, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in heeded()}
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)  # the reading thread runs soon, and so notes the true moment of reading
    try:
        session.run()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the rest of the buffer goes nowhere
    finally:
        inbox.close()
        sys.setswitchinterval(interval)
        for number, handler in before.items():
            signal.signal(number, handler)
