"""The SPAD512S driver over a real socket, against an emulation of its vendor's program with its traps."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import (
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.frames import BlockFlag, FrameBlock
from drivers.interfaces import DeviceState, SpadRequest
from drivers.ring import BlockRing, OnFull
from drivers.spads.spad512s import OWN_ONES, Spad512s, Spad512sConfig
from drivers.spads.spad512s_line import Deadlines
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import CONTROL_FILE, IN, OUT, Tap, TapFile, read_taps
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.serve.tcp import TcpServer
from tests.wire.emulated_lasers import PATIENCE_S, eventually
from tests.wire.spad_runs import begin, finish, take_run

FRAME_BYTES = 32_768
PATIENT = Deadlines(open_s=PATIENCE_S, answer_s=PATIENCE_S, listens_s=PATIENCE_S)
REQUEST = SpadRequest(Fraction(50_000), 20e-6, "burst", block_frames=16)


def noise(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """Frames that can be told from each other."""
    frames = np.zeros((n, 512, 64), np.uint8)
    for index in range(n):
        frames[index] = np.random.default_rng(first + index).integers(0, 256, (512, 64), dtype=np.uint8)
    return frames


def reads_done(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """Frames whose every four bytes read DONE or ERRO, also at the end of each read of 32 768 bytes."""
    rows = np.tile(np.frombuffer(b"DONEERRO" if first % 2 else b"ERRODONE", np.uint8), 8)
    frames = np.tile(rows, (n, 512, 1))
    frames[:, 1, 0] = np.arange(first, first + n)
    return frames


@contextmanager
def connected(model: Spad512sModel, **config: Any) -> Iterator[tuple[Spad512s, TcpServer]]:
    with (
        TcpServer(model) as server,
        Spad512s(Spad512sConfig(**config), server.endpoint, deadlines=PATIENT) as device,
    ):
        yield device, server


def take(device: Spad512s, n_frames: int) -> list[FrameBlock]:
    return take_run(device, n_frames, REQUEST, 64)


@contextmanager
def scripted(*turns: tuple[bytes, bytes]) -> Iterator[tuple[str, list[bytes]]]:
    """A peer that greets, then waits for the first of each pair and answers with the second; and what it heard."""
    listener = socket.create_server(("127.0.0.1", 0))
    heard: list[bytes] = []

    def serve() -> None:
        client, _ = listener.accept()
        with client:
            client.settimeout(PATIENCE_S)
            client.sendall(b"SPAD512S ready\n")
            for expected, answer in turns:
                heard.append(client.recv(4096))
                if heard[-1] != expected:
                    return
                client.sendall(answer)
            client.recv(4096)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{listener.getsockname()[1]}", heard
    finally:
        listener.close()
        thread.join(PATIENCE_S)


INFO = b"M1\nS1\n2.0\n1.0\n1.0\n512\n1\n1\n1\n"


@contextmanager
def answering(
    n_frames: int, answer: bytes, tap: Tap | None = None, info: bytes = INFO, **config: Any
) -> Iterator[Spad512s]:
    """A device that answers one run of n frames with these very bytes."""
    script = ((b"D", info), (b"PU,0", b"ok"), (f"I,1,20,{n_frames},0,1,0,1\n".encode(), answer))
    made = Spad512sConfig.model_validate(config)
    with scripted(*script) as (address, heard), Spad512s(made, Endpoint(address), PATIENT, tap) as device:
        yield device
        assert heard == [command for command, _ in script]


def test_trap_bits_come_most_significant_first_and_frames_lie_on_their_side(tmp_path: Path) -> None:
    # One bit at the right end of the sensor's row 0: the corner that a quarter turn to the left takes to the top left.
    pixels = bytearray(2 * FRAME_BYTES)
    pixels[63] = 0x01
    pixels[FRAME_BYTES + 511 * 64] = 0x80  # frame 1: left end of the last row, which comes to the bottom right
    tap = Tap(TapFile.begin(tmp_path / CONTROL_FILE), "spad")
    with answering(2, bytes(pixels) + b"DONE", tap) as device:
        (block,) = take(device, 2)
    image = np.unpackbits(block.bits, axis=2)
    assert np.argwhere(image[0]).tolist() == [[0, 0]]
    assert np.argwhere(image[1]).tolist() == [[511, 511]]
    assert block.header.flags == BlockFlag.FIRST | BlockFlag.LAST | BlockFlag.BURST
    assert not block.records["marks"].any()
    tap.flush()  # commands and answers are tapped, pixels are not
    passed = read_taps(tmp_path / CONTROL_FILE)
    assert [one.data for one in passed if one.direction == OUT] == [b"D", b"PU,0", b"I,1,20,2,0,1,0,1\n"]
    assert INFO in [one.data for one in passed if one.direction == IN]
    assert sum(len(one.data) for one in passed) < 500


def test_frames_come_as_they_were_taken() -> None:
    with connected(Spad512sModel(noise)) as (device, _):
        blocks = take(device, 40)
        assert [block.n_frames for block in blocks] == [16, 16, 8]
        assert np.array_equal(np.concatenate([block.bits for block in blocks]), noise(0, 0, 0, 40))
        assert (device.counters.exposed, device.counters.delivered, device.counters.lost) == (40, 40, 0)


def test_trap_done_inside_pixel_data() -> None:
    with connected(Spad512sModel(reads_done, rotation=0), rotation=0) as (device, _):
        blocks = take(device, 48)
        assert sum(block.n_frames for block in blocks) == 48
        assert bytes(blocks[0].bits[0, 0, :8]) == b"ERRODONE"


def test_trap_time_in_microseconds_for_one_bit() -> None:
    model = Spad512sModel(noise)
    with connected(model) as (device, _):
        device.configure(SpadRequest(Fraction(10_000), 100e-6, "burst", 16))
        device.start(10_000)
        eventually(lambda: model._run is not None)  # commands that come together are none
        device.stop()
        assert model.commands[2:] == ["I,1,100,10000,0,1,0,1", "STOP"]


def test_trap_calibration_on_connecting_is_waited_for_in_silence_also_behind_a_restart() -> None:
    model = Spad512sModel(noise, calibration_s=0.1)
    begun = time.monotonic()
    with connected(model) as (device, server):
        assert time.monotonic() - begun >= 0.1
        assert model.commands == ["D", "D"]
        assert device.info.serial == "MASTER-0042"
        server.unplug()
        model.restarted()
        server.plug()
        with pytest.raises(DeviceDisconnected):
            _ = device.health
        model.commands.clear()
        assert len(take(device, 16)) == 1
        assert model.commands[:3] == ["D", "D", "PU,0"]


@pytest.mark.parametrize("at_byte", [0, 16 * FRAME_BYTES - 10, 16 * FRAME_BYTES, 20 * FRAME_BYTES + 7])
def test_trap_error_text_instead_of_pixels_is_told_and_never_taken_for_them(at_byte: int) -> None:
    model = Spad512sModel(noise)
    with connected(model) as (device, _):
        model.fail_at_byte = at_byte
        ring, reader = begin(device, REQUEST, 64, 8)
        with pytest.raises(DeviceFault, match=r"Auto-protect: too much light\. Acquisition ERROR"):
            finish(device, ring)
        ring.finish()
        delivered = 0
        for block in reader:
            assert np.array_equal(block.bits, noise(block.header.first_frame, 0, 0, block.n_frames))
            delivered += block.n_frames
        assert (device.counters.delivered, device.counters.lost) == (delivered, 64 - delivered)
        device.stop()
        assert len(take(device, 20)) == 2  # connected anew


@pytest.mark.parametrize(
    ("behind", "sort", "said"),
    [(b" ERROR too hot ERROR", DeviceFault, "too hot ERROR"), (bytes(6) + b"DONX", ProtocolError, "not DONE")],
)
def test_trap_error_or_anything_but_done_at_the_end_of_the_right_length(
    behind: bytes, sort: type[DeviceError], said: str
) -> None:
    with answering(1, bytes(FRAME_BYTES - 6) + behind) as device, pytest.raises(sort, match=said):
        take(device, 1)


def test_trap_frames_without_numbers_may_come_twice_in_place_of_others() -> None:
    def stuck(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
        return noise(first if first < 40 else first - 24, start_s, period_s, n)

    with connected(Spad512sModel(stuck)) as (device, _), pytest.raises(ProtocolError, match=r"40 .* same as frame 16"):
        take(device, 64)
    dark = np.zeros((8, 512, 64), np.uint8)
    for uniform in (dark, ~dark):
        with connected(Spad512sModel(lambda first, start_s, period_s, n: uniform[:n])) as (device, _):  # noqa: B023
            assert len(take(device, 48)) == 3


def stuck_pixels(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    frames = np.zeros((n, 512, 64), np.uint8)
    frames[:, 100, 5] = 0x10
    return frames


def broken_row(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """A row that always fires, and a dark count somewhere else in every fourth frame."""
    frames = np.zeros((n, 512, 64), np.uint8)
    frames[:, 7] = 0xFF
    for index in range(n):
        if (first + index) % 4 == 0:
            frames[index, 9 + (first + index) // 4, 3] = 1
    return frames


def screaming_pixels(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
    """200 pixels that nearly always fire, under a light that is on in every other frame."""
    frames = np.zeros((n, 512, 64), np.uint8)
    for index in range(n):
        draw = np.random.default_rng(first + index)
        frames[index, :200, 7] = draw.random(200) < 0.999
        if (first + index) % 2:
            frames[index, 200:] = draw.integers(0, 256, (312, 64))
    return frames


@pytest.mark.parametrize("dark", [stuck_pixels, broken_row, screaming_pixels])
def test_dark_frames_that_differ_in_nothing_are_sound(dark: Any) -> None:
    with connected(Spad512sModel(dark)) as (device, _):
        got = device.grab(100, exposure_s=1e-6)
    assert got.number.size == 100
    assert np.unique(got.bits, axis=0).shape[0] < 100, "some came twice"


@pytest.mark.parametrize("ones", [2 * OWN_ONES, 100_000])
@pytest.mark.parametrize("stuck_from", [1, 2, 21])
def test_a_camera_that_sends_one_frame_again_and_again_is_found(ones: int, stuck_from: int) -> None:
    def stuck(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
        draws = (np.random.default_rng(min(number, stuck_from - 1)) for number in range(first, first + n))
        return np.stack([np.packbits(draw.random((512, 512)) < ones / 512**2, axis=1) for draw in draws])

    found = rf"frame {stuck_from} is the very same as frame {stuck_from - 1}"
    with connected(Spad512sModel(stuck)) as (device, _), pytest.raises(ProtocolError, match=found):
        device.grab(50)


def test_frames_that_came_before_a_run_failed_are_kept(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with connected(Spad512sModel(noise)) as (device, _):
        fill, blocks = device._do_fill, [2]

        def stops(ring: BlockRing, timeout_s: float) -> bool:
            if blocks[0] == 0:
                raise DeviceTimeout("the trigger has stopped")
            blocks[0] -= 1
            return fill(ring, timeout_s)

        monkeypatch.setattr(device, "_do_fill", stops)
        got = device.grab(300)
        came = got.number.size
        assert 0 < came < 300
        assert np.array_equal(got.number, np.arange(came))
        assert np.array_equal(got.lost, np.arange(came, 300))
        assert isinstance(got.ended_by, DeviceTimeout)
        assert f"only {came} of 300 frames came" in caplog.text
        assert device.state is DeviceState.CONFIGURED
        with pytest.raises(DeviceTimeout, match="has stopped"):
            device.grab(300)  # nothing came


def test_frames_of_an_unfinished_block_are_kept_when_the_trigger_stops() -> None:
    """All but the last one, behind which an error text might begin."""
    sent = noise(0, 0.0, 0.0, 50)
    with answering(300, sent.tobytes()) as device:
        got = device.grab(300, frame_rate_hz=REQUEST.frame_rate_hz, exposure_s=REQUEST.exposure_s, timeout_s=1.0)
        assert np.array_equal(got.number, np.arange(49))
        assert isinstance(got.ended_by, DeviceTimeout)
        assert device.counters.delivered == 49
        assert device.counters.lost == 251


def test_trap_done_glued_to_answers_commands_never_pipelined_and_pile_up_before_every_run() -> None:
    class Strict(Spad512sModel):
        early = False

        def receive(self, data: bytes, now_s: float) -> None:
            self.early = self.early or bool(self._out) or self._run is not None
            super().receive(data, now_s)

    model = Strict(noise, glued_done=True, extra_fields=True)
    with connected(model) as (device, _):
        health = device.health
        assert (health.frame_clock_hz, health.excess_bias_v) == (97_656.25, 4.0)
        assert list(health.temperatures_c) == ["master FPGA", "slave FPGA", "board", "chip"]
        assert "firmware 1.4" in device.identity
        take(device, 16)
        take(device, 1)  # each run has a PU of its own
        _ = device.health
    assert not model.early
    runs = ["PU,0", "I,1,20,16,0,1,0,1", "PU,0", "I,1,20,1,0,1,0,1"]
    assert model.commands == ["D", "R", "V", *runs, "R", "V"]


def test_trap_a_second_client_and_a_unit_without_intensity_imaging_are_refused() -> None:
    with (
        connected(Spad512sModel(noise)) as (_, server),
        pytest.raises(DeviceNotFound, match="refuses the connection"),
    ):
        Spad512s(Spad512sConfig(), server.endpoint)
    with TcpServer(Spad512sModel(noise, intensity=False)) as server, pytest.raises(DeviceFault, match="not enabled"):
        Spad512s(Spad512sConfig(), server.endpoint)


def test_a_server_that_hangs_up_at_once_is_busy_and_silence_a_timeout() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = Endpoint(f"127.0.0.1:{listener.getsockname()[1]}")
        with pytest.raises(DeviceTimeout, match="nothing greets"):
            Spad512s(Spad512sConfig(), address, Deadlines(open_s=0.1))
        listener.accept()[0].close()
        threading.Thread(target=lambda: listener.accept()[0].close(), daemon=True).start()
        with pytest.raises(DeviceBusy, match="it serves one client"):
            Spad512s(Spad512sConfig(), address, PATIENT)
    words = r"calibration did not end within 0\.2 s"
    with TcpServer(Spad512sModel(noise, calibration_s=60)) as server, pytest.raises(DeviceTimeout, match=words):
        Spad512s(Spad512sConfig(), server.endpoint, replace(PATIENT, calibration_s=0.2))


def test_wrong_addresses_are_one_line_each() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        unused = f"127.0.0.1:{free.getsockname()[1]}"
    for address, said in ((unused, "start the program"), ("127.0.0.1", "host:port"), ("127.0.0.1:99999", "host:port")):
        with pytest.raises(DeviceNotFound, match=said) as refused:
            Spad512s(Spad512sConfig(), Endpoint(address), PATIENT)
        assert "\n" not in str(refused.value)


def test_the_1m_flavour_has_1024_rows_of_1024_columns() -> None:
    def frames(first: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
        return np.random.default_rng(first).integers(0, 256, (n, 1024, 128), dtype=np.uint8)

    model = Spad512sModel(frames, flavour="1M", fields=(9,))
    with connected(model, max_frame_rate="97.65625 kHz", width_in_command=True) as (device, _):
        assert (device.info.width, device.info.height) == (1024, 1024)
        (block,) = take(device, 8)
        assert np.array_equal(block.bits, frames(0, 0, 0, 8))
        assert model.commands[-1] == "I,1,20,8,0,1,0,1,1024"


def test_the_1m_flavour_needs_a_frame_rate_of_its_own_since_frames_carry_no_time() -> None:
    with (
        TcpServer(Spad512sModel(noise, flavour="1M")) as server,
        pytest.raises(DeviceFault, match=r"97\.7 kHz.*of the 512 x 512 sensor.*max_frame_rate"),
    ):
        Spad512s(Spad512sConfig(), server.endpoint)


def test_frames_of_another_size_than_expected_are_told_and_never_taken() -> None:
    half = b"".join(noise(number, 0, 0, 1).tobytes() for number in range(6)) + b"DONE"  # three frames of 1024 x 512
    info = INFO.replace(b"512", b"1M")
    with (
        answering(3, half, info=info, max_frame_rate="97.65625 kHz") as device,
        pytest.raises(ProtocolError, match="65536 bytes a frame, not 131072"),
    ):
        take(device, 3)


@pytest.mark.parametrize("wants_width", [False, True])
def test_the_width_is_sent_as_a_ninth_field_where_the_program_wants_it(wants_width: bool) -> None:
    model = Spad512sModel(noise, fields=(9,) if wants_width else (8, 9))
    with connected(model, width_in_command=True) as (device, _):
        take(device, 16)
        assert model.commands[-1] == "I,1,20,16,0,1,0,1,512"
    model = Spad512sModel(noise, fields=(9,) if wants_width else (8, 9))
    with connected(model) as (device, _):
        if wants_width:
            with pytest.raises(DeviceFault, match=r"Wrong number of arguments ERROR.*width_in_command"):
                take(device, 16)
        else:
            take(device, 16)
        assert "I,1,20,16,0,1,0,1" in model.commands


@pytest.mark.parametrize("lines", [7, 8, 9, 10])
def test_the_description_may_have_lines_more_than_those_that_are_read(lines: int) -> None:
    info = b"".join(INFO.splitlines(keepends=True)[:lines]) + b"1\n" * (lines - 9)
    with answering(1, bytes(FRAME_BYTES) + b"DONE", info=info) as device:
        assert device.info.serial == "M1"
        take(device, 1)


def test_a_banner_that_names_no_spad_is_only_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with connected(Spad512sModel(noise, banner="cS512 server 3.0\n")) as (device, _):
        assert device.info.model == "cS512 512"
        take(device, 16)
    assert "greets with 'cS512 server 3.0'" in caplog.text


def test_a_rate_that_does_not_follow_from_the_exposure_is_refused_or_triggered() -> None:
    request = SpadRequest(Fraction(20_000), 10e-6, "burst", 16)
    with connected(Spad512sModel(noise)) as (device, _):
        with pytest.raises(LimitExceeded, match=r"running free that is 976"):
            device.configure(request)
        with pytest.raises(LimitExceeded, match=r"10\.5 us; it takes whole microseconds"):
            device.configure(SpadRequest(Fraction(20_000), 10.5e-6, "burst", 16))
    model = Spad512sModel(noise)
    with connected(model, trigger="external") as (device, _):
        device.configure(request)
        device.start(1)
        eventually(lambda: "I,1,10,1,1,1,0,1" in model.commands)
        device.stop()


@pytest.mark.parametrize("heeds_stop", [True, False])
def test_trap_a_stop_may_not_be_heeded_and_the_device_is_ready_for_the_next_run(heeds_stop: bool) -> None:
    with connected(Spad512sModel(noise, heeds_stop=heeds_stop, paced=not heeds_stop)) as (device, _):
        ring, _ = begin(device, REQUEST, 10_000, 4)
        device.fill(ring, PATIENCE_S)
        with pytest.raises(WrongState, match="health is not possible while running"):
            _ = device.health
        device.stop()
        counters = device.counters
        assert (counters.delivered, counters.lost) == (16, 10_000 - 16)
        assert len(take(device, 32)) == 2


def test_a_program_that_ends_or_hangs_within_a_run_is_said_so() -> None:
    with connected(Spad512sModel(noise, paced=True)) as (device, server):
        ring, _ = begin(device, REQUEST, 10_000, 4, OnFull.DROP)  # however much came before it hung
        device.fill(ring, PATIENCE_S)
        server.hang()
        with pytest.raises(DeviceTimeout, match="sent nothing"):  # noqa: PT012
            while device.fill(ring, 0.1):
                pass
        server.resume()
        server.unplug()
        with pytest.raises(DeviceDisconnected):
            finish(device, ring)
        server.plug()
        device.stop()
        assert len(take(device, 16)) == 1


def test_a_stop_while_the_ring_is_full_and_waits_ends_the_run_without_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with connected(Spad512sModel(noise)) as (device, _):
        ring, _ = begin(device, REQUEST, 160, 1, OnFull.WAIT)
        assert device.fill(ring, PATIENCE_S)
        more: list[bool] = []
        waits, claim = threading.Event(), ring.claim
        monkeypatch.setattr(ring, "claim", lambda timeout_s: waits.set() or claim(timeout_s))
        filling = threading.Thread(target=lambda: more.append(device.fill(ring, PATIENCE_S)))
        filling.start()
        assert waits.wait(PATIENCE_S)
        device.stop()
        filling.join(PATIENCE_S)
        assert more == [False]


def test_a_ring_that_does_not_wait_loses_counted_blocks() -> None:
    with connected(Spad512sModel(noise)) as (device, _):
        ring, reader = begin(device, REQUEST, 160, 2, OnFull.DROP)
        finish(device, ring)
        assert len(list(reader)) == 2
        assert (device.counters.delivered, device.counters.lost, ring.dropped_frames) == (32, 128, 128)
