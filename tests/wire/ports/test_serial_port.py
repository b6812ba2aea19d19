"""Serial ports: deadlines kept, every failure one typed line, emulated and with pyserial on a pseudo terminal.

Deadlines are looked at on the emulated port, which keeps virtual time.
"""

import errno
import os
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
import serial
from serial.tools import list_ports

from drivers.clock import VirtualClock, now_s
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.serial_port import SerialPort
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.emulated_lasers import PATIENCE_S, Silent
from tests.wire.faults import Fault, FaultScript
from tests.wire.serial_wire import STANDSTILL_S, SerialWire, hold_up


class Echo(Silent):
    """Answers each line with itself in brackets."""

    def receive(self, data: bytes, now_s: float) -> bytes:
        return b"".join(b"[" + line + b"]\r\n" for line in data.split(b"\n") if line)


Server = SerialServer | SerialWire


@pytest.fixture(params=[SerialWire, SerialServer], ids=["emulated", "pseudo terminal"])
def server(request: pytest.FixtureRequest) -> Iterator[Server]:
    clock = VirtualClock() if request.param is SerialWire else None
    with request.param(Echo(), clock=clock, baud=1_000_000) as served:
        yield served


@pytest.fixture
def port(server: Server) -> Iterator[SerialPort]:
    opened = SerialPort("echo", server.endpoint)
    yield opened
    opened.close()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def virtual(clock: VirtualClock) -> Iterator[SerialPort]:
    """A port on virtual time."""
    with SerialWire(Echo(), clock=clock, baud=9600) as wire:
        yield SerialPort("echo", wire.endpoint)


def test_lines_come_as_sent(port: SerialPort) -> None:
    port.write(b"ab\n")
    assert port.read_line(b"\r\n", PATIENCE_S) == b"[ab]"
    port.write(b"cd\n")
    assert port.read_line(b"]", PATIENCE_S) == b"[cd"
    assert port.read_line(b"\n", PATIENCE_S) == b"\r"


def test_a_reply_that_does_not_come_is_a_timeout_at_the_deadline(virtual: SerialPort, clock: VirtualClock) -> None:
    with pytest.raises(DeviceTimeout, match=r"0\.2 s"):
        virtual.read_line(b"\n", 0.2)
    assert now_s(clock) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("deadline_s", [0.02, 0.2])
def test_what_came_while_the_host_was_held_up_is_no_timeout(
    deadline_s: float, virtual: SerialPort, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold_up(virtual, clock, monkeypatch)
    virtual.write(b"ab\n")
    assert virtual.read_line(b"\r\n", deadline_s) == b"[ab]"
    assert now_s(clock) >= STANDSTILL_S
    with pytest.raises(DeviceTimeout):
        virtual.read_line(b"\r\n", deadline_s)


def test_what_came_before_a_timeout_is_kept_until_the_input_is_reset(virtual: SerialPort) -> None:
    virtual.write(b"ab\n")
    with pytest.raises(DeviceTimeout, match="6 bytes came"):
        virtual.read_line(b"!", 0.2)
    assert virtual.read_line(b"\r\n", 0.1) == b"[ab]"
    virtual.write(b"cd\n")
    with pytest.raises(DeviceTimeout):
        virtual.read_line(b"!", 0.2)
    virtual.reset_input()
    with pytest.raises(DeviceTimeout, match="0 bytes came"):
        virtual.read_line(b"\n", 0.05)


def test_noise_without_an_end_is_a_protocol_error(virtual: SerialPort) -> None:
    virtual._received += bytes(70_000)
    with pytest.raises(ProtocolError, match="noise"):
        virtual.read_line(b"\n", 0.1)


def test_replies_leave_at_ten_bits_a_character(virtual: SerialPort, clock: VirtualClock) -> None:
    virtual.write(b"x" * 95 + b"\n")
    virtual.read_line(b"\n", 2.0)
    assert now_s(clock) == pytest.approx(99 * 10 / 9600, rel=0.05)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("/dev/ttyNOWHERE", "/dev/ttyNOWHERE is not there"),
        ("/dev/null", "cannot be opened as a serial port"),
        ("rfc2217://127.0.0.1:2217", "socat"),
        ("socket://127.0.0.1:2217", "socat"),
    ],
)
def test_what_is_no_port_is_refused_in_one_line(address: str, said: str) -> None:
    with pytest.raises(DeviceNotFound, match=said) as refused:
        SerialPort("laser", Endpoint(address))
    assert "\n" not in str(refused.value)


@pytest.mark.usefixtures("port")
def test_a_busy_port_is_refused(server: Server) -> None:
    with pytest.raises(DeviceBusy, match="held by another program; close that program, or the device if this program"):
        SerialPort("laser", server.endpoint)


def test_a_forbidden_port_names_the_udev_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*args: object, **kwargs: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port /dev/ttyUSB0: Permission denied")

    monkeypatch.setattr(serial, "Serial", forbidden)
    with pytest.raises(DevicePermission, match=r"config/udev/70-spadrig\.rules"):
        SerialPort("laser", Endpoint("/dev/ttyUSB0"))


CALLS: dict[str, Callable[[SerialPort], object]] = {
    "write": lambda port: port.write(b"x\n"),
    "read a line": lambda port: port.read_line(b"\n", 0.3),
    "reset": SerialPort.reset_input,
    "drain": lambda port: port.drain(0.1, 0.3),
}
each_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


@each_call
def test_an_unplugged_port_is_lost_whatever_is_called(
    server: Server, port: SerialPort, call: Callable[[SerialPort], object]
) -> None:
    assert not port.lost
    server.unplug()
    assert port.lost
    with pytest.raises(DeviceDisconnected, match="is lost"):
        call(port)


@each_call
def test_a_port_that_was_closed_under_a_call_is_lost(port: SerialPort, call: Callable[[SerialPort], object]) -> None:
    port.close()
    port.close()
    with pytest.raises(DeviceDisconnected):
        call(port)


def test_a_device_that_was_plugged_in_again_is_opened_again(server: Server, port: SerialPort) -> None:
    server.unplug()
    with pytest.raises(DeviceNotFound):
        SerialPort("echo", server.endpoint)
    server.plug()
    again = SerialPort("echo", server.endpoint)
    again.write(b"ab\n")
    assert again.read_line(b"\r\n", PATIENCE_S) == b"[ab]"
    again.close()


def test_a_device_that_takes_nothing_is_a_timeout(server: Server, port: SerialPort) -> None:
    server.hang()
    with pytest.raises(DeviceTimeout, match="took no data"):
        port.write(bytes(100_000))


def attached(*ports: tuple[str, str | None, int | None, int | None]) -> list[SimpleNamespace]:
    return [SimpleNamespace(device=d, serial_number=s, vid=v, pid=p) for d, s, v, p in ports]


def test_a_port_is_found_by_serial_number_and_by_product(monkeypatch: pytest.MonkeyPatch) -> None:
    with SerialServer(Echo()) as server:
        listed = attached(("/dev/ttyS0", None, None, None), (server.path, "A1", 0x2E8A, 0xA))
        monkeypatch.setattr(list_ports, "comports", lambda: listed)
        for address in ("serial=A1", "usb=2E8A:000a"):
            found = SerialPort("box", Endpoint(address))
            assert found.path == server.path
            found.close()
    with pytest.raises(DeviceNotFound, match=r"no serial port with serial=B2; attached: .*serial=A1"):
        SerialPort("box", Endpoint("serial=B2"))


def test_the_usb_ids_of_a_port_are_found_through_links_too(monkeypatch: pytest.MonkeyPatch) -> None:
    with SerialServer(Echo()) as server:
        for listed, ids in ((os.path.realpath(server.path), (0x2E8A, 0xA)), ("/dev/ttyS0", None)):
            monkeypatch.setattr(list_ports, "comports", lambda: attached((listed, None, 0x2E8A, 0xA)))  # noqa: B023
            port = SerialPort("box", server.endpoint)  # whose path is a link
            assert port.usb_ids == ids
            port.close()


def test_two_equal_devices_ask_for_the_serial_number_or_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = attached(("/dev/ttyACM0", "A1", 0x2E8A, 0xA), ("/dev/ttyACM1", "A1", 0x2E8A, 0xA))
    monkeypatch.setattr(list_ports, "comports", lambda: listed)
    with pytest.raises(DeviceNotFound, match=r"2 serial ports .*ttyACM0, /dev/ttyACM1.*give serial="):
        SerialPort("box", Endpoint("usb=2e8a:000a"))
    with pytest.raises(DeviceNotFound, match="give the port's path"):
        SerialPort("box", Endpoint("serial=A1"))


def test_emulated_ports_are_looked_up_and_real_ones_are_not() -> None:
    laser = Endpoint("/tmp/tty")
    assert resolve("emulated:laser", {"laser": laser}) is laser
    assert resolve("/dev/ttyUSB0", {"laser": laser}) == Endpoint("/dev/ttyUSB0")
    with pytest.raises(DeviceNotFound, match="choose one of: gate, laser"):
        resolve("emulated:lasr", {"laser": laser, "gate": laser})
    with pytest.raises(DeviceNotFound, match="emulating world"):
        resolve("emulated:laser", {})


@pytest.mark.parametrize(
    ("fault", "arrives"),
    [
        (Fault.LATE, b"[a]\r\n[b]\r\n"),
        (Fault.SPLIT, b"[a]\r\n[b]\r\n"),
        (Fault.MERGED, b"[a]\r\n[b]\r\n"),
        (Fault.REPEATED, b"[a]\r\n[a]\r\n[b]\r\n"),
        (Fault.LOST, b"[b]\r\n"),
        (Fault.STALL, b"[a]\r\n[b]\r\n"),
    ],
)
def test_each_fault_does_to_the_first_reply_what_it_says(fault: Fault, arrives: bytes, clock: VirtualClock) -> None:
    with SerialWire(Echo(), clock=clock, faults=FaultScript(fault, late_s=0.1, stall_s=0.2)) as wire:
        port = SerialPort("echo", wire.endpoint)
        port.write(b"a\n")
        clock.sleep(0.05)
        port.write(b"b\n")
        assert port.drain(0.4, 2.0) == arrives
