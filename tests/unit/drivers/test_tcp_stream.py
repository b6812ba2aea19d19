import errno
import socket

import pytest

from drivers.errors import DeviceDisconnected
from drivers.transports.tcp_line import TcpStream


class Lost:
    """A socket whose other side answers no more, as the system says after minutes without an acknowledgement."""

    def __init__(self, *_: object) -> None:
        pass

    def ignore(self, *_: object) -> None:
        pass

    settimeout = setsockopt = ignore

    def fail(self, *_: object) -> int:
        raise TimeoutError(errno.ETIMEDOUT, "Connection timed out")

    sendall = recv_into = fail


def test_a_peer_that_the_system_gives_up_is_lost_and_not_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "create_connection", Lost)
    stream = TcpStream("spad", "127.0.0.1:9")
    with pytest.raises(DeviceDisconnected, match="is lost"):
        stream.send(b"x", 1.0)
    with pytest.raises(DeviceDisconnected, match="is lost"):
        stream.receive(1.0)
