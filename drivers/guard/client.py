"""The application's side of the guard. It starts the guard, talks to it, sends heartbeats, and makes the devices safe
itself if the guard is lost.
"""

import itertools
import logging
import os
import queue
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, cast

from drivers.errors import DeviceError, DeviceTimeout, GuardLost
from drivers.guard.channel import Channel, Heartbeat, Message, error_from, plain_ports
from drivers.guard.process import Rescue
from drivers.guard.watch import GuardLimits, WatchedProcess
from drivers.interfaces import Device, LaserLimits, LaserStatus, LineLaser, Pulse, SyncSource, SyncStatus
from drivers.registry import KindConfig
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import TapFile


class _Guarded(Device):
    """A device whose port the guard owns. about: properties that the guard read when it opened the device."""

    _slot: ClassVar[str]

    def __init__(self, guard: "Guard", about: dict[str, Any]) -> None:
        super().__init__(about["name"])
        self._guard, self._about = guard, about

    @property
    def identity(self) -> str:
        """The identity that the guard read."""
        return str(self._about["identity"])

    def _ask(self, verb: str, *arguments: Any) -> Any:
        return self._guard.ask(self._slot, verb, *arguments)

    def _lost_at_close(self, error: DeviceError) -> None:
        raise error  # a scan whose light could not be ended has not ended well

    def _do_close(self) -> None:
        if not self._guard.lost:
            self._ask("close")


class GuardedLaser(_Guarded, LineLaser):
    """A laser whose port the guard owns."""

    _slot = "laser"

    @property
    def limits(self) -> LaserLimits:
        """The limits that the guard read when it opened the laser."""
        return LaserLimits(*self._about["limits"])

    @property
    def gate_only(self) -> bool:
        """Whether only the gate ends the laser's light; the guard read this when it opened the laser."""
        return bool(self._about["gate_only"])

    def _do_status(self) -> LaserStatus:
        self._guard.laser_status = LaserStatus(**self._ask("status"))
        return self._guard.laser_status

    def _check_health(self) -> None:
        """Do nothing: `arm` in the guard checks already, and a slow laser need not be asked twice."""

    def _do_arm(self, power_w: float) -> None:
        self._guard.changed = self._ask("arm", power_w)

    def _do_pause(self) -> None:
        self._ask("pause")

    def _do_disarm(self) -> None:
        self._ask("disarm")


class GuardedSync(_Guarded, SyncSource):
    """A sync source whose port the guard owns."""

    _slot = "sync"

    @property
    def resolution_s(self) -> float:
        """The resolution that the guard read when it opened the device."""
        return float(self._about["resolution_s"])

    def most_repeats(self, pulses: Sequence[Pulse]) -> int | None:
        """Largest number of times that the device can repeat `pulses`, asked through the guard; None if there is no
        limit."""
        most: int | None = self._ask("most_repeats", _plain(pulses))
        return most

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        self._ask("program", _plain(pulses), repeats)

    def _do_run(self) -> None:
        self._ask("run")

    def _do_gate_low(self) -> None:
        self._ask("gate_low")

    def _do_abort(self) -> None:
        self._ask("abort")

    def _do_status(self) -> SyncStatus:
        return SyncStatus(**self._ask("status"))


_Proxy = TypeVar("_Proxy", GuardedLaser, GuardedSync)


def _plain(pulses: Sequence[Pulse]) -> list[list[Any]]:
    return [[pulse.outputs, pulse.duration_s, pulse.held] for pulse in pulses]


_log = logging.getLogger(__name__)

OPEN_S = 30.0
"""Time for the guard to start and open its devices. A laser that accepts ten commands a second is slow to open."""
ANSWER_S = {"arm": 180.0, "program": 20.0}
"""Time for the answer to a method. For `arm`, the `warm_up` of the laser's config is added."""
USUAL_ANSWER_S = 10.0
LOWER_S = 5.0
"""Longest wait for the rescue after the guard is gone."""
SILENCE_S = 2.0
"""A guard that gives no sign of life for this long, while this process is awake, counts as hung and is killed."""
BUSY_SILENCE_S = 5.0
"""The same limit for a guard that is at work or waits for a processor or a disk."""
_TICK_S = 0.01
_MAX_STEP_S = 0.1
_RESCUE_SWITCH_S = 5e-4
"""Longest time for which other threads keep the interpreter during a rescue; Python's default is 5 ms."""
_LOWERING = ("pause", "disarm", "gate_low", "abort")
_ENABLING = ("arm", "program", "run")


class Guard:
    """Owns laser and sync source in a separate process, from its creation to `close`.

    `laser` and `sync` raise what opening them raised, so that a rig can list all problems at once. A device whose
    config is None is not guarded. Thread-safe, except that only the source thread calls `beat` and `wait`.
    """

    def __init__(
        self,
        *,
        laser: KindConfig | None = None,
        sync: KindConfig | None = None,
        ports: Mapping[str, Endpoint] | None = None,
        limits: GuardLimits | None = None,
        tap: TapFile | None = None,
    ) -> None:
        """Start the guard without waiting until it has opened the devices.

        laser, sync: configs of the devices. ports: emulated ports by name. limits: None means the defaults of
        `GuardLimits`. tap: the file in which the guard records what passes the devices' ports. Raises `UnknownKind`, or
        `DeviceError` outside Linux.
        """
        configs = {slot: config for slot, config in (("laser", laser), ("sync", sync)) if config is not None}
        ports = ports or {}
        self._rescue = Rescue(configs, ports)
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._answers: dict[int, queue.SimpleQueue[Message | None]] = {}
        self._opened: dict[str, Message] = {}
        self._opening = {slot: threading.Event() for slot in configs}
        self._proxies: dict[str, Any] = {}
        self._armed = False
        self.changed: list[str] = []
        """The laser's settings that the guard has changed (`LineLaser.changed`), as far as it has told."""
        self._answer_s = ANSWER_S | {"arm": ANSWER_S["arm"] + getattr(laser, "warm_up", 0.0)}
        self.laser_status: LaserStatus | None = None
        """The laser's last report. The guard asks an armed laser every second and tells; to read this asks nothing."""
        self.failure: DeviceError | None = None
        """The reason why the guard switched the light off, or `GuardLost`; None while all is well."""
        self._lost = threading.Event()
        self._rescued = threading.Event()
        self._outcome = ""
        self._closing = False
        self._parted = False
        self._heartbeat = Heartbeat.create()
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = _start(theirs, self._heartbeat)
        self._seen = WatchedProcess(self._process.pid)
        self._channel = Channel(ours)
        self._reader = threading.Thread(target=self._listen, name="guard listener", daemon=True)
        self._reader.start()
        self._channel.send(
            {
                "open": {slot: config.model_dump(mode="json") for slot, config in configs.items()},
                "ports": plain_ports(ports),
                "tap": None if tap is None else asdict(tap),
                "limits": asdict(limits or GuardLimits()),
                "pid": os.getpid(),
                "listener": self._reader.native_id,
            },
            within_s=1.0,
        )

    @property
    def laser(self) -> LineLaser:
        """The guarded laser. Waits until it is open; raises `DeviceError` if it is not guarded or cannot be opened."""
        return self._proxy("laser", GuardedLaser)

    @property
    def sync(self) -> SyncSource:
        """The guarded sync source. Waits and raises errors as `laser` does."""
        return self._proxy("sync", GuardedSync)

    @property
    def lost(self) -> bool:
        """Whether the guard's process is gone; also True after `close`."""
        return self._lost.is_set()

    @property
    def pid(self) -> int:
        """Process id of the guard."""
        return self._process.pid

    def beat(self, frame: int) -> None:
        """Report the last frame number received. Call it on the source thread for every block; it only writes to
        memory. Raises `failure` if there is one."""
        self._heartbeat.waited_s = 0.0
        self._heartbeat.frame = frame
        if self.failure is not None:
            raise self.failure

    def wait(self, waited_s: float) -> None:
        """Report for how long the SPAD has been asked for frames without giving any. Call it on the source thread."""
        self._heartbeat.waited_s = waited_s

    def expect(self, limits: GuardLimits) -> None:
        """Apply other limits from now on, for example for a burst, which sends nothing until it is read out."""
        self._channel.send({"limits": asdict(limits)}, within_s=1.0)

    def ask(self, slot: str, verb: str, *arguments: Any) -> Any:
        """Have the guard call a device's method on behalf of a proxy; returns its result or raises its error.

        Raises `failure` instead of switching anything on, `DeviceTimeout` if the answer takes too long, and `GuardLost`
        if the guard is gone. A method that makes a device safe then first waits, at most `LOWER_S`, until the
        application has tried to make the devices safe itself.
        """
        if self.failure is not None and verb in _ENABLING:
            raise self.failure
        self._armed = self._armed or verb == "arm"
        number = next(self._numbers)
        inbox: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        with self._lock:
            self._answers[number] = inbox
        try:
            if self.lost:
                raise self._gone(verb)
            request = {"id": number, "slot": slot, "verb": verb, "arguments": arguments}
            self._channel.send(request, within_s=1.0)
            deadline_s = self._answer_s.get(verb, USUAL_ANSWER_S)
            answer = inbox.get(timeout=deadline_s)
        except queue.Empty:
            raise DeviceTimeout(f"{slot}: {verb} is not done after {deadline_s:g} s; check the device") from None
        finally:
            with self._lock:
                del self._answers[number]
        return self._told(answer, verb)["result"]

    def close(self) -> None:
        """Close both devices, which leaves them safe, and end the guard. A second call does nothing. Raises
        `DeviceError` if a device could not be left safe; the guard has ended even then."""
        if self._closing:
            return
        self._closing = True
        try:
            for proxy in (self._proxies.get("sync"), self._proxies.get("laser")):
                if proxy is not None and not self.lost:
                    proxy.close()
        finally:
            self._channel.send({"bye": True}, within_s=1.0)
            self._reader.join(timeout=OPEN_S)
            if self._process.poll() is None:
                self._process.kill()
                self._process.wait()
            self._channel.close()
            self._heartbeat.close()
            self._seen.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _proxy(self, slot: str, make: type[_Proxy]) -> _Proxy:
        if slot not in self._opening:
            raise DeviceError(f"{slot}: not guarded; open it by itself")
        if not self._opening[slot].wait(OPEN_S):
            raise DeviceTimeout(f"{slot}: the guard has not opened it after {OPEN_S:g} s; check the device")
        about = self._told(self._opened.get(slot), "open")["about"]
        with self._lock:
            if slot not in self._proxies:
                self._proxies[slot] = make(self, about)
            return cast(_Proxy, self._proxies[slot])

    def _told(self, answer: Message | None, verb: str) -> Message:
        """The answer. If it carries an error, raises that. Raises `GuardLost` if it is None: the guard is gone."""
        if answer is None:
            raise self._gone(verb)
        if "error" in answer:
            raise error_from(answer["error"])
        return answer

    def _gone(self, verb: str) -> GuardLost:
        if verb in _LOWERING:
            self._rescued.wait(LOWER_S)
        outcome = f" ({self._outcome})" if self._outcome else ""
        return GuardLost(f"{verb}: the process that guards the laser is gone{outcome}; check the laser, start again")

    # On the listener's thread

    def _listen(self) -> None:
        silent_s, before, begun, noted = 0.0, time.monotonic(), False, False
        while True:
            ready, _, _ = select.select([self._channel], [], [], _TICK_S)
            messages = self._channel.receive() if ready else []
            if messages is None:
                return self._end()
            for message in messages:
                self._take(message)
            self._channel.flush()
            now = time.monotonic()
            silent_s += min(now - before, _MAX_STEP_S)
            before = now
            if messages:
                silent_s, begun, noted = 0.0, True, False
                continue
            if not noted:
                noted = True
                self._seen.note_progress()
            if self._hangs(silent_s, begun):
                _log.error("the laser guard hangs; ending it")
                self._process.kill()
                silent_s = 0.0

    def _hangs(self, silent_s: float, begun: bool) -> bool:
        if not begun:
            return silent_s > OPEN_S
        if self._seen.stopped or silent_s > BUSY_SILENCE_S:
            return True
        return silent_s > SILENCE_S and not self._seen.busy()

    def _take(self, message: Message) -> None:
        if "opened" in message:
            self._opened[message["opened"]] = message
            self.changed = message.get("about", {}).get("changed", self.changed)
            self._opening[message["opened"]].set()
        elif "laser_status" in message:
            self.laser_status = LaserStatus(**message["laser_status"])
        elif "tripped" in message:
            self.failure = error_from(message["tripped"])
        elif "id" in message:
            with self._lock:
                inbox = self._answers.get(message["id"])
            if inbox is not None:
                inbox.put(message)
        elif "bye" in message:
            self._parted = True

    def _end(self) -> None:
        """Handle the end of the guard. If it ended without a goodbye, make the devices safe from this process."""
        if self._parted:
            self._lost.set()
        else:
            self.failure = self.failure or GuardLost("the process that guards the laser is gone; check the laser")
            self._lost.set()
            self._release()
            sys.setswitchinterval(_RESCUE_SWITCH_S)
            slots = {slot for slot, answer in self._opened.items() if "about" in answer}
            self._outcome = self._rescue.run(slots, self._armed, self.changed)
            _log.error("the laser guard is gone; %s", self._outcome)
        self._process.wait()
        self._rescued.set()
        self._release()

    def _release(self) -> None:
        """Tell everybody who waits for an answer that none will come."""
        with self._lock:
            waiting = list(self._answers.values())
        for inbox in waiting:
            inbox.put(None)
        for event in self._opening.values():
            event.set()


def _start(theirs: socket.socket, heartbeat: Heartbeat) -> "subprocess.Popen[bytes]":
    """Start the guard's process in a session of its own: no Ctrl-C, no closed terminal reaches it."""
    package_root = str(Path(__file__).parents[2])
    paths = [package_root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return subprocess.Popen(
        [sys.executable, "-m", "drivers.guard", str(theirs.fileno()), str(heartbeat.handle)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=(theirs.fileno(), heartbeat.handle),
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))},
    )
