"""A laser without a protocol: switched on, set and switched off by hand, and modulated by its TTL input.

The laser takes no commands and gives no answers, so all of `status` is what the driver assumes: the laser is on, at the
config's power, and shines whenever the gate is high. `emission` is therefore always True, `interlock_closed` and
`key_on` are None, and `armed` only means that `arm` was called, which logs a warning. `pause`, `disarm` and `close` do
not change the light, so `gate_only` is True. The only way to end it by software is a low gate: a scan whose sync source
cannot read its gate back low is refused, as with any laser. Use a laser whose light is off while nothing is connected
to its TTL input, or add a pull-down resistor.
"""

import logging
import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.errors import DeviceNotFound
from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.registry import Kind, KindConfig, Surroundings, alone, config_of
from drivers.transports.endpoints import EMULATED_PREFIX, resolve
from drivers.units import Watts, format_quantity

_log = logging.getLogger(__name__)

BY_HAND = "by hand, W: "
"""Begins the address that an emulating world gives to such a laser; the power that it is set to, in W, follows."""


class TtlConfig(KindConfig):
    """Config of a laser without a port: it is switched on by hand, and then shines while the gate is high."""

    kind: Literal["ttl"] = "ttl"
    power: Annotated[Watts, Field(gt=0)]
    """Power, in watts, that is set at the laser: that of its light while the gate is high."""
    max_power: Annotated[Watts, Field(gt=0)]
    """Most power, in watts, that this rig may ever send out."""
    port: str | None = None
    """ "emulated:NAME" for a laser of an emulating world. None: a real laser, which has no port."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.power > self.max_power:
            power, most = (format_quantity(value, "power") for value in (self.power, self.max_power))
            raise ValueError(f"power {power} is above max_power {most}; set the laser to less, and write that here")
        if self.port is not None and (not self.port.startswith(EMULATED_PREFIX) or self.port == EMULATED_PREFIX):
            raise ValueError(f"port is {self.port!r}, a laser that is switched by hand has none; leave it out")
        return self


class TtlLaser(LineLaser):
    """A laser that shines whenever the gate is high, whatever is called here."""

    def __init__(self, power_w: float) -> None:
        super().__init__("ttl laser")
        self._power_w = power_w
        self._armed = False

    @classmethod
    def open(cls, *, power_w: float, max_power_w: float | None = None) -> "TtlLaser":
        """A laser by itself, without a config file.

        power_w: power in watts that is set at the laser by hand. max_power_w: most power in watts that the laser may
        ever emit; None: `power_w`. Raises `LimitExceeded` for a power that is not possible.
        """
        most_w = power_w if max_power_w is None else max_power_w
        return create(config_of(TtlConfig, power_w=power_w, max_power_w=most_w), alone())

    @property
    def identity(self) -> str:
        """The name, and the power that is assumed; there is nothing to ask."""
        return f"{self.name} at {format_quantity(self._power_w, 'power')}, set by hand"

    @property
    def limits(self) -> LaserLimits:
        """Only the power that is set at the laser."""
        return LaserLimits(self._power_w, self._power_w)

    @property
    def gate_only(self) -> bool:
        """True: only the gate ends this laser's light."""
        return True

    def _do_status(self) -> LaserStatus:
        return LaserStatus(
            emission=True,
            armed=self._armed,
            interlock_closed=None,
            fault=None,
            key_on=None,
            warming_up=False,
            input_mode="digital",
        )

    def _do_arm(self, power_w: float) -> None:
        self._armed = True
        _log.warning(
            "%s: only the gate controls its light, and this program cannot switch it off. It must be on, at %s, and is "
            "to be switched off by hand",
            self._name,
            format_quantity(power_w, "power"),
        )

    def _do_pause(self) -> None:
        _log.info("%s: its light goes on while the gate is high", self._name)

    def _do_disarm(self) -> None:
        self._armed = False
        _log.warning("%s: not switched off, which must be done by hand; only a low gate keeps it dark", self._name)

    def _do_close(self) -> None:
        pass  # no port


def create(config: TtlConfig, surroundings: Surroundings) -> TtlLaser:
    """The laser. Raises `DeviceNotFound` for an emulated port without such a laser, or with one at another power."""
    if config.port is not None:
        at = resolve(config.port, surroundings.ports).address
        found = at.removeprefix(BY_HAND)
        if found == at:
            raise DeviceNotFound(f"ttl laser: the one at {config.port} is not switched by hand; set world.laser to ttl")
        if not math.isclose(float(found), config.power):
            emulated, power = (format_quantity(value, "power") for value in (float(found), config.power))
            raise DeviceNotFound(
                f"ttl laser: the one at {config.port} is set to {emulated} by hand, not {power}; make laser.power and "
                "world.ttl_power the same"
            )
    return TtlLaser(config.power)


KIND = Kind(config=TtlConfig, create=create)
