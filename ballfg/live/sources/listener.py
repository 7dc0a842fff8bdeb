"""A listener binds an address for TCP or UDP and tells senders and the user about problems."""

import selectors
import socket
import sys
from collections.abc import Collection
from ipaddress import ip_address
from time import perf_counter
from typing import Any

from ballfg.live.sources.source import Source

WAIT = 0.1  # s, after which a quiet listener checks whether it should stop
SENDERS = 64  # Largest number of senders at once
IDLE = 300.0  # s, after which a silent TCP sender is dropped
NOTICE = 5.0  # s between two notices of the same kind


class Listener(Source):
    """The common part of TCP and UDP: one bound address, and notices to senders and the user.

    Args: host: name or address.  port: 0 takes a free one.  idle: s.
    Raises: OSError: the address cannot be bound.
    """

    scheme = "tcp"
    kind = socket.SOCK_STREAM

    def __init__(self, host: str, port: int, idle: float) -> None:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=self.kind, flags=socket.AI_PASSIVE)[0]
        self.idle = idle
        self._socket = socket.socket(family, self.kind)
        self._said: dict[str, float] = {}
        try:
            self._open(place)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        address = self._socket.getsockname()
        self.name = f"{self.scheme}://{written(address)}"
        own = ip_address(address[0].partition("%")[0]).is_loopback
        whoever = "any program of this machine" if own else "anyone who reaches this address"
        self.trust = f"{whoever} can send samples, without authentication or encryption"

    def _open(self, place: Any) -> None:
        self._socket.bind(place)

    def say(self, kind: str, text: str) -> bool:
        """Prints a notice, unless one of its kind has just been printed. Returns: True if printed."""
        now = perf_counter()
        if now - self._said.get(kind, -NOTICE) < NOTICE:
            return False
        self._said[kind] = now
        print(f"ballfg live: {text}", file=sys.stderr, flush=True)
        return True

    def close(self) -> None:
        """As `Source.close`."""
        self._socket.close()


def readable(sockets: Collection[socket.socket], timeout: float) -> list[Any]:
    """The readable sockets, after a timeout (s) if there is none."""
    with selectors.PollSelector() as selector:
        for each in sockets:
            selector.register(each, selectors.EVENT_READ)
        return [key.fileobj for key, _ in selector.select(timeout)]


def written(address: Any) -> str:
    """HOST:PORT of an address, an IPv6 host in brackets."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
