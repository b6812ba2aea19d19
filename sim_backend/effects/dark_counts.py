"""Dark counts: detections without light, a rate per pixel with a heavy tail (`sim_backend.optics`)."""

from sim_backend.effects.setting import Array, Setting
from sim_backend.optics import dark_rates


class DarkCounts:
    """Steady detections of the sensor itself."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting

    def rate(self) -> Array:
        """Detections per second, float64 (rows, width)."""
        return dark_rates(self._setting.sensor, self._setting.view.u.shape)
