"""The model of an NI card through the real package nidaqmx, over gRPC. No driver of ours.

Expected values are from NI's manuals and from the tests of nidaqmx-python (docs/reference/hardware.md).
"""

import itertools
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
import pytest
from nidaqmx import DaqError, DaqWriteError, GrpcSessionOptions, Task
from nidaqmx._stubs import nidaqmx_pb2
from nidaqmx.constants import (
    AcquisitionType,
    ChannelType,
    LineGrouping,
    RegenerationMode,
    Signal,
    TaskMode,
    WriteRelativeTo,
)
from nidaqmx.errors import RpcError
from nidaqmx.stream_writers import AnalogMultiChannelWriter, AnalogUnscaledWriter, DigitalSingleChannelWriter
from nidaqmx.system import System
from numpy.typing import NDArray

from drivers.clock import VirtualClock
from drivers.errors import DeviceError
from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq import NidaqModel
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import Edges, Output, Pulses, Span
from sim_backend.wire.serve.grpc import GrpcServer

RATE_HZ = 50_000.0
PERIOD_S = 1 / RATE_HZ
FIRST_S = 2e-8
"""Time from the start of a task to its first sample: two ticks of 100 MHz."""
FIFO = 8191
CONTINUOUS, FINITE = AcquisitionType.CONTINUOUS, AcquisitionType.FINITE


@dataclass
class Card:
    """The model, its server and its clock, and a client."""

    model: NidaqModel
    server: GrpcServer
    clock: VirtualClock
    channel: Any

    @property
    def now_s(self) -> float:
        return self.clock.now_ns() / 1e9

    def task(self, name: str = "") -> Task:
        return Task(name, grpc_options=GrpcSessionOptions(self.channel, name))

    def galvo(self, samples: int = 0, *, rate_hz: float = RATE_HZ, mode: AcquisitionType = CONTINUOUS) -> Task:
        """A task of the first analogue output with a clock. samples: those of a finite one."""
        task = self.task()
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=mode, samps_per_chan=samples or 1000)
        return task

    def markers(self, lines: str = "Dev1/port0/line0:2", source: str = "/Dev1/ao/SampleClock") -> Task:
        """A task of digital lines, by default on the clock of the analogue outputs."""
        task = self.task()
        task.do_channels.add_do_chan(lines, line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
        task.timing.cfg_samp_clk_timing(RATE_HZ, source=source, sample_mode=CONTINUOUS)
        return task

    def volts(self, *times_s: float, output: str = "ao0") -> NDArray[np.float64]:
        return self.model.outputs[output].values(np.array(times_s))

    def sampled(self, start_s: float, n: int, output: str = "ao0") -> NDArray[np.float64]:
        """Values in the middle of n sample periods after a start."""
        times_s: NDArray[np.float64] = np.arange(n, dtype=np.float64) + 0.5
        return self.model.outputs[output].values(start_s + FIRST_S + times_s * PERIOD_S)


@pytest.fixture
def make() -> Iterator[Callable[..., Card]]:
    """Function that plugs in a card; its arguments are those of the model."""
    opened: list[Card] = []

    def plug(**options: Any) -> Card:
        clock = VirtualClock(1_000_000_000)
        server = GrpcServer(NidaqModel(**options), clock=clock).start()
        opened.append(Card(server.model, server, clock, grpc.insecure_channel(server.address)))  # type: ignore[arg-type]
        return opened[-1]

    yield plug
    for card in opened:
        card.channel.close()
        card.server.close()


@pytest.fixture
def card(make: Callable[..., Card]) -> Card:
    """A card with default settings."""
    return make()


def refused(code: int) -> Any:
    return pytest.raises(DaqError, match=rf"(?s).*Status Code: {code}$")


RAMP = np.linspace(-2.0, 2.0, 100)
STEP_V = 10 / 32767


# The card and its names


def test_the_card_tells_what_it_is_and_has(card: Card) -> None:
    system = System.remote(GrpcSessionOptions(card.channel, ""))
    assert [one.name for one in system.devices] == ["Dev1"]
    device = system.devices["Dev1"]
    assert device.product_type == "PCIe-6363"
    assert device.serial_num == card.model.serial
    assert not device.is_simulated
    assert device.ao_physical_chans.channel_names == [f"Dev1/ao{n}" for n in range(4)]
    assert device.do_ports.channel_names == ["Dev1/port0", "Dev1/port1", "Dev1/port2"]
    assert len(device.do_lines.channel_names) == 48
    assert len(device.co_physical_chans.channel_names) == 4
    assert {"/Dev1/PFI0", "/Dev1/ao/SampleClock", "/Dev1/ao/StartTrigger"} < set(device.terminals)
    assert device.ao_voltage_rngs == [-5.0, 5.0, -10.0, 10.0]
    assert device.ao_samp_clk_supported
    assert [port.do_samp_clk_supported for port in device.do_ports] == [True, False, False]
    assert [port.do_port_width for port in device.do_ports] == [32, 8, 8]
    with refused(-200220):
        _ = system.devices["Dev2"].product_type
    with refused(-200197):
        _ = device.ai_gains


def test_a_call_that_the_server_lacks_is_no_error_of_the_driver(card: Card) -> None:
    with pytest.raises(RpcError, match="not supported by the NI gRPC Device Server"):
        card.task().ai_channels.add_ai_voltage_chan("Dev1/ai0")


def test_the_voltage_of_an_output_can_be_measured_inside_the_card(card: Card) -> None:
    galvo, inside = card.galvo(), card.task()
    inside.ai_channels.add_ai_voltage_chan("Dev1/_ao0_vs_aognd")
    galvo.write(RAMP, auto_start=True)
    card.clock.sleep(30.5 * PERIOD_S)
    assert inside.read() == pytest.approx(RAMP[30], abs=STEP_V)
    galvo.stop()
    card.clock.sleep(1.0)
    assert inside.read(2) == pytest.approx([RAMP[30]] * 2, abs=STEP_V)


@pytest.mark.parametrize(
    ("channel", "code"), [("Dev2/ao0", -200220), ("Dev1/ao4", -200170), ("Dev1/ai3", -200430), ("Dev1/ctr0", -200430)]
)
def test_a_channel_that_is_no_analogue_output_is_refused_at_once(card: Card, channel: str, code: int) -> None:
    with refused(code):
        card.task().ao_channels.add_ao_voltage_chan(channel)


def test_channels_of_different_kinds_or_twice_do_not_go_into_one_task(card: Card) -> None:
    task = card.galvo()
    assert task.channels.chan_type == ChannelType.ANALOG_OUTPUT
    with refused(-200489):
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    with refused(-200559):
        task.do_channels.add_do_chan("Dev1/port0/line0")
    with refused(-200082):
        task.ao_channels.add_ao_voltage_chan("Dev1/ao1", min_val=1.0, max_val=1.0)
    task.ao_channels.add_ao_voltage_chan("Dev1/ao1:2", "y")
    assert task.channel_names == ["Dev1/ao0", "y0", "y1"]


# Rates


@pytest.mark.parametrize(
    ("asked_hz", "real_hz"), [(50_000, 50_000), (48_000, 1e8 / 2083), (44_100, 1e8 / 2268), (999_999, 1e6)]
)
def test_the_rate_is_the_timebase_by_the_nearest_integer(card: Card, asked_hz: float, real_hz: float) -> None:
    assert card.galvo(rate_hz=asked_hz).timing.samp_clk_rate == real_hz


def test_a_rate_is_refused_beyond_what_the_channels_allow(card: Card) -> None:
    assert card.galvo(rate_hz=2.8e6).timing.samp_clk_rate == pytest.approx(1e8 / 36)
    with refused(-200077):
        _ = card.galvo(rate_hz=3e6).timing.samp_clk_rate
    task = card.task()
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0:1")
    task.timing.cfg_samp_clk_timing(2.8e6)
    with refused(-200077):
        task.control(TaskMode.TASK_VERIFY)


def test_the_crystal_is_off_and_the_rate_read_back_does_not_tell(make: Callable[..., Card]) -> None:
    card = make(clock_error=100e-6)
    task, start_s = card.galvo(), card.now_s
    task.write(np.tile([0.0, 1.0], 50))
    task.start()
    card.clock.sleep(10.0)
    assert task.timing.samp_clk_rate == RATE_HZ
    assert task.out_stream.total_samp_per_chan_generated == pytest.approx(10 * RATE_HZ * 1.0001, abs=2)
    assert card.volts(start_s + 9.5 * PERIOD_S)[0] == pytest.approx(1.0, abs=STEP_V)


# One analogue output


def test_a_single_value_comes_out_at_once_and_stays(card: Card) -> None:
    task = card.task()
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    with refused(-200846):
        task.write(1.0, auto_start=False)
    assert task.write(-2.5) == 1
    task.close()
    card.clock.sleep(100.0)
    assert card.volts(card.now_s, card.now_s + 3600.0) == pytest.approx([-2.5, -2.5], abs=STEP_V)
    assert card.model.history.command(np.array([0.0, card.now_s])) == pytest.approx([0, -0.25], abs=1e-4)


def test_the_buffer_is_repeated_until_the_stop_and_the_last_voltage_stays(card: Card) -> None:
    task, start_s = card.galvo(), card.now_s
    assert task.write(RAMP) == 100
    assert task.out_stream.output_buf_size == 100
    task.start()
    assert not task.is_task_done()
    assert card.model.moving(card.now_s)
    card.clock.sleep(250.5 * PERIOD_S)
    assert task.out_stream.total_samp_per_chan_generated == 251
    task.stop()
    assert not card.model.moving(card.now_s)
    assert card.sampled(start_s, 250) == pytest.approx(np.tile(RAMP, 3)[:250], abs=STEP_V)
    assert card.volts(card.now_s + 10) == pytest.approx(RAMP[50], abs=STEP_V)
    task.start()
    assert card.volts(card.now_s + 0.5 * PERIOD_S)[0] == pytest.approx(RAMP[0], abs=STEP_V), "it begins anew"


def test_a_finite_task_ends_by_itself_and_holds(card: Card) -> None:
    task, start_s = card.galvo(150, mode=FINITE), card.now_s
    task.write(RAMP)
    task.start()
    with refused(-200560):
        task.wait_until_done(100 * PERIOD_S)
    task.wait_until_done(1.0)
    assert card.now_s == pytest.approx(start_s + 150 * PERIOD_S, abs=0.002)
    assert task.is_task_done()
    assert card.sampled(start_s, 200)[100:] == pytest.approx([*RAMP[:50], *[RAMP[49]] * 50], abs=STEP_V)


def test_voltages_beyond_the_limits_are_refused_and_nothing_is_written(card: Card) -> None:
    task = card.task()
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=-4.0, max_val=4.0)
    task.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    assert task.ao_channels.all.ao_dac_rng_high == 5.0
    with pytest.raises(DaqWriteError) as error:
        task.write([0.0, 4.1])
    assert (error.value.error_code, error.value.samps_per_chan_written) == (-200561, 0)
    wide = card.task()
    wide.ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=-12.0, max_val=12.0)
    with refused(-200077):
        wide.write(0.0)


def test_a_task_without_data_or_with_a_single_sample_does_not_start(card: Card) -> None:
    task = card.galvo()
    with refused(-200462):
        task.start()
    with refused(-200547):
        task.write([1.0])
    with refused(-200478):
        card.task().start()
    task.out_stream.output_buf_size = 1
    task.write([1.0], auto_start=False)
    with refused(-200609):
        task.start()


def test_several_channels_and_both_layouts_of_data_come_out_alike(card: Card) -> None:
    task, start_s = card.task(), card.now_s
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0:1")
    task.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    AnalogMultiChannelWriter(task.out_stream).write_many_sample(np.stack([RAMP, -RAMP]))
    task.start()
    assert card.sampled(start_s, 100, "ao1") == pytest.approx(-RAMP, abs=STEP_V)
    task.close()
    codes = card.galvo()
    AnalogUnscaledWriter(codes.out_stream).write_int16(np.array([[-32767, 32767]], np.int16))
    codes.start()
    assert card.sampled(card.now_s, 2) == pytest.approx([-10, 10])


def test_new_samples_come_after_those_in_the_cards_memory_in_the_middle_of_the_wave(card: Card) -> None:
    """Memory of 8191 samples holds 81 periods and 91 samples of the next."""
    task, start_s = card.galvo(), card.now_s
    task.write(np.full(100, 1.0))
    task.start()
    task.write(np.full(100, -1.0))
    jump = card.model.outputs["ao0"].values(start_s + FIRST_S + (np.array([FIFO - 1, FIFO]) + 0.5) * PERIOD_S)
    assert jump == pytest.approx([1.0, -1.0], abs=STEP_V)
    assert FIFO % 100 != 0


def test_part_of_the_buffer_can_be_written_anew(card: Card) -> None:
    task, start_s = card.galvo(), card.now_s
    task.write(np.zeros(100))
    task.out_stream.relative_to = WriteRelativeTo.FIRST_SAMPLE
    task.out_stream.offset = 98
    task.write([1.0, 1.0, 1.0, 1.0])
    task.start()
    assert np.flatnonzero(card.sampled(start_s, 100) > 0.5).tolist() == [0, 1, 98, 99]
    with refused(-200557):
        task.timing.cfg_samp_clk_timing(1000.0)
    task.stop()
    with refused(-200293):
        task.write(np.zeros(101))


def test_with_the_cards_memory_only_the_wave_must_fit_and_cannot_be_changed(card: Card) -> None:
    task = card.galvo()
    task.ao_channels.all.ao_use_only_on_brd_mem = True
    task.write(np.zeros(FIFO + 1))
    with refused(-200341):
        task.start()
    task.control(TaskMode.TASK_UNRESERVE)
    task.write(np.zeros(100))
    task.start()
    with refused(-200295):
        task.write(np.zeros(100))


# Samples that come out once


def stream(card: Card, buffer: int = 1000) -> Task:
    task = card.galvo()
    task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
    task.write(np.full(buffer, 1.0))
    return task


def test_samples_follow_one_another_without_a_seam_while_they_are_written_in_time(card: Card) -> None:
    task, start_s = stream(card), card.now_s
    task.start()
    for value in (2.0, 3.0):
        card.clock.sleep(500 * PERIOD_S)
        task.write(np.full(1000, value))
    values = card.sampled(start_s, 3000)
    assert values == pytest.approx(np.repeat([1.0, 2.0, 3.0], 1000), abs=STEP_V)


def test_an_underflow_stops_with_the_voltage_held_and_is_told_until_the_stop(card: Card) -> None:
    task, start_s = stream(card), card.now_s
    task.start()
    card.clock.sleep(1.0)
    assert card.volts(start_s + 2.0)[0] == pytest.approx(1.0, abs=STEP_V)
    assert not card.model.moving(card.now_s)
    for call in (task.is_task_done, lambda: task.write(np.zeros(10)), lambda: task.wait_until_done(0.1), task.stop):
        with refused(-200290):
            call()
    task.stop()
    assert task.is_task_done()


def test_a_write_waits_for_room_and_tells_how_much_it_took_when_time_is_up(card: Card) -> None:
    task = stream(card)
    with pytest.raises(DaqWriteError) as error:
        task.write(np.zeros(2 * FIFO))
    assert (error.value.error_code, error.value.samps_per_chan_written) == (-200293, 0), "before the start, at once"
    task.start()
    with pytest.raises(DaqWriteError) as error:
        task.write(np.zeros(2 * FIFO), timeout=0.01)
    assert error.value.error_code == -200292
    assert FIFO <= error.value.samps_per_chan_written <= FIFO + 0.02 * RATE_HZ
    before_s = card.now_s
    assert task.write(np.zeros(5000)) == 5000
    assert card.now_s - before_s == pytest.approx(5000 * PERIOD_S, abs=0.01)


# States and resources


def test_two_tasks_cannot_have_the_same_output_or_the_one_clock(card: Card) -> None:
    first, second, third = card.galvo(), card.galvo(), card.task()
    third.ao_channels.add_ao_voltage_chan("Dev1/ao1")
    first.control(TaskMode.TASK_RESERVE)
    with refused(-50103):
        second.control(TaskMode.TASK_RESERVE)
    with refused(-200963):
        third.write(0.5)
    third.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    with refused(-50103):
        third.write(RAMP)
    first.close()
    second.write(RAMP, auto_start=True)
    lines = card.task()
    lines.do_channels.add_do_chan("Dev1/port0/line0")
    lines.start()
    with refused(-200587):
        card.markers().write(np.zeros(10, np.uint32))


def test_a_stop_goes_back_to_the_state_before_the_start_and_frees_the_outputs(card: Card) -> None:
    task, other = card.galvo(), card.galvo()
    task.write(RAMP, auto_start=True)
    task.stop()
    other.write(RAMP)
    other.start()
    other.start()
    other.stop()
    with refused(-50103):
        task.write(RAMP)


def test_a_task_that_was_cleared_is_gone(card: Card) -> None:
    task = card.galvo()
    handle = task._handle
    task.close()
    with refused(-200088):
        task._interpreter.start_task(handle)


def test_a_client_that_goes_away_leaves_its_task_running_for_the_next_one(card: Card) -> None:
    task = card.task("galvo")
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    task.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    task.write(RAMP, auto_start=True)
    with grpc.insecure_channel(card.server.address) as channel:
        again = Task("galvo", grpc_options=GrpcSessionOptions(channel, "galvo"))
        assert again.channel_names == ["Dev1/ao0"]
        with again:
            pass  # does not clear what it only attached to
    assert card.model.moving(card.now_s)
    System.remote(GrpcSessionOptions(card.channel, "")).devices["Dev1"].reset_device()
    assert not card.model.moving(card.now_s)
    assert card.volts(card.now_s + 1.0)[0] == 0.0, "an X Series card is reset to 0 V"
    with refused(-88709):
        task.is_task_done()
    task.write(RAMP, auto_start=True)
    assert card.model.moving(card.now_s)


# Markers


def test_lines_on_the_clock_of_the_voltage_change_with_its_samples(card: Card) -> None:
    galvo, markers, start_s = card.galvo(), card.markers(), card.now_s
    galvo.write(RAMP)
    words = np.zeros(100, np.uint32)
    words[0] |= 0b011
    words[50] |= 0b001
    words[50:] |= 0b100
    markers.write(words)
    markers.start()
    card.clock.sleep(0.5)
    assert markers.out_stream.total_samp_per_chan_generated == 0, "no clock yet"
    galvo.start()
    start_s = card.now_s
    card.clock.sleep(3600.0)
    history = card.model.history
    edges = history.rising(GREEN, start_s, start_s + 200 * PERIOD_S)
    assert edges - start_s - FIRST_S == pytest.approx(np.array([0, 50, 100, 150]) * PERIOD_S, abs=1e-9)
    scans = history.rising(BLUE, start_s, start_s + 200 * PERIOD_S)
    assert scans - start_s - FIRST_S == pytest.approx([0.0, 100 * PERIOD_S], abs=1e-9)
    assert len(history.rising(BLUE, card.now_s, card.now_s + 1.0)) == 500, "an hour later, and in the future"
    backward = history.level(INTENSITY, start_s + FIRST_S + (np.arange(100.0) + 0.5) * PERIOD_S)
    assert backward.tolist() == [0] * 50 + [1] * 50
    assert history.command(edges[1:2] + PERIOD_S / 2)[0] == pytest.approx(RAMP[50] / 10, abs=1e-4)
    assert max(len(output) for output in card.model.outputs.values()) <= 2, "memory does not grow"
    assert markers.out_stream.total_samp_per_chan_generated == galvo.out_stream.total_samp_per_chan_generated


def test_lines_hold_their_level_when_the_clock_stops(card: Card) -> None:
    galvo, markers = card.galvo(), card.markers()
    galvo.write(RAMP)
    markers.write(np.ones(100, np.uint32))
    markers.start()
    galvo.start()
    card.clock.sleep(10.3 * PERIOD_S)
    galvo.stop()
    assert not markers.is_task_done()
    assert markers.out_stream.total_samp_per_chan_generated == 11
    assert card.model.history.level(GREEN, np.array([card.now_s + 60.0]))[0] == 1
    galvo.start()
    card.clock.sleep(0.3 * PERIOD_S)
    assert markers.out_stream.total_samp_per_chan_generated == 12, "it goes on with the next clock"


def test_lines_that_start_after_the_voltage_are_late(card: Card) -> None:
    galvo, markers = card.galvo(), card.markers()
    galvo.write(RAMP)
    markers.write(np.array([1] + 99 * [0], np.uint32))
    galvo.start()
    start_s = card.now_s
    card.clock.sleep(7.5 * PERIOD_S)
    markers.start()
    assert card.model.history.rising(GREEN, 0.0, start_s + 100 * PERIOD_S) - start_s == pytest.approx(
        [8 * PERIOD_S], abs=1e-7
    )


def test_booleans_and_integers_address_lines_differently(card: Card) -> None:
    """Integers have a bit for every line of the port, by number; booleans are those of the channel, in its order."""
    task, start_s = card.markers("Dev1/port0/line4:5", source=""), card.now_s
    DigitalSingleChannelWriter(task.out_stream).write_many_sample_port_uint32(np.array([0x10, 0x20], np.uint32))
    task.start()
    assert card.sampled(start_s, 4, "port0/line4").tolist() == [1, 0, 1, 0]
    assert card.sampled(start_s, 4, "port0/line5").tolist() == [0, 1, 0, 1]
    task.close()
    task, start_s = card.task(), card.now_s
    task.do_channels.add_do_chan("Dev1/port0/line4:5", line_grouping=LineGrouping.CHAN_PER_LINE)
    task.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    task.write([[True, True, False], [False, True, True]])
    task.start()
    assert card.sampled(start_s, 3, "port0/line4").tolist() == [1, 1, 0]
    assert card.sampled(start_s, 3, "port0/line5").tolist() == [0, 1, 1]


def test_only_port_0_has_a_clock(card: Card) -> None:
    with refused(-201062):
        card.markers("Dev1/port1/line0").write(np.ones(10, np.bool_))
    line = card.task()
    line.do_channels.add_do_chan("Dev1/port1/line3")
    assert line.write(True) == 1
    assert card.volts(card.now_s, output="port1/line3").tolist() == [1]


def test_a_counter_divides_the_clock_of_the_voltage(make: Callable[..., Card]) -> None:
    card = make(markers={GREEN: "ctr0", BLUE: "ctr1"})
    counter, galvo = card.task(), card.galvo()
    counter.co_channels.add_co_pulse_chan_ticks(
        "Dev1/ctr0", "/Dev1/ao/SampleClock", initial_delay=10, low_ticks=49, high_ticks=1
    )
    counter.timing.cfg_implicit_timing(sample_mode=CONTINUOUS)
    counter.start()
    once = card.task()
    once.co_channels.add_co_pulse_chan_ticks("Dev1/ctr1", "/Dev1/ao/SampleClock", low_ticks=1, high_ticks=3)
    once.start()
    galvo.write(RAMP)
    galvo.start()
    start_s = card.now_s
    edges = card.model.history.rising(GREEN, 0.0, start_s + 150 * PERIOD_S) - start_s - FIRST_S
    assert edges == pytest.approx(np.array([10, 60, 110]) * PERIOD_S)
    levels = card.model.history.level(GREEN, start_s + FIRST_S + np.array([9.5, 10.5, 11.5]) * PERIOD_S)
    assert levels.tolist() == [0, 1, 0]
    assert card.model.history.level(BLUE, start_s + np.array([0.5, 2.5, 3.5, 99.5]) * PERIOD_S).tolist() == [1, 1, 0, 0]
    assert not once.is_task_done()
    card.clock.sleep(10 * PERIOD_S)
    assert once.is_task_done()
    assert not counter.is_task_done()


def test_a_counter_can_be_the_clock_of_voltage_and_lines(card: Card) -> None:
    clock, galvo = card.task(), card.task()
    clock.co_channels.add_co_pulse_chan_freq("Dev1/ctr0", freq=RATE_HZ)
    clock.timing.cfg_implicit_timing(sample_mode=FINITE, samps_per_chan=60)
    assert clock.co_channels.all.co_pulse_freq == RATE_HZ
    galvo.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    galvo.timing.cfg_samp_clk_timing(RATE_HZ, source="/Dev1/Ctr0InternalOutput", sample_mode=CONTINUOUS)
    markers = card.markers(source="/Dev1/Ctr0InternalOutput")
    galvo.write(RAMP)
    markers.write(np.tile(np.array([1, 0], np.uint32), 50))
    for task in (galvo, markers, clock):
        task.start()
    clock.wait_until_done()
    assert galvo.out_stream.total_samp_per_chan_generated == 60
    assert card.volts(card.now_s)[0] == pytest.approx(RAMP[59], abs=STEP_V)
    assert len(card.model.history.rising(GREEN, 0.0, card.now_s)) == 30


def test_impossible_routes_have_the_errors_of_the_router(card: Card) -> None:
    unknown = card.markers(source="Test_Invalid_Device_Source")
    with refused(-89120):
        _ = unknown.timing.samp_clk_src
    with refused(-89136):
        card.markers(source="/Dev1/do/SampleClock").write(np.ones(10, np.uint32))
    galvo = card.galvo()
    galvo.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ao/StartTrigger")
    with refused(-89136):
        galvo.write(RAMP)
    still = card.task()
    still.ao_channels.add_ao_voltage_chan("Dev1/ao1")
    still.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
    with refused(-200262):
        still.write(1.0)
    galvo.export_signals.export_signal(Signal.SAMPLE_CLOCK, "/Dev1/PFI5")
    assert card.model.routes == {"PFI5": "ao/SampleClock"}
    with refused(-89121):
        galvo.export_signals.export_signal(Signal.SAMPLE_CLOCK, "/Dev1/PFI99")


def test_tasks_start_together_on_a_start_trigger(card: Card) -> None:
    galvo, markers = card.galvo(), card.markers(source="")
    galvo.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI3")
    markers.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ao/StartTrigger")
    galvo.write(RAMP)
    markers.write(np.array([1] + 99 * [0], np.uint32))
    markers.start()
    galvo.start()
    card.clock.sleep(1.0)
    assert not card.model.moving(card.now_s)
    with card.server.lock:
        card.model.pulse("PFI3", card.now_s)
    assert card.model.moving(card.now_s)
    assert card.model.history.rising(GREEN, 0.0, card.now_s + PERIOD_S) == pytest.approx([card.now_s + FIRST_S])
    assert card.sampled(card.now_s, 100) == pytest.approx(RAMP, abs=STEP_V)


# The server


def test_a_server_out_of_reach_leaves_the_card_running(card: Card) -> None:
    task = card.galvo()
    task.write(RAMP, auto_start=True)
    address = card.server.address
    card.server.unplug()
    with pytest.raises(RpcError, match="Failed to connect"):
        task.stop()
    assert card.model.moving(card.now_s)
    card.server.plug()
    assert card.server.address == address
    with grpc.insecure_channel(address) as channel:
        grpc.channel_ready_future(channel).result(timeout=10)
        again = System.remote(GrpcSessionOptions(channel, "")).devices["Dev1"]
        again.reset_device()
    assert not card.model.moving(card.now_s)


def test_a_server_that_hangs_answers_when_it_goes_on(card: Card) -> None:
    stub = card.galvo()._interpreter._client.GetErrorString
    request = nidaqmx_pb2.GetErrorStringRequest(error_code=-200290)
    card.server.hang()
    with pytest.raises(grpc.RpcError) as error:
        stub(request, timeout=0.2)
    assert error.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
    card.server.resume()
    assert "regeneration of old samples" in stub(request, timeout=10).error_string
    card.server.hang()


def test_a_server_closes_although_a_call_waits(card: Card) -> None:
    task = card.galvo()
    task.write(RAMP, auto_start=True)
    waiting = task._interpreter._client.WaitUntilTaskDone.future(
        nidaqmx_pb2.WaitUntilTaskDoneRequest(task=task._handle, time_to_wait=-1.0)
    )
    card.server.close()
    assert waiting.exception(timeout=10).code() == grpc.StatusCode.UNAVAILABLE


def test_without_the_packages_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx._stubs", None)
    with pytest.raises(DeviceError, match=r"spadrig\[nidaq\].*pip install \"nidaqmx"):
        GrpcServer(NidaqModel())


# The history


@pytest.mark.parametrize("seed", range(5))
def test_edges_are_where_the_level_changes(seed: int) -> None:
    """Compare the arithmetic of rising edges with levels sampled between all clock edges, for spans of all sorts."""
    random = np.random.default_rng(seed)
    output, at_s, period_s = Output(), 1.0, 0.01
    for number in range(6):
        n = int(random.integers(1, 9))
        edges, data = Edges(at_s, period_s), (random.random(n) < 0.5).astype(np.uint8)
        if number % 2:
            ticks = {one: int(random.integers(1, 4)) for one in ("delay", "high", "low")}
            output.play(Pulses(edges, 40, np.zeros(1), inverted=bool(random.random() < 0.5), **ticks))
        else:
            output.play(Span(edges, 30, data, int(random.integers(0, n))))
        at_s = round(at_s + int(random.integers(5, 50)) * period_s, 6)
    output.cut(at_s)
    times = np.arange(0.9, at_s + 1.0, period_s)
    levels = output.values(times + period_s / 2)
    expected = times[1:][(levels[1:] > 0) & (levels[:-1] == 0)]
    found = output.rising(0.0, at_s + 1.0)
    assert found == pytest.approx(expected, abs=1e-6)
    cuts = np.sort(random.uniform(0.9, at_s + 1.0, 5))
    parts = [output.rising(a, b) for a, b in itertools.pairwise([0.0, *cuts, at_s + 1.0])]
    assert np.concatenate(parts) == pytest.approx(expected, abs=1e-6)
    output.forget(at_s - 0.1)
    late = times[times > at_s - 0.1]
    assert output.values(late + period_s / 2).tolist() == levels[times > at_s - 0.1].tolist()
