"""Random faults on the wire of an OBIS laser: every sequence ends right or in one of our errors, in time.

python -m tests.campaigns.devices.obis_faults --sequences 10000 --seed 1
"""

import random
from typing import cast

from drivers.interfaces import LineLaser
from drivers.lasers.obis import ObisConfig, create
from drivers.registry import Surroundings
from drivers.transports.dialogue import LineTiming
from sim_backend.wire.firmware.obis import ObisModel
from tests.campaigns.devices.laser_sequences import LIMIT_W, LaserModel, Subject, run

TIMING = LineTiming(reply_s=0.03, quiet_s=0.01, drain_s=0.05)


class Model(ObisModel):
    """With what the campaign asks."""

    def told_power_w(self) -> float:
        """What it was set to."""
        return self.set_power_w

    def is_off(self) -> bool:
        """Neither on nor about to be."""
        return not self.state_on


def make(rng: random.Random) -> LaserModel:
    model = Model(
        handshake=rng.random() < 0.5,
        channel=rng.choice((None, None, 2)),
        warm_up_s=rng.choice((0.0, 0.0, 3.0)),
        cdrh_delay_s=rng.choice((0.0, 5.0)),
    )
    if rng.random() < 0.3:
        model.shine(0.05, gated=rng.random() < 0.5)
    return model


def open_laser(model: LaserModel, surroundings: Surroundings) -> LineLaser:
    channel = cast(Model, model).channel
    config = ObisConfig(port="emulated:laser", max_power=f"{LIMIT_W} W", channel=channel)  # type: ignore[arg-type]
    return create(config, surroundings, TIMING)


SUBJECT = Subject(make, open_laser)

if __name__ == "__main__":
    run(SUBJECT, __doc__)
