"""What the USB transport does on a bus with one loopback device: one body per behaviour, run over every transport.

`python -m tests.wire.ports.usb_bodies` runs all of them against real libusb and prints a JSON object {body: "" or what
failed}; the last one pulls the cable.
"""

import array
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial

import pytest

from drivers.clock import SystemClock, now_s
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceFault, DeviceNotFound, DeviceTimeout, ProtocolError
from drivers.transports.usb_device import UsbDevice, UsbId, attached, open_device, translated
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.bodies import report
from tests.wire.emulated_lasers import PATIENCE_S, eventually
from tests.wire.usb.loopback import DEAF, ECHO_IN, GONE, OVERLONG, STALL_BULK_IN

LOOPBACK = UsbId("loopback", 0x1209, 0x0001)
VENDOR_IN, VENDOR_OUT = 0xC0, 0x40
DEADLINE_S = PATIENCE_S
SHORT_S = 0.05
"""For what does not come."""


def opened(backend: object | None) -> UsbDevice:
    return open_device(LOOPBACK, "usb", {0: 1}, backend)


def steer(device: UsbDevice, request: int, value: int = 0) -> None:
    with translated(device.label, 0, DEADLINE_S):
        device._device.ctrl_transfer(VENDOR_OUT, request, value, 0, b"", round(1e3 * DEADLINE_S))


def found_by_numbers_and_by_serial(backend: object | None) -> None:
    (listing,) = attached(LOOPBACK, backend)
    assert (listing.serial, listing.product_name, listing.address) == ("LOOP1", "Loopback", "usb:serial=LOOP1")
    for address in ("usb", "usb:serial=LOOP1", f"usb:path={listing.path}"):
        open_device(LOOPBACK, address, {0: 1}, backend).close()
    with pytest.raises(DeviceNotFound, match="usb:serial=LOOP1"):
        open_device(LOOPBACK, "usb:serial=OTHER", {0: 1}, backend)
    with pytest.raises(DeviceNotFound, match="1209:00ff"):
        open_device(UsbId("nothing", 0x1209, 0x00FF), "usb", {0: 0}, backend)


def alternate_setting_0_has_no_endpoints(backend: object | None) -> None:
    with closing(open_device(LOOPBACK, "usb", {0: 0}, backend)) as device:
        with pytest.raises(ProtocolError):
            device.write(0x06, b"x", DEADLINE_S)
        device.set_alternate(0, 1)
        device.write(0x06, b"x", DEADLINE_S)


def control_transfers_carry_data_and_a_refused_one_is_a_fault(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        assert device.control_in(VENDOR_IN, ECHO_IN, 0x1234, 0, 2, DEADLINE_S) == b"\x34\x12"
        with pytest.raises(DeviceFault, match="stall"):
            device.control_in(VENDOR_IN, 0x7E, 0, 0, 2, DEADLINE_S)
        assert device.control_in(VENDOR_IN, ECHO_IN, 7, 0, 2, DEADLINE_S) == b"\x07\x00"


def interrupt_endpoints_carry_both_ways(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        for text in (b"\x03\x00", bytes(range(32))):
            device.write(0x06, text, DEADLINE_S)
            assert device.read(0x83, 32, DEADLINE_S) == text


def a_read_without_an_answer_ends_at_its_deadline(backend: object | None) -> None:
    clock = backend._clock if isinstance(backend, EmulatedUsb) else SystemClock()
    with closing(opened(backend)) as device:
        began_s = now_s(clock)
        with pytest.raises(DeviceTimeout, match="0x83"):
            device.read(0x83, 32, SHORT_S)
        assert SHORT_S * 0.9 <= now_s(clock) - began_s < PATIENCE_S


def bulk_endpoints_carry_long_transfers(backend: object | None) -> None:
    text = bytes(range(256)) * 100
    with closing(opened(backend)) as device:
        device.write(0x02, text + b"end", DEADLINE_S)
        assert device.read(0x81, 64 * 1024, DEADLINE_S) == text + b"end"
        device.write(0x02, text, DEADLINE_S)
        buffer = array.array("B", bytes(len(text)))
        assert device.read_into(0x81, buffer, DEADLINE_S) == len(text)
        assert buffer.tobytes() == text


def a_timeout_that_brought_data_gives_the_data(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        device.write(0x02, bytes(128), DEADLINE_S)  # whole packets: nothing says that the transfer is over
        came: list[bytes] = []

        def come() -> bool:
            with suppress(DeviceTimeout):
                came.append(device.read(0x81, 1024, SHORT_S))
            return bool(came)

        eventually(come)
        assert came == [bytes(128)]


def an_out_endpoint_that_takes_nothing_ends_at_its_deadline(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        steer(device, DEAF, 1)
        with pytest.raises(DeviceTimeout, match="0x02"):
            device.write(0x02, bytes(64), SHORT_S)
        steer(device, DEAF, 0)
        device.write(0x02, b"abc", DEADLINE_S)
        assert device.read(0x81, 64, DEADLINE_S) == b"abc"


def a_stalled_endpoint_is_a_fault_until_it_is_cleared(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        steer(device, STALL_BULK_IN)
        for _ in range(2):
            with pytest.raises(DeviceFault, match="0x81"):
                device.read(0x81, 64, DEADLINE_S)
        device._device.clear_halt(0x81)
        device.write(0x02, b"abc", DEADLINE_S)
        assert device.read(0x81, 64, DEADLINE_S) == b"abc"


def an_overlong_packet_is_refused(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        steer(device, OVERLONG)
        with pytest.raises(ProtocolError, match="more bytes"):
            device.read(0x83, 8, DEADLINE_S)


def draining_ends_with_silence(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        for _ in range(3):
            device.write(0x06, b"old", DEADLINE_S)
        dropped = [0]
        eventually(lambda: dropped.append(device.drain(0x83, 32, SHORT_S)) or sum(dropped) == 3)


def a_claimed_device_is_busy(backend: object | None) -> None:
    with closing(opened(backend)), pytest.raises(DeviceBusy, match="another program"):
        opened(backend)
    opened(backend).close()


def unplugging_is_a_disconnection(backend: object | None) -> None:
    with closing(opened(backend)) as device:
        with suppress(DeviceDisconnected):  # the request may or may not be answered on the way down
            steer(device, GONE)
        with pytest.raises(DeviceDisconnected):
            device.read(0x83, 32, DEADLINE_S)
        with pytest.raises(DeviceDisconnected):
            device.write(0x06, b"x", DEADLINE_S)


BODIES: tuple[Callable[[object | None], None], ...] = (
    found_by_numbers_and_by_serial,
    alternate_setting_0_has_no_endpoints,
    control_transfers_carry_data_and_a_refused_one_is_a_fault,
    interrupt_endpoints_carry_both_ways,
    a_read_without_an_answer_ends_at_its_deadline,
    bulk_endpoints_carry_long_transfers,
    a_timeout_that_brought_data_gives_the_data,
    an_out_endpoint_that_takes_nothing_ends_at_its_deadline,
    a_stalled_endpoint_is_a_fault_until_it_is_cleared,
    an_overlong_packet_is_refused,
    draining_ends_with_silence,
    a_claimed_device_is_busy,
    unplugging_is_a_disconnection,
)


if __name__ == "__main__":
    report({body.__name__: partial(body, None) for body in BODIES})
