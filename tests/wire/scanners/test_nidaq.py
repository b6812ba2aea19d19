"""The NI card's driver: its config, and what it does to an emulated card. Facts: docs/reference/devices/nidaq.md."""

import gc
import random
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from types import FrameType, SimpleNamespace
from typing import Any

import grpc
import numpy as np
import pytest
from nidaqmx.errors import DaqNotFoundError, RpcError
from pydantic import ValidationError

from drivers import errors
from drivers.clock import VirtualClock, now_s
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceNotFound, DeviceTimeout, LimitExceeded
from drivers.interfaces import LEVEL_BACKWARD, MARKER_LINE, MARKER_SCAN
from drivers.registry import Surroundings, lookup
from drivers.scanners import nidaq, nidaq_card
from drivers.scanners.nidaq import Nidaq, NidaqConfig, NidaqDac, NidaqRun, create, pulse_train
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq import NidaqModel
from tests.campaigns.devices.ni_cards import FaultyChannel
from tests.wire.emulated_lasers import PATIENCE_S, eventually
from tests.wire.emulated_scanners import GALVO, cosine, finish
from tests.wire.faults import FaultScript
from tests.wire.scanners.ni_bench import NiBench, marked, ni_bench

USUAL: dict[str, Any] = {"port": "Dev1", "max_velocity": "400 /s", "max_acceleration": "1e6 /s2"}
STEP = 1 / 32767
TICK_S = 2e-8
"""From a start to the first sample: two ticks of 100 MHz."""


def config(**given: Any) -> NidaqConfig:
    return NidaqConfig.model_validate(USUAL | given)


@pytest.fixture
def bench() -> Iterator[NiBench]:
    with ni_bench() as made:
        yield made


# The config


def test_values_have_units_and_read_back_the_same() -> None:
    assert lookup("scanner", "nidaq").config is NidaqConfig
    given = config(
        full_scale="5 V", buffer="100 ms", max_point_rate="80 kHz", clock="PFI0", clock_rate="100000/3 Hz", start="PFI1"
    )
    assert (given.full_scale, given.buffer, given.max_point_rate) == (5.0, 0.1, 80e3)
    assert given.clock_rate == Fraction(100_000, 3)
    assert NidaqConfig.model_validate(given.model_dump(mode="json")) == given
    mixed = config(line_marker="port0/line31", scan_marker="ctr0", backward_marker=None)
    assert (mixed.lines, mixed.counters) == ({MARKER_LINE: 31}, {MARKER_SCAN: "ctr0"})
    for port in ("Dev1", "cDAQ1Mod2", "grpc=scan-pc.lab:31763/Dev1", "emulated:scanner"):
        assert config(port=port).port == port


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        *(({"port": port}, "port") for port in ("", "/Dev1", "Dev1/ao0", "grpc=10.0.0.5/Dev1", "10.0.0.5:31763")),
        ({"full_scale": "11 V"}, "full_scale"),
        ({"full_scale": 10.0}, "no unit"),
        ({"channel": "ai0"}, "channel"),
        ({"buffer": "1 ms"}, "buffer"),
        ({"max_point_rate": "2 MHz"}, "max_point_rate"),
        ({"clock": "PFI0"}, "give a terminal and its rate"),
        ({"clock_rate": "50 kHz"}, "give a terminal and its rate"),
        ({"clock": "PFI0", "clock_rate": "200 kHz"}, "divide the clock"),
        ({"clock": "PFI0", "clock_rate": "10 Hz"}, "outside 1000 to 100000 Hz"),
        ({"start": "PFI 1"}, "start"),
        ({"start": "PFI0", "clock_out": "PFI0"}, "name one twice"),
        ({"scan_marker": "port0/line0"}, "name one twice"),
        ({"scan_marker": "port1/line0"}, "scan_marker"),
        ({"line_marker": "line0"}, "line_marker"),
    ],
)
def test_a_config_that_cannot_be_is_refused(given: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        config(**given)


def test_a_notebook_gives_si_values_and_gets_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: dict[str, Any] = {"max_velocity_per_s": 400.0, "max_acceleration_per_s2": 1e6}
    with pytest.raises(
        LimitExceeded, match=r"^full_scale_v = 12.0: .*less than or equal to 10; correct this argument$"
    ):
        Nidaq.open("Dev1", full_scale_v=12.0, **limits)
    with pytest.raises(LimitExceeded, match=r"^full_scale_v is '5 V'; give a number in SI units, or full_scale='5 V'$"):
        Nidaq.open("Dev1", full_scale_v="5 V", **limits)  # type: ignore[arg-type]
    with pytest.raises(LimitExceeded, match="give a terminal and its rate"):
        Nidaq.open("Dev1", clock="PFI0", **limits)
    with pytest.raises(DeviceNotFound, match=r"NoSuchCard.*; "):
        Nidaq.open("NoSuchCard", **limits)
    for package, port in (("grpc", "grpc=127.0.0.1:1/Dev1"), ("nidaqmx", "Dev1")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(
            errors.ProtocolError, match=rf"no package {package}; install the extra spadrig\[nidaq\]: .*pip"
        ):
            Nidaq.open(port, **limits)


@pytest.mark.parametrize(
    ("high", "train"),
    [
        ("00000000", None),
        ("11100000", (0, 3, 8, 1)),
        ("0110001100", (1, 2, 5, 2)),
        ("00001111", (4, 4, 8, 1)),
        *((high, "") for high in ("11111111", "0110011100", "0110110000", "00010000", "11111110")),
    ],
)
def test_a_counter_makes_equal_pulses_at_equal_distances_and_refuses_all_other_markers(high: str, train: Any) -> None:
    bits = np.array([one == "1" for one in high])
    if train == "":
        with pytest.raises(ValueError, match="points"):
            pulse_train(bits)
    else:
        assert pulse_train(bits) == train


# Opening


def test_opening_looking_and_closing_moves_nothing_and_leaves_no_task(bench: NiBench) -> None:
    with bench.open() as device:
        assert device.identity == "PCIe-6363, serial 0x1C3A5F7"
        device.load(cosine(device), 3)
        device.stop()
        assert device.status.position == 0
    assert not bench.model.tasks
    assert "StartTask" not in bench.model.calls
    assert bench.drive(*np.linspace(0, bench.now_s(), 100)).tolist() == [0.0] * 100


@pytest.mark.parametrize("measures", [True, False])
def test_a_mirror_left_elsewhere_with_markers_high_comes_to_the_centre_and_they_fall(
    bench: NiBench, measures: bool
) -> None:
    bench.model.measures = measures
    for output, value in (("ao0", 4.0), ("port0/line1", 1.0)):
        bench.model.outputs[output].put(value, bench.now_s())
    bench.clock.sleep(0.01)
    begun_s = bench.now_s()
    with bench.open() as device:
        limits = device.limits
        assert device.status.position == 0
        assert bench.levels() == [0, 0, 0]
        assert bench.drive()[0] == 0
        assert (bench.jump(begun_s, 1e-5) <= limits.step) == measures


@pytest.mark.parametrize(
    ("lacks", "settings", "said"),
    [
        ({0x2996: False}, {}, "no analogue output with a sample clock"),
        ({0x2996: None}, {}, "no analogue output with a sample clock"),
        ({0x299A: None}, {}, "no digital lines with a sample clock; make each marker a counter"),
        ({0x299B: [-5.0, 5.0]}, {}, "full_scale 10 V is beyond its -5 to 5 V; lower it"),
        ({0x2997: 833.0}, {"clock": "PFI0", "clock_rate": "2 kHz"}, "2000 Hz exceeds 833 Hz; divide the clock"),
    ],
)
def test_a_card_that_cannot_do_it_is_refused_at_the_opening(
    bench: NiBench, lacks: dict[int, Any], settings: dict[str, Any], said: str
) -> None:
    for number, value in lacks.items():
        bench.model.properties[number] = value
        if value is None:
            del bench.model.properties[number]
    with pytest.raises(LimitExceeded, match=said):
        bench.open(**settings)


def test_a_card_of_another_name_a_busy_one_and_a_dead_server_are_one_line_each(bench: NiBench) -> None:
    with bench.open(start="PFI0") as device:
        device.load(cosine(device), 1)
        device.start()
        with pytest.raises(DeviceBusy, match=r"-200587: .*; close the program that uses it"):
            bench.open()
    limits: dict[str, Any] = {"max_velocity_per_s": 400.0, "max_acceleration_per_s2": 1e6}
    with pytest.raises(DeviceNotFound, match=r"-200220: .*; NI MAX shows what there is"):
        Nidaq.open(f"grpc={bench.server.address}/Dev2", **limits)
    bench.server.unplug()
    with pytest.raises(DeviceNotFound, match=r"no answer at .*; start NI's gRPC device server"):
        Nidaq.open(f"grpc={bench.server.address}/Dev1", **limits)


# Runs


@pytest.mark.parametrize("counted", [False, True])
def test_points_and_markers_leave_with_the_same_edges_and_the_lines_end_low(counted: bool) -> None:
    wired = {"scan_marker": "ctr0", "backward_marker": "ctr1", "line_marker": None} if counted else {}
    outputs = {GREEN: "port0/line0", BLUE: "ctr0", INTENSITY: "ctr1"} if counted else {}
    options: Any = {"markers": outputs} if counted else {}
    with ni_bench(**options) as bench, bench.open(full_scale="5 V", **wired) as device:
        wave = cosine(device, rate_hz=48_000)
        assert wave.point_rate_hz == Fraction(10**8, 2083)
        assert device.load(wave, 3) == wave.point_rate_hz
        begun_s, period_s = bench.now_s(), float(1 / wave.point_rate_hz)
        device.start()
        finish(device)
        history = bench.model.history
        starts = history.rising(BLUE, begun_s, bench.now_s())
        assert np.diff(starts) / period_s == pytest.approx([6000, 6000], abs=1e-6)
        at = starts[0] + (np.arange(18_000) + 0.5) * period_s
        assert 2 * bench.drive(*at) == pytest.approx(np.tile(wave.command, 3), abs=2 * STEP)  # 5 V of 10
        for line, bit in ((GREEN, MARKER_LINE), (BLUE, MARKER_SCAN), (INTENSITY, LEVEL_BACKWARD)):
            wanted = np.tile((wave.markers & bit) != 0, 3) & (line != GREEN or not counted)
            assert (history.level(line, at) == wanted).all()
        assert bench.levels() == [0, 0, 0]
        assert not bench.model.tasks
        assert device.status.position == pytest.approx(wave.command[-1])


def test_a_counter_that_cannot_make_a_marker_says_so_at_the_load(bench: NiBench) -> None:
    with bench.open(line_marker="ctr0") as device:
        wave = cosine(device)
        wave.markers[100:150] = MARKER_LINE
        with pytest.raises(LimitExceeded, match="ctr0 cannot make the line_marker: pulses of 4 to 50 points"):
            device.load(wave, 1)


def test_steps_stay_within_the_limit_from_start_to_close_and_a_stop_brakes(bench: NiBench) -> None:
    begun_s = bench.now_s()
    with bench.open(max_point_rate="25 kHz", park=0.8) as device:
        device.load(marked(device), 1000)
        for _ in range(2):
            device.start()
            eventually(lambda: bench.levels() != [0, 0, 0])
            device.stop()
            assert bench.levels() == [0, 0, 0]
            assert bench.drive()[0] == pytest.approx(device.status.position, abs=STEP)
        assert bench.jump(begun_s, 4e-5) <= device.limits.step
    assert bench.jump(begun_s, 4e-5) <= 0.1
    assert bench.drive()[0] == 0


def test_an_outside_clock_and_trigger_make_point_0_and_what_does_not_come_is_told(bench: NiBench) -> None:
    outside = {"clock": "PFI0", "clock_rate": "20 kHz", "start": "PFI1", "start_wait": "2 s"}
    with bench.open(**outside, clock_out="PFI4", start_out="PFI5") as device:
        wave = cosine(device, 1000, 20_000)
        device.load(wave, 2)
        device.start()
        assert bench.model.exported == {"PFI4": "ao/SampleClock", "PFI5": "ao/StartTrigger"}
        assert bench.drive()[0] == pytest.approx(-0.5, abs=STEP), "it waits at the first point"
        device.stop()
        assert device.status.position == pytest.approx(-0.5)
        assert bench.levels() == [0, 0, 0]
        device.start()
        finish(device)
        assert "no first point within 2 s; check that clock (PFI0) and start (PFI1)" in str(device.status.fault)
        device.start()
        with bench.server.lock:
            bench.model.clock("PFI0", 5e-5, bench.now_s())
            bench.model.trigger("PFI1", bench.now_s())
            begun_s = bench.now_s()
        finish(device)
        assert device.status.fault is None
        starts = bench.model.history.rising(BLUE, begun_s, bench.now_s())
        assert starts == pytest.approx([begun_s, begun_s + 0.05], abs=1e-4)


def test_cards_that_the_driver_of_ni_knows_are_listed_and_without_it_none(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(devices=[SimpleNamespace(name="Dev1", product_type="PCIe-6363")])
    monkeypatch.setattr("nidaqmx.system.System.local", lambda: found)
    assert nidaq_card.attached_cards() == [("Dev1", "PCIe-6363")]

    def missing() -> None:
        raise DaqNotFoundError("no NI-DAQmx")

    monkeypatch.setattr("nidaqmx.system.System.local", missing)
    assert nidaq_card.attached_cards() == []
    monkeypatch.setitem(sys.modules, "nidaqmx.system", None)
    assert nidaq_card.attached_cards() == []


# What goes wrong


def test_a_host_that_was_late_ends_the_run_dark_with_the_mirror_where_it_was(bench: NiBench) -> None:
    with bench.open() as device:
        device.load(marked(device), 10_000)
        device.start()
        eventually(lambda: bench.levels()[1] == 1)
        bench.clock.sleep(0.3)
        finish(device)
        assert "-200290" in str(device.status.fault)
        assert "the points ran dry: lengthen buffer" in str(device.status.fault)
        assert bench.levels() == [0, 0, 0]
        stands, since_s = bench.drive()[0], bench.now_s()
        device.start()
        assert device.status.fault is None
        device.stop()
        assert bench.drive(since_s)[0] == stands
        assert bench.jump(since_s, 1e-5) <= device.limits.step


def test_a_reset_by_another_program_ends_the_run(bench: NiBench) -> None:
    with bench.open() as device:
        device.load(marked(device), 10_000)
        device.start()
        with bench.server.lock:
            bench.model.reset(bench.now_s())
        with pytest.raises(DeviceDisconnected, match="-88709"):
            finish(device)
        assert bench.levels() == [0, 0, 0]


@pytest.mark.parametrize("moves", [False, True])
def test_a_lost_server_is_said_by_every_verb_and_close_returns(
    bench: NiBench, moves: bool, caplog: pytest.LogCaptureFixture
) -> None:
    device = bench.open()
    device.on_fault = (failed := threading.Event()).set
    device.load(marked(device), 10_000)
    if moves:
        device.start()
        eventually(lambda: bench.levels()[1] == 1)
    bench.server.unplug()
    with pytest.raises(DeviceDisconnected, match="server lost, while the card keeps its levels"):
        finish(device)
    if moves:
        assert failed.wait(PATIENCE_S)
    device.close()
    assert "keeps its levels" in caplog.text
    bench.clock.sleep(1.0)
    assert not bench.model.moving(bench.now_s())
    assert bench.levels()[1] == moves, "as they were: the gate must not depend on this card alone"
    bench.server.plug()
    if moves:
        with pytest.raises(DeviceBusy, match=r"restart NI's gRPC server"):  # where its tasks live on
            bench.open()
        bench.model.reset(bench.now_s())
    with bench.open():
        assert bench.levels() == [0, 0, 0]


@pytest.mark.parametrize(
    ("status", "kind"),
    [("UNAVAILABLE", DeviceDisconnected), ("CANCELLED", DeviceDisconnected), ("DEADLINE_EXCEEDED", DeviceTimeout)],
)
def test_what_grpc_says_of_a_call_is_told_as_what_has_happened(
    status: str, kind: type[errors.DeviceError], bench: NiBench
) -> None:
    with bench.open() as device, pytest.raises(kind, match="gRPC server"), device._card.errors():
        raise RpcError(grpc.StatusCode[status], "")


def test_a_server_that_hangs_ends_every_verb_in_time(bench: NiBench) -> None:
    device = bench.open()
    device.load(marked(device), 10_000)
    device.start()
    device._card._call_s = device._card._limit_s = 0.12  # whether or not its thread has begun to be patient
    device._card._late_s = 0.05
    bench.model.calls = []
    eventually(lambda: len(bench.model.calls) > 1)  # the call under way was still a patient one
    bench.server.hang()
    finish(device)
    assert "no answer of the gRPC server" in str(device.status.fault)
    device.close()
    bench.server.resume()


@pytest.mark.parametrize("verb", ["load", "park", "start"])
def test_a_card_whose_server_does_not_answer_is_closed_within_a_second_without_an_error(
    verb: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = VirtualClock()
    channel = FaultyChannel(NidaqModel(), clock, FaultScript(), random.Random(1))
    monkeypatch.setattr("grpc.insecure_channel", lambda *_, **__: channel)
    monkeypatch.setattr("grpc.channel_ready_future", lambda _: SimpleNamespace(result=lambda timeout: None))
    settings = NidaqConfig.model_validate({"port": "emulated:card", **GALVO})
    device = create(settings, Surroundings(clock, None, 1, {"card": Endpoint("127.0.0.1:1/Dev1")}))
    device.load(cosine(device), 10_000)
    if verb != "load":
        getattr(device, verb)()
    channel.hung = True
    begun_s = now_s(clock)
    device.close()
    assert now_s(clock) - begun_s < 1
    assert "could not be left safe" in caplog.text


class Strike:
    """Interrupts the n-th line of the driver that is run."""

    def __init__(self, n: int) -> None:
        self.left = n

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        if event == "line" and frame.f_code.co_filename in (nidaq.__file__, nidaq_card.__file__):
            self.left -= 1
            if self.left == 0:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self


@pytest.mark.long
def test_an_interrupt_at_any_line_leaves_the_markers_low_and_no_task(bench: NiBench) -> None:
    at, struck = 0, True
    while struck:  # at every 101st line, until there is none
        at += 101
        strike, before = Strike(at), sys.gettrace()
        with suppress(KeyboardInterrupt), bench.open() as device:
            device.load(marked(device, 700), 10_000)
            sys.settrace(strike)
            try:
                device.start()
                device.stop()
                device.park()
            finally:
                sys.settrace(before)
        struck = strike.left == 0
        assert bench.levels() == [0, 0, 0], at
        assert bench.drive()[0] == 0, at
        assert not any(task.outputs for task in bench.model.tasks.values()), at
    assert at > 300


@pytest.mark.parametrize("ended", ["deleted", "Python ends"])
def test_a_scanner_that_nobody_closes_is_stopped_with_its_markers_low(
    bench: NiBench, caplog: pytest.LogCaptureFixture, ended: str
) -> None:
    device = bench.open()
    device.load(marked(device, 700), 1_000_000)
    device.start()
    eventually(lambda: bench.levels() != [0, 0, 0])
    forgotten = device._forgotten
    if ended == "deleted":
        del device
        gc.collect()
    else:
        forgotten()
    assert bench.levels() == bench.levels(after_s=10.0) == [0, 0, 0]
    assert bench.drive()[0] == 0
    assert not any(task.outputs for task in bench.model.tasks.values())
    assert "was not closed; its mirror was stopped and is at the centre" in caplog.text
    bench.open().close()  # the card is free


def test_a_marker_from_a_counter_is_low_after_a_stop_and_a_close() -> None:
    with ni_bench(markers={GREEN: "port0/line0", BLUE: "ctr0", INTENSITY: "port0/line2"}) as bench:
        with bench.open(scan_marker="ctr0", line_marker=None, backward_marker=None) as device:
            wave = cosine(device, 2500)
            wave.markers[:] = 0
            wave.markers[:2400] |= MARKER_SCAN
            device.load(wave, 1000)
            device.start()
            eventually(lambda: bench.levels()[1] == 1)
            device.stop()
            assert bench.levels() == bench.levels(after_s=10.0) == [0, 0, 0]
        assert bench.levels(after_s=60.0) == [0, 0, 0]


def test_the_first_error_of_a_run_is_told_although_its_end_fails_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(dac: NidaqDac) -> None:
        raise DeviceBusy("taken")

    def interrupted(run: NidaqRun, stopping: Any) -> None:
        raise KeyboardInterrupt

    with ni_bench() as bench, bench.open() as device:
        with monkeypatch.context() as patched:
            patched.setattr(NidaqDac, "dark", taken)
            patched.setattr(NidaqRun, "_feed", interrupted)
            with pytest.raises(KeyboardInterrupt):
                device.park()
        device.park()


def test_an_axis_is_refused_since_the_channel_is_the_mirror() -> None:
    with pytest.raises(ValidationError, match="axis y means nothing"):
        NidaqConfig.model_validate({"port": "Dev1", **GALVO, "axis": "y"})
