"""The one error of this package."""


class CalibrationError(ValueError):
    """A rig model that cannot be used: unreadable, inconsistent, for another sensor, or asked outside its range.

    The message is one line that names the thing, the value, the limit and the next step.
    """
