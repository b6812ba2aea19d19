"""Pulse Streamer: its config, the sequences for programs, and the count of sweeps. Nothing here is on a wire."""

import base64
import struct
from collections.abc import Callable

import pytest
from pydantic import ValidationError

from drivers.errors import DeviceNotFound, LimitExceeded
from drivers.interfaces import OUT_FRAME, OUT_GATE, OUT_MARKER, Pulse
from drivers.interfaces.sync import HOLD_S
from drivers.registry import kinds, lookup
from drivers.sync.board import OutputPins
from drivers.sync.pulsestreamer import CLOCKS, PulseStreamer, PulseStreamerConfig
from drivers.sync.pulsestreamer_rpc import JsonRpc
from drivers.sync.pulsestreamer_sequence import (
    IDLE_POLL_S,
    MAX_STEPS,
    MAX_TICKS,
    POLL_S,
    GateSequence,
    SweepCount,
    compile_sequence,
)

WAIT, GATE, DARK = Pulse(0, None), Pulse(OUT_GATE, 5e-3), Pulse(0, 1e-3)
SWEEP = (WAIT, DARK, GATE, DARK)
USUAL = OutputPins()


def compiled(*pulses: Pulse, repeats: int = 1, pins: OutputPins = USUAL, external_hold: bool = False) -> GateSequence:
    return compile_sequence("Pulse Streamer", pulses, repeats, pins, external_hold=external_hold)


def sent(sequence: GateSequence) -> list[tuple[int, ...]]:
    """Duration in ns, channels and two analog outputs of each step, from the text that `stream` sends."""
    return list(struct.iter_unpack(">IBhh", base64.b64decode(sequence.encoded)))


# Config


def test_the_kind_is_installed_and_its_config_needs_only_an_address() -> None:
    assert "pulsestreamer" in kinds("sync")
    config = lookup("sync", "pulsestreamer").config.model_validate({"kind": "pulsestreamer", "port": "192.168.1.10"})
    assert isinstance(config, PulseStreamerConfig)
    assert (config.clock, config.hold, config.pins, config.real_time) == ("internal", "none", USUAL, True)


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": ""},
        {"clock": "external"},
        {"hold": "software"},
        {"gate_output": 8},
        {"gate_output": -1},
        {"gate_output": 2},  # the marker's
        {"trigger_pulse": "1 us"},  # a PrawnDO's
    ],
)
def test_a_config_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        PulseStreamerConfig.model_validate({"port": "192.168.1.10", **wrong})
    with pytest.raises(ValidationError):
        PulseStreamerConfig.model_validate({key: value for key, value in wrong.items() if key != "port"})


def test_open_refuses_a_wrong_setting_in_one_line() -> None:
    with pytest.raises(LimitExceeded, match=r"clock: .*; correct this argument") as refused:
        PulseStreamer.open("192.168.1.10", clock="10 MHz")
    assert "\n" not in str(refused.value)
    assert set(CLOCKS) == {"internal", "external-125MHz", "external-10MHz"}


@pytest.mark.parametrize("address", [":8050", "box:", "box:x", "box:0", "box:65536", "box:\u0661", "[::1]:8050"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(DeviceNotFound, match="write 'port' as host or host:port"):
        JsonRpc("Pulse Streamer", address)


# Sequences


def test_a_sweep_becomes_one_sequence_for_each_scan_marker() -> None:
    sequence = compiled(*SWEEP, repeats=7)
    assert sent(sequence) == [(1_000_000, 0, 0, 0), (5_000_000, 0b010, 0, 0), (1_000_000, 0, 0, 0)]
    assert (sequence.waits, sequence.sweeps, sequence.rest) == (True, 7, 0)
    assert sequence.duration_s == pytest.approx(7e-3)


def test_equal_sweeps_written_out_are_the_same_sequence_more_often() -> None:
    twice = compiled(*SWEEP, *SWEEP, repeats=7)
    assert sent(twice) == sent(compiled(*SWEEP))
    assert twice.sweeps == 14


def test_a_program_without_waits_is_played_by_itself() -> None:
    sequence = compiled(GATE, DARK, repeats=3)
    assert sent(sequence) == [(5_000_000, 0b010, 0, 0), (1_000_000, 0, 0, 0)]
    assert (sequence.waits, sequence.sweeps) == (False, 3)


def test_outputs_are_on_the_channels_of_the_config_also_while_it_waits() -> None:
    pins = OutputPins(frame=7, gate=5, marker=0)
    sequence = compiled(
        Pulse(OUT_MARKER, None), Pulse(OUT_FRAME | OUT_GATE | OUT_MARKER, 1e-6), Pulse(OUT_GATE, 1e-6), pins=pins
    )
    assert [step[1] for step in sent(sequence)] == [0b1010_0001, 0b0010_0000]
    assert sequence.rest == 0b0000_0001


def test_durations_are_whole_nanoseconds_and_long_words_are_several_steps() -> None:
    sequence = compiled(Pulse(0, 10.6e-9), Pulse(0, 2.5 * MAX_TICKS * 1e-9))
    (first, *parts) = [step[0] for step in sent(sequence)]
    assert first == 11
    assert len(parts) == 3
    assert max(parts) <= MAX_TICKS
    assert sum(parts) == round(2.5 * MAX_TICKS)


def test_steps_are_sent_in_the_byte_order_that_the_box_reads() -> None:
    sequence = compiled(Pulse(OUT_GATE, 1e-6))
    assert base64.b64decode(sequence.encoded) == bytes((0, 0, 0x03, 0xE8, 2, 0, 0, 0, 0))
    assert base64.b64decode(sequence.encoded("<")) == bytes((0xE8, 0x03, 0, 0, 2, 0, 0, 0, 0))


OTHER = (WAIT, DARK, Pulse(OUT_GATE, 4e-3), DARK)


@pytest.mark.parametrize(
    ("pulses", "said"),
    [
        ((DARK, WAIT, GATE), "word 1 waits for the scan marker and word 0 does not"),
        ((*SWEEP, *OTHER), "its 2 waits are followed by different words"),
        ((*SWEEP, Pulse(OUT_MARKER, None), *SWEEP[1:]), "different words"),
        ((WAIT,), "no words follow the wait before word 1"),
        ((WAIT, WAIT, GATE), "no words follow"),
        ((*SWEEP, WAIT), "no words follow the wait before word 5"),
        ((WAIT, Pulse(OUT_GATE, 2e-9)), "word 1 lasts 2e-09 s, under 3 ns"),
        ((Pulse(0, 1e6 * MAX_TICKS * 1e-9),), f"more than {MAX_STEPS} steps"),
        ((DARK,) * (MAX_STEPS + 1), f"more than {MAX_STEPS} steps"),
    ],
)
def test_what_the_box_cannot_play_is_refused_in_one_line(pulses: tuple[Pulse, ...], said: str) -> None:
    with pytest.raises(LimitExceeded, match=said) as refused:
        compiled(*pulses)
    assert "\n" not in str(refused.value)


# Held pulses


def held(duration_s: float) -> Pulse:
    return Pulse(OUT_GATE, duration_s, held=True)


@pytest.mark.parametrize(
    "pulses",
    [
        (WAIT, held(1.1 * HOLD_S)),
        (WAIT, Pulse(0, HOLD_S), held(0.1 * HOLD_S)),  # short, but the marker may have fallen long before
        (WAIT, held(0.4 * HOLD_S), Pulse(0, HOLD_S), held(0.4 * HOLD_S)),
        (held(1e-6), DARK),  # never waits, so nobody knows of a marker
    ],
)
def test_a_held_pulse_that_may_outlast_the_marker_is_refused_unless_hardware_holds_it(
    pulses: tuple[Pulse, ...],
) -> None:
    with pytest.raises(LimitExceeded, match=r"held by the scan marker .* set hold: external") as refused:
        compiled(*pulses)
    assert "\n" not in str(refused.value)
    assert len(sent(compiled(*pulses, external_hold=True))) == len([p for p in pulses if p.duration_s is not None])


def test_a_held_pulse_that_ends_soon_after_the_markers_edge_is_played() -> None:
    pulses = (WAIT, Pulse(0, 0.5 * HOLD_S), held(0.5 * HOLD_S), DARK)
    assert compiled(*pulses, *pulses).sweeps == 2


# Counting


class Box:
    """A box that plays sweeps of 10 ms, at known times."""

    def __init__(self, begins_s: list[float]) -> None:
        self._begins_s = begins_s

    def plays(self, at_s: float) -> bool:
        return any(begin <= at_s < begin + 0.01 for begin in self._begins_s)


def ends_at_s(count: SweepCount, box: Box, pause_s: Callable[[float], float]) -> float:
    """Time of the answer at which the count says that all is over. An answer takes 1 ms and is true half-way."""
    asked_s = 0.0
    while asked_s < 10.0:
        answered_s = asked_s + 1e-3
        if count.take(asked_s, answered_s, box.plays(asked_s + 0.5e-3)):
            return answered_s
        asked_s = answered_s + pause_s(answered_s)
    raise AssertionError("never over")


@pytest.mark.parametrize("pause_s", [1e-3, 2e-3, 5e-3, 50e-3])
def test_sweeps_are_counted_whether_or_not_the_pause_between_them_is_seen(pause_s: float) -> None:
    begins_s = [0.1 + index * (0.01 + pause_s) for index in range(21)]
    count = SweepCount(20, 0.01, 0.0)
    over_s = ends_at_s(count, Box(begins_s), count.pause_s)
    assert begins_s[19] + 0.01 <= over_s <= begins_s[20] + 0.01, "all 20 sweeps are whole, and the end is soon"


def test_a_sweep_is_never_counted_twice_however_often_the_box_is_asked() -> None:
    count = SweepCount(2, 0.01, 0.0)
    box = Box([0.05, 0.5])
    over_s = ends_at_s(count, box, lambda _: 1e-4)
    assert count.done == 2
    assert over_s == pytest.approx(0.51, abs=3e-3)


def test_late_questions_count_too_few_and_never_too_many() -> None:
    count = SweepCount(5, 0.01, 0.0)
    box = Box([0.012 * index for index in range(1, 1000)])
    over_s = ends_at_s(count, box, lambda _: 0.03)
    assert over_s > 0.012 * 5 + 0.01


def test_answers_that_overlap_are_not_told_apart() -> None:
    count = SweepCount(2, 0.01, 0.0)
    assert not count.take(0.1, 0.102, True)
    assert not count.take(0.101, 0.103, False)  # may be older than the one before
    assert not count.take(0.104, 0.105, True)
    assert count.done == 1


def test_the_box_is_asked_often_only_when_something_is_due() -> None:
    count = SweepCount(3, 10.0, 0.0)
    assert count.pause_s(0.0) == POLL_S
    count.take(0.001, 0.002, True)
    assert count.pause_s(0.002) == IDLE_POLL_S, "a sweep of 10 s has just begun"
    assert count.pause_s(9.99) == pytest.approx(0.01)
    assert count.pause_s(10.1) == POLL_S, "it may be over"
    count.take(11.0, 11.1, False)
    assert count.pause_s(11.1) == POLL_S, "the next one may begin at any time"
    count.take(13.0, 13.1, False)
    assert count.pause_s(13.1) == IDLE_POLL_S
