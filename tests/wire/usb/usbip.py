"""Emulated USB devices for a real kernel: plugged into Linux' virtual host controller, served over USB/IP.

    with UsbIpBus(SystemClock()) as bus:        # as root, on a kernel with vhci-hcd
        bus.plug(HeliosModel())

The kernel is given one end of a socket and speaks USB/IP 1.1.1 on it (Documentation/usb/usbip_protocol.rst of Linux):
headers of 48 bytes, big-endian. It enumerates the device, keeps claims and settings and gives back what a process held
that died; the emulation answers transfers, in order on each endpoint. A transfer that is taken back returns what had
come until then, as a real host controller's does.
"""

import errno
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from drivers.clock import NS_PER_S, Clock
from sim_backend.wire.serve.usb_model import AttachedDevice, Setup, UsbFailure, UsbModel

CONTROLLER = Path("/sys/devices/platform/vhci_hcd.0")

_HEADER: Final = struct.Struct(">IIIII28s")
_SUBMIT: Final = struct.Struct(">IiIII8s")
_RETURN: Final = struct.Struct(">iiiii8x")
_CMD_SUBMIT, _CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_IN = 1
_SPEED = {"full": 2, "high": 3, "super": 5}
"""As the kernel numbers them (include/uapi/linux/usb/ch9.h)."""
_FIRST_SUPER_PORT = 8
"""Ports below are those of the controller's USB 2 hub."""
_SET_CONFIGURATION, _SET_INTERFACE, _CLEAR_FEATURE = (0x00, 9), (0x01, 11), (0x02, 1)
_POLL_S = 250e-6
_SET_UP_S = 10.0


def missing() -> str:
    """What this machine lacks for it; "" where nothing."""
    return "" if (CONTROLLER / "attach").exists() else "the kernel has no virtual USB host controller (vhci-hcd)"


class UsbIpBus:
    """A bus: `plug` devices, which the kernel finds at once."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._cables: list[_Cable] = []

    def plug(self, model: UsbModel) -> AttachedDevice:
        """Attach a model; the kernel has set it up when this returns. TimeoutError where it does not."""
        number = len(self._cables)
        attached = AttachedDevice(model, 1, number + 1, lambda: self._clock.now_ns() / NS_PER_S)
        self._cables.append(_Cable(attached, number, self._clock))
        return attached

    def environment(self) -> dict[str, str]:
        """Environment of a client process."""
        return dict(os.environ)

    def close(self) -> None:
        """Unplug all."""
        for cable in self._cables:
            cable.close()

    def __enter__(self) -> Self:
        """The bus itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


def _attach(line: str) -> None:
    """Give the kernel its end. A port that was just unplugged takes a moment to be free."""
    ends_at = time.monotonic() + _SET_UP_S
    while True:
        try:
            (CONTROLLER / "attach").write_text(line)
            return
        except OSError as error:
            if error.errno not in (errno.EBUSY, errno.EINVAL) or time.monotonic() > ends_at:
                raise
            time.sleep(0.05)


@dataclass(slots=True)
class _Transfer:
    """One that the kernel asked for. sent, received: what went either way so far."""

    number: int
    endpoint: int
    length: int
    setup: bytes
    data: bytes
    received: bytearray
    sent: int = 0


class _Cable:
    """One device, its end of the socket and the thread that answers there."""

    def __init__(self, device: AttachedDevice, number: int, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._waiting: dict[int, deque[_Transfer]] = {}
        self._closing = threading.Event()
        self._end, theirs = socket.socketpair()
        speed = device.spec.speed
        port = number + (_FIRST_SUPER_PORT if speed == "super" else 0)
        with theirs:
            _attach(f"{port} {theirs.fileno()} {device.address} {_SPEED[speed]}")
        self._configured = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="usbip", daemon=True)
        self._thread.start()
        if not self._configured.wait(_SET_UP_S):
            self.close()
            raise TimeoutError(f"the kernel did not set up {device.spec.product_name} within {_SET_UP_S:g} s")

    def close(self) -> None:
        """Pull the cable; again: nothing happens."""
        self._closing.set()
        self._thread.join()

    def _serve(self) -> None:
        """Until the kernel or the device hangs up."""
        with self._end, suppress(OSError, EOFError):
            while not self._closing.is_set() and self._device.present:
                busy = any(self._waiting.values())
                if select.select([self._end], [], [], _POLL_S if busy else 0.02)[0]:
                    self._take()
                for queue in self._waiting.values():
                    while queue and self._advance(queue[0]):
                        queue.popleft()
            self._end.shutdown(socket.SHUT_RDWR)

    # Messages

    def _take(self) -> None:
        command, number, _, direction, endpoint, rest = _HEADER.unpack(self._receive(_HEADER.size))
        if command == _CMD_UNLINK:
            return self._unlink(number, struct.unpack_from(">I", rest)[0])
        _, length, _, _, _, setup = _SUBMIT.unpack(rest)
        data = self._receive(length) if direction != _IN else b""
        address = endpoint | (0x80 if direction == _IN else 0)
        self._waiting.setdefault(address, deque()).append(_Transfer(number, address, length, setup, data, bytearray()))

    def _unlink(self, number: int, which: int) -> None:
        status = 0
        for queue in self._waiting.values():
            for transfer in [one for one in queue if one.number == which]:
                queue.remove(transfer)
                if transfer.received or transfer.sent:
                    self._return(transfer, -errno.ECONNRESET)
                else:
                    status = -errno.ECONNRESET
        self._end.sendall(_HEADER.pack(_RET_UNLINK, number, 0, 0, 0, _RETURN.pack(status, 0, 0, 0, 0)))

    def _return(self, transfer: _Transfer, status: int = 0) -> None:
        incoming = bool(transfer.endpoint & 0x80)
        n = len(transfer.received) if incoming else transfer.sent
        head = _HEADER.pack(_RET_SUBMIT, transfer.number, 0, 0, 0, _RETURN.pack(status, n, 0, 0, 0))
        self._end.sendall(head + (bytes(transfer.received) if incoming else b""))

    def _receive(self, n: int) -> bytes:
        data = bytearray()
        while len(data) < n:
            piece = self._end.recv(n - len(data))
            if not piece:
                raise EOFError
            data += piece
        return bytes(data)

    # Transfers

    def _advance(self, transfer: _Transfer) -> bool:
        """Whether it is over, and answered."""
        try:
            if transfer.endpoint & 0x0F == 0:
                over = self._control(transfer)
            else:
                over = self._in(transfer) if transfer.endpoint & 0x80 else self._out(transfer)
        except UsbFailure as failure:
            if failure.number == errno.ENODEV:
                raise EOFError from None
            self._return(transfer, -failure.number)
            return True
        if over:
            self._return(transfer)
        return over

    def _in(self, transfer: _Transfer) -> bool:
        while len(transfer.received) < transfer.length:
            room = transfer.length - len(transfer.received)
            piece = self._device.inp(transfer.endpoint, room, self)
            if piece is None:
                return False
            transfer.received += piece
            if self._device.ends_transfer(transfer.endpoint, len(piece)):
                break
        return True

    def _out(self, transfer: _Transfer) -> bool:
        transfer.sent += self._device.out(transfer.endpoint, transfer.data[transfer.sent :], self)
        return transfer.sent == transfer.length

    def _control(self, transfer: _Transfer) -> bool:
        setup = Setup(*struct.unpack("<BBHHH", transfer.setup))
        request = setup.request_type, setup.request
        device = self._device
        if request == _SET_CONFIGURATION:
            device.close(self)
            device.set_configuration(setup.value)
            for interface in {one.interface for one in device.spec.alternates} if setup.value else ():
                device.claim(interface, self)  # who may use them is the kernel's business
            self._configured.set()
        elif request == _SET_INTERFACE:
            device.set_alternate(setup.index, setup.value, self)
        elif request == _CLEAR_FEATURE:
            device.clear_halt(setup.index)
        else:
            reply = device.control(setup, transfer.data)
            if reply is None:
                return False
            transfer.received += reply
        transfer.sent = len(transfer.data)
        return True
