"""The suite of every sync source: no light while waiting, the program as written, all outputs low at every end."""

import math
from typing import Any

import numpy as np
import pytest

from drivers.errors import LimitExceeded, WrongState
from drivers.interfaces import OUT_FRAME, OUT_GATE, OUT_MARKER, DeviceState, Pulse
from spadrig.conformance.cases import SyncCase, require_final


def sweep(case: SyncCase) -> list[Pulse]:
    """Pulses of one sweep: wait for the scan marker, settle, light, dark."""
    words = Pulse(0, case.step_s), Pulse(OUT_GATE | OUT_FRAME, case.step_s), Pulse(0, case.step_s)
    return [Pulse(OUT_MARKER, None), *words]


def running(case: SyncCase, repeats: int = 2) -> None:
    """Start the program, trigger it once and wait until the middle of its lit pulse."""
    case.device.program(sweep(case), repeats)
    case.device.run()
    case.trigger()
    case.clock.sleep(1.5 * case.step_s)
    assert case.pins() == (OUT_GATE | OUT_FRAME if case.plays else 0)


class SyncSourceSuite:
    """Tests of a sync source. The fixture `sync` gives a `SyncCase`."""

    @pytest.fixture
    def playing(self, sync: SyncCase) -> None:
        """Skips the test for a source whose outputs do not follow its program."""
        if not sync.plays:
            pytest.skip("a stand-in plays nothing")

    def test_it_is_found_low_and_verbs_out_of_order_are_refused_and_say_what_to_call(self, sync: SyncCase) -> None:
        device = sync.device
        assert device.name
        assert device.resolution_s > 0
        assert device.status.outputs == 0
        with pytest.raises(WrongState, match="program"):
            device.run()
        device.program([Pulse(OUT_FRAME, sync.step_s)], 100)  # which plays nothing yet
        assert device.state is DeviceState.CONFIGURED
        assert device.status.state == "stopped"
        assert sync.pins() == 0
        device.run()
        with pytest.raises(WrongState, match="abort"):
            device.run()
        with pytest.raises(WrongState, match="abort"):
            device.program(sweep(sync), 1)
        device.abort()
        device.program(sweep(sync), 1)

    def test_what_no_source_may_play_is_refused_and_replaces_nothing(self, sync: SyncCase) -> None:
        device, resolution_s = sync.device, sync.device.resolution_s
        lit, short = Pulse(OUT_GATE, sync.step_s), Pulse(OUT_GATE, 0.4 * resolution_s)
        all_high = OUT_GATE | OUT_FRAME | OUT_MARKER
        refused: list[tuple[list[Any], Any, str]] = [
            ([], 1, "0 words"),
            ([lit], 0, "0 repeats"),
            ([lit], 2.5, "repeats is 2.5; give a whole number"),
            ([(OUT_GATE, sync.step_s)], 1, "word 0 is .*; give a Pulse"),
            ([Pulse(0.5, sync.step_s)], 1, "outputs of word 0 is 0.5; give a whole number"),  # type: ignore[arg-type]
            ([Pulse(0, "10 ms")], 1, "word 0 lasts '10 ms'; give a number of seconds"),  # type: ignore[arg-type]
            *(([Pulse(outputs, sync.step_s)], 1, "0x0 to 0x7") for outputs in (8, -1)),
            *(([lit, Pulse(0, duration_s)], 1, "word 1 lasts") for duration_s in (0.0, -1.0, math.nan, math.inf)),
            ([lit, short], 1, f"{0.4 * resolution_s:g} s, under the resolution {resolution_s:g} s"),
            *(
                ([lit, Pulse(outputs, None)], 1, rf"word 1 waits .*\(0x{outputs:x}\)")
                for outputs in (OUT_GATE, all_high)
            ),
        ]

        def refuse_all() -> None:
            for pulses, repeats, said in refused:
                with pytest.raises(LimitExceeded, match=said):
                    device.program(pulses, repeats)

        refuse_all()
        assert device.state is DeviceState.READY
        assert sync.pins() == 0
        device.program(sweep(sync), np.int64(1))  # type: ignore[arg-type]
        refuse_all()
        device.run()
        assert device.status.state == sync.waiting

    @pytest.mark.usefixtures("playing")
    def test_it_waits_dark_for_each_scan_marker_plays_the_program_once_and_ends_low(self, sync: SyncCase) -> None:
        sync.device.program(sweep(sync), 2)
        sync.device.run()
        for _ in range(3):
            sync.clock.sleep(sync.step_s)
            status = sync.device.status
            assert status.state == sync.waiting
            assert status.outputs in (None, OUT_MARKER)
            assert sync.pins() == OUT_MARKER
        assert sync.device.state is DeviceState.RUNNING
        for played in range(2):
            sync.trigger()
            sync.clock.sleep(0.5 * sync.step_s)
            assert (sync.device.status.state, sync.pins()) == ("running", 0)
            sync.clock.sleep(sync.step_s)
            status = sync.device.status
            assert status.state == "running"
            assert status.outputs in (None, OUT_GATE | OUT_FRAME)
            assert sync.pins() == OUT_GATE | OUT_FRAME
            sync.clock.sleep(sync.step_s)
            assert sync.pins() == 0
            sync.clock.sleep(sync.step_s)
            assert sync.device.status.state == (sync.waiting, "stopped")[played]
        assert sync.pins() == 0
        sync.trigger()
        sync.clock.sleep(1.5 * sync.step_s)
        assert sync.pins() == 0
        sync.device.run()  # a program that has ended may run again
        assert sync.device.status.state == sync.waiting

    @pytest.mark.usefixtures("playing")
    def test_a_program_that_ends_on_a_high_word_ends_low(self, sync: SyncCase) -> None:
        sync.device.program([Pulse(OUT_GATE | OUT_MARKER, sync.step_s)], 2)
        sync.device.run()
        sync.clock.sleep(1.5 * sync.step_s)
        assert sync.pins() == OUT_GATE | OUT_MARKER
        sync.clock.sleep(sync.step_s)
        assert sync.pins() == 0
        assert sync.device.status.state == "stopped"

    def test_abort_is_possible_in_any_state_and_low_at_once_and_the_program_may_run_again(self, sync: SyncCase) -> None:
        sync.device.abort()
        assert sync.device.state is DeviceState.READY
        running(sync)
        sync.device.abort()
        assert sync.pins() == 0
        status = sync.device.status
        assert status.outputs == 0
        assert status.state in ("aborted", "stopped")
        assert sync.device.state is DeviceState.CONFIGURED
        sync.trigger()
        sync.clock.sleep(1.5 * sync.step_s)
        assert sync.pins() == 0
        sync.device.abort()
        sync.device.run()
        assert sync.device.status.state == sync.waiting

    def test_gate_low_is_low_until_the_next_run_and_a_close_leaves_all_low_for_good(self, sync: SyncCase) -> None:
        sync.device.gate_low()
        running(sync)
        sync.device.gate_low()
        assert not sync.pins() & OUT_GATE
        sync.trigger()
        for _ in range(5):
            sync.clock.sleep(sync.step_s)
            assert not sync.pins() & OUT_GATE
        device = sync.device
        device.abort()
        running(sync)
        verbs = (device.run, device.gate_low, device.abort, lambda: device.status)
        require_final(device, lambda: device.program(sweep(sync), 1), *verbs)
        assert sync.pins() == 0
