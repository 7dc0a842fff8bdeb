"""`ballfg live` as a user meets it: real processes, pipes and sockets."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ballfg.dynamics import nominal_model, save_model
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.estimation import Online, Settings, dataset_settings, dataset_surfaces
from ballfg.live.session import Session
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset, write_dataset
from tests.commands import printed, refused
from tests.live.test_recording import disk_of

SAMPLES = 14
COMMAND = [sys.executable, "-c", "from ballfg.cli.main import run; run()", "live"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shots, cut short: predictions take time."""
    folder = tmp_path_factory.mktemp("live")
    write_simulation(folder / "whole", SimulationConfig(tracks=2, rate=60.0, seed=2))
    whole = read_dataset(folder / "whole")
    write_dataset(folder / "shots", whole.info, [track.until(track.times[SAMPLES - 1]) for track in whole])
    return folder / "shots"


@contextmanager
def started(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    command = [*COMMAND, *map(str, arguments)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with subprocess.Popen(command, env=environment, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def lines_of(text: bytes) -> list[dict]:
    return [json.loads(line) for line in text.splitlines()]


def expected_states(dataset: Path, number: int) -> list:
    data = read_dataset(dataset)
    model = nominal_model(data.ball)
    online = Online(model, dataset_surfaces(data), dataset_settings(data, model))
    track = list(data)[number]
    return [online.push(t, p) for t, p in zip(track.times, track.positions, strict=True)]


def csv(dataset: Path, number: int, later: float = 0.0) -> list[bytes]:
    track = list(read_dataset(dataset))[number]
    return [f"{t + later},{x},{y},{z}\n".encode() for t, (x, y, z) in zip(track.times, track.positions, strict=True)]


def test_a_replay_gives_the_states_of_the_online_estimator(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    arguments = ("--replay", dataset, "--speed", 0, "--plane", "x=1.0", "--horizon", 0.5, "--out", out)
    said = printed("live", *arguments)
    assert said.out == ""
    lines = lines_of(out.read_bytes())
    assert [path.name for path in tmp_path.iterdir()] == ["states.jsonl"]
    for number in (0, 1):
        states = [line for line in lines if line["kind"] == "state" and line["ball"] == number + 1]
        expected = expected_states(dataset, number)[2:]
        assert [line["t_track"] for line in states] == [state.time for state in expected]
        for line, state in zip(states, expected, strict=True):
            mean = [*line["position"], *line["velocity"], *line["spin"]]
            atol = 1e-9 if number == 0 else 1e-7  # the second is later on the stream's clock: its stamps are rounded
            np.testing.assert_allclose(mean, state.state, rtol=0, atol=atol)
            np.testing.assert_allclose(line["covariance"], state.covariance, rtol=1e-6, atol=1e-9)
            assert line["latency_ms"] > 0.0
        assert states[-1]["crossing"]["state"][0] == pytest.approx(1.0)
        assert states[-1]["bounce"]["t"] > states[-1]["t"]
        assert states[-1]["note"] == ""
    others = [line["kind"] for line in lines if line["kind"] != "state"]
    assert others == ["newcomer", "newcomer", "newcomer", "lost", "newcomer", "lost"]  # the second stamp tells
    assert re.search(
        r"latency of 24 lines: median [\d.]+ ms, 99 % [\d.]+ ms, 99.9 % [\d.]+ ms, worst [\d.]+ ms", said.err
    )
    assert "28 positions, 2 balls; 0 late, 0 too old, 0 repeated, 0 malformed, 0 dropped" in said.err


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.thorough)])
def test_a_service_manager_or_a_closed_terminal_end_a_stream_like_ctrl_c(dataset: Path, number: int) -> None:
    with started("--listen", "tcp://127.0.0.1:0", "--like", dataset) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        place = re.search(r"reading tcp://127.0.0.1:(\d+)", process.stderr.readline().decode())
        assert place is not None
        with socket.create_connection(("127.0.0.1", int(place[1]))) as sender:
            sender.sendall(csv(dataset, 0)[0])
            process.stdout.readline()
        process.send_signal(number)
        _, said = process.communicate()
    assert process.returncode == 0
    assert b"1 position, " in said


def test_senders_that_talk_nonsense_and_break_off_do_not_hurt_the_next_ball(dataset: Path) -> None:
    """The second sender's clock begins anew, and its ball is tracked like the first; Ctrl-C ends it."""
    with started("--listen", "tcp://127.0.0.1:0", "--like", dataset, "--patience", 0) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        ready = process.stderr.readline().decode()
        place = re.search(r"reading tcp://127.0.0.1:(\d+)", ready)
        assert place is not None, ready
        with socket.create_connection(("127.0.0.1", int(place[1]))) as sender:
            first = csv(dataset, 0, later=50.0)
            sender.sendall(b"".join([*first[:9], b"0x?!\n", b"50.2,nan,0,0\n", *first[9:], b"50.4,1,2"]))
        found = [json.loads(process.stdout.readline()) for _ in range(SAMPLES + 3)]
        with socket.create_connection(("127.0.0.1", int(place[1]))) as sender:
            sender.sendall(b"".join(csv(dataset, 1)))
            found += [json.loads(process.stdout.readline()) for _ in range(SAMPLES + 1)]
        process.send_signal(signal.SIGINT)
        rest, said = process.communicate()
    assert process.returncode == 0
    found += lines_of(rest)
    for ball, number, since in ((1, 0, 0), (2, 1, 2)):  # two samples tell that the clock began anew
        last = [line for line in found if line["kind"] == "state" and line["ball"] == ball][-1]
        assert last["samples"] == SAMPLES - since
        position = list(read_dataset(dataset))[number].positions[-1]
        np.testing.assert_allclose(last["position"], position, atol=0.01)
    assert any("no prediction: the line had waited" in line.get("note", "") for line in found)
    reasons = [line["reason"] for line in found if line["kind"] == "refused"]
    assert len([reason for reason in reasons if "a CSV line must be t,x,y,z" in reason]) == 2
    assert "a coordinate is not finite" in reasons
    text = said.decode()
    assert "2 too old, 0 repeated, 3 malformed" in text
    assert "1 clocks begun anew" in text


def test_a_stream_without_a_group_may_be_of_one_that_the_model_does_not_know(tmp_path: Path) -> None:
    """One known group and the usual prior of 60 rad/s, each by a half: the law of total variance, by hand."""
    model = nominal_model()
    model.spins = SpinPopulation("player", {"ann": SpinGroup((0.0, 150.0, 0.0), (4.0, 12.0, 8.0), 10)})
    save_model(model, tmp_path / "model.yaml")
    lines = b"".join(f"{t},{3.0 * t},0.0,{0.5 + t - 4.905 * t**2}\n".encode() for t in (0.0, 0.02, 0.04))
    with started("--model", tmp_path / "model.yaml") as process:
        out, err = process.communicate(lines)
    covariance = np.array(lines_of(out)[-2]["covariance"])[6:, 6:]
    usual = Settings.for_measured(model).spin_prior
    across = (12.0**2 + usual**2) / 2.0 + 150.0**2 / 4.0
    assert np.sqrt(np.diag(covariance)) == pytest.approx(
        [np.sqrt((4.0**2 + usual**2) / 2.0), np.sqrt(across), np.sqrt((8.0**2 + usual**2) / 2.0)], rel=0.05
    )
    assert b"the stream names no group (player): balls get the mixture of its groups, ann" in err


def test_a_closed_pipe_ends_it_cleanly(dataset: Path) -> None:
    with started("--like", dataset, "--patience", 0) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write(b"".join(csv(dataset, 0)))
        process.stdin.flush()
        assert json.loads(process.stdout.readline())["kind"] == "newcomer"
        process.stdout.close()
        for k in range(100):  # it meets the closed pipe with one of them
            try:
                process.stdin.write(f"{2.0 + 0.01 * k},0,0,1\n".encode())
                process.stdin.flush()
            except BrokenPipeError:
                break
        said = process.stderr.read().decode()
        assert process.wait() == 0
    assert "Traceback" not in said
    assert "Exception" not in said
    assert re.search(r"\d+ positions, \d+ balls?; ", said)  # how many lines it had read is chance


def test_a_full_disk_ends_it_with_one_line_and_the_recording_stays(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    with disk_of(20_000):
        said = printed("live", "--replay", dataset, "--speed", 0, "--out", out, status=2).err
    assert said.endswith(f"error: {out}: File too large. Check the path, its permissions and the space on the disk.\n")
    content = out.read_bytes()
    assert content.endswith(b"}\n")
    assert 15_000 < len(content) <= 20_000
    assert [line["kind"] for line in lines_of(content)][:3] == ["newcomer", "newcomer", "state"]
    assert "out must be a new file for a replay" in refused("live", "--replay", dataset, "--speed", 0, "--out", out)
    assert out.read_bytes() == content


def test_an_interrupt_in_the_middle_of_a_sample_keeps_the_recording(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second Ctrl-C raises wherever the program is."""
    tell, told = Session._tell, []

    def interrupted(self: Session, *arguments: object) -> None:
        told.append(arguments)
        if len(told) == 6:
            raise KeyboardInterrupt
        tell(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Session, "_tell", interrupted)
    out = tmp_path / "states.jsonl"
    said = printed("live", "--replay", dataset, "--speed", 0, "--out", out, status=130).err
    assert len(lines_of(out.read_bytes())) == 5
    assert said.endswith("ballfg: interrupted\n")


@pytest.fixture
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "tilted.yaml"
    path.write_text("{flight: {gravity: {}}, bounce: {restitution: {}}, measurement: {frame_tilt: {x: 0.01}}}")
    return path


def test_a_model_with_measurement_effects_is_refused_before_the_stream(tilted: Path) -> None:
    said = refused("live", "--model", tilted)
    assert said.startswith("ballfg: error: model must have no measurement effects here: they are undone from whole")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--replay", "nowhere"], "folder must exist; nowhere does not"),
        (["--listen", "5005"], "listen must be tcp://HOST:PORT or udp://HOST:PORT; got '5005'"),
        (["--plane", "2.0"], "plane must be an axis and a place in m; got '2.0'"),
        (["--speed", "-1"], "speed must be at least 0"),
        (["--lag", "-1"], "lag must be at least 0"),
        (["--horizon", "0"], "horizon must be finite and above 0"),
        (["--noise", "3"], "noise must be in m, at most 1; got 3. It is probably in mm"),
        (["--topic", "/ball"], "topic must come with a bag to replay"),
        (["--out", "nowhere/states.jsonl"], "out must be in an existing folder"),
        (["--out", "states.db3"], "out must be JSON lines or a bag in MCAP; got states.db3"),
        (["--idle", "0"], "idle must be finite and above 0"),
        (["--model", "nowhere.yaml"], "model file nowhere.yaml does not exist"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert refused("live", *arguments).startswith(f"ballfg: error: {message}")
    assert list(tmp_path.iterdir()) == []
