"""Samples from the network: lines over TCP from any number of senders, or packets over UDP."""

from __future__ import annotations

import re
import selectors
import socket
import threading
from collections.abc import Iterator

from ballfg.checks import shown
from ballfg.live.sources.source import CHUNK, Arrival, LineBuffer, Source

WAIT = 0.1
"""s, after which a quiet socket looks whether it shall stop."""
SENDERS = 64
"""TCP senders that may be connected at once."""
ADDRESS = re.compile(r"(tcp|udp)://(\[[0-9a-fA-F:.]+\]|[^:/\[\]]*):(\d{1,5})")


def listen(address: str) -> Source:
    """A source that listens at tcp://HOST:PORT or udp://HOST:PORT; port 0 takes a free one.

    Raises: ValueError: another form of address. OSError: an address that cannot be listened at.
    """
    found = ADDRESS.fullmatch(address)
    if found is None or int(found[3]) > 65535:
        raise ValueError(
            f"listen must be tcp://HOST:PORT or udp://HOST:PORT; got {shown(address)}. Write tcp://0.0.0.0:5005."
        )
    kind = TcpServer if found[1] == "tcp" else UdpSocket
    try:
        return kind(found[2].strip("[]"), int(found[3]))
    except OSError as error:
        problem = error.strerror or str(error)
        raise ValueError(f"listen must be a free address; {address}: {problem}. Choose another.") from None


def _bound(host: str, port: int, kind: socket.SocketKind) -> socket.socket:
    """A socket of a kind at an address. Raises: OSError."""
    family, _, _, _, place = socket.getaddrinfo(host or None, port, type=kind, flags=socket.AI_PASSIVE)[0]
    made = socket.socket(family, kind)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(place)
    except OSError:
        made.close()
        raise
    return made


class TcpServer:
    """Lines of every sender that connects; one that goes leaves the others and the balls alone."""

    live, lossy = True, False

    def __init__(self, host: str, port: int) -> None:
        self._socket = _bound(host, port, socket.SOCK_STREAM)
        self._socket.listen()
        self._socket.setblocking(False)
        self.name = f"tcp://{host}:{self._socket.getsockname()[1]}"

    def arrivals(self, stop: threading.Event) -> Iterator[Arrival]:
        """As `Source.arrivals`."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            try:
                while not stop.is_set():
                    for key, _ in selector.select(WAIT):
                        if key.data is None:
                            self._accept(selector)
                        else:
                            yield from _received(key.fileobj, key.data, selector)  # type: ignore[arg-type]
            finally:
                for key in [k for k in selector.get_map().values() if k.data is not None]:
                    key.fileobj.close()  # type: ignore[union-attr]

    def _accept(self, selector: selectors.BaseSelector) -> None:
        try:
            sender, _ = self._socket.accept()
        except OSError:  # it went before it was let in
            return
        if len(selector.get_map()) > SENDERS:
            sender.close()
            return
        sender.setblocking(False)
        selector.register(sender, selectors.EVENT_READ, LineBuffer())

    def close(self) -> None:
        """As `Source.close`."""
        self._socket.close()


def _received(sender: socket.socket, buffer: LineBuffer, selector: selectors.BaseSelector) -> Iterator[Arrival]:
    """The lines that a sender has sent, the last one too where it has gone."""
    try:
        chunk = sender.recv(CHUNK)
    except BlockingIOError:
        return
    except OSError:  # the connection broke: half a line is none
        chunk = b""
    if chunk:
        yield from buffer.feed(chunk)
        return
    yield from buffer.end()
    selector.unregister(sender)
    sender.close()


class UdpSocket:
    """Packets of one or more whole lines."""

    live, lossy = True, True

    def __init__(self, host: str, port: int) -> None:
        self._socket = _bound(host, port, socket.SOCK_DGRAM)
        self._socket.settimeout(WAIT)
        self.name = f"udp://{host}:{self._socket.getsockname()[1]}"

    def arrivals(self, stop: threading.Event) -> Iterator[Arrival]:
        """As `Source.arrivals`."""
        buffer = LineBuffer()
        while not stop.is_set():
            try:
                packet = self._socket.recv(CHUNK)
            except TimeoutError:
                continue
            yield from buffer.feed(packet)
            yield from buffer.end()

    def close(self) -> None:
        """As `Source.close`."""
        self._socket.close()
