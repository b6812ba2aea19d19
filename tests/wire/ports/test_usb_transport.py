"""The USB transport over the emulated backend and, where umockdev is installed, over real libusb."""

import errno
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing

import pytest
import usb.core

from drivers.clock import SystemClock, VirtualClock
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.usb_device import attached, open_device, translated
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.bodies import outcomes
from tests.wire.ports.usb_bodies import BODIES, LOOPBACK
from tests.wire.usb import umockdev
from tests.wire.usb.loopback import LoopbackModel
from tests.wire.usb.umockdev import UmockdevBus, missing


def test_the_package_s_libusb_is_enough_where_the_system_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(umockdev, "find_library", lambda name: None if "usb-1.0" in name else f"lib{name}.so.0")
    assert missing() == ""
    monkeypatch.setattr(umockdev, "find_library", lambda name: None)
    assert missing() == "not installed: umockdev (apt install umockdev)"


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.__name__)
def test_over_the_emulated_backend(body: Callable[[object | None], None]) -> None:
    bus = EmulatedUsb(VirtualClock())
    bus.plug(LoopbackModel())
    body(bus)


@pytest.fixture(scope="module")
def over_libusb() -> dict[str, str]:
    """What became of each body in a process of its own, with real libusb."""
    if missing():
        pytest.skip(missing())
    with UmockdevBus(SystemClock()) as bus:
        bus.plug(LoopbackModel())
        return outcomes(bus, "tests.wire.ports.usb_bodies")


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.__name__)
def test_over_libusb(body: Callable[[object | None], None], over_libusb: dict[str, str]) -> None:
    assert over_libusb[body.__name__] == ""


def bus_of(*serials: str | None) -> EmulatedUsb:
    bus = EmulatedUsb(VirtualClock())
    for serial in serials:
        bus.plug(LoopbackModel(serial))
    return bus


@pytest.mark.parametrize(
    ("serials", "choices", "address"),
    [
        (("A", "B"), "usb:serial=A, usb:serial=B", "usb:serial=B"),
        ((None, None), "usb:path=1-1, usb:path=1-2", "usb:path=1-2"),
    ],
)
def test_two_equal_devices_ask_for_serial_or_path(serials: tuple[str | None, ...], choices: str, address: str) -> None:
    bus = bus_of(*serials)
    with pytest.raises(DeviceError, match=f"2 are attached; set port to one of {choices}"):
        open_device(LOOPBACK, "usb", {0: 1}, bus)
    with closing(open_device(LOOPBACK, address, {0: 1}, bus)) as device:
        assert device.listing.address == address


@pytest.mark.parametrize("address", ["usb", "usb:serial=LOOP1"])
def test_no_permission_names_the_udev_rule(address: str) -> None:
    bus = EmulatedUsb(VirtualClock())
    bus.plug(LoopbackModel()).denied = True
    with pytest.raises(DevicePermission, match=r"config/udev/70-spadrig\.rules"):
        open_device(LOOPBACK, address, {0: 1}, bus)


@pytest.mark.parametrize("address", ["", "usb:", "usb:serial=", "usb:port=3", "/dev/ttyUSB0"])
def test_what_is_no_usb_address_is_refused_with_the_forms(address: str) -> None:
    with pytest.raises(DeviceError, match="write usb, usb:serial=ABC or usb:path=1-2"):
        open_device(LOOPBACK, address, {0: 1}, bus_of("A"))


def test_a_device_plugged_in_again_is_found_again_and_left_in_alternate_setting_0() -> None:
    bus = EmulatedUsb(VirtualClock())
    first, model = bus.plug(LoopbackModel()), LoopbackModel()
    open_device(LOOPBACK, "usb", {0: 1}, bus).close()
    first.unplug()
    assert attached(LOOPBACK, bus) == []
    bus.plug(model)
    with closing(open_device(LOOPBACK, "usb", {0: 1}, bus)):
        assert model.alternate == 1
    assert model.alternate == 0


@pytest.mark.parametrize(
    ("number", "ours", "said"),
    [
        (errno.ETIMEDOUT, DeviceTimeout, "0x81 within 0.5 s"),
        (errno.ENODEV, DeviceDisconnected, "check cable and power"),
        (errno.EIO, DeviceDisconnected, "check cable and power"),
        (errno.ESHUTDOWN, DeviceDisconnected, "check cable and power"),
        (errno.EACCES, DevicePermission, "udev"),
        (errno.EBUSY, DeviceBusy, "another program"),
        (errno.EPIPE, DeviceFault, "stall"),
        (errno.EOVERFLOW, ProtocolError, "more bytes"),
        (errno.ENOMEM, DeviceError, "usbfs_memory_mb"),
        (errno.ENOENT, DeviceError, "text"),
        (None, DeviceError, "text"),
    ],
)
def test_every_usb_error_becomes_one_line_of_ours(number: int | None, ours: type[DeviceError], said: str) -> None:
    with pytest.raises(ours, match=f"^thing.*{said}") as raised, translated("thing", 0x81, 0.5):
        raise usb.core.USBError("text", None, number)
    assert type(raised.value) is ours
    assert "\n" not in str(raised.value)


def test_a_missing_libusb_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda find_library=None: None)
    with pytest.raises(DeviceError, match=r"pip install --force-reinstall libusb-package"):
        attached(LOOPBACK)


WITHOUT_A_SYSTEM_LIBRARY = """
import ctypes, ctypes.util, usb.util
from types import SimpleNamespace
from drivers.errors import DeviceNotFound
from drivers.transports.bulk_link import QueuedLink
from drivers.transports.usb_device import UsbId, attached

load = ctypes.CDLL
def by_path_alone(name, *rest, **named):
    if name is not None and "/" not in str(name):
        raise OSError(name)
    return load(name, *rest, **named)
ctypes.CDLL, ctypes.util.find_library = by_path_alone, lambda name: None
usb.util.dispose_resources = lambda device: None

assert attached(UsbId("a thing that nobody makes", 0x1234, 0x5678)) == []
try:
    QueuedLink(SimpleNamespace(handle=None, address="1-1", path="1-1"), "thing", (0,))
except DeviceNotFound as error:
    print(error)
"""


def test_the_library_that_comes_along_serves_where_the_system_has_none() -> None:
    run = subprocess.run([sys.executable, "-c", WITHOUT_A_SYSTEM_LIBRARY], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert "gone since it was found" in run.stdout
