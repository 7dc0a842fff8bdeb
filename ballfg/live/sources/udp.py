"""Receives lines in UDP packets."""

import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from time import perf_counter
from typing import Any

from ballfg.live.outlook import encoded, refusal
from ballfg.live.sources.listener import SENDERS, WAIT, Listener, readable, written
from ballfg.live.sources.sender import PAUSE, WAITING, Line, Sender
from ballfg.live.sources.source import CHUNK

SILENT = 1.0  # s, after which a silent sender makes room for a new one: it can return at any time
DROPS = 40  # The option SO_RXQ_OVFL of Linux: a packet comes with the number of packets dropped before it
DROP_SPACE = 64  # Bytes for that number


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
