"""Emulated USB devices for real libusb, in another process: a device tree and usbfs calls served through umockdev.

    with UmockdevBus(SystemClock()) as bus:
        bus.plug(HeliosModel())
        subprocess.run([sys.executable, "-m", "..."], env=bus.environment())

The client runs under `libumockdev-preload.so.0` (Debian package umockdev), which sends its ioctl
calls on /dev/bus/usb/* to a socket of the device, as three 64-bit words (command, argument, argument); memory of the
client is read and written through the same socket. Structures and numbers: linux/usbdevice_fs.h (64 bit).

libusb waits for the device file to become writable when a transfer is over. The file is a FIFO here: full means that
there is nothing to reap. It is filled and drained by this side only. A client whose server dies is aborted by the
preloaded library: run clients as subprocesses, and close the bus after them.
"""

import contextlib
import errno
import fcntl
import os
import shutil
import socket
import struct
import tempfile
import threading
from collections import deque
from ctypes.util import find_library
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Self

import libusb_package

from drivers.clock import NS_PER_S, Clock
from sim_backend.wire.serve.usb_model import AttachedDevice, Setup, UsbFailure, UsbModel

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
    RESET = 0x5514
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
    """The device file as one client has it open."""

    def __init__(self, connection: socket.socket, served: "_ServedDevice") -> None:
        self._connection = connection
        self._served, self._device = served, served.device
        self._lock = threading.Lock()
        self._queued: list[_Urb] = []
        self.over: deque[_Urb] = deque()
        self.thread = threading.Thread(target=self._serve, daemon=True)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self.thread.join()

    def advance(self) -> bool:
        """Let the device work on what is queued, endpoint by endpoint in order; True where something is over."""
        with self._lock:
            busy: set[int] = set()
            over = []
            for urb in self._queued:
                if urb.endpoint not in busy and self._work(urb):
                    over.append(urb)
                else:
                    busy.add(urb.endpoint)
            self._queued = [urb for urb in self._queued if urb not in over]
            self.over.extend(over)
            return bool(over)

    def _work(self, urb: _Urb) -> bool:
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
            self._served.forget(self)

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
                self._served.configured(value)
            case _Call.CLEAR_HALT:
                self._device.clear_halt(self._number(argument))
            case _Call.RESETEP:
                pass  # resets the host's side only: the device is not told
            case _Call.RESET:
                self._device.reset()
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
            self._served.refresh()

    def _reap(self, argument: int) -> None:
        with self._lock:
            urb = self.over.popleft() if self.over else None
        if urb is None:
            self._served.refresh()
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
        self._served.refresh()

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


_USB_MAJOR = 189


def write_tree(device: AttachedDevice, root: Path) -> Path:
    """What libusb and libudev read of a device; returns the file with the present configuration."""
    name = f"{device.bus}-{device.port}"
    folder = root / f"sys/devices/usb{device.bus}/{name}"
    folder.mkdir(parents=True)
    node = f"bus/usb/{device.bus:03}/{device.address:03}"
    minor = device.address - 1 + 128 * (device.bus - 1)
    spec = device.spec
    texts = {
        "uevent": (
            f"MAJOR={_USB_MAJOR}\nMINOR={minor}\nDEVNAME={node}\nDEVTYPE=usb_device\nDRIVER=usb\n"
            f"PRODUCT={spec.vendor:x}/{spec.product:x}/{spec.release:x}\nTYPE=0/0/0\n"
            f"BUSNUM={device.bus:03}\nDEVNUM={device.address:03}\n"
        ),
        "busnum": f"{device.bus}\n",
        "devnum": f"{device.address}\n",
        "speed": f"{ {'full': 12, 'high': 480, 'super': 5000}[spec.speed] }\n",
        "bConfigurationValue": f"{device.configuration}\n",
    }
    for file, text in texts.items():
        (folder / file).write_text(text)
    (folder / "descriptors").write_bytes(spec.device_descriptor() + spec.configuration_descriptor())
    (folder / "subsystem").symlink_to("../../../bus/usb")
    (root / "sys/bus/usb/devices" / name).symlink_to(f"../../../devices/usb{device.bus}/{name}")
    (root / "dev/.node" / node.replace("/", "_")).symlink_to(f"{_USB_MAJOR}:{minor}")
    return folder / "bConfigurationValue"


PRELOAD = "libumockdev-preload.so.0"

_FIFO_BYTES = 4096
_POLL_S = 250e-6


def missing() -> str:
    """What this machine lacks for these tests; "" where nothing."""
    found = {
        "umockdev": find_library("umockdev-preload"),
        "libusb-1.0-0": libusb_package.find_library("usb-1.0"),  # the one that the drivers use: usually the package's
    }
    packages = [package for package, library in found.items() if library is None]
    return f"not installed: {', '.join(packages)} (apt install {' '.join(packages)})" if packages else ""


class UmockdevBus:
    """A USB bus in a folder of its own. One thread per open device of the client, one that completes transfers."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        # Socket addresses are at most 107 characters long, so the folder stays close to the root.
        self._root = Path(tempfile.mkdtemp(prefix="usb-"))
        self._devices: list[_ServedDevice] = []
        (self._root / "sys/bus/usb/devices").mkdir(parents=True)
        (self._root / "dev/.node").mkdir(parents=True)

    def plug(self, model: UsbModel) -> AttachedDevice:
        """Attach a model. Clients that already run do not notice: without udevd nothing tells libusb."""
        port = len(self._devices) + 1
        attached = AttachedDevice(model, 1, port, lambda: self._clock.now_ns() / NS_PER_S)
        self._devices.append(_ServedDevice(attached, self._root, self._clock))
        return attached

    def environment(self) -> dict[str, str]:
        return {**os.environ, "LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": str(self._root)}

    def close(self) -> None:
        """End the threads and remove the tree. End the clients first."""
        for device in self._devices:
            device.close()
        shutil.rmtree(self._root, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _ServedDevice:
    """The files of one device and the threads behind them."""

    def __init__(self, device: AttachedDevice, root: Path, clock: Clock) -> None:
        self.device = device
        self._clock = clock
        self._closing = threading.Event()
        self._handles: list[UsbFile] = []
        self._configuration_file = write_tree(device, root)
        node = root / f"dev/bus/usb/{device.bus:03}/{device.address:03}"
        node.parent.mkdir(parents=True, exist_ok=True)
        os.mkfifo(node)
        self._fifo = os.open(node, os.O_RDWR | os.O_NONBLOCK)
        fcntl.fcntl(self._fifo, fcntl.F_SETPIPE_SZ, _FIFO_BYTES)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path = root / f"ioctl/dev/bus/usb/{device.bus:03}/{device.address:03}"
        path.parent.mkdir(parents=True, exist_ok=True)
        self._listener.bind(str(path))
        self._listener.listen()
        self._lock = threading.Lock()
        self.ready(False)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._accept, self._pump)]
        for thread in self._threads:
            thread.start()

    def ready(self, something: bool) -> None:
        """Make the device file writable: there is something to reap. Or not."""
        with contextlib.suppress(BlockingIOError):
            while True:
                if something:
                    os.read(self._fifo, _FIFO_BYTES)
                else:
                    os.write(self._fifo, bytes(_FIFO_BYTES))

    def refresh(self) -> None:
        with self._lock:
            self.ready(any(handle.over for handle in self._handles))

    def configured(self, value: int) -> None:
        """libusb reads the present configuration from sysfs."""
        self._configuration_file.write_text(f"{value}\n")

    def close(self) -> None:
        self._closing.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join()
        for handle in list(self._handles):
            handle.close()
        os.close(self._fifo)

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            handle = UsbFile(connection, self)
            with self._lock:
                self._handles.append(handle)
            handle.thread.start()

    def forget(self, handle: UsbFile) -> None:
        with self._lock:
            self._handles.remove(handle)
        self.device.close(handle)

    def _pump(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                handles = list(self._handles)
            if any([handle.advance() for handle in handles]):
                self.refresh()
            self._clock.sleep(_POLL_S)
