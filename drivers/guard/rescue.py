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
from drivers.transports.endpoints import Endpoint

_log = logging.getLogger(__name__)

FREE_S = 1.0
"""Time for the kernel to free the ports of a process that ended."""
_RETRY_S = 0.005


class Rescue:
    """Lowers gate and laser at the same time, each on a thread of its own."""

    def __init__(self, configs: Mapping[str, Any], ports: Mapping[str, Endpoint]) -> None:
        """Finds the drivers now: there will be no time to import them."""
        surroundings = Surroundings(SystemClock(), None, 0, ports)
        self._create: dict[str, Callable[[], Any]] = {}
        for slot, config in configs.items():
            self._create[slot] = partial(lookup(slot, config.kind).create, config, surroundings)
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
            with self._open(slot) as device:
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

    def _open(self, slot: str) -> Any:
        ends_at = time.monotonic() + FREE_S
        while True:
            try:
                return self._create[slot]()
            except DeviceBusy:
                if time.monotonic() > ends_at:
                    raise
                time.sleep(_RETRY_S)
