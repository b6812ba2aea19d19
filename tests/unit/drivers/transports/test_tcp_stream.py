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


def test_exactly_so_many_bytes_are_received_or_what_came_within_the_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        stream = TcpStream("dac", f"127.0.0.1:{server.getsockname()[1]}", 1.0)
        other, _ = server.accept()
        with other:
            assert stream.peer == "127.0.0.1"
            other.sendall(b"abc")
            other.sendall(b"de")
            assert stream.receive_exactly(4, 1.0) == b"abcd"
            assert stream.receive_exactly(4, 0.05) == b"e"
        with pytest.raises(DeviceDisconnected, match="closed the connection"):
            stream.receive_exactly(1, 1.0)
        stream.close()
