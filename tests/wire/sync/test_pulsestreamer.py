"""Pulse Streamer: its driver on the model's wire, the sequences for programs, and the count of sweeps."""

import base64
import errno
import gc
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import chain, repeat
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.clock import SystemClock
from drivers.errors import (
    CommandRefused,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    LimitExceeded,
    ProtocolError,
    WrongState,
)
from drivers.interfaces import OUT_FRAME, OUT_GATE, OUT_MARKER, Pulse
from drivers.interfaces.sync import HOLD_S, SyncStatus
from drivers.sync import pulsestreamer_rpc
from drivers.sync.board import OutputPins
from drivers.sync.pulsestreamer import SOFTWARE, PulseStreamer, PulseStreamerConfig
from drivers.sync.pulsestreamer_rpc import JsonRpc, discover
from drivers.sync.pulsestreamer_sequence import (
    IDLE_POLL_S,
    MAX_STEPS,
    MAX_TICKS,
    POLL_S,
    GateSequence,
    SweepCount,
    compile_sequence,
)
from tests.wire.emulated_lasers import PATIENCE_S, eventually
from tests.wire.emulated_syncs import PulseBox, pulse_box
from tests.wire.faults import Fault, FaultScript

WAIT, GATE, DARK = Pulse(0, None), Pulse(OUT_GATE, 5e-3), Pulse(0, 1e-3)
SWEEP = (WAIT, DARK, GATE, DARK)
LOW = [0, 0, 0, 0]
USUAL = OutputPins()


def compiled(*pulses: Pulse, repeats: int = 1, pins: OutputPins = USUAL, external_hold: bool = False) -> GateSequence:
    return compile_sequence("Pulse Streamer", pulses, repeats, pins, external_hold=external_hold)


def sent(sequence: GateSequence) -> list[tuple[int, ...]]:
    """Duration in ns, channels and two analog outputs of each step, from the text that `stream` sends."""
    return list(struct.iter_unpack(">IBhh", base64.b64decode(sequence.encoded)))


def heard(box: PulseBox, before: Callable[[str], None] = lambda method: None) -> list[Any]:
    """What the box hears from now on: methods, with their parameters if they have any."""
    calls: list[Any] = []
    call = box.model.call

    def noted(method: str, params: list[Any], now_s: float) -> Any:
        before(method)
        calls.append((method, *params) if params else method)
        return call(method, params, now_s)

    box.model.call = noted  # type: ignore[method-assign]
    return calls


# On the wire


def left_running(box: PulseBox) -> None:
    """As a dead host leaves it: each scan marker opens the gate."""
    box.model.call("setTrigger", [2, 0], 0.0)
    box.model.call("stream", [compiled(Pulse(OUT_GATE, 1.0)).encoded, 1, [0, OUT_GATE, 0, 0]], 0.0)
    box.trigger.pulse(0.1, 0.1)
    box.clock.sleep(0.5)
    assert box.pins == OUT_GATE


@pytest.mark.parametrize("keeps_sequence", [False, True])
def test_opening_first_takes_all_low_whatever_the_box_was_doing(keeps_sequence: bool) -> None:
    with pulse_box(keeps_sequence=keeps_sequence) as box:
        left_running(box)
        calls = heard(box)
        with box.open(clock="external-10MHz") as device:
            assert calls[:2] == [("constant", LOW), "reset"]
            assert ("selectClock", 2) in calls
            assert device.identity == "Pulse Streamer 8/2 00:26:32:F0:3B:1B, firmware 1.7.0, clock external-10MHz"
            assert (device.serial, device.resolution_s, device.status.outputs) == ("00:26:32:F0:3B:1B", 1e-9, 0)
            assert device.ask("getTemperature") == 45
            box.trigger.pulse(box.now_s + 0.1, 0.1)
            box.clock.sleep(1.0)
            assert not any(level for _, level in box.changes(0.6))


def test_each_verb_says_what_it_has_to_and_no_more() -> None:
    lowering = [("constant", LOW), ("setTrigger", 1, 1), ("constant", LOW), "stream 1 times"]
    with pulse_box() as box, box.open() as device:
        calls = heard(box)
        for pulses, repeats, expected in (
            (SWEEP, 3, [("constant", LOW), ("setTrigger", 2, 0), "getTriggerStart", "stream 1 times"]),
            (SWEEP, 1, [("constant", LOW), ("setTrigger", 2, 1), "getTriggerStart", "stream 1 times"]),
            (
                (GATE, DARK),
                3,
                [("constant", LOW), ("setTrigger", 1, 1), "getTriggerStart", "stream 3 times", "startNow"],
            ),
        ):
            calls.clear()
            device.program(pulses, repeats)
            assert calls == ["getClock"]
            for verb, told in ((device.run, expected), (device.gate_low, lowering), (device.abort, lowering)):
                calls.clear()
                verb()
                said = [f"stream {call[2]} times" if call[0] == "stream" else call for call in calls]
                assert [call for call in said if call not in ("isStreaming", "hasFinished")] == told


@pytest.mark.parametrize(
    ("answers", "error", "said"),
    [
        ({"getFirmwareVersion": "1.1.9"}, ProtocolError, "firmware 1.1.9 is older than 1.2.0"),
        ({"getFirmwareVersion": "Linux"}, ProtocolError, "no version in 'Linux'"),
        ({"getClock": 1}, DeviceFault, "its clock is 1, not 0"),
        ({"startNow": 0}, ProtocolError, "did not end within 1 s"),  # as if it read steps in the other byte order
        ({"setTrigger": 0}, ProtocolError, "did not wait for its start"),
        ({"isStreaming": "no"}, ProtocolError, "neither yes nor no"),
    ],
)
def test_a_box_that_is_not_as_expected_is_refused_in_one_line(
    answers: dict[str, Any], error: type[DeviceError], said: str
) -> None:
    with pulse_box() as box:
        box.model._methods |= {name: lambda *_, answer=answer: answer for name, answer in answers.items()}
        with pytest.raises(error, match=said) as refused:
            box.open()
        assert "\n" not in str(refused.value)
        assert box.pins == 0


def test_a_trigger_that_is_not_as_it_was_set_and_a_lost_clock_are_found_before_any_light() -> None:
    with pulse_box() as box, box.open() as device:
        device.program(SWEEP, 1)
        box.model._methods["getTriggerStart"] = lambda: 0
        with pytest.raises(DeviceFault, match="its trigger is 0, not 2: it has restarted"):
            device.run()
        box.model.clock_source = 1
        with pytest.raises(DeviceFault, match="its clock is 1"):
            device.program(SWEEP, 1)
        assert not box.model.program.levels.any()


@pytest.mark.parametrize("heard", ["never", "late", "at once"])
@pytest.mark.parametrize("pulses", [(GATE,), SWEEP])
@pytest.mark.parametrize("keeps_sequence", [False, True])
def test_ctrl_c_anywhere_on_the_way_to_light_leaves_it_dark_whatever_the_box_hears_late(
    heard: str, pulses: tuple[Pulse, ...], keeps_sequence: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pulse_box(keeps_sequence=keeps_sequence) as box, box.open() as device:
        device.program(pulses, 1000)
        exchange = device._rpc.call
        for index in range(5 - (pulses == SWEEP)):
            left, late = [index], []

            def interrupted(method: str, *params: Any, left: Any = left, late: Any = late) -> Any:
                left[0] -= 1
                if left[0] == -1 and heard != "at once":
                    late.append((method, *params))
                    raise KeyboardInterrupt
                result = exchange(method, *params)
                if left[0] == -1:
                    raise KeyboardInterrupt
                return result

            monkeypatch.setattr(device._rpc, "call", interrupted)
            with pytest.raises(KeyboardInterrupt):
                device.run()
            for call in late if heard == "late" else []:
                exchange(*call)
            since_s = box.now_s
            box.trigger.pulse(since_s + 0.1, 0.1)
            box.clock.sleep(1.0)
            assert not any(level for _, level in box.changes(since_s)), index


@pytest.mark.parametrize("step", ["constant", "setTrigger", "getTriggerStart", "stream", "startNow"])
def test_an_abort_of_another_thread_meanwhile_is_the_last_word(step: str) -> None:
    with pulse_box() as box, box.open() as device:
        device.program((GATE,), 1000)

        def abort() -> None:
            with suppress(DeviceFault):  # the next run may be on its way when it reads the outputs back
                device.abort()

        lowered, aborting = threading.Event(), threading.Thread(target=abort)
        threads = [aborting]

        def before(method: str) -> None:
            if method == step and threads:
                thread = threads.pop()
                thread.start()
                ends_at = time.monotonic() + PATIENCE_S
                box.server.lock.release()  # so that the abort is heard
                while device._aborts == aborts and time.monotonic() < ends_at:
                    time.sleep(1e-3)
                time.sleep(0.02)
                box.server.lock.acquire()
                lowered.set()

        aborts = device._aborts
        heard(box, before)
        with pytest.raises(WrongState, match="interrupted by abort"):
            device.run()
        assert lowered.is_set()
        aborting.join(PATIENCE_S)
        since_s = box.now_s
        box.clock.sleep(1.0)
        eventually(lambda: not box.pins)
        assert not any(level for _, level in box.changes(since_s))
        assert device.status.state in ("aborted", "stopped")


@pytest.mark.parametrize("keeps_sequence", [False, True])
def test_sweeps_are_counted_to_their_end_and_then_markers_open_nothing(keeps_sequence: bool) -> None:
    with pulse_box(clock=SystemClock(), keeps_sequence=keeps_sequence) as box, box.open(hold="external") as device:
        device.program([WAIT, DARK, Pulse(OUT_GATE, 0.05, held=True), DARK], 3)
        begun_s = box.now_s
        for index in range(1, 300):  # a busy host may miss many of them
            box.trigger.pulse(begun_s + 0.1 * index, 0.07)
        device.run()
        eventually(lambda: device.status.state == "stopped")
        assert box.now_s - begun_s > 0.35
        assert device.status.outputs == 0
        ended_s = box.now_s
        time.sleep(0.25)
        assert not any(level for _, level in box.changes(ended_s))
        assert [level for _, level in box.changes(begun_s)].count(OUT_GATE) >= 3, "none is left out"


@pytest.mark.parametrize("question", ["isStreaming", "hasFinished"])
def test_a_program_is_not_said_to_wait_while_another_thread_finds_its_end(
    question: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That thread takes the outputs low, after which the box does not remember that the program has ended."""
    monkeypatch.setattr("drivers.sync.pulsestreamer._watch", lambda *watched: None)
    with pulse_box() as box, box.open() as device:
        device.program(SWEEP, 1)
        device.run()
        box.trigger.pulse(box.now_s + 1e-3, 1e-3)
        box.clock.sleep(1.0)
        call, run, main = device._rpc.call, device._run, threading.current_thread()
        assert run is not None
        lowered, asked = threading.Event(), threading.Event()
        watching = threading.Thread(target=device._has_ended, args=(run, box.now_s, False))

        def calling(method: str, *params: Any) -> Any:
            from_main = threading.current_thread() is main
            if from_main and method == question and not lowered.is_set():
                watching.start()
                assert lowered.wait(PATIENCE_S)
            answer = call(method, *params)
            if from_main and method == "hasFinished":
                assert not answer
                asked.set()
            elif method == "constant" and not from_main and not lowered.is_set():
                lowered.set()
                assert asked.wait(PATIENCE_S)
            return answer

        monkeypatch.setattr(device._rpc, "call", calling)
        assert device.status == SyncStatus("stopped", 0)
        watching.join(PATIENCE_S)


def test_a_close_whose_abort_failed_takes_the_outputs_low_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    with pulse_box() as box:
        device = box.open()
        device.program((Pulse(OUT_GATE, 10.0),), 1)
        device.run()
        assert box.pins
        monkeypatch.setattr(device, "_do_abort", lambda: (_ for _ in ()).throw(DeviceDisconnected("for a moment")))
        device.close()
        assert not box.pins


@pytest.mark.parametrize("lose", ["unplug", "hang"])
def test_a_box_that_is_lost_is_told_to_the_guard_and_at_the_close(lose: str, caplog: pytest.LogCaptureFixture) -> None:
    with pulse_box() as box:
        device = box.open(silence="0.4 s")
        device.program((GATE,), 100_000)
        device.run()
        getattr(box.server, lose)()
        device._rpc.call_s = 0.2
        eventually(lambda: device.port_lost)
        for verb in (lambda: device.status, device.abort):
            with pytest.raises((DeviceDisconnected, DeviceTimeout)):
                verb()
        device.close()
        assert "turn the laser off by its key" in caplog.text
        with pytest.raises(WrongState, match="open the device again"):
            device.run()
        with pytest.raises(DeviceNotFound, match="Pulse Streamer"):
            box.open(call_s=0.2)


@pytest.mark.parametrize("pulses", [SWEEP, (Pulse(OUT_GATE, 10.0),)])
def test_a_box_that_restarts_on_the_way_is_found(pulses: tuple[Pulse, ...]) -> None:
    with pulse_box(clock=SystemClock()) as box, box.open() as device:
        device.program(pulses, 3)
        device.run()
        with box.server.lock:
            box.model.power_cycle(box.now_s)
        eventually(lambda: device.port_lost)
        device.abort()


def test_no_program_starts_while_the_box_may_still_hear_a_call_that_it_has_not_answered() -> None:
    """A `stream` of an earlier abort, heard late, would stop the program in its midst, with the gate high."""
    with pulse_box() as box, box.open() as device:
        device.program((GATE,), 1000)
        box.server.hang()
        device._rpc.call_s = 0.1
        with pytest.raises(DeviceTimeout):
            device.abort()
        box.server.resume()
        device._rpc.call_s = 1000.0
        with pytest.raises(DeviceTimeout, match="may still hear; run again in"):
            device.run()
        device._rpc._unanswered_s -= 5000.0
        device.run()


def test_a_program_asks_with_a_deadline_of_its_own() -> None:
    with pulse_box() as box, box.open(call_s=1e4, silence="0.2 s") as device:
        device.program((GATE,), 100_000)
        device.run()
        box.server.hang()
        eventually(lambda: device.port_lost)
        assert device._rpc.settles_in_s < 0, "a question that is heard late does no harm"
        box.server.resume()


@pytest.mark.parametrize("running", [False, True])
def test_a_box_that_does_not_answer_is_closed_within_a_second_without_an_error(
    running: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    waits_s: list[float] = []

    def silent(method: str, body: bytes, within_s: float, retry_s: float) -> bytes:
        if threading.current_thread() is threading.main_thread():
            waits_s.append(within_s)
        raise DeviceTimeout("no answer")

    with pulse_box() as box:
        device = box.open()
        device.program((GATE,), 1)
        if running:
            device.run()
        with monkeypatch.context() as patched:
            patched.setattr(device._rpc, "_exchange", silent)
            device.close()
        assert len(waits_s) == (3 if running else 2)
        assert sum(waits_s) < 1
        assert "could not be left safe: no answer" in caplog.text


def test_a_program_whose_answer_is_lost_is_not_sent_again_and_nothing_plays() -> None:
    """A second `stream` could stop the first one in its midst, with the gate high."""
    faults = FaultScript()
    with pulse_box(faults) as box, box.open() as device:
        device.program(SWEEP, 3)
        calls = heard(box)
        faults._script = [None, None, None, Fault.LOST]
        with pytest.raises(DeviceDisconnected):
            device.run()
        assert (calls[3][0], calls[4]) == ("stream", ("constant", LOW))
        faults._script = [Fault.LOST]
        assert device.status.outputs == 0, "a question is asked again"
        box.trigger.pulse(box.now_s + 0.1, 0.1)
        box.clock.sleep(1.0)
        assert box.pins == 0


GOOD = b'{"id": 7, "jsonrpc": "2.0", "result": 5}'
HEAD = b"HTTP/1.1 200 OK\r\n"


@pytest.mark.parametrize(
    ("pieces", "expected"),
    [
        ([HEAD + b"content-LENGTH: 40\r\n\r\n" + GOOD], 5),
        ([HEAD[:5], HEAD[5:] + b"\r\n" + GOOD[:9], GOOD[9:]], 5),  # its end is that of the connection
        ([HEAD + b"Transfer-Encoding: chunked\r\n\r\n", b"28\r\n" + GOOD + b"\r\n0\r\n\r\n"], 5),
        ([HEAD + b"Content-Length: 40\r\n\r\n" + GOOD[:20]], ProtocolError),
        ([b"220 mail.example\r\n"], ProtocolError),
        ([HEAD + b"\r\n" + bytes(10**5)], ProtocolError),
        ([HEAD + b'\r\n{"error": {"code": -32601, "message": "no such\\nmethod"}}'], CommandRefused),
        (chain([HEAD[:3]], repeat(b" ")), DeviceTimeout),  # a byte now and then does not put the deadline off
    ],
)
def test_answers_in_all_forms_of_http_are_read_and_others_are_errors(pieces: Iterable[bytes], expected: Any) -> None:
    def serve() -> None:
        client, _ = listener.accept()
        with client, suppress(OSError):
            client.recv(65_536)
            for piece in pieces:
                client.sendall(piece)
                time.sleep(0.02)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        call_s = 0.5 if expected is DeviceTimeout else PATIENCE_S
        rpc = JsonRpc("box", f"127.0.0.1:{listener.getsockname()[1]}", call_s=call_s)
        if isinstance(expected, int):
            assert rpc.call("isStreaming") == expected
        else:
            with pytest.raises(expected) as refused:
                rpc.call("startNow")
            assert "\n" not in str(refused.value)
        thread.join()


class WaitedTime:
    """Time that passes only while its maker's thread waits for something. In place of the module `time`, and of a
    selector. For other threads, such as one of an earlier test that ends late, time passes as ever."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._thread = threading.current_thread()

    @property
    def _is_asked(self) -> bool:
        return threading.current_thread() is self._thread

    def monotonic(self) -> float:
        return self.now_s if self._is_asked else time.monotonic()

    def sleep(self, seconds: float) -> None:
        if self._is_asked:
            self.now_s += seconds
        else:
            time.sleep(seconds)

    def selector(self) -> selectors.BaseSelector:
        waited = self

        class Selector(selectors.SelectSelector):
            def select(self, timeout: float | None = None) -> list[Any]:
                if not waited._is_asked:
                    return super().select(timeout)
                ready = super().select(0)
                waited.now_s += 0 if ready else timeout or 0
                return ready

        return Selector()


@pytest.mark.parametrize(("listens", "connections"), [(True, 2), (False, 0)])
def test_a_question_is_asked_twice_within_the_silence_of_a_box_and_then_the_box_is_lost(
    listens: bool, connections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    passed = WaitedTime()
    monkeypatch.setattr(pulsestreamer_rpc, "time", passed)
    monkeypatch.setattr(pulsestreamer_rpc.selectors, "DefaultSelector", passed.selector)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        rpc = JsonRpc("box", f"127.0.0.1:{listener.getsockname()[1]}")
        if not listens:
            listener.close()
        with pytest.raises(DeviceTimeout if listens else DeviceDisconnected):
            rpc.ask("isStreaming", 0.3)
        assert passed.now_s == pytest.approx(0.3, abs=0.021)
        for _ in range(connections):
            listener.accept()[0].close()


@pytest.mark.parametrize("trouble", [errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ECONNREFUSED])
@pytest.mark.parametrize("silence_s", [0.3, 4.0])
def test_a_box_without_a_route_is_lost_only_after_its_silence(
    trouble: int, silence_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pulsestreamer_rpc, "time", passed := WaitedTime())
    monkeypatch.setattr(socket.socket, "connect_ex", lambda *_: trouble)
    with pytest.raises(DeviceDisconnected, match="cannot be reached"):
        JsonRpc("box", "127.0.0.1").ask("isStreaming", silence_s)
    assert passed.now_s == pytest.approx(silence_s, abs=0.021)


def test_a_computer_that_is_late_does_not_take_the_box_for_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long its thread does not run."""
    with pulse_box() as box:
        rpc = JsonRpc("box", box.server.address, call_s=60.0)
        monkeypatch.setattr(pulsestreamer_rpc, "time", late := WaitedTime())
        monkeypatch.setattr(late, "monotonic", lambda: late.sleep(100.0) or late.now_s)
        assert rpc.call("getTemperature") == 45


def test_boxes_that_answer_a_question_to_all_are_found_among_others() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(("127.0.0.1", 0))

        def answer() -> None:
            question, asker = box.recvfrom(2048)
            assert question == b"PS-DISCOVERY"
            for said in (b"{}", b"PS-DISCOVERY-REPLY", b"PS-DISCOVERY-REPLY[]", b'PS-DISCOVERY-REPLY{"serial": "F0"}'):
                box.sendto(said, asker)

        thread = threading.Thread(target=answer)
        thread.start()
        assert next(discover(PATIENCE_S, [box.getsockname()])) == ("127.0.0.1", "F0")
        thread.join()
    assert list(discover(0.01, [("127.0.0.1", 9)])) == []


# Config and sequences


@pytest.mark.parametrize(
    "wrong",
    [
        *({"port": ""}, {"clock": "external"}, {"hold": "software"}, {"gate_output": 8}, {"gate_output": -1}),
        *({"gate_output": 2}, {"trigger_pulse": "1 us"}),  # the marker's; a PrawnDO's
    ],
)
def test_a_config_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        PulseStreamerConfig.model_validate({"port": "192.168.1.10", **wrong})
    with pytest.raises(ValidationError):
        PulseStreamerConfig.model_validate({key: value for key, value in wrong.items() if key != "port"})


def test_open_refuses_a_wrong_setting_and_an_address_that_is_none() -> None:
    with pytest.raises(LimitExceeded, match=r"clock: .*; correct this argument"):
        PulseStreamer.open("192.168.1.10", clock="10 MHz")
    for address in (":8050", "box:", "box:x", "box:0", "box:65536", "box:\u0661", "[::1]:8050"):
        with pytest.raises(DeviceNotFound, match="write 'port' as host or host:port"):
            JsonRpc("Pulse Streamer", address)


def test_programs_become_sequences() -> None:
    sweep = [(1_000_000, 0, 0, 0), (5_000_000, 0b010, 0, 0), (1_000_000, 0, 0, 0)]
    for sequence, steps, sweeps, waits in (
        (compiled(*SWEEP, repeats=7), sweep, 7, True),
        (compiled(*SWEEP, *SWEEP, repeats=7), sweep, 14, True),
        (compiled(GATE, DARK, repeats=3), sweep[1:], 3, False),
    ):
        assert (sent(sequence), sequence.sweeps, sequence.waits, sequence.rest) == (steps, sweeps, waits, 0)
    assert base64.b64decode(compiled(Pulse(OUT_GATE, 1e-6)).encoded) == bytes((0, 0, 0x03, 0xE8, 2, 0, 0, 0, 0))
    pins = OutputPins(frame=7, gate=5, marker=0)
    all_high = Pulse(OUT_FRAME | OUT_GATE | OUT_MARKER, 1e-6)
    sequence = compiled(Pulse(OUT_MARKER, None), all_high, Pulse(OUT_GATE, 1e-6), pins=pins)
    assert ([step[1] for step in sent(sequence)], sequence.rest) == ([0b1010_0001, 0b0010_0000], 1)
    (first, *parts) = [step[0] for step in sent(compiled(Pulse(0, 10.6e-9), Pulse(0, 2.5 * MAX_TICKS * 1e-9)))]
    assert (first, len(parts), sum(parts)) == (11, 3, round(2.5 * MAX_TICKS))


def held(duration_s: float) -> Pulse:
    return Pulse(OUT_GATE, duration_s, held=True)


OTHER = (WAIT, DARK, Pulse(OUT_GATE, 4e-3), DARK)
HELD = "held by the scan marker .* set hold: external"


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
        ((WAIT, held(1.1 * HOLD_S)), HELD),
        ((WAIT, Pulse(0, HOLD_S), held(0.1 * HOLD_S)), HELD),  # short, but the marker may have fallen long before
        ((WAIT, held(0.4 * HOLD_S), Pulse(0, HOLD_S), held(0.4 * HOLD_S)), HELD),
        ((held(1e-6), DARK), HELD),  # never waits, so nobody knows of a marker
    ],
)
def test_what_the_box_cannot_play_is_refused_in_one_line(pulses: tuple[Pulse, ...], said: str) -> None:
    with pytest.raises(LimitExceeded, match=said) as refused:
        compiled(*pulses)
    assert "\n" not in str(refused.value)
    if said == HELD:
        assert sent(compiled(*pulses, external_hold=True))


def test_a_held_pulse_that_ends_soon_after_the_markers_edge_is_played() -> None:
    pulses = (WAIT, Pulse(0, 0.5 * HOLD_S), held(0.5 * HOLD_S), DARK)
    assert compiled(*pulses, *pulses).sweeps == 2


# Counting


def ends_at_s(count: SweepCount, begins_s: list[float], pause_s: Callable[[float], float]) -> float:
    """Time of the answer at which the count says that all is over, if sweeps of 10 ms begin at these times. An answer
    takes 1 ms and is true half-way."""
    asked_s = 0.0
    while True:
        answered_s = asked_s + 1e-3
        plays = any(begin <= asked_s + 0.5e-3 < begin + 0.01 for begin in begins_s)
        if count.take(asked_s, answered_s, plays):
            return answered_s
        assert answered_s < 10, "never over"
        asked_s = answered_s + pause_s(answered_s)


@pytest.mark.parametrize("pause_s", [1e-3, 2e-3, 5e-3, 50e-3])
def test_sweeps_are_counted_whether_or_not_the_pause_between_them_is_seen(pause_s: float) -> None:
    begins_s = [0.1 + index * (0.01 + pause_s) for index in range(21)]
    count = SweepCount(20, 0.01, 0.0)
    over_s = ends_at_s(count, begins_s, count.pause_s)
    assert begins_s[19] + 0.01 <= over_s <= begins_s[20] + 0.01, "all 20 sweeps are whole, and the end is soon"


def test_none_is_counted_twice_however_often_and_too_few_if_rarely_asked() -> None:
    assert ends_at_s(SweepCount(2, 0.01, 0.0), [0.05, 0.5], lambda _: 1e-4) == pytest.approx(0.51, abs=3e-3)
    many = [0.012 * index for index in range(1, 1000)]
    assert ends_at_s(SweepCount(5, 0.01, 0.0), many, lambda _: 0.03) > 0.012 * 5 + 0.01
    count = SweepCount(2, 0.01, 0.0)
    assert not count.take(0.1, 0.102, True)
    assert not count.take(0.101, 0.103, False)  # overlaps: may be older than the one before
    assert not count.take(0.104, 0.105, True)
    assert count.done == 1


def test_the_box_is_asked_often_only_when_something_is_due() -> None:
    count = SweepCount(3, 10.0, 0.0)
    assert count.pause_s(0.0) == POLL_S
    count.take(0.001, 0.002, True)
    assert count.pause_s(0.002) == IDLE_POLL_S, "a sweep of 10 s has just begun"
    assert count.pause_s(9.99) == pytest.approx(0.01)
    assert count.pause_s(10.1) == POLL_S, "it may be over"
    for asked_s, pause_s in ((11.0, POLL_S), (13.0, IDLE_POLL_S)):  # the next one may begin at any time
        count.take(asked_s, asked_s + 0.1, False)
        assert count.pause_s(asked_s + 0.1) == pause_s


def test_a_box_that_refuses_is_not_asked_for_longer_on_a_busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pause of 5 ms takes 0.1 s here."""

    class Busy:
        now_s = 0.0

        def monotonic(self) -> float:
            return self.now_s

        def sleep(self, time_s: float) -> None:
            self.now_s += 0.1

    busy = Busy()
    with socket.socket() as server:  # bound, but it does not listen: connections are refused
        server.bind(("127.0.0.1", 0))
        rpc = JsonRpc("box", f"127.0.0.1:{server.getsockname()[1]}", None, 1.0)
        monkeypatch.setattr(pulsestreamer_rpc, "time", busy)
        with pytest.raises(DeviceDisconnected, match="refused"):
            rpc.ask("isStreaming", 0.3)
    assert 0.2 < busy.now_s < 0.5


def test_a_box_that_was_out_of_reach_is_taken_low_when_the_network_is_back() -> None:
    with pulse_box() as box, box.open() as device:
        device.program(SWEEP, 3)
        device.run()
        box.server.unplug()
        eventually(lambda: device.port_lost)
        box.server.plug()
        eventually(lambda: device.status.state == "aborted")
        box.trigger.pulse(box.now_s + 1e-3, 1e-3)
        box.clock.sleep(2e-3)
        assert box.pins == 0


@pytest.mark.parametrize("repeats", [1, 1000])
def test_a_box_that_is_deleted_while_its_program_waits_is_taken_low(
    repeats: int, caplog: pytest.LogCaptureFixture
) -> None:
    with pulse_box() as box:
        device = box.open()
        device.program(SWEEP, repeats)
        device.run()
        del device
        gc.collect()
        # Its thread may just ask.
        eventually(lambda: "may have been left playing; its outputs were taken low" in caplog.text)
        box.trigger.pulse(box.now_s + 1e-3, 1e-3)
        box.clock.sleep(2e-3)
        assert box.pins == 0


def test_a_box_that_fails_to_disarm_is_told_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the last sweep. Some firmware may keep the sequence, and play it at the next marker."""
    failed: list[str] = []
    call = JsonRpc.call

    def failing(rpc: JsonRpc, method: str, *params: Any) -> Any:
        if method == "setTrigger" and params[0] == SOFTWARE and not failed:
            failed.append(method)
            raise DeviceTimeout("no answer")
        return call(rpc, method, *params)

    with pulse_box() as box, box.open() as device:
        device.program(SWEEP, 1)
        device.run()
        monkeypatch.setattr(JsonRpc, "call", failing)
        box.trigger.pulse(box.now_s + 1e-3, 1e-3)
        eventually(lambda: failed and not device._may_play.is_set())
        assert device.status == SyncStatus("aborted", 0)
        assert device.port_lost


def test_a_raw_call_may_raise_the_gate(caplog: pytest.LogCaptureFixture) -> None:
    with pulse_box() as box:
        device = box.open()
        device.ask("getSerial")
        assert device.status.outputs == 0
        device.ask("constant", (0, 2, 0, 0))
        assert device.status.outputs is None  # the box cannot be asked for its levels
        del device
        gc.collect()
        assert "may have been left playing; its outputs were taken low" in caplog.text
        assert box.pins == 0


def test_a_box_that_is_forgotten_is_taken_low(caplog: pytest.LogCaptureFixture) -> None:
    with pulse_box() as box:
        device = box.open()
        device.program(SWEEP, 3)
        device.run()
        device._forgotten()  # as when Python ends
        assert "may have been left playing; its outputs were taken low" in caplog.text
        box.trigger.pulse(box.now_s + 1e-3, 1e-3)
        box.clock.sleep(2e-3)
        assert box.pins == 0
        device.close()
