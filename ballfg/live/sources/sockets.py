"""Receives samples from the network: lines over TCP, or packets over UDP."""

import re

from ballfg.checks import shown
from ballfg.live.sources.listener import IDLE
from ballfg.live.sources.source import Source
from ballfg.live.sources.tcp import TcpServer
from ballfg.live.sources.udp import UdpServer

ADDRESS = re.compile(r"(tcp|udp)://(\[[0-9a-fA-F:.]+\]|[^:/\[\]]*):(\d{1,5})")


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
