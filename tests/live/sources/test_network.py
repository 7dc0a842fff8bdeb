"""Listeners on the loopback interface: who may send, how many, for how long; what hostile senders cost the others."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from ballfg.live.sources import sockets
from ballfg.live.sources.listener import SENDERS
from ballfg.live.sources.sender import WAITING, Arrival
from ballfg.live.sources.sockets import listen
from ballfg.live.sources.source import Inbox, Source

PATIENCE = 20.0
"""s that a test waits at most."""


@contextmanager
def heard(address: str, idle: float = 300.0) -> Iterator[tuple[Source, Iterator[list[Arrival]]]]:
    source = listen(address, idle)
    inbox = Inbox(source)
    try:
        yield source, inbox.groups()
    finally:
        inbox.close()


def place_of(source: Source) -> tuple[str, int]:
    host, port = source.name.rpartition("/")[2].rsplit(":", 1)
    return host.strip("[]"), int(port)


def connected(source: Source) -> socket.socket:
    return socket.create_connection(place_of(source), PATIENCE)


def packets(host: str = "127.0.0.1") -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((host, 0))
    made.settimeout(PATIENCE)
    return made


def stamp(group: list[Arrival]) -> float | None:
    return None if group[0].sample is None else group[0].sample.time


def told(sender: socket.socket) -> str:
    """The reason in the line that a sender gets."""
    line = json.loads(sender.recv(4096))
    assert line["kind"] == "refused"
    return line["reason"]


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
def test_without_a_host_only_this_machine_can_send(scheme: str) -> None:
    with heard(f"{scheme}://:0") as (source, _):
        assert place_of(source)[0] == "127.0.0.1"
        assert source.trust == "any program of this machine can send samples, without authentication or encryption"


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
def test_an_address_that_others_reach_is_named_as_such(scheme: str) -> None:
    source = listen(f"{scheme}://0.0.0.0:0")
    source.close()
    assert source.trust == "anyone who reaches this address can send samples, without authentication or encryption"


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
@pytest.mark.parametrize("option", [None, "SO_REUSEADDR", "SO_REUSEPORT"])
def test_nobody_else_gets_the_same_address(scheme: str, option: str | None) -> None:
    """Neither another `ballfg live` nor a program that asks to share it, before and after senders have come."""
    kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
    with heard(f"{scheme}://127.0.0.1:0") as (source, groups), ExitStack() as stack:
        for k in range(3):
            with pytest.raises(ValueError, match=r"listen must be a free address; .*: Address already in use"):
                listen(source.name)
            with socket.socket(socket.AF_INET, kind) as other, pytest.raises(OSError, match="in use"):  # noqa: PT012
                if option is not None:
                    other.setsockopt(socket.SOL_SOCKET, getattr(socket, option), 1)
                other.bind(place_of(source))
                other.listen()
            sender = stack.enter_context(connected(source) if scheme == "tcp" else packets())
            sender.sendto(f"{k},1,2,3\n".encode(), place_of(source))
            assert stamp(next(groups)) == k


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
def test_ipv6(scheme: str) -> None:
    try:
        packets("::1").close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with heard(f"{scheme}://[::1]:0") as (source, groups):
        assert source.name.startswith(f"{scheme}://[::1]:")
        sender = connected(source) if scheme == "tcp" else packets("::1")
        with sender:
            for k in range(3):
                sender.sendto(f"{k},1,2,3\n".encode(), place_of(source))
                assert stamp(next(groups)) == k


def test_one_connection_too_many_is_told_so(capfd: pytest.CaptureFixture[str]) -> None:
    with heard("tcp://127.0.0.1:0") as (source, groups), ExitStack() as stack:
        senders = [stack.enter_context(connected(source)) for _ in range(SENDERS)]
        for k, sender in enumerate(senders):
            sender.sendall(f"{k},1,2,3\n".encode())
            assert stamp(next(groups)) == k
        for _ in range(3):
            late = stack.enter_context(connected(source))
            assert told(late) == "64 senders are connected; no more are let in. Come back when one has gone."
            assert late.recv(1) == b""
        assert capfd.readouterr().err.count("64 senders are connected: 127.0.0.1:") == 1
        senders[0].close()
        deadline = time.monotonic() + PATIENCE
        while True:
            again = stack.enter_context(connected(source))
            again.sendall(b"70,1,2,3\n")
            again.settimeout(0.3)
            try:
                assert b"refused" in again.recv(4096)
            except TimeoutError:  # let in: nothing is said
                break
            assert time.monotonic() < deadline
        assert stamp(next(groups)) == 70


def test_idle_connections_are_dropped_and_those_with_lines_are_not(capfd: pytest.CaptureFixture[str]) -> None:
    """A sender that never ends its line is idle too; an empty line is a sign of life."""
    with heard("tcp://127.0.0.1:0", idle=0.5) as (source, groups), ExitStack() as stack:
        idle, slow, busy = (stack.enter_context(connected(source)) for _ in range(3))
        begun = time.monotonic()
        while time.monotonic() < begun + 1.2:
            busy.sendall(b"\n")
            if time.monotonic() < begun + 0.4:
                slow.sendall(b"1")
            time.sleep(0.05)
        for sender in (idle, slow):
            assert told(sender) == "no line came for 0.5 s. Connect again, or send an empty line now and then."
        busy.sendall(b"0.1,1,2,3\n")
        assert stamp(next(groups)) == 0.1
        assert "was dropped: no line for 0.5 s" in capfd.readouterr().err


def test_one_udp_sender_too_many_is_told_so_and_the_silent_make_room(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sockets, "SILENT", 3600.0)
    with heard("udp://127.0.0.1:0") as (source, groups), ExitStack() as stack:
        senders = [stack.enter_context(packets()) for _ in range(SENDERS + 1)]
        for k, sender in enumerate(senders[:SENDERS]):
            sender.sendto(f"{k},1,2,3".encode(), place_of(source))
            assert stamp(next(groups)) == k
        senders[SENDERS].sendto(b"99,1,2,3", place_of(source))
        assert told(senders[SENDERS]) == "64 senders are heard; no more are. Come back when one has gone."
        assert "64 senders are heard: the packets of 127.0.0.1:" in capfd.readouterr().err
        monkeypatch.setattr(sockets, "SILENT", 0.0)
        senders[SENDERS].sendto(b"100,1,2,3", place_of(source))
        assert stamp(next(groups)) == 100
        senders[0].sendto(b"101,1,2,3", place_of(source))  # who made room comes back
        assert stamp(next(groups)) == 101


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
def test_a_flood_takes_nothing_from_another_sender(scheme: str, capfd: pytest.CaptureFixture[str]) -> None:
    """A hundred lines beside a flood: each is answered after at most a few of the flood's, none is lost."""
    with heard(f"{scheme}://127.0.0.1:0") as (source, groups), ExitStack() as stack:
        flooding, good = (stack.enter_context(connected(source) if scheme == "tcp" else packets()) for _ in range(2))
        flooding.settimeout(0.1)
        stop = threading.Event()

        def flood() -> None:
            while not stop.is_set():
                try:
                    flooding.sendto(b"-1,1,2,3\n-2,1,2,3\n" * 4, place_of(source))
                except TimeoutError:  # it has to wait, as it shall
                    continue

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            for _ in range(2 * WAITING):  # until there is more of it than may wait
                assert stamp(next(groups)) in (-1, -2)
            for k in range(100):
                good.sendto(f"{k},1,2,3\n".encode(), place_of(source))
                taken, since = next(groups), 0
                while stamp(taken) in (-1, -2):
                    taken, since = next(groups), since + 1
                    time.sleep(0.0005)
                assert stamp(taken) == k
                assert since < WAITING / 8
        finally:
            stop.set()
            thread.join()
        if scheme == "udp":
            assert "sends more than can be answered" in capfd.readouterr().err
            assert "lines or packets were dropped: more than can be answered" in told(flooding)


def test_a_hundred_thousand_bytes_without_end_and_noise_leave_the_next_line_alone() -> None:
    with heard("tcp://127.0.0.1:0") as (source, groups), connected(source) as hostile, connected(source) as good:
        hostile.sendall(b"9" * 300_000)
        group = next(groups)
        assert group[0].problem.startswith("a line must have at most 65536 bytes")
        hostile.sendall(b"\n" + os.urandom(5000).replace(b"\n", b"") + b"\n\x1b[2Jname\x07,1,2\n")
        for _ in range(2):
            group = next(groups)
            assert group[0].sample is None
            assert group[0].problem.isprintable()
        good.sendall(b"0.1,1,2,3\n")
        assert stamp(next(groups)) == 0.1


def test_packets_of_any_size_are_taken() -> None:
    with heard("udp://127.0.0.1:0") as (source, groups), packets() as sender:
        for content in (
            b"",
            b"\0" * 65507,
            b"#\n" * 32753,
            b'{"t":1,"positions":[' + b"[1,2,3]," * 8000 + b"[1,2,3]]}",
        ):
            sender.sendto(content, place_of(source))
        sender.sendto(b"0.1,1,2,3", place_of(source))
        found = next(groups)
        while found[0].sample is None:
            found = next(groups)
        assert stamp(found) == 0.1


def test_many_connections_in_a_row_leave_nothing_behind() -> None:
    """More than there are places for, some with half a line that waits to be answered. The last one is let in."""
    with heard("tcp://127.0.0.1:0") as (source, groups):
        assert isinstance(source, sockets.TcpServer)
        before = len(os.listdir("/dev/fd"))
        for k in range(300):
            with connected(source) as sender:
                if k % 3 == 0:
                    sender.sendall(b"0.1,1,")
        with connected(source) as sender:
            sender.sendall(b"7,1,2,3\n")
            found = [stamp(next(groups)) for _ in range(101)]
            assert found.count(7) == 1
        deadline = time.monotonic() + PATIENCE
        while source._senders:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert len(os.listdir("/dev/fd")) <= before + 2
