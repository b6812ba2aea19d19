"""Pytest plugin: serial devices are emulated behind a kernel's USB serial driver instead of on pseudo terminals.

Within the guest of `tests.campaigns.kernel.serial`: -p tests.wire.kernel_serial_ports. `SerialServer.plug` then has
QEMU plug in an FTDI chip, whose far end is a virtio port of the guest, and `unplug` has it pulled out.
"""

import json
import os
import select
import time
from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports

from sim_backend.wire.serve.serial import SerialServer
from tests.wire import lasers, syncs

WIRES = ("wire0", "wire1")
"""Serial ports there can be at a time, and the virtio ports at their far ends."""
QMP = "qmp"
"""The port that takes QEMU's own commands."""
WITHIN_S = 20.0
_PORTS = Path("/sys/class/virtio-ports")


class Machine:
    """QEMU, as its guest can command it."""

    def __init__(self) -> None:
        self._commands = open_port(QMP)
        self._heard = b""
        self.do("qmp_capabilities")

    def do(self, command: str, **arguments: Any) -> None:
        """Have it done. OSError where QEMU refuses."""
        line = json.dumps({"execute": command, "arguments": arguments}) + "\n"
        os.write(self._commands, line.encode())
        while True:
            answer = self._next()
            if "error" in answer:
                raise OSError(f"{command}: {answer['error']}")
            if "return" in answer:
                return

    def _next(self) -> dict[str, Any]:
        while b"\n" not in self._heard:
            if not select.select([self._commands], [], [], WITHIN_S)[0]:
                raise TimeoutError("QEMU does not answer")
            self._heard += os.read(self._commands, 4096)
        line, _, self._heard = self._heard.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer


def open_port(name: str) -> int:
    """The virtio port of that name, not waited on."""
    (number,) = [port.name for port in _PORTS.iterdir() if (port / "name").read_text().strip() == name]
    return os.open(f"/dev/{number}", os.O_RDWR | os.O_NONBLOCK)


def tty_of(serial_number: str, there: bool) -> str:
    """The path of the USB serial port with that number once it is there, or (not `there`) is no more."""
    ends_at = time.monotonic() + WITHIN_S
    while True:
        found = [port.device for port in list_ports.comports() if port.serial_number == serial_number]
        if bool(found) is there:
            return found[0] if found else ""
        if time.monotonic() > ends_at:
            raise TimeoutError(f"{serial_number}: the kernel does not {'set it up' if there else 'let go of it'}")
        time.sleep(0.01)


def pytest_configure(config: pytest.Config) -> None:
    """Put the cables in the place of the pseudo terminals."""
    machine = Machine()
    free = list(WIRES)
    used: dict[SerialServer, str] = {}

    def plug(server: SerialServer) -> None:
        with server.lock:
            if server._master is not None:
                return
            wire = used[server] = free.pop(0)
            server._master = open_port(wire)
            server._slave = os.dup(server._master)
            while select.select([server._master], [], [], 0.02)[0] and os.read(server._master, 4096):
                pass  # what was on its way to the device before
            machine.do("device_add", driver="usb-serial", id=wire, bus="xhci.0", chardev=wire, serial=wire)
            os.symlink(tty_of(wire, True), server.path)

    def unplug(server: SerialServer) -> None:
        with server.lock:
            if server._master is None or server._slave is None:
                return
            os.unlink(server.path)
            server._outbox.clear()
            os.write(server._wake_out, b"w")
            wire = used.pop(server)
            machine.do("device_del", id=wire)
            tty_of(wire, False)
            with server._waiting:
                os.close(server._slave)
                os.close(server._master)
                server._master = server._slave = None
            free.append(wire)

    def rest(server: SerialServer) -> None:
        """A chip takes what comes for a device that hangs, and loses it; else QEMU itself would stand still."""
        with server.lock:
            if server._master is not None and select.select([server._master], [], [], 0)[0]:
                os.read(server._master, 65_536)
        server._ending.wait(0.001)

    lasers.SerialWire = syncs.SerialWire = SerialServer  # type: ignore[attr-defined, misc, assignment]
    SerialServer._rest = rest  # type: ignore[method-assign]
    SerialServer.plug = plug  # type: ignore[method-assign]
    SerialServer.unplug = unplug  # type: ignore[method-assign]
