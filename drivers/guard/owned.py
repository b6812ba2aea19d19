"""A device that the guard owns: opened from its config, used through the application's messages, made safe at the end.

Each device has two lanes. A lane is a thread (`JobThread`) that does one job after the other.
"""

import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DeviceError
from drivers.interfaces import DeviceState, LineLaser, Pulse, SyncSource
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import Tap, TapFile

Job = Callable[[], object]


class JobThread:
    """A daemon thread that does jobs one after the other. An error in a job is only logged: the next job may be the one
    that switches the light off.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.PriorityQueue[tuple[int, int, Job]] = queue.PriorityQueue()
        self._order = itertools.count()
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def do(self, job: Job, *, first: bool = False) -> None:
        """Queue a job. first: put it before all jobs that were queued without `first`."""
        self._jobs.put((0 if first else 1, next(self._order), job))

    @property
    def idle(self) -> bool:
        """Whether nothing is queued or under way."""
        return self._jobs.unfinished_tasks == 0

    def _work(self) -> None:
        while True:
            _, _, job = self._jobs.get()
            try:
                job()
            except Exception:
                _log.exception("guard")
            finally:
                self._jobs.task_done()


_log = logging.getLogger(__name__)

RETRY_S = 0.1
"""Pause between attempts to make a device safe that does not answer or is not there."""


class GuardedDevice:
    """One device of the rig, with a lane for its ordinary jobs and another for jobs that must not wait for them."""

    def __init__(
        self,
        slot: str,
        config: dict[str, Any],
        ports: dict[str, str],
        tap: dict[str, Any] | None,
        watch: tuple[Callable[[DeviceError], object], Callable[[], bool]],
    ) -> None:
        """slot: "laser" or "sync". config: the device's config as JSON data. ports: addresses of emulated ports by
        name. tap: fields of the `TapFile` in which the port's traffic is recorded; None: nothing is recorded. watch:
        arguments of `LineLaser.watch`, which are passed while the device is an armed laser. Raises `UnknownKind`, or
        pydantic's `ValidationError` for a wrong config."""
        self.slot = slot
        self._watch = watch
        self.device: Any = None
        self.armed = False
        """Whether this is a laser that is to be disarmed if the application cannot go on."""
        self.emits = False
        """Whether this is a laser that shines through an open gate, judged by the calls made so far."""
        self.lane = JobThread(slot)
        self.urgent = JobThread(f"{slot}, urgent")
        self.enabling = False
        """Whether a method that may switch light on is under way on `lane`."""
        self.unsafe = False
        """Whether `try_safe` is to be called until it has succeeded."""
        self.trying = False
        self._next_try = 0.0
        self._trouble = ""
        kind = lookup(slot, config["kind"])
        endpoints = {name: Endpoint(address) for name, address in ports.items()}
        self._tap = None if tap is None else Tap(TapFile(**tap), slot)
        surroundings = Surroundings(SystemClock(), None, 0, endpoints, self._tap)
        model = kind.config.model_validate(config)
        self._create = partial(kind.create, model, surroundings)

    def open(self) -> dict[str, Any]:
        """Open the device; returns the properties that its proxy in the application can then tell without asking. May
        raise DeviceError."""
        self.device = self._create()
        about: dict[str, Any] = {"name": self.device.name, "identity": self.device.identity}
        if isinstance(self.device, LineLaser):
            limits = self.device.limits
            about["limits"] = [limits.min_power_w, limits.max_power_w]
            about["gate_only"] = self.device.gate_only
            about["changed"] = self.device.changed
        else:
            about["resolution_s"] = self.device.resolution_s
        return about

    def flush(self) -> None:
        """If the port's traffic is recorded, wait until what has passed so far is written."""
        if self._tap is not None:
            self._tap.flush()

    @property
    def port_lost(self) -> bool:
        """Whether the device's port has hung up, as far as its driver can tell without sending anything."""
        device = self.device
        if device is None or device.state is DeviceState.CLOSED:
            return False
        return bool(getattr(device, "port_lost", False))

    def call(self, verb: str, arguments: list[Any]) -> Any:
        """Call the method that a proxy asks for; returns a result that JSON can carry. May raise DeviceError."""
        device = self.device
        if isinstance(device, LineLaser):
            self.armed = (self.armed or verb == "arm") and verb != "disarm"
            self.emits = (self.emits or verb == "arm") and verb not in ("pause", "disarm")
            device.watch(*(self._watch if self.armed else (None,)))
        match verb:
            case "status":
                return asdict(device.status)
            case "arm":
                device.arm(*arguments)
                return device.changed
            case "program":
                pulses, repeats = arguments
                device.program([Pulse(*pulse) for pulse in pulses], repeats)
            case "most_repeats":
                return device.most_repeats([Pulse(*pulse) for pulse in arguments[0]])
            case "pause" | "disarm" | "run" | "gate_low" | "abort" | "close":
                getattr(device, verb)()
            case _:
                raise DeviceError(f"the guard knows no {self.slot}.{verb}")
        return None

    @property
    def due(self) -> bool:
        """Whether it is time for an attempt to make the device safe, and no attempt is under way."""
        return self.unsafe and not self.trying and time.monotonic() >= self._next_try

    def try_safe(self) -> None:
        """Try once to make the device safe: all outputs low, or the laser paused and, if it was armed, disarmed. A lost
        port is opened again first. A `DeviceError` is only logged, and `unsafe` then stays True. Runs on a lane."""
        try:
            if self.port_lost:
                self.device = self._create()  # DeviceError while it is not plugged in again
            if self.device is not None and self.device.state is not DeviceState.CLOSED:
                armed = self.armed
                make_safe(self.device, disarm=armed)
                self.armed = self.armed and not armed
            self.unsafe = False
        except DeviceError as error:
            if str(error) != self._trouble:
                _log.error("%s: %s", self.slot, error)
            self._trouble = str(error)
        finally:
            self._next_try = time.monotonic() + RETRY_S
            self.trying = False

    def calm(self) -> None:
        """Make the device dark during a method that may switch light on, or right after it. Errors are only logged."""
        try:
            make_safe(self.device, disarm=False)
        except DeviceError as error:
            _log.error("%s: %s", self.slot, error)


def make_safe(device: LineLaser | SyncSource, *, disarm: bool) -> None:
    """Take all outputs of a sync source low, or pause a laser and, if `disarm`, disarm it. May raise DeviceError."""
    if isinstance(device, SyncSource):
        device.abort()
        return
    device.pause()
    if disarm:
        device.disarm()
