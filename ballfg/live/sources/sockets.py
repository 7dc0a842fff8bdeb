"""Receives samples from the network: lines over TCP, or packets over UDP."""

import re
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from time import perf_counter
from typing import Any

from ballfg.checks import shown
from ballfg.live.outlook import encoded, refusal
from ballfg.live.sources.listener import IDLE, SENDERS, WAIT, Listener, readable, written
from ballfg.live.sources.sender import PAUSE, WAITING, Line, Sender
from ballfg.live.sources.source import CHUNK, Source

ADDRESS = re.compile(r"(tcp|udp)://(\[[0-9a-fA-F:.]+\]|[^:/\[\]]*):(\d{1,5})")
PIECE = 4096  # Number of bytes read at once of a TCP sender: less than a millisecond's work
SILENT = 1.0  # s, after which a silent UDP sender makes room for a new one: it can return at any time
DROPS = 40  # The option SO_RXQ_OVFL of Linux: a packet comes with the number of packets dropped before it
DROP_SPACE = 64  # Bytes for that number


def listen(address: str, idle: float = IDLE) -> Source:
    """A source that listens at tcp://HOST:PORT or udp://HOST:PORT; port 0 takes a free one.

    Args: address: without a host, only this machine can send.  idle: s, after which silent senders are dropped.
    Raises: ValueError: another form of address, or one that cannot be bound.
    """
    found = ADDRESS.fullmatch(address)
    if found is None or int(found[3]) > 65535:
        raise ValueError(
            f"listen must be tcp://HOST:PORT or udp://HOST:PORT; got {shown(address)}. Write tcp://127.0.0.1:5005."
        )
    kind = TcpServer if found[1] == "tcp" else UdpServer
    try:
        return kind(found[2].strip("[]") or "127.0.0.1", int(found[3]), idle)
    except OSError as error:
        problem = error.strerror or str(error)
        raise ValueError(f"listen must be a free address; {address}: {problem}. Choose another.") from None


class Connection(Sender):
    """A TCP sender. Attributes: open: True if more may come."""

    def __init__(self, connected: socket.socket, name: str) -> None:
        super().__init__(name)
        connected.setblocking(False)
        self.socket = connected
        self.open = True

    def receive(self) -> Iterator[Line]:
        """Its new lines, including the last one if it has gone."""
        try:
            chunk = self.socket.recv(PIECE)
        except BlockingIOError:
            return iter(())
        except OSError:  # the connection broke
            chunk = b""
        if not chunk:
            self.socket.close()
            self.open = False
        return self.cut(chunk, last=not chunk)

    def dismiss(self, reason: str) -> None:
        """Tells it why no more lines are taken, and closes."""
        with suppress(OSError):
            self.socket.send(encoded(refusal(reason), 0.0))
            self.socket.shutdown(socket.SHUT_WR)
            for _ in range(PIECE):  # unread bytes would turn the close into a reset, which destroys the reason
                if not self.socket.recv(PIECE):
                    break
        self.socket.close()
        self.open = False


class TcpServer(Listener):
    """Receives the lines of every sender that connects; one that leaves does not affect the others."""

    def _open(self, place: Any) -> None:
        # the port of a command that has just ended is free at once; two listeners still exclude each other
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind(place)
        self._socket.listen()
        self._senders: list[Connection] = []
        self._refused = 0

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """As `Source.lines`."""
        try:
            while not stop.is_set():
                read = {sender.socket: sender for sender in self._senders if sender.open and not sender.full}
                door = [] if self._is_leaving() else [self._socket]
                held = len(read) < len(self._senders)
                ready = readable([*read, *door], PAUSE if held else WAIT)
                for each in ready:
                    if each is not self._socket:
                        yield from read[each].receive()
                if self._socket in ready and not self._is_leaving():
                    self._accept()
                self._drop_idle()
        finally:
            for sender in self._senders:
                sender.socket.close()

    def _is_leaving(self) -> bool:
        """True if all places are taken, but a sender has gone and its lines are answered."""
        return len(self._senders) >= SENDERS and not all(sender.open for sender in self._senders)

    def _accept(self) -> None:
        for _ in range(max(SENDERS - len(self._senders), 1)):
            try:
                connected, address = self._socket.accept()
            except OSError:  # nobody is left, or the sender has left already
                return
            sender = Connection(connected, written(address))
            if len(self._senders) < SENDERS:
                self._senders.append(sender)
                continue
            sender.dismiss(f"{SENDERS} senders are connected; no more are let in. Come back when one has gone.")
            self._refused += 1
            text = f"{SENDERS} senders are connected: {sender.name} was refused ({self._refused} refused so far)"
            self.say("refused", text)

    def _drop_idle(self) -> None:
        """Drops silent senders, and forgets those that have gone and are answered."""
        now = perf_counter()
        for sender in self._senders:
            if sender.full:
                sender.heard = now  # it was not read
            if sender.open and now - sender.heard > self.idle:
                sender.dismiss(f"no line came for {self.idle:g} s. Connect again, or send an empty line now and then.")
                self.say("idle", f"{sender.name} was dropped: no line for {self.idle:g} s")
        self._senders = [sender for sender in self._senders if sender.open or sender.busy]


class Correspondent(Sender):
    """A UDP sender.

    Args: address: of the sender.  own: a socket for its packets alone; None if the system grants none.

    Attributes:
        lost: number of packets that the system dropped.  told: number of dropped lines and packets that it was told.
    """

    def __init__(self, address: Any, own: socket.socket | None) -> None:
        super().__init__(written(address))
        self.address = address
        self.socket = own
        self.lost = 0
        self.told = 0

    @property
    def surplus(self) -> int:
        """Number of its dropped lines and packets."""
        return self.dropped + self.lost


class UdpServer(Listener):
    """Receives packets of one or more whole lines.

    The first packet of a sender comes through the common socket. Later ones come through a socket connected to that
    sender: the system queues each sender's packets separately, so that a flood fills its own buffer alone.
    """

    scheme = "udp"
    kind = socket.SOCK_DGRAM
    lossy = True

    def _open(self, place: Any) -> None:
        self._socket.bind(place)
        _count_drops(self._socket)
        self._senders: dict[Any, Correspondent] = {}
        self._refused: set[Any] = set()

    def lines(self, stop: threading.Event) -> Iterator[Line]:
        """As `Source.lines`."""
        try:
            look = 0.0
            while not stop.is_set():
                senders = [sender for sender in self._senders.values() if sender.socket is not None]
                read = [sender for sender in senders if not sender.full]
                timeout = WAIT if len(read) == len(senders) else PAUSE
                if perf_counter() > look:  # now and then the full ones too: dropping here costs less than in the system
                    read, look = senders, perf_counter() + PAUSE
                own = [sender.socket for sender in read if sender.socket is not None]
                for ready in readable([self._socket, *own], timeout):
                    most = WAITING if ready is self._socket else 1  # packets from before its own socket come first
                    for _ in range(most):
                        found = self._receive(ready)
                        if found is None:
                            break
                        yield from found
                self._tell_surplus()
        finally:
            for sender in self._senders.values():
                _close(sender.socket)

    def _receive(self, place: socket.socket) -> Iterator[Line] | None:
        """The lines of a packet; None without a packet, or for an unknown sender."""
        try:
            packet, extra, _, address = place.recvmsg(CHUNK, DROP_SPACE)
        except OSError:  # none is left, or the system reports an unheard notice
            return None
        sender = self._senders.get(address) or self._newcomer(address)
        if sender is None:
            return None
        for level, kind, count in extra:
            if level == socket.SOL_SOCKET and kind == DROPS and place is sender.socket:
                lost = int.from_bytes(count, sys.byteorder)
                self.lost += lost - sender.lost
                sender.lost = lost
        return sender.cut(packet, last=True)

    def _newcomer(self, address: Any) -> Correspondent | None:
        if len(self._senders) >= SENDERS:
            now = perf_counter()
            silent = [s for s in self._senders.values() if not s.busy and now - s.heard > SILENT]
            if not silent:  # told once for each notice
                if self.say("refused", f"{SENDERS} senders are heard: the packets of {written(address)} are refused"):
                    self._refused.clear()
                if address not in self._refused and len(self._refused) < SENDERS:
                    self._refused.add(address)
                    self._tell(address, f"{SENDERS} senders are heard; no more are. Come back when one has gone.")
                return None
            oldest = min(silent, key=lambda sender: sender.heard)
            _close(self._senders.pop(oldest.address).socket)
        sender = self._senders[address] = Correspondent(address, self._own_socket(address))
        return sender

    def _own_socket(self, address: Any) -> socket.socket | None:
        own = socket.socket(self._socket.family, self.kind)
        try:
            own.setblocking(False)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # for this one bind
            own.bind(self._socket.getsockname())
            own.connect(address)
            _count_drops(own)
        except OSError:
            own.close()
            return None
        finally:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)  # nobody else may share the address
        return own

    def _tell_surplus(self) -> None:
        """Tells senders the number of their dropped lines and packets, and the user the worst."""
        new = [sender for sender in self._senders.values() if sender.surplus > sender.told]
        if not new:
            return
        worst = max(new, key=lambda sender: sender.surplus - sender.told)
        text = f"{worst.name} sends more than can be answered: {worst.surplus} of its lines or packets were dropped"
        if self.say("surplus", text):
            for sender in new:
                sender.told = sender.surplus
                self._tell(sender.address, f"{sender.told} lines or packets were dropped: more than can be answered")

    def _tell(self, address: Any, reason: str) -> None:
        with suppress(OSError):
            self._socket.sendto(encoded(refusal(reason), 0.0), address)


def _count_drops(own: socket.socket) -> None:
    """Makes the system report the number of dropped packets, where it can."""
    if sys.platform == "linux":
        own.setsockopt(socket.SOL_SOCKET, DROPS, 1)


def _close(own: socket.socket | None) -> None:
    if own is not None:
        own.close()
