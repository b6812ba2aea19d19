"""The guard's own process: carries out what the application asks, and watches the application meanwhile.

The main thread never touches a device. It reads messages, looks at the application every 10 ms and queues jobs for the
threads of the devices (lanes, see `drivers.guard.owned`). The light is ended (a "trip") when the application ends, is
stopped or takes no frames; when a port hangs up; when the laser reports an open interlock or a fault, or falls silent;
or when the guard is told to end. In a trip all outputs of the gate go low; at the same time the laser is paused and, if
it was armed, disarmed. An application that was stopped or took no frames is killed, unless it makes its rig safe in
time. The ports are closed when the guard ends. If frames stop only because the gate's program has ended, there is no
trip; the laser is just paused. "The gate" in this module is the sync source, which drives the gate.

`Rescue` is for the opposite case, when the guard is gone: the application opens the ports, which are free then, and
makes the devices safe as far as it can.
"""

import logging
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict
from functools import partial
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DeviceBusy, DeviceDisconnected, DeviceError, DeviceFault, DeviceTimeout, InterlockOpen
from drivers.guard.channel import Channel, Heartbeat, Message, error_message
from drivers.guard.owned import GuardedDevice, make_safe
from drivers.guard.watch import TICK_S, FrameWatch, GuardLimits, WatchedProcess, host_overloaded
from drivers.interfaces import DeviceState, LineLaser
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from drivers.transports.serial_port import SerialPort, configured_port

_log = logging.getLogger(__name__)

SIGN_OF_LIFE_S = 0.05
"""Time between the guard's own signs of life."""
POLL_S = 1.0
"""Time between questions to an armed laser about interlock and faults: at most 1 s
(docs/reference/hardware.md, Lasers on a serial line)."""
ALIVE_S = 0.1
"""Time from the last question to an armed laser to the next one, which only shows that its firmware still runs. With
the kind's `silence`, `drivers.transports.dialogue.AGAIN_S` and the time to lower the gate, the light of a laser that
hangs is off within 500 ms. An overloaded host waits longer (`host_overloaded`)."""
END_CHECK_S = 0.2
"""Time between checks whether the gate's program has ended, while an application at work is late with its frames."""
GATE_FIRST_S = 0.1
"""Delay before a stopped application is killed, so that the gate is low first: once the application is dead, the mirror
may stand still."""
GIVE_UP_S = 10.0
"""Time after which the guard gives up making a device safe that does not answer."""

_URGENT = ("gate_low", "abort", "pause", "disarm")
_ENABLING = ("arm", "program", "run")


class GuardProcess:
    """The guard of one application. `run` returns the exit code: 0 after a normal end, 1 if the guard had to act."""

    def __init__(self, channel: Channel, heartbeat: Heartbeat) -> None:
        self._channel = channel
        self._heartbeat = heartbeat
        self._watch = FrameWatch(GuardLimits())
        self._owned: dict[str, GuardedDevice] = {}
        self._application: WatchedProcess | None = None
        self._tripped: DeviceError | None = None
        self._trip_lock = threading.Lock()
        self._kill_at: float | None = None
        self._safe_asked = False
        self._ending = False
        self._check_until: float | None = None
        self._next_end_check = 0.0
        self._silence_noted = False
        self._next_poll = self._next_alive = 0.0
        self._terminated = False

    def run(self) -> int:
        """Serve the application until it says goodbye or is gone, or the signal SIGTERM tells the guard to end. Then
        leave the devices safe and close them; returns the exit code. Must run on the main thread."""
        signal.signal(signal.SIGTERM, self._on_terminate)
        before = seen = time.monotonic()
        while not self._ending:
            for message in self._receive():
                self._take(message)
            now = time.monotonic()
            self._look(now - before)
            before = now
            if now - seen >= SIGN_OF_LIFE_S:
                seen = now
                self._channel.send({"alive": True})
            self._channel.flush()
        return self._end()

    def _on_terminate(self, number: int, frame: object) -> None:
        self._terminated = True

    # Messages

    def _receive(self) -> list[Message]:
        """The messages that come within a tick. If the application is gone, ends the light and lets `run` end."""
        sources = [self._channel.fileno()]
        if self._application is not None and self._application.handle is not None:
            sources.append(self._application.handle)
        ready, _, _ = select.select(sources, [], [], TICK_S)
        messages = self._channel.receive() if self._channel.fileno() in ready else []
        gone = self._application is not None and self._application.ended
        if messages is None or gone:
            self._trip(DeviceDisconnected("the application is gone"))
            self._ending = True
            return []
        return messages

    def _take(self, message: Message) -> None:
        if "open" in message:
            self._open(message)
        elif "limits" in message:
            self._watch.limits = GuardLimits(**message["limits"])
        elif "bye" in message:
            self._ending = True
        else:
            self._request(message)

    def _open(self, message: Message) -> None:
        self._application = WatchedProcess(message["pid"], message["listener"])
        self._watch.limits = GuardLimits(**message["limits"])
        for slot, config in message["open"].items():
            try:
                owned = GuardedDevice(slot, config, message["ports"], message["tap"], (self._trip, host_overloaded))
            except Exception as error:  # a config that is unusable here is reported to the application
                self._channel.send({"opened": slot, "error": error_message(error)})
                continue
            self._owned[slot] = owned
            owned.lane.do(partial(self._open_one, owned))

    def _open_one(self, owned: GuardedDevice) -> None:
        answer: Message
        try:
            answer = {"opened": owned.slot, "about": owned.open()}
        except Exception as error:
            answer = {"opened": owned.slot, "error": _told(error)}
        self._channel.send(answer)

    def _request(self, message: Message) -> None:
        slot, verb = message["slot"], message["verb"]
        owned = self._owned[slot]
        if verb == "run":
            self._watch.start(self._heartbeat.frame)
        if verb in _URGENT or verb == "close":
            self._safe_asked = True
        lane = owned.urgent if verb in _URGENT else owned.lane
        lane.do(lambda: self._answer(owned, message))
        if verb in _URGENT and owned.enabling:
            owned.lane.do(owned.calm)  # undoes what the overtaken method may still do

    def _answer(self, owned: GuardedDevice, message: Message) -> None:
        """Call a device's method and send its result or error. Runs on one of the device's lanes."""
        verb = message["verb"]
        answer: Message = {"id": message["id"]}
        with self._trip_lock:
            refused = self._tripped if verb in _ENABLING else None
            owned.enabling |= verb in _ENABLING and refused is None
        try:
            if refused is not None:
                raise refused
            answer["result"] = owned.call(verb, message["arguments"])
        except Exception as error:
            answer["error"] = _told(error)
        finally:
            if verb in _ENABLING:
                owned.enabling = False
        lowers = verb in ("gate_low", "abort", "close")
        if owned.slot == "sync" and ((lowers and "error" not in answer) or (verb == "run" and "error" in answer)):
            self._watch.stop()  # no light can come out any more
        self._channel.send(answer)

    # Watching

    def _look(self, elapsed_s: float) -> None:
        """Look at the application and the devices once, at every tick."""
        if self._terminated:
            self._trip(DeviceFault("the guard was told to end"))
            self._ending = True
        for owned in self._owned.values():
            if self._tripped is None and owned.port_lost:
                what = f"{owned.device.name}: its port or its program is lost"
                self._trip(DeviceDisconnected(f"{what}; check power, cable and other programs that use it"))
        if self._application is not None:
            self._look_at(self._application, elapsed_s)
        self._make_safe()
        self._poll_laser(time.monotonic())

    def _look_at(self, application: WatchedProcess, elapsed_s: float) -> None:
        watch, frame = self._watch, self._heartbeat.frame
        if frame != watch.last:
            self._silence_noted = False
        elif watch.watching and not self._silence_noted:  # slow, since it looks at every thread; seldom needed
            self._silence_noted = True
            application.note_progress()
        emits = any(owned.emits for owned in self._owned.values())
        stopped = (watch.watching or emits) and application.stopped
        trouble = watch.look(elapsed_s, frame, stopped, application.busy, self._heartbeat.waited_s)
        now = time.monotonic()
        if trouble is not None:
            self._suspect(trouble, stopped, now)
        elif watch.quiet and now >= self._next_end_check:
            self._next_end_check = now + END_CHECK_S
            sync = self._owned.get("sync")
            if sync is not None and sync.lane.idle:
                sync.lane.do(lambda: self._note_end(sync))
        if self._kill_at is not None and now >= self._kill_at:
            self._kill_at = None
            if not self._safe_asked:
                _log.error("guard: killing the application")
                application.kill()

    def _suspect(self, trouble: str, stopped: bool, now: float) -> None:
        """Trip the application. If it is not stopped, ask the gate first, and do nothing if its program has ended."""
        sync = self._owned.get("sync")
        if stopped or sync is None or (self._check_until is not None and now > self._check_until):
            self._trip_application(trouble, stopped)
        elif self._check_until is None:
            self._check_until = now + self._watch.limits.check_s
            sync.urgent.do(lambda: self._check_end(sync, trouble), first=True)

    def _check_end(self, sync: GuardedDevice, trouble: str) -> None:
        """Trip the application unless the gate's program has ended by itself. Runs on one of the gate's lanes."""
        if not self._note_end(sync):
            self._trip_application(f"{trouble}; check the SPAD's cable and trigger, or unload the computer", False)
        self._check_until = None

    def _note_end(self, sync: GuardedDevice) -> bool:
        """Whether the gate's program has ended. If so, stops watching and pauses the laser. Runs on a gate's lane."""
        try:
            status = sync.device.status
        except DeviceError:
            return False
        if status.state != "stopped" or status.outputs != 0:
            return False
        self._watch.stop()
        laser = self._owned.get("laser")
        if laser is not None and laser.emits and not laser.enabling:
            laser.urgent.do(lambda: self._rest(laser))  # later requests of the application queue behind it
        return True

    def _rest(self, laser: GuardedDevice) -> None:
        """Pause the laser after the end of the gate's program. Runs on the laser's urgent lane."""
        try:
            laser.call("pause", [])
        except DeviceError as error:
            if laser.device.state is not DeviceState.CLOSED:
                self._trip(error)

    def _trip_application(self, trouble: str, stopped: bool) -> None:
        self._safe_asked = False
        if self._trip(DeviceTimeout(f"the guard took the light: the application {trouble}")):
            self._kill_at = time.monotonic() + (GATE_FIRST_S if stopped else self._watch.limits.help_itself_s)

    def _poll_laser(self, now: float) -> None:
        laser = self._owned.get("laser")
        if self._tripped is not None or laser is None or not laser.armed or not laser.lane.idle:
            return
        if now >= self._next_poll:
            self._next_poll = now + POLL_S
            laser.lane.do(lambda: self._ask_laser(laser))
        elif now >= self._next_alive:
            laser.lane.do(lambda: self._check_alive(laser))
        else:
            return
        self._next_alive = now + ALIVE_S

    def _check_alive(self, laser: GuardedDevice) -> None:
        """Ask the laser, on its lane, for a sign of life. Its silence trips by itself (`LineLaser.watch`)."""
        with suppress(DeviceError):  # what else is wrong, the next question about faults shows
            laser.device.check_alive()

    def _ask_laser(self, laser: GuardedDevice) -> None:
        """Ask the laser, on its lane, about interlock and faults; a second time if an answer is missing or garbled."""
        device: LineLaser = laser.device
        for attempt in range(2):
            try:
                status = device.status
            except DeviceError as error:
                if device.state is DeviceState.CLOSED or self._tripped is not None:  # by an earlier job, or by silence
                    return
                if attempt:
                    self._trip(error)
                continue
            self._channel.send({"laser_status": asdict(status)})
            if status.interlock_closed is False:
                self._trip(InterlockOpen(f"{device.name}: the interlock is open; close it and start again"))
            elif status.fault is not None:
                self._trip(DeviceFault(f"{device.name}: fault {status.fault}; clear it at the laser and start again"))
            return

    # Ending the light

    def _trip(self, cause: DeviceError) -> bool:
        """Take the gate low and pause the laser, at once, whatever else is under way. Returns False if that was done
        before.
        """
        with self._trip_lock:
            if self._tripped is not None:
                return False
            self._tripped = cause
        for owned in self._owned.values():
            if owned.enabling:  # dark at once, and again (`try_safe`) behind the method that switches light on
                owned.urgent.do(owned.calm, first=True)
            owned.unsafe = True
        self._make_safe()
        _log.error("guard: %s", cause)
        self._channel.send({"tripped": error_message(cause)})
        return True

    def _make_safe(self) -> None:
        """Queue an attempt to make a device safe, for each device that is `due`."""
        with self._trip_lock:
            due = [owned for owned in self._owned.values() if owned.due]
            due.sort(key=lambda owned: owned.slot != "sync")  # the gate is the faster one, and ends the light alone
            for owned in due:
                owned.trying = True
        for owned in due:
            lane = owned.lane if owned.enabling else owned.urgent
            lane.do(owned.try_safe, first=True)

    def _end(self) -> int:
        """Make those devices safe that are not safe yet, and close all; returns the exit code."""
        ends_at = time.monotonic() + GIVE_UP_S
        while any(owned.unsafe for owned in self._owned.values()) and time.monotonic() < ends_at:
            self._make_safe()
            time.sleep(TICK_S)
        for owned in self._owned.values():
            try:
                if owned.device is not None:
                    owned.device.close()
            except Exception as error:  # the next device is still closed
                _log.error("%s: %s", owned.slot, error)
        for owned in self._owned.values():
            owned.flush()
        self._channel.send({"bye": True}, within_s=0.1)
        return 0 if self._tripped is None else 1


def _told(error: Exception) -> list[str]:
    """The content of a message that carries an error. If it is no `DeviceError`, it is a fault in the guard: log it."""
    if not isinstance(error, DeviceError):
        _log.exception("guard")
    return error_message(error)


def main(arguments: list[str]) -> int:
    """Run the guard; returns its exit code. arguments: file descriptors, as text, of the socket to the application and
    of the memory page shared with it (`Heartbeat`)."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.raiseExceptions = False  # the terminal may be gone before the light is
    end, page = (int(argument) for argument in arguments)
    return GuardProcess(Channel(socket.socket(fileno=end)), Heartbeat(page)).run()


FREE_S = 1.0
"""Time for the kernel to free the ports of a process that ended."""
_RETRY_S = 0.005


OFF_TIMES = 2
"""Number of times that `Kind.off` is sent: the laser may ignore the first, since the guard may just have asked it."""


class Rescue:
    """Makes gate and laser safe from the application once the guard is gone: at the same time, each on its own
    thread."""

    def __init__(self, configs: Mapping[str, Any], ports: Mapping[str, Endpoint]) -> None:
        """Import the drivers now, since a rescue leaves no time for that. configs: by slot ("laser" or "sync"). ports:
        emulated ports by name. Raises `UnknownKind`."""
        surroundings = Surroundings(SystemClock(), None, 0, ports)
        self._create: dict[str, Callable[[], Any]] = {}
        self._off: dict[str, tuple[Callable[[], SerialPort], bytes]] = {}
        for slot, config in configs.items():
            kind = lookup(slot, config.kind)
            self._create[slot] = partial(kind.create, config, surroundings)
            if kind.off is not None:
                self._off[slot] = partial(configured_port, slot, config, ports), kind.off(config)
        self._outcome: dict[str, str] = {}

    def run(self, slots: set[str], armed: bool, changed: Sequence[str] = ()) -> str:
        """Make the devices of these slots safe; returns the outcome as text for a message. armed: whether the laser was
        armed. changed: the laser's settings that the guard had changed (`LineLaser.changed`), as far as is known.
        """
        threads = [threading.Thread(target=self._save, args=(slot, armed, changed), daemon=True) for slot in slots]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return ", ".join(f"{slot}: {self._outcome[slot]}" for slot in sorted(slots)) or "no device was open"

    def _save(self, slot: str, armed: bool, changed: Sequence[str]) -> None:
        try:
            if armed and slot in self._off:
                with suppress(Exception):  # opening the device is tried all the same, and shows what is wrong
                    self._switch_off(slot)
            with _once_free(self._create[slot]) as device:
                if isinstance(device, LineLaser):
                    device.adopt(changed)
                make_safe(device, disarm=armed)
                dark = not (isinstance(device, LineLaser) and device.gate_only)
            self._outcome[slot] = "made safe by the application" if dark else "NOT switched off, only its gate ends it"
        except Exception as error:  # also a fault in a driver: the outcome must name both devices
            self._outcome[slot] = f"NOT made safe, {error}"
            _log.error("%s: %s", slot, error)

    def _switch_off(self, slot: str) -> None:
        """Switch the emission off before anything is asked: opening a slow laser takes more than a second."""
        open_port, off = self._off[slot]
        with closing(_once_free(open_port)) as port:
            port.write_again(off, OFF_TIMES)


def _once_free(open_it: Callable[[], Any]) -> Any:
    ends_at = time.monotonic() + FREE_S
    while True:
        try:
            return open_it()
        except DeviceBusy:
            if time.monotonic() > ends_at:
                raise
            time.sleep(_RETRY_S)
