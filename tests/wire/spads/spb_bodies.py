"""What the SPB1 driver does on a bus with one device, through real libusb: run in a process of its own under umockdev.

`python -m tests.wire.spads.spb_bodies CHIP` prints a JSON object {behaviour: "" or what failed}.
"""

import contextlib
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest

from drivers.clock import SystemClock
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceTimeout
from drivers.spads.spb_usb import SpbUsb, SpbUsbConfig, open_link
from drivers.transports.bulk_link import QueuedLink
from drivers.transports.endpoints import Endpoint
from tests.wire.bodies import report
from tests.wire.emulated_lasers import PATIENCE_S
from tests.wire.spad_runs import begin, finish
from tests.wire.spb_device import REQUEST, require_right, take

CHIP = sys.argv[1] if len(sys.argv) > 1 else "fx3"


PULL_HEARTBEAT = "12345 ms"
"""A run with this heartbeat makes the other side pull the cable."""


def opened(reads: str, heartbeat: str = "60 s") -> SpbUsb:
    config = SpbUsbConfig.model_validate({"chip": CHIP, "reads": reads, "heartbeat": heartbeat})
    return SpbUsb(config, open_link(config, Endpoint("usb")), SystemClock())


def queued_reads_bring_every_frame_where_libusb_wrote_it_and_plain_ones_too() -> None:
    with opened("plain") as device:
        assert require_right(take(device, 1000)) == list(range(1000))
    with opened("queued") as device:
        assert isinstance(device._link, QueuedLink)
        for _ in range(3):
            ring, reader = begin(device, REQUEST, 1000, 400)
            finish(device, ring)
            blocks = list(reader)
            assert require_right(blocks) == list(range(1000))
            assert all(np.shares_memory(block.bits, ring._memory) for block in blocks)


def stopping_with_reads_in_flight_leaves_the_device_ready() -> None:
    with opened("queued") as device:
        for _ in range(3):
            ring, reader = begin(device, REQUEST, None, 40)
            for _ in range(5):
                device.fill(ring, PATIENCE_S)
            device.stop()
            reader.close()
            assert len(ring._free) == ring.slots
        assert require_right(take(device, 100)) == list(range(100))


def bytes_that_came_before_a_time_out_are_kept() -> None:
    with opened("queued") as device:
        device.configure(REQUEST)
        device.start(REQUEST.block_frames)
        # Whole packets: nothing tells libusb that the transfer is over. Its own reads would drop them (issue 42).
        came, ends_at = b"", time.monotonic() + PATIENCE_S
        while len(came) < device._timing.stride and time.monotonic() < ends_at:
            with contextlib.suppress(DeviceTimeout):
                came += device._link.read(device._wiring.stream_in, 64 << 10, 0.2)
        assert came[:4] == b"SPB1"
        assert len(came) == device._timing.stride
        device.stop()


def the_kernels_16_mb_grant_fewer_reads() -> None:
    with opened("queued") as device:
        buffers = [np.zeros(1 << 20, np.uint8) for _ in range(20)]
        granted = [device._link.submit(device._wiring.stream_in, buffer) for buffer in buffers]
        assert granted == [True] * 15 + [False] * 5
        device._link.cancel()
        assert require_right(take(device, 100)) == list(range(100))


def a_second_program_finds_it_busy() -> None:
    with opened("queued"), pytest.raises(DeviceBusy):
        opened("queued")


def pulling_the_cable_is_a_disconnection() -> None:
    with opened("queued", heartbeat=PULL_HEARTBEAT) as device:
        ring, _ = begin(device, REQUEST, None, 40)
        with pytest.raises(DeviceDisconnected, match="the device is gone"):
            finish(device, ring)
        device.stop()
        assert not ring._claimed


BODIES: tuple[Callable[[], None], ...] = (
    queued_reads_bring_every_frame_where_libusb_wrote_it_and_plain_ones_too,
    stopping_with_reads_in_flight_leaves_the_device_ready,
    bytes_that_came_before_a_time_out_are_kept,
    the_kernels_16_mb_grant_fewer_reads,
    a_second_program_finds_it_busy,
    pulling_the_cable_is_a_disconnection,
)


if __name__ == "__main__":
    report({body.__name__: body for body in BODIES})
