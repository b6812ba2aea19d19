"""An application in a process of its own, to be killed: arms, scans and beats, in the order that a scan does.

    python -m tests.wire.scans.guarded_application LASER_PATH SYNC_PATH [MODE]

Says "lit" once it scans. MODE: beat (default), hang (stops beating after "lit", asleep), spin (the same, computing),
vanish (exits at once after "lit").
"""

import os
import sys
import threading
import time

from drivers.errors import DeviceError
from drivers.guard import Guard
from drivers.interfaces import OUT_GATE, Pulse
from drivers.lasers.obis import ObisConfig
from drivers.sync.prawndo import PrawnDoConfig

POWER_W = 0.02
SWEEP_S = 0.012
SWEEP = (Pulse(0, None), Pulse(0, 0.001), Pulse(OUT_GATE, SWEEP_S - 0.003), Pulse(0, 0.001))


def main(laser_port: str, sync_port: str, mode: str = "beat") -> None:
    laser_config = ObisConfig.model_validate({"port": laser_port, "max_power": "50 mW", "silence": "1.5 s"})
    sync_config = PrawnDoConfig(port=sync_port)
    with Guard(laser=laser_config, sync=sync_config) as guard:
        laser, sync = guard.laser, guard.sync
        sync.program(SWEEP, 10_000)
        sync.gate_low()
        laser.arm(POWER_W)
        sync.run()
        guard.beat(0)
        print("lit", guard.pid, flush=True)
        frame = 0
        try:
            while True:
                frame += 100
                guard.beat(frame)
                if frame > 20_000 and mode != "beat":
                    misbehave(mode)
                time.sleep(0.001)
        finally:
            for step in (sync.abort, laser.pause):
                try:
                    step()
                except DeviceError as error:
                    print(f"{type(error).__name__}: {error}", flush=True)


def labour() -> None:
    """A thread that fights the beating one for the interpreter, and one that now and then does not let go of it."""

    def spin() -> None:
        while True:
            sum(range(1000))

    def hold() -> None:
        numbers = [(i * 7919) % 1_000_003 for i in range(100_000)]
        while True:
            sorted(numbers)  # one C call: 0.03 s on an idle machine, 0.1 s on a loaded one
            time.sleep(1.0)

    for work in (spin, hold):
        threading.Thread(target=work, daemon=True).start()


def misbehave(mode: str) -> None:
    print("now", flush=True)
    ends_at = time.monotonic() + 60
    while time.monotonic() < ends_at:
        if mode == "hang":
            time.sleep(60)
        elif mode == "vanish":
            os._exit(7)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except DeviceError as error:
        print(f"{type(error).__name__}: {error}", flush=True)
        sys.exit(3)
