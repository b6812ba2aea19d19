"""Emulated USB devices for real libusb, in another process: a device tree and usbfs calls served through umockdev.

    with UmockdevBus(SystemClock()) as bus:
        bus.plug(HeliosModel())
        subprocess.run([sys.executable, "-m", "..."], env=bus.environment())

The client runs under `libumockdev-preload.so.0` (Debian packages umockdev and libusb-1.0-0), which sends its ioctl
calls on /dev/bus/usb/* to a socket of the device (`umockdev_calls`).

libusb waits for the device file to become writable when a transfer is over. The file is a FIFO here: full means that
there is nothing to reap. It is filled and drained by this side only. A client whose server dies is aborted by the
preloaded library: run clients as subprocesses, and close the bus after them.
"""

import contextlib
import fcntl
import os
import shutil
import socket
import tempfile
import threading
from ctypes.util import find_library
from pathlib import Path
from typing import Self

from drivers.clock import NS_PER_S, Clock
from sim_backend.wire.umockdev_calls import UsbFile
from sim_backend.wire.umockdev_tree import write_tree
from sim_backend.wire.usb_model import AttachedDevice, UsbModel

PRELOAD = "libumockdev-preload.so.0"

_FIFO_BYTES = 4096
_POLL_S = 250e-6


def missing() -> str:
    """What this machine lacks for these tests; "" where nothing."""
    libraries = {"umockdev": "umockdev-preload", "libusb-1.0-0": "usb-1.0"}
    packages = [package for package, library in libraries.items() if find_library(library) is None]
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
        """Environment of a client process."""
        return {**os.environ, "LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": str(self._root)}

    def close(self) -> None:
        """End the threads and remove the tree. End the clients first."""
        for device in self._devices:
            device.close()
        shutil.rmtree(self._root, ignore_errors=True)

    def __enter__(self) -> Self:
        """The bus itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
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
        """Say whether any handle has something to reap."""
        with self._lock:
            self.ready(any(handle.over for handle in self._handles))

    def configured(self, value: int) -> None:
        """libusb reads the present configuration from sysfs."""
        self._configuration_file.write_text(f"{value}\n")

    def close(self) -> None:
        """End the threads."""
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
            handle = UsbFile(connection, self.device, self.refresh, self.configured, self.forget)
            with self._lock:
                self._handles.append(handle)
            handle.thread.start()

    def forget(self, handle: UsbFile) -> None:
        """The client closed it."""
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
