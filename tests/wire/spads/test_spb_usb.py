"""The SPB1 driver over USB against an emulated device: control plane, watchdog, both chips."""

import struct
import zlib
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock, now_s
from drivers.errors import (
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
)
from drivers.frames import BlockFlag, Mark
from drivers.interfaces import WindowTable
from drivers.spads.spb_usb import SpbUsb
from drivers.spb1.control import Ack, AckStatus, Command, Feature, Op, Register, SensorState, pattern_row, read_acks
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.wire.spad_runs import begin, finish
from tests.wire.spb_device import (
    HEIGHT,
    LINE_FRAMES,
    REQUEST,
    SWEEP_FRAMES,
    WIDTH,
    NumberedSource,
    model,
    nth,
    on_bus,
    opened,
    require_right,
    take,
)

STRIDE = 7168
"""Of 16 frames of 128x24: 96 + 256 + pad to 384, 16 x 384 pixels, 32, rounded up to 1024."""


# The control plane


def test_golden_bytes_of_commands_and_acknowledgements() -> None:
    # {`SPC1`, u16 op, u16 req_id, u32 addr, u32 value}, little-endian
    assert (
        Command(Op.WRITE, 0x0102, 0x0110, 1000).packed().hex(" ") == "53 50 43 31 02 00 02 01 10 01 00 00 e8 03 00 00"
    )
    assert Command(Op.PING, 7, 0, 0xFFFF_FFFF).packed().hex(" ") == "53 50 43 31 06 00 07 00 00 00 00 00 ff ff ff ff"
    acks = bytes.fromhex("53 50 41 31 01 00 07 00 00 00 00 00 53 50 42 31")
    assert read_acks(acks) == [Ack(Op.READ, 7, 0, 0x31425053)]
    with pytest.raises(ProtocolError, match="instead of an acknowledgement"):
        read_acks(b"SPC1" + acks[4:])
    # the test pattern: row index in the first 2 bytes, one walking pixel
    assert pattern_row(0x0102, 0, 64) == bytes.fromhex("02 01 80 00 00 00 00 00")
    assert pattern_row(3, 9, 64) == bytes.fromhex("03 00 00 40 00 00 00 00")


def test_golden_bytes_of_the_ft601_session_which_leaves_pipes_not_in_use_alone() -> None:
    # u32 index, u8 pipe, u8 command, u16 0, u32 length, u32 0, u32 0:
    # abort, clear, abort, stream; at the end abort, clear
    seen: list[bytes] = []

    class Spy(SpbUsbModel):
        def _session(self, data: bytes) -> int:
            seen.append(data)
            return super()._session(data)

    opened(Spy(NumberedSource(), SpbUsbBoard(WIDTH, HEIGHT, chip="ft601", acks="stream"))).close()
    head = [data[:6].hex(" ") for data in seen]
    assert head == [f"00 00 00 00 82 {command}" for command in ("00", "03", "00", "02", "00", "03")]
    assert all(len(data) == 20 for data in seen)


def test_what_is_written_before_a_run() -> None:
    device = model()
    with opened(device, test_pattern=False, heartbeat="500 ms") as spad:
        device.commands.clear()
        take(spad, 32)
    written = {address: value for op, address, value in device.commands if op == Op.WRITE}
    assert written == {
        **{Register.HEARTBEAT_MS: 500, Register.PERIOD_TICKS: 1000, Register.EXPOSURE_TICKS: 1000, Register.MODE: 0},
        **{Register.STRIDE: STRIDE, Register.BLOCK_FRAMES: 16, Register.WINDOW_WIDTH_PX: 0},
        **{Register.N_FRAMES: 32, Register.N_FRAMES + 4: 0},
    }
    assert device.commands[-5][0] == Op.START  # EXPOSED is asked for behind it, two halves twice


def test_a_start_without_what_it_needs_is_refused() -> None:
    device = model(paced=True)
    for name, value in (
        *((Register.EXPOSURE_TICKS, 1000), (Register.PERIOD_TICKS, 1000), (Register.BLOCK_FRAMES, 4)),
        *((Register.WINDOW_WIDTH_PX, 64), (Register.WINDOW_SWEEPS, 1), (Register.WINDOW_COUNTS, 1)),
    ):
        device._obey(Op.WRITE, 0, name, value, 0.0)
        started = device._obey(Op.START, 0, 0, 0, 0.0)
        complete = name == Register.BLOCK_FRAMES
        assert started.status == (AckStatus.OK if complete else AckStatus.BAD_VALUE), name
        if complete:
            device._obey(Op.ABORT, 0, 0, 0, 0.0)


@pytest.mark.parametrize(
    ("settings", "registers", "deaf", "sort", "words"),
    [
        ({"product_name": "FX3 camera"}, {}, False, DeviceNotFound, "no USB device|none is attached"),
        ({"protocol": 0x0200}, {}, False, DeviceFault, r"speaks SPB1 2\.0, this driver 1\.x"),
        ({}, {Register.MAGIC: 0x12345678}, False, DeviceNotFound, "identity 0x12345678 is not SPB1"),
        ({}, {}, True, DeviceNotFound, "does not speak SPB1"),
    ],
)
def test_the_wrong_firmware_is_one_line(
    settings: dict[str, Any], registers: dict[int, int], deaf: bool, sort: type[DeviceError], words: str
) -> None:
    device = model(**settings)
    device._registers |= registers
    device.deaf = deaf
    with pytest.raises(sort, match=words) as refused:
        opened(device)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("address", ["/dev/ttyUSB0", "usb:serail=1", "usb:serial="])
def test_an_address_that_is_none_is_said_also_if_nothing_is_attached(address: str) -> None:
    with pytest.raises(DeviceError, match=f"port '{address}' is no USB address; write usb, usb:serial=ABC or"):
        SpbUsb.open(address)


def test_a_flipped_bit_in_an_answer_without_a_checksum_is_noticed() -> None:
    class Flipping(SpbUsbModel):
        left = 0

        def _read(self, address: int) -> tuple[AckStatus, int]:
            status, value = super()._read(address)
            if address == Register.EXPOSED and self.left:
                self.left -= 1
                value ^= self.left + 1  # another one each time
            return status, value

    device = Flipping(NumberedSource(), SpbUsbBoard(WIDTH, HEIGHT))
    with opened(device) as spad:
        device.left = 1
        take(spad, 20)
        assert spad.counters.exposed == 20
        device.left = 100
        with pytest.raises(ProtocolError, match="two answers to the same question differ"):
            take(spad, 20)


@pytest.mark.parametrize("order", ["bits", "rows"])
def test_a_wrong_order_of_bits_or_rows_is_found_when_opening(order: str) -> None:
    def turned(block: bytearray) -> tuple[bytes]:
        pixels = np.frombuffer(block, np.uint8)[192 : 192 + 3 * HEIGHT * 16].reshape(3, HEIGHT, 16)
        reverse = np.packbits(np.unpackbits(pixels, axis=2, bitorder="little"), axis=2)
        pixels[:] = reverse if order == "bits" else pixels[:, ::-1]
        payload = 192 - 96 + pixels.size
        struct.pack_into("<I", block, 96 + payload + 20, zlib.crc32(block[96 : 96 + payload]))
        struct.pack_into("<I", block, 96 + payload + 28, zlib.crc32(block[96 + payload : 96 + payload + 28]))
        return (bytes(block),)

    device = model()
    device.mangle = nth(0, turned)
    with pytest.raises(ProtocolError, match="bits or rows come in another order"):
        opened(device)


def test_a_device_found_running_is_aborted_first() -> None:
    bus = EmulatedUsb(VirtualClock())
    device = model()
    bus.plug(device)
    first = on_bus(bus)
    first.configure(REQUEST)
    first.start(None)
    first._link.close()  # the program dies
    with on_bus(bus) as again:
        assert require_right(take(again, 50)) == list(range(50))


def test_a_rate_off_the_ticks_is_refused_with_the_nearest_and_blocks_are_as_long_as_the_stride_allows() -> None:
    with opened(model(max_stride=4096)) as spad:
        with pytest.raises(LimitExceeded, match="100000000/3001 Hz is"):
            spad.configure(replace(REQUEST, frame_rate_hz=Fraction(100_000_000, 3001) + Fraction(1, 100)))
        blocks = take(spad, 40)
        assert max(block.n_frames for block in blocks) == 9
        assert require_right(blocks) == list(range(40))


# Streams


@pytest.mark.parametrize("acks", ["endpoint", "stream"])
@pytest.mark.parametrize("chip", ["fx3", "ft601"])
def test_both_chips_bring_every_frame_with_its_record(chip: str, acks: str) -> None:
    with opened(model(chip=chip, acks=acks)) as spad:
        for n_frames in (300, 7):
            blocks = take(spad, n_frames)
            assert require_right(blocks) == list(range(n_frames))
        assert spad.counters.exposed == spad.counters.delivered == 7
        marks = np.concatenate([block.records["marks"] for block in blocks])
        assert marks[0] == Mark.GATE_HIGH | Mark.SCAN
        blocks = take(spad, 100, replace(REQUEST, mode="burst"))
        assert require_right(blocks) == list(range(100))
        assert all(block.header.flags & BlockFlag.BURST for block in blocks)


def test_windows_move_with_the_line_markers_of_the_stream() -> None:
    window = WindowTable(
        64, tuple(np.array([64 * ((i + s) % 2) for i in range(SWEEP_FRAMES // LINE_FRAMES)], np.int32) for s in (0, 1))
    )
    with opened(model()) as spad:
        blocks = take(spad, 3 * SWEEP_FRAMES, replace(REQUEST, window=window))
        records = np.concatenate([block.records for block in blocks])
        expected = window.x0_of(records["marks"], records["line"], records["sweep"].astype(np.int64) - 1)
        assert np.array_equal(records["x0"], expected)
        assert len(set(records["x0"].tolist())) == 2
        with pytest.raises(LimitExceeded, match="3 sweeps"):
            spad.configure(replace(REQUEST, window=WindowTable(64, (window.x0[0],) * 3)))
    with opened(model(features=Feature.STREAM)) as spad, pytest.raises(LimitExceeded, match="moves no windows"):
        spad.configure(replace(REQUEST, window=window))


def test_heartbeats_between_slow_frames_are_no_frames_and_pings_go_on() -> None:
    device = model(paced=True)
    with opened(device, heartbeat="200 ms") as spad:
        slow = replace(REQUEST, frame_rate_hz=Fraction(50), exposure_s=0.01, block_frames=10)
        begun_s = now_s(spad._clock)
        blocks = take(spad, 30, slow)
        assert now_s(spad._clock) - begun_s >= 0.5
        assert require_right(blocks) == list(range(30))
        assert len(device.pings) >= 5
        assert device.pings == sorted(device.pings)


def test_a_host_that_falls_silent_ends_the_run_with_the_gate_low() -> None:
    device = model(paced=True)
    with opened(device, heartbeat="50 ms") as spad:
        ring, _ = begin(spad, REQUEST, None, 8)
        assert device.gate_allowed
        spad._clock.sleep(0.15)  # a hung program sends no pings
        with pytest.raises(DeviceFault, match=r"heard nothing of this program for 0\.05 s, dropped its gate"):
            finish(spad, ring)
        assert not device.gate_allowed
        assert device.state is SensorState.ARMED
        spad.stop()
        ring, _ = begin(spad, REQUEST, None)
        assert [spad.fill(ring, 1.0) for _ in range(5)] == [True] * 5
        spad.stop()  # aborts, with the gate low
        assert not device.gate_allowed
        assert spad.counters.delivered == 80
        assert not ring._claimed
        assert require_right(take(spad, 20)) == list(range(20))


def test_a_firmware_that_hangs_is_a_timeout_and_unplugging_a_disconnection() -> None:
    bus = EmulatedUsb(VirtualClock())
    device = model()
    attached = bus.plug(device)
    with on_bus(bus) as spad:
        ring, _ = begin(spad, REQUEST, None)
        spad.fill(ring, 1.0)
        device.deaf = True
        with pytest.raises(DeviceTimeout):  # noqa: PT012
            while spad.fill(ring, 0.1):
                pass
        device.deaf = False
        attached.unplug()
        with pytest.raises(DeviceDisconnected):
            finish(spad, ring)
        assert spad.counters.delivered > 0
        spad.stop()
    bus.plug(model())
    with on_bus(bus) as spad:
        take(spad, 10)
