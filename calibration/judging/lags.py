"""What directions and speeds are short of for lags that hold wherever the calibration is used."""

from collections.abc import Sequence

from calibration.model.lag_speeds import lag_groups, one_speed
from calibration.verdict import Reason

_SPEEDS = "scan both ways (scan.bidirectional), at two speeds or more (scan.exposures)"


def lag_lack(velocities_per_s: Sequence[float], *, mean_will_do: bool) -> list[Reason]:
    """Why sweeps at these signed velocities do not tell both lags.

    mean_will_do: planes found with the mean of both lags at one speed are right at that speed, both ways.
    """
    ways = {velocity > 0 for velocity in velocities_per_s}
    if not ways:
        return []
    if len(ways) == 1:
        way, other = ("up", "down") if True in ways else ("down", "up")
        text = f"only sweeps {way} were scanned; nothing tells the lag {other}, which is taken to be the same"
        return [Reason("one-way", text, 1.0, 2.0, _SPEEDS)]
    if len(lag_groups(velocities_per_s)) == 2 or (mean_will_do and one_speed(velocities_per_s)):
        return []
    text = "one speed each way tells a mean of the two lags only"
    return [Reason("one-speed", text, 1.0, 2.0, _SPEEDS)]
