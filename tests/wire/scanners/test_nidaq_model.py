"""The model of an NI card through the real package nidaqmx, over gRPC. No driver of ours.

Expected values are from NI's manuals and from the tests of nidaqmx-python (docs/reference/devices/nidaq.md).
"""

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
import pytest
from nidaqmx import DaqError, DaqWriteError, GrpcSessionOptions, Task
from nidaqmx.constants import AcquisitionType, LineGrouping, RegenerationMode
from nidaqmx.errors import RpcError
from nidaqmx.system import Device
from numpy.typing import NDArray

from drivers.clock import VirtualClock, now_s
from sim_backend.wire.firmware.helios import BLUE, GREEN
from sim_backend.wire.firmware.nidaq import NidaqModel
from sim_backend.wire.firmware.nidaq_parts.daq_outputs import Edges, Output, Samples
from sim_backend.wire.serve.grpc import GrpcServer

RATE_HZ = 50_000.0
PERIOD_S = 1 / RATE_HZ
FIRST_S = 2e-8
"""Time from the start of a task to its first sample: two ticks of 100 MHz."""
FIFO = 8191
CONTINUOUS, FINITE = AcquisitionType.CONTINUOUS, AcquisitionType.FINITE
RAMP = np.linspace(-2.0, 2.0, 100)
STEP_V = 10 / 32767


@dataclass
class Card:
    """The model, its server and its clock, and a client."""

    model: NidaqModel
    server: GrpcServer
    clock: VirtualClock
    channel: Any

    @property
    def now_s(self) -> float:
        return now_s(self.clock)

    def task(self, name: str = "") -> Task:
        return Task(name, grpc_options=GrpcSessionOptions(self.channel, name))

    def output(self, channel: str = "Dev1/ao0") -> Task:
        task = self.task()
        task.ao_channels.add_ao_voltage_chan(channel)
        return task

    def galvo(self, *, rate_hz: float = RATE_HZ, once: bool = False, **timing: Any) -> Task:
        """A task of the first analogue output with a clock. once: its samples are not repeated."""
        task = self.output()
        task.timing.cfg_samp_clk_timing(rate_hz, **({"sample_mode": CONTINUOUS} | timing))
        if once:
            task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        return task

    def markers(self, source: str = "/Dev1/ao/SampleClock") -> Task:
        task = self.task()
        task.do_channels.add_do_chan("Dev1/port0/line0:2", line_grouping=LineGrouping.CHAN_FOR_ALL_LINES)
        task.timing.cfg_samp_clk_timing(RATE_HZ, source=source, sample_mode=CONTINUOUS)
        return task

    def counter(self, **ticks: int) -> Task:
        task = self.task()
        task.co_channels.add_co_pulse_chan_ticks("Dev1/ctr0", "/Dev1/ao/SampleClock", **ticks)
        return task

    def sampled(self, start_s: float, n: int) -> NDArray[np.float64]:
        """Volts in the middle of n sample periods after a start."""
        at = start_s + FIRST_S + (np.arange(n, dtype=np.float64) + 0.5) * PERIOD_S
        return self.model.outputs["ao0"].values(at)


@contextmanager
def plugged(**options: Any) -> Iterator[Card]:
    clock, model = VirtualClock(1_000_000_000), NidaqModel(**options)
    with GrpcServer(model, clock=clock) as server, grpc.insecure_channel(server.address) as channel:
        yield Card(model, server, clock, channel)


@pytest.fixture
def card() -> Iterator[Card]:
    with plugged() as made:
        yield made


def refused(code: int) -> Any:
    return pytest.raises(DaqError, match=rf"(?s).*Status Code: {code}$")


REFUSED: list[tuple[int, Callable[[Card], Any]]] = [
    (-200220, lambda card: card.output("Dev2/ao0")),
    (-200170, lambda card: card.output("Dev1/ao4")),
    (-200430, lambda card: card.output("Dev1/ctr0")),
    (-200082, lambda card: card.task().ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=1.0, max_val=1.0)),
    (-200489, lambda card: card.output().ao_channels.add_ao_voltage_chan("Dev1/ao0")),
    (-200559, lambda card: card.output().do_channels.add_do_chan("Dev1/port0/line0")),
    (-200197, lambda card: Device("Dev1", grpc_options=GrpcSessionOptions(card.channel, "")).ai_gains),
    (-200077, lambda card: card.galvo(rate_hz=3e6).timing.samp_clk_rate),
    (-200846, lambda card: card.output().write(1.0, auto_start=False)),
    (-200462, lambda card: card.galvo().start()),
    (-200547, lambda card: card.galvo().write([1.0])),
    (-200478, lambda card: card.task().start()),
    (-200561, lambda card: card.galvo().write([0.0, 10.1])),
    (-89120, lambda card: card.markers("nowhere").timing.samp_clk_src),
    (-89136, lambda card: card.markers("/Dev1/do/SampleClock").write(np.ones(10, np.uint32))),
]


def test_what_cannot_be_is_refused_with_nis_number(card: Card) -> None:
    for code, act in REFUSED:
        with refused(code):
            act(card)
        card.model.tasks.clear()
    with pytest.raises(RpcError, match="not supported by the NI gRPC Device Server"):
        card.galvo().wait_until_done()


@pytest.mark.parametrize(
    ("asked_hz", "real_hz"), [(50_000, 50_000), (48_000, 1e8 / 2083), (44_100, 1e8 / 2268), (999_999, 1e6)]
)
def test_the_rate_is_the_timebase_by_the_nearest_integer(card: Card, asked_hz: float, real_hz: float) -> None:
    assert card.galvo(rate_hz=asked_hz).timing.samp_clk_rate == real_hz


def test_the_crystal_is_off_and_the_rate_read_back_does_not_tell() -> None:
    with plugged(clock_error=100e-6) as card:
        task = card.galvo()
        task.write(RAMP, auto_start=True)
        card.clock.sleep(10.0)
        assert task.timing.samp_clk_rate == RATE_HZ
        assert task.out_stream.total_samp_per_chan_generated == pytest.approx(10 * RATE_HZ * 1.0001, abs=2)


def test_a_single_value_stays_after_its_task_and_is_measured_inside_the_card(card: Card) -> None:
    task = card.output()
    assert task.write(-2.5) == 1
    task.close()
    card.clock.sleep(100.0)
    assert card.model.history.command(np.array([0.0, card.now_s])) == pytest.approx([0, -0.25], abs=1e-4)
    inside = card.task()
    inside.ai_channels.add_ai_voltage_chan("Dev1/_ao0_vs_aognd")
    assert inside.read() == pytest.approx(-2.5, abs=STEP_V)


def test_the_buffer_is_repeated_until_the_stop_and_the_last_voltage_stays(card: Card) -> None:
    task, start_s = card.galvo(), card.now_s
    task.write(RAMP, auto_start=True)
    assert card.model.moving(card.now_s)
    card.clock.sleep(250.5 * PERIOD_S)
    assert task.out_stream.total_samp_per_chan_generated == 251
    task.stop()
    assert not card.model.moving(card.now_s)
    assert card.sampled(start_s, 250) == pytest.approx(np.tile(RAMP, 3)[:250], abs=STEP_V)
    assert card.sampled(card.now_s + 10, 1) == pytest.approx(RAMP[50], abs=STEP_V)


def test_new_samples_come_after_those_in_the_cards_memory_in_the_middle_of_the_wave(card: Card) -> None:
    """Memory of 8191 samples holds 81 periods and 91 samples of the next."""
    task, start_s = card.galvo(), card.now_s
    task.write(np.full(100, 1.0), auto_start=True)
    task.write(np.full(100, -1.0))
    assert card.sampled(start_s, FIFO + 1)[-2:] == pytest.approx([1.0, -1.0], abs=STEP_V)


def test_samples_follow_one_another_without_a_seam_and_an_underflow_holds_the_voltage(card: Card) -> None:
    task, start_s = card.galvo(once=True), card.now_s
    task.write(np.full(1000, 1.0), auto_start=True)
    for value in (2.0, 3.0):
        card.clock.sleep(500 * PERIOD_S)
        task.write(np.full(1000, value))
    assert card.sampled(start_s, 4000) == pytest.approx(np.repeat([1.0, 2.0, 3.0, 3.0], 1000), abs=STEP_V)
    card.clock.sleep(1.0)
    assert not card.model.moving(card.now_s)
    for call in (lambda: task.write(np.zeros(10)), lambda: task.out_stream.total_samp_per_chan_generated, task.stop):
        with refused(-200290):
            call()
    task.stop()


def test_a_write_waits_for_room_and_tells_how_much_it_took_when_time_is_up(card: Card) -> None:
    task = card.galvo(once=True)
    task.write(np.full(1000, 1.0))
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


def test_two_tasks_cannot_have_the_same_output_or_the_one_clock(card: Card) -> None:
    first, second, third = card.galvo(), card.galvo(), card.output("Dev1/ao1")
    first.write(RAMP)
    with refused(-50103):
        second.write(RAMP)
    with refused(-200963):
        third.write(0.5)
    third.timing.cfg_samp_clk_timing(RATE_HZ, sample_mode=CONTINUOUS)
    with refused(-50103):
        third.write(RAMP)
    handle = first._handle
    first.close()
    with refused(-200088):
        first._interpreter.start_task(handle)
    second.write(RAMP, auto_start=True)
    second.stop()
    third.write(RAMP)  # the stop went back to the state before the write


def test_a_client_that_goes_away_leaves_its_task_running_until_a_reset(card: Card) -> None:
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
        Device("Dev1", grpc_options=GrpcSessionOptions(channel, "")).reset_device()
    assert not card.model.moving(card.now_s)
    assert card.sampled(card.now_s + 1.0, 1)[0] == 0.0, "an X Series card is reset to 0 V"
    with refused(-88709):
        task.stop()
    task.write(RAMP, auto_start=True)
    assert card.model.moving(card.now_s)


def test_lines_change_with_the_samples_of_the_voltage_and_hold_when_the_clock_stops(card: Card) -> None:
    galvo, markers = card.galvo(), card.markers()
    galvo.write(RAMP)
    words = np.zeros(100, np.uint32)
    words[0], words[50] = 0b011, 0b001
    markers.write(words)
    markers.start()
    card.clock.sleep(0.5)
    assert markers.out_stream.total_samp_per_chan_generated == 0, "no clock yet"
    galvo.start()
    start_s, history = card.now_s + FIRST_S, card.model.history
    card.clock.sleep(3600.0)
    until_s = start_s + 200 * PERIOD_S
    assert history.rising(GREEN, 0, until_s) - start_s == pytest.approx(np.arange(0, 200, 50) * PERIOD_S, abs=1e-9)
    assert history.rising(BLUE, 0, until_s) - start_s == pytest.approx([0.0, 100 * PERIOD_S], abs=1e-9)
    assert len(history.rising(BLUE, card.now_s, card.now_s + 1.0)) == 500, "an hour later, and in the future"
    card.clock.sleep(0.3 * PERIOD_S)
    galvo.stop()
    assert history.level(GREEN, np.array([card.now_s, card.now_s + 60.0])).tolist() == [1, 1]


def test_a_counters_pulses_begin_with_the_edge_that_its_delay_names() -> None:
    with plugged(markers={GREEN: "ctr0"}) as card:
        counter, galvo = card.counter(initial_delay=10, low_ticks=48, high_ticks=2), card.galvo()
        counter.timing.cfg_implicit_timing(sample_mode=FINITE, samps_per_chan=3)
        counter.start()
        galvo.write(RAMP, auto_start=True)
        start_s = card.now_s + FIRST_S
        card.clock.sleep(1.0)
        edges = card.model.history.rising(GREEN, 0.0, card.now_s) - start_s
        assert edges == pytest.approx(np.array([9, 59, 109]) * PERIOD_S), "the first edge is number 1"
        at = start_s + np.array([8.5, 9.5, 10.5, 11.5]) * PERIOD_S
        assert card.model.history.level(GREEN, at).tolist() == [0, 1, 1, 0]


def test_tasks_start_on_a_trigger_and_follow_a_clock_from_outside(card: Card) -> None:
    galvo = card.galvo(source="/Dev1/PFI2")
    galvo.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI3")
    galvo.write(RAMP, auto_start=True)
    with card.server.lock:
        card.model.clock("PFI2", PERIOD_S, card.now_s)
        card.clock.sleep(1.0)
        assert not card.model.moving(card.now_s)
        card.model.trigger("PFI3", card.now_s)
    assert card.model.moving(card.now_s)
    assert card.sampled(card.now_s, 100) == pytest.approx(RAMP, abs=STEP_V)


def test_a_server_out_of_reach_leaves_the_card_running(card: Card) -> None:
    task = card.galvo(once=True)
    task.write(np.zeros(1000), auto_start=True)
    card.server.unplug()
    with pytest.raises(RpcError, match="Failed to connect"):
        task.stop()
    assert card.model.moving(card.now_s)


@pytest.mark.parametrize("seed", range(3))
def test_edges_are_where_the_level_changes(seed: int) -> None:
    """Compare the arithmetic of rising edges with levels sampled between all clock edges."""
    random = np.random.default_rng(seed)
    output, at_s, period_s = Output(), 1.0, 0.01
    for _ in range(6):
        n = int(random.integers(1, 9))
        data = (random.random(n) < 0.5).astype(np.uint8)
        output.play(Samples(Edges(at_s, period_s), 30, data, int(random.integers(0, n))))
        at_s = round(at_s + int(random.integers(5, 50)) * period_s, 6)
    times = np.arange(0.9, at_s + 1.0, period_s)
    levels = output.values(times + period_s / 2)
    expected = times[1:][(levels[1:] > 0) & (levels[:-1] == 0)]
    assert output.rising(0.0, at_s + 1.0) == pytest.approx(expected, abs=1e-6)
    cuts = [0.0, *np.sort(random.uniform(0.9, at_s + 1.0, 5)), at_s + 1.0]
    parts = [output.rising(a, b) for a, b in itertools.pairwise(cuts)]
    assert np.concatenate(parts) == pytest.approx(expected, abs=1e-6)
    output.forget(at_s - 0.1)
    late = times > at_s - 0.1
    assert output.values(times[late] + period_s / 2).tolist() == levels[late].tolist()
