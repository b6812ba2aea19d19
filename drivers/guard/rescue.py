"""The guard itself is gone: the application opens the ports, which are free now, and lowers what it can."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DeviceBusy, DeviceError
from drivers.interfaces import LineLaser
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint, resolve
from drivers.transports.serial_port import SerialPort

_log = logging.getLogger(__name__)

FREE_S = 1.0
"""Time for the kernel to free the ports of a process that ended."""
_RETRY_S = 0.005
OFF_TIMES, OFF_GAP_S = 2, 0.11
"""`Kind.off` is sent so often, so far apart: a Cobolt heeds no command within 0.1 s of another (hardware.md 4.1), and
the guard may just have asked something."""


class Rescue:
    """Lowers gate and laser at the same time, each on a thread of its own."""

    def __init__(self, configs: Mapping[str, Any], ports: Mapping[str, Endpoint]) -> None:
        """Finds the drivers now: there will be no time to import them."""
        surroundings = Surroundings(SystemClock(), None, 0, ports)
        self._create: dict[str, Callable[[], Any]] = {}
        self._off: dict[str, tuple[Callable[[], Endpoint], bytes]] = {}
        for slot, config in configs.items():
            kind = lookup(slot, config.kind)
            self._create[slot] = partial(kind.create, config, surroundings)
            if kind.off is not None:
                self._off[slot] = partial(resolve, config.port, ports), kind.off(config)
        self._outcome: dict[str, str] = {}

    def run(self, slots: set[str], armed: bool) -> str:
        """Make the devices of these slots safe; returns what came of it, for a message. armed: the laser was."""
        threads = [
            threading.Thread(target=self._save, args=(slot, armed), name=f"rescue {slot}", daemon=True)
            for slot in slots
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return ", ".join(f"{slot}: {self._outcome[slot]}" for slot in sorted(slots)) or "no device was open"

    def _save(self, slot: str, armed: bool) -> None:
        try:
            if armed and slot in self._off:
                self._switch_off(slot)
            with _once_free(self._create[slot]) as device:
                if isinstance(device, LineLaser):
                    device.pause()
                    if armed:
                        device.disarm()
                else:
                    device.abort()
            self._outcome[slot] = "made safe by the application"
        except DeviceError as error:
            self._outcome[slot] = f"NOT made safe, {error}"
            _log.error("%s: %s", slot, error)

    def _switch_off(self, slot: str) -> None:
        """Off, before anything is asked: to open a laser that takes ten commands a second takes more than one."""
        place, off = self._off[slot]
        address = place().address
        port = _once_free(lambda: SerialPort(slot, address))
        try:
            for _ in range(OFF_TIMES):
                port.write(off)
                time.sleep(OFF_GAP_S)
        finally:
            port.close()


def _once_free(open_it: Callable[[], Any]) -> Any:
    ends_at = time.monotonic() + FREE_S
    while True:
        try:
            return open_it()
        except DeviceBusy:
            if time.monotonic() > ends_at:
                raise
            time.sleep(_RETRY_S)
