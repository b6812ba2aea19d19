"""One open USB device file of a client under umockdev: usbfs calls, its queue of transfers, its memory.

The client's ioctl calls come over a socket as three 64-bit words (command, argument, argument); memory of the client is
read and written through the same socket. Structures and numbers: linux/usbdevice_fs.h (64 bit).
"""

import contextlib
import errno
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from sim_backend.wire.usb_model import AttachedDevice, Setup, UsbFailure

_REQUEST, _DONE, _READ_MEMORY, _WRITE_MEMORY = 1, 3, 5, 6
_MESSAGE = struct.Struct("=QQQ")
_URB = struct.Struct("=BBxxiIxxxxQiiiiiIQ")
"""type, endpoint, status, flags, buffer, buffer_length, actual_length, start_frame, packets, errors, signr, context."""
_URB_CONTROL = 2
_URB_STATUS_AT, _URB_ACTUAL_AT = 4, 28


class _Call(IntEnum):
    """Numbers of usbfs calls."""

    RESETEP = 0x80045503
    SETINTERFACE = 0x80085504
    SETCONFIGURATION = 0x80045505
    SUBMITURB = 0x8038550A
    DISCARDURB = 0x550B
    REAPURB = 0x4008550C
    REAPURBNDELAY = 0x4008550D
    CLAIMINTERFACE = 0x8004550F
    RELEASEINTERFACE = 0x80045510
    CLEAR_HALT = 0x80045515
    GET_CAPABILITIES = 0x8004551A
    GET_SPEED = 0x551F


_CAN = 0x01 | 0x04 | 0x10
"""Capabilities: zero packets, no limit of 16 KiB a transfer, reaping after a disconnect."""

_USBFS_LIMIT_BYTES = 16 << 20
"""`usbfs_memory_mb` as Linux ships it: what all queued transfers may hold..."""
_URB_BYTES = 512
"""...and about what the kernel keeps of each besides (drivers/usb/core/devio.c): 16 of 1 MiB do not fit."""


@dataclass(eq=False)
class _Urb:
    """A queued transfer. address, buffer: in the client's memory."""

    address: int
    buffer: int
    endpoint: int
    length: int
    setup: Setup | None
    out_data: bytes
    arrived: bytes | memoryview = b""
    sent: int = 0
    status: int = 0

    @property
    def actual(self) -> int:
        return self.sent or len(self.arrived)


class UsbFile:
    """The file. ready: called when what can be reaped changed; configured: with the new one; closed: last."""

    def __init__(
        self,
        connection: socket.socket,
        device: AttachedDevice,
        ready: Callable[[], None],
        configured: Callable[[int], None],
        closed: "Callable[[UsbFile], None]",
    ) -> None:
        self._connection = connection
        self._device = device
        self._ready, self._configured, self._closed = ready, configured, closed
        self._lock = threading.Lock()
        self._queued: list[_Urb] = []
        self.over: deque[_Urb] = deque()
        self.thread = threading.Thread(target=self._serve, daemon=True)

    def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self.thread.join()

    def advance(self) -> bool:
        """Let the device work on what is queued, endpoint by endpoint in order; True where something is over."""
        with self._lock:
            busy: set[int] = set()
            over = []
            for urb in self._queued:
                if urb.endpoint in busy:
                    continue
                if not self._work(urb):
                    busy.add(urb.endpoint)
                else:
                    over.append(urb)
            self._queued = [urb for urb in self._queued if urb not in over]
            self.over.extend(over)
            return bool(over)

    def _work(self, urb: _Urb) -> bool:
        """Whether the transfer is over."""
        try:
            if urb.setup is not None:
                reply = self._device.control(urb.setup, urb.out_data)
                if reply is None:
                    return False
                urb.arrived, urb.sent = reply, len(urb.out_data)
                return True
            if not urb.endpoint & 0x80:
                urb.sent += self._device.out(urb.endpoint, urb.out_data[urb.sent :], self)
                return urb.sent == urb.length
            return self._receive(urb)
        except UsbFailure as failure:
            urb.status = -(errno.ESHUTDOWN if failure.number == errno.ENODEV else failure.number)
            return True

    def _receive(self, urb: _Urb) -> bool:
        while True:
            data = self._device.inp(urb.endpoint, urb.length - len(urb.arrived), self)
            if data is None:
                return False
            urb.arrived = bytes(urb.arrived) + bytes(data) if urb.arrived else data
            if len(urb.arrived) == urb.length or self._device.ends_transfer(urb.endpoint, len(data)):
                return True

    def _serve(self) -> None:
        try:
            self._device.open()
            while True:
                command, request, argument = _MESSAGE.unpack(self._receive_bytes(_MESSAGE.size))
                assert command == _REQUEST, f"umockdev sent command {command}"
                try:
                    result = self._call(request & 0xFFFFFFFF, argument)
                    self._connection.sendall(_MESSAGE.pack(_DONE, result, 0))
                except UsbFailure as failure:
                    self._connection.sendall(_MESSAGE.pack(_DONE, (1 << 64) - 1, failure.number))
        except (OSError, EOFError, UsbFailure):
            pass  # the client closed the file or died
        finally:
            self._connection.close()
            self._closed(self)

    def _call(self, request: int, argument: int) -> int:
        match request:
            case _Call.SUBMITURB:
                self._submit(argument)
            case _Call.REAPURBNDELAY | _Call.REAPURB:  # never held: that would block the client's other calls
                self._reap(argument)
            case _Call.DISCARDURB:
                self._discard(argument)
            case _Call.CLAIMINTERFACE:
                self._device.claim(self._number(argument), self)
            case _Call.RELEASEINTERFACE:
                self._device.release(self._number(argument), self)
            case _Call.SETINTERFACE:
                interface, alternate = struct.unpack("=II", self._peek(argument, 8))
                self._device.set_alternate(interface, alternate, self)
            case _Call.SETCONFIGURATION:
                value = self._number(argument)
                self._device.set_configuration(value)
                self._configured(value)
            case _Call.CLEAR_HALT | _Call.RESETEP:
                self._device.clear_halt(self._number(argument))
            case _Call.GET_CAPABILITIES:
                self._poke(argument, struct.pack("=I", _CAN))
            case _Call.GET_SPEED:
                return {"full": 2, "high": 3, "super": 5}[self._device.spec.speed]
            case _:
                raise UsbFailure(errno.ENOTTY)
        return 0

    def _submit(self, address: int) -> None:
        kind, endpoint, _, _, buffer, length, *_ = _URB.unpack(self._peek(address, _URB.size))
        if not self._device.present:
            raise UsbFailure(errno.ENODEV)
        with self._lock:
            held = sum(urb.length + _URB_BYTES for urb in (*self._queued, *self.over))
            if held + length + _URB_BYTES > _USBFS_LIMIT_BYTES:
                raise UsbFailure(errno.ENOMEM)
        setup, data = None, b""
        if kind == _URB_CONTROL:
            setup = Setup(*struct.unpack("<BBHHH", self._peek(buffer, 8)))
            buffer, length, endpoint = buffer + 8, length - 8, 0
        if (setup is not None and not setup.request_type & 0x80) or (setup is None and not endpoint & 0x80):
            data = self._peek(buffer, length)
        with self._lock:
            self._queued.append(_Urb(address, buffer, endpoint, length, setup, data))
        if self.advance():
            self._ready()

    def _reap(self, argument: int) -> None:
        with self._lock:
            urb = self.over.popleft() if self.over else None
        if urb is None:
            self._ready()
            raise UsbFailure(errno.EAGAIN if self._device.present else errno.ENODEV)
        if urb.arrived:
            self._poke(urb.buffer, urb.arrived)
        self._poke(urb.address + _URB_STATUS_AT, struct.pack("=i", urb.status))
        self._poke(urb.address + _URB_ACTUAL_AT, struct.pack("=i", urb.actual))
        self._poke(argument, struct.pack("=Q", urb.address))

    def _discard(self, address: int) -> None:
        with self._lock:
            found = [urb for urb in self._queued if urb.address == address]
            if not found:
                raise UsbFailure(errno.EINVAL)
            found[0].status = -errno.ENOENT
            self._queued.remove(found[0])
            self.over.append(found[0])
        self._ready()

    def _number(self, address: int) -> int:
        return int.from_bytes(self._peek(address, 4), "little")

    def _peek(self, address: int, length: int) -> bytes:
        if length == 0:
            return b""
        self._connection.sendall(_MESSAGE.pack(_READ_MEMORY, address, length))
        return self._receive_bytes(length)

    def _poke(self, address: int, data: bytes | memoryview) -> None:
        self._connection.sendall(_MESSAGE.pack(_WRITE_MEMORY, address, len(data)))
        self._connection.sendall(data)

    def _receive_bytes(self, length: int) -> bytes:
        data = bytearray(length)
        view, got = memoryview(data), 0
        while got < length:
            count = self._connection.recv_into(view[got:])
            if count == 0:
                raise EOFError
            got += count
        return bytes(data)
