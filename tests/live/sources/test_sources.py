"""Sources on real pipes and sockets: whole lines, however they arrive, and senders that go."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from ballfg.live.sources.sender import WAITING, Arrival, Line, Sample, Sender
from ballfg.live.sources.sockets import listen
from ballfg.live.sources.source import Inbox, Pipe, Replay, Source, dataset_samples
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset


@contextmanager
def opened(source: Source) -> Iterator[Iterator[list[Arrival]]]:
    inbox = Inbox(source)
    try:
        yield inbox.groups()
    finally:
        inbox.close()


def times(group: list[Arrival]) -> list[float | None]:
    return [None if arrival.sample is None else arrival.sample.time for arrival in group]


def address_of(source: Source) -> tuple[str, int]:
    host, port = source.name.rpartition("/")[2].split(":")
    return host, int(port)


def test_a_pipe_gives_lines_however_they_are_cut() -> None:
    out, into = os.pipe()
    with opened(Pipe(out)) as groups:
        for piece in (b"0.1,1,2", b",3\n0.2,1,2,3\nbro", b"ken\n", b"0.3,1,2,3"):
            os.write(into, piece)
        os.close(into)
        found = [arrival for group in groups for arrival in group]
    os.close(out)
    assert times(found) == [0.1, 0.2, None, 0.3]
    assert found[2].problem.endswith("got 1 cells: 'broken'")
    assert all(arrival.read > 0.0 for arrival in found)


def test_a_file_is_read_as_it_is_needed_and_stamps_come_together(tmp_path: Path) -> None:
    path = tmp_path / "lines.csv"
    path.write_text("t,x,y,z\n0.1,1,2,3\n0.1,4,5,6\n0.2,1,2,3\n")
    with path.open("rb") as file:
        source = Pipe(file.fileno())
        assert not source.live
        with opened(source) as groups:
            assert [times(group) for group in groups] == [[0.1, 0.1], [0.2]]


def test_a_line_without_end_is_cut_and_the_next_one_is_whole() -> None:
    out, into = os.pipe()
    with opened(Pipe(out)) as groups:
        for piece in (*[b"9" * 60000] * 3, b"\n0.2,1,2,3\n"):
            os.write(into, piece)
        os.close(into)
        found = [times(group) for group in groups]
    os.close(out)
    assert found == [[None], [0.2]]


def test_tcp_senders_come_and_go() -> None:
    """One breaks off within a line; what another sends is not mixed with it."""
    source = listen("tcp://127.0.0.1:0")
    with opened(source) as groups:
        first, second = (socket.create_connection(address_of(source)) for _ in range(2))
        first.sendall(b"0.1,1,2,3\n0.2,4")
        assert times(next(groups)) == [0.1]
        second.sendall(b'{"t": 0.3, "position": [1, 2, 3]}\n')
        assert times(next(groups)) == [0.3]
        first.close()
        assert times(next(groups)) == [None]
        second.sendall(b"0.4,1,2,3\n")
        assert times(next(groups)) == [0.4]
        second.close()
        with socket.create_connection(address_of(source)) as third:
            third.sendall(b"0.5,1,2,3\n")
            assert times(next(groups)) == [0.5]


def test_udp_packets_hold_whole_lines() -> None:
    source = listen("udp://127.0.0.1:0")
    with opened(source) as groups, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet, expected in ((b"0.1,1,2,3", [0.1]), (b"0.2,1", [None]), (b"0.3,1,2,3\n0.3,4,5,6\n", [0.3])):
            sender.sendto(packet, address_of(source))
            group = next(groups)
            assert times(group)[:1] == expected
    assert source.lossy


class Burst(Source):
    """More samples than may wait, all at once, of two senders after one another; then a signal that they are there."""

    name, lossy = "burst", True

    def __init__(self, *counts: int) -> None:
        self.counts = counts
        self.sent = threading.Event()

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        for number, count in enumerate(self.counts):
            sender = Sender(str(number))
            for k in range(count):
                yield Line(sender, 0.0, Sample(float(k), [[0.0, 0.0, 0.0]], tag=(("sender", number),)))
        self.sent.set()


def test_what_waits_is_bounded_and_the_oldest_goes_first() -> None:
    source = Burst(WAITING + 100)
    inbox = Inbox(source)
    assert source.sent.wait(20.0)
    found = [time for group in inbox.groups() for time in times(group)]
    assert inbox.dropped == 100
    assert found == [float(k) for k in range(100, WAITING + 100)]


def test_senders_take_turns_and_the_surplus_of_one_costs_the_others_nothing() -> None:
    source = Burst(3 * WAITING, 10)
    inbox = Inbox(source)
    assert source.sent.wait(20.0)
    assert inbox.dropped == 2 * WAITING
    first = [dict(group[0].sample.tag)["sender"] for group in inbox.groups() if group[0].sample is not None]
    assert first[:20] == [0, 1] * 10
    assert first[20:] == [0] * (WAITING - 10)


def test_an_interrupt_ends_what_waits() -> None:
    source = listen("tcp://127.0.0.1:0")
    inbox = Inbox(source)
    threading.Timer(0.05, inbox.interrupt).start()
    assert list(inbox.groups()) == []
    inbox.close()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:80", r"listen must be tcp://HOST:PORT or udp://HOST:PORT; got '127.0.0.1:80'"),
        ("tcp://127.0.0.1:70000", "listen must be tcp://HOST:PORT"),
        ("udp://no.such.host.invalid:1", "listen must be a free address; udp://no.such.host.invalid:1: "),
    ],
)
def test_bad_addresses_are_refused(address: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        listen(address)


def test_a_dataset_plays_its_tracks_one_after_the_other(tmp_path: Path) -> None:
    write_simulation(tmp_path / "shots", SimulationConfig(tracks=2, rate=50.0, seed=4))
    data = read_dataset(tmp_path / "shots")
    samples = list(dataset_samples(data))
    stamps = [sample.time for sample in samples]
    first, second = list(data)
    assert stamps == sorted(stamps)
    assert stamps[len(first)] == pytest.approx(first.times[-1] + 1.0)
    assert dict(samples[-1].tag) == {"trajectory": "001", "t_track": second.times[-1]}
    played = list(Replay(samples, 1e4, "shots").lines(threading.Event()))
    assert [line.content for line in played] == samples
    assert all(before.read <= after.read for before, after in pairwise(played))
