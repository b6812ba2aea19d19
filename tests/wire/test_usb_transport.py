"""The USB transport over the emulated backend and, where umockdev is installed, over real libusb."""

import errno
from collections.abc import Callable

import pytest
import usb.core

from drivers.clock import SystemClock, VirtualClock
from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
    ProtocolError,
)
from drivers.transports.usb_device import attached, open_device, translated
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.bodies import outcomes
from tests.wire.usb.loopback import LoopbackModel
from tests.wire.usb.umockdev import UmockdevBus, missing
from tests.wire.usb_bodies import BODIES, LOOPBACK


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
        return outcomes(bus, "tests.wire.usb_bodies")


@pytest.mark.parametrize("body", BODIES, ids=lambda body: body.__name__)
def test_over_libusb(body: Callable[[object | None], None], over_libusb: dict[str, str]) -> None:
    assert over_libusb[body.__name__] == ""


def bus_of(*serials: str | None) -> EmulatedUsb:
    bus = EmulatedUsb(VirtualClock())
    for serial in serials:
        bus.plug(LoopbackModel(serial))
    return bus


def test_an_absent_device_is_one_line_with_its_numbers() -> None:
    with pytest.raises(DeviceNotFound, match=r"loopback.*1209:0001.*plug it in"):
        open_device(LOOPBACK, "usb", {0: 1}, bus_of())


def test_two_equal_devices_ask_for_the_serial() -> None:
    bus = bus_of("A", "B")
    with pytest.raises(DeviceError, match="2 are attached; set port to one of usb:serial=A, usb:serial=B"):
        open_device(LOOPBACK, "usb", {0: 1}, bus)
    with open_device(LOOPBACK, "usb:serial=B", {0: 1}, bus) as device:
        assert device.listing.serial == "B"


def test_two_equal_devices_without_serials_ask_for_the_path() -> None:
    bus = bus_of(None, None)
    with pytest.raises(DeviceError, match="set port to one of usb:path=1-1, usb:path=1-2"):
        open_device(LOOPBACK, "usb", {0: 1}, bus)
    with open_device(LOOPBACK, "usb:path=1-2", {0: 1}, bus) as device:
        assert device.listing.path == "1-2"


@pytest.mark.parametrize("address", ["usb", "usb:serial=LOOP1"])
def test_no_permission_names_the_udev_rule(address: str) -> None:
    bus = EmulatedUsb(VirtualClock())
    bus.plug(LoopbackModel()).denied = True
    with pytest.raises(DevicePermission, match=r"config/udev/70-spadrig\.rules"):
        open_device(LOOPBACK, address, {0: 1}, bus)


def test_a_busy_device_is_one_line() -> None:
    bus = bus_of("A")
    with open_device(LOOPBACK, "usb", {0: 1}, bus), pytest.raises(DeviceBusy) as refused:
        open_device(LOOPBACK, "usb", {0: 1}, bus)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("address", ["", "usb:", "usb:serial=", "usb:port=3", "/dev/ttyUSB0"])
def test_what_is_no_usb_address_is_refused_with_the_forms(address: str) -> None:
    with pytest.raises(DeviceError, match="write usb, usb:serial=ABC or usb:path=1-2"):
        open_device(LOOPBACK, address, {0: 1}, bus_of("A"))


def test_a_device_plugged_in_again_is_found_again() -> None:
    bus = EmulatedUsb(VirtualClock())
    first = bus.plug(LoopbackModel())
    open_device(LOOPBACK, "usb", {0: 1}, bus).close()
    bus.unplug(first)
    assert attached(LOOPBACK, bus) == []
    bus.plug(LoopbackModel())
    open_device(LOOPBACK, "usb", {0: 1}, bus).close()


def test_giving_a_device_back_returns_it_to_alternate_setting_0() -> None:
    bus = EmulatedUsb(VirtualClock())
    model = LoopbackModel()
    bus.plug(model)
    with open_device(LOOPBACK, "usb", {0: 1}, bus):
        assert model.alternate == 1
    assert model.alternate == 0


@pytest.mark.parametrize(
    ("number", "ours"),
    [
        (errno.ETIMEDOUT, DeviceTimeout),
        (errno.ENODEV, DeviceDisconnected),
        (errno.EIO, DeviceDisconnected),
        (errno.ESHUTDOWN, DeviceDisconnected),
        (errno.EACCES, DevicePermission),
        (errno.EBUSY, DeviceBusy),
        (errno.EPIPE, DeviceFault),
        (errno.EOVERFLOW, ProtocolError),
        (errno.ENOMEM, DeviceError),
        (errno.ENOENT, DeviceError),
        (None, DeviceError),
    ],
)
def test_every_usb_error_becomes_one_line_of_ours(number: int | None, ours: type[DeviceError]) -> None:
    with pytest.raises(ours) as raised, translated("thing", 0x81, 0.5):
        raise usb.core.USBError("text", None, number)
    assert type(raised.value) is ours
    assert str(raised.value).startswith("thing")
    assert "\n" not in str(raised.value)


def test_too_little_kernel_memory_says_how_to_raise_it() -> None:
    with pytest.raises(DeviceError, match="usbfs_memory_mb"), translated("thing"):
        raise usb.core.USBError("text", -11, errno.ENOMEM)


def test_a_missing_libusb_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: None)
    with pytest.raises(DeviceError, match=r"apt install libusb-1\.0-0"):
        attached(LOOPBACK)
