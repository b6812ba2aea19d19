"""A line laser without key or warm-up, whose emission follows `arm` and `pause` at once: simulated, or recorded."""

from collections.abc import Callable

from drivers.interfaces import LaserLimits, LaserStatus, LineLaser


class PlainLaser(LineLaser):
    """Any power up to `max_power_w`. emit: told how much it emits under the gate, in W, whenever that changes."""

    def __init__(self, name: str, max_power_w: float, emit: Callable[[float], None] | None = None) -> None:
        super().__init__(name)
        self._limits = LaserLimits(0.0, max_power_w)
        self._emit = emit
        self._armed = self._emission = False

    @property
    def limits(self) -> LaserLimits:
        """From 0 W on."""
        return self._limits

    def _do_status(self) -> LaserStatus:
        return LaserStatus(
            emission=self._emission,
            armed=self._armed,
            interlock_closed=True,
            fault=None,
            key_on=None,
            warming_up=False,
            input_mode="digital",
        )

    def _do_arm(self, power_w: float) -> None:
        self._armed = True
        self._set(power_w, emission=True)

    def _do_pause(self) -> None:
        self._set(0.0, emission=False)

    def _do_disarm(self) -> None:
        self._do_pause()
        self._armed = False

    def _do_close(self) -> None:
        self._do_disarm()

    def _set(self, power_w: float, *, emission: bool) -> None:
        self._emission = emission
        if self._emit is not None:
            self._emit(power_w)
