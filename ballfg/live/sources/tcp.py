"""Receives lines over TCP."""

import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from time import perf_counter
from typing import Any

from ballfg.live.outlook import encoded, refusal
from ballfg.live.sources.listener import SENDERS, WAIT, Listener, readable, written
from ballfg.live.sources.sender import PAUSE, Line, Sender

PIECE = 4096  # Number of bytes read at once of a sender: less than a millisecond's work


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
