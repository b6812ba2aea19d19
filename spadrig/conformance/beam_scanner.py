"""The suite of every beam scanner: states, the exact clock, limits checked before anything moves, ends, parking."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from drivers.errors import LimitExceeded, WrongState
from drivers.interfaces import MARKER_LINE, MARKER_SCAN, DeviceState, ScanWaveform
from spadrig.conformance.cases import ScannerCase, require_final

POINTS = 200
ENDLESS = 10**9
"""Repeats that no test waits for."""


def gentle(case: ScannerCase) -> ScanWaveform:
    """A waveform without a jump at its ends: a raised cosine with a point rate in the middle of the scanner's range.

    Its swing is a third of the largest that the scanner's limits allow.
    """
    limits = case.device.limits
    slowest, fastest = limits.point_rate_hz
    clock = case.device.point_clock((slowest * fastest) ** 0.5)
    low, high = limits.command_range
    turn = 2 * np.pi / POINTS
    rate = float(clock)
    swing = min(
        (high - low) / 2,
        limits.step / turn,
        limits.velocity_per_s / (turn * rate),
        min(1.0, limits.rms_duty) * limits.acceleration_per_s2 / (turn * rate) ** 2,
    )
    command = (low + high) / 2 - swing / 3 * np.cos(turn * np.arange(POINTS))
    markers = np.zeros(POINTS, np.uint8)
    markers[0] = MARKER_SCAN
    markers[POINTS // 2] = MARKER_LINE
    return ScanWaveform(command, markers, clock)


class BeamScannerSuite:
    """Tests of a scanner. The fixture `scanner` gives a `ScannerCase`."""

    def test_the_point_clock_is_exact_and_verbs_out_of_order_are_refused_and_say_what_to_call(
        self, scanner: ScannerCase
    ) -> None:
        device = scanner.device
        low, high = device.limits.point_rate_hz
        for requested in np.geomspace(low * 1.01, high * 0.99, 23):
            clock = device.point_clock(float(requested))
            assert isinstance(clock, Fraction)
            assert low <= clock <= high
            assert clock == device.point_clock(float(clock))
        with pytest.raises(WrongState, match="load"):
            device.start()
        device.load(gentle(scanner), ENDLESS)
        assert device.state is DeviceState.CONFIGURED
        device.start()
        with pytest.raises(WrongState, match="stop"):
            device.start()
        with pytest.raises(WrongState, match="stop"):
            device.load(gentle(scanner), 1)
        device.stop()
        device.load(gentle(scanner), 1)

    def test_what_is_beyond_its_limits_is_refused_with_value_and_limit_and_moves_nothing(
        self, scanner: ScannerCase
    ) -> None:
        device, wave, limits = scanner.device, gentle(scanner), scanner.device.limits
        (low, high), (slowest, fastest), most = limits.command_range, limits.point_rate_hz, limits.max_points
        for rate in (slowest / 2, fastest * 2, -1.0, float("nan")):
            with pytest.raises(
                LimitExceeded, match=re.escape(f"rate {rate:g} Hz is outside {slowest:g} to {fastest:g} Hz")
            ):
                device.point_clock(rate)
        jumps = np.where(np.arange(POINTS) % 2, low, high)
        quickest = replace(wave, command=jumps, point_rate_hz=device.point_clock(0.99 * fastest))
        long = ScanWaveform(np.zeros(most + 1), np.zeros(most + 1, np.uint8), wave.point_rate_hz)
        above, below = wave.command + 2 * (high - low), np.full(POINTS, low - 0.01)
        for broken, repeats, said in (
            (wave, 0, "0 repeats"),
            (replace(wave, command=above), 1, f"{above.max():.6g} .*{high:.6g}"),
            (replace(wave, command=below), 1, f"{low - 0.01:.6g} .*{high:.6g}"),
            (quickest, 1, r"(step|velocity|acceleration) of \S+ .*exceeds \S+"),
            (long, 1, f"{most + 1} points .*{most}"),
        ):
            with pytest.raises(LimitExceeded, match=said):
                device.load(broken, repeats)
        assert device.state is DeviceState.READY
        assert not scanner.turning()

    def test_loading_moves_nothing_and_what_is_loaded_is_a_copy_played_until_its_repeats_are_over(
        self,
        scanner: ScannerCase,
    ) -> None:
        device, wave = scanner.device, gentle(scanner)
        repeats = 4
        assert device.load(wave, repeats) == wave.point_rate_hz
        assert not scanner.turning()
        assert not device.status.moving
        wave.command[:] = np.nan
        device.start()
        assert device.state is DeviceState.RUNNING
        assert device.status.fault is None
        scanner.let_pass(1.0 + 1.1 * repeats * POINTS / float(wave.point_rate_hz))
        position = device.status.position
        assert position is None or np.isfinite(position)
        assert not device.status.moving
        assert not scanner.turning()
        device.load(gentle(scanner), 1)
        assert device.state is DeviceState.CONFIGURED

    def test_stop_ends_the_movement_and_the_waveform_can_be_started_again(self, scanner: ScannerCase) -> None:
        device = scanner.device
        device.stop()
        device.load(gentle(scanner), ENDLESS)
        device.start()
        device.stop()
        assert device.state is DeviceState.CONFIGURED
        assert not device.status.moving
        assert not scanner.turning()
        device.stop()
        device.start()
        assert device.status.moving
        assert scanner.turning()

    def test_park_stops_at_one_place_in_any_state_and_a_close_for_good(self, scanner: ScannerCase) -> None:
        device, wave = scanner.device, gentle(scanner)
        low, high = device.limits.command_range

        def parked() -> float | None:
            device.park()
            scanner.let_pass(0.1)
            assert not device.status.moving
            assert not scanner.turning()
            return device.status.position

        places = [parked()]
        device.load(wave, ENDLESS)
        places.append(parked())
        device.start()
        scanner.let_pass(2.3 * POINTS / float(wave.point_rate_hz))
        places.append(parked())
        if places[0] is not None:
            assert places == pytest.approx([places[0]] * 3, abs=1e-3 * (high - low))
            assert low <= places[0] <= high
        device.start()
        verbs = (lambda: device.load(wave, 1), device.start, device.stop, device.park, lambda: device.status)
        require_final(device, *verbs, lambda: device.point_clock(float(wave.point_rate_hz)))
        assert not scanner.turning()
