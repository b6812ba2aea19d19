"""Random faults on the wire of a Cobolt laser: every sequence ends right or in one of our errors, in time.

python -m tests.campaigns.devices.cobolt_faults --sequences 10000 --seed 1
"""

import random
from typing import cast

from drivers.interfaces import LineLaser
from drivers.lasers.cobolt import CoboltConfig, create
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from sim_backend.wire.firmware.cobolt import CoboltModel, Family
from tests.campaigns.devices.laser_sequences import GAP_S, LIMIT_W, LaserModel, Subject, run

TIMING = LineTiming(gap_s=GAP_S, reply_s=0.03, quiet_s=0.01, drain_s=0.05)
"""The gap is mostly virtual time."""


class Model(CoboltModel):
    """With what the campaign asks."""

    def told_power_w(self) -> float:
        """Of its mode."""
        return self.modulation_power_w if self.mode == "modulation" else self.constant_power_w

    def is_off(self) -> bool:
        """`l0` was heard."""
        return not self.on


def make(rng: random.Random) -> LaserModel:
    family = cast(Family, rng.choice(("06-MLD", "06-01")))
    model = Model(
        family, autostart=rng.random() < 0.5, warm_up_s=rng.choice((0.0, 5.0)), junk=rng.choice((b"", b"", b"\xff>"))
    )
    if rng.random() < 0.3:
        model.shine(0.05, gated=rng.random() < 0.5)
    if rng.random() < 0.2:
        model.mode = "modulation"  # with an input or without one
    return model


def open_laser(model: LaserModel, surroundings: Surroundings) -> LineLaser:
    return create(CoboltConfig(port="emulated:laser", max_power=f"{LIMIT_W} W"), surroundings, TIMING)  # type: ignore[arg-type]


SUBJECT = Subject(make, open_laser)

if __name__ == "__main__":
    run(SUBJECT, __doc__)
