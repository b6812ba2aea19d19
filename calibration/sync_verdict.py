"""The verdict on lag and row delay, by the depth error that their uncertainty makes."""

from calibration.model import RigModel
from calibration.sensitivity import sensitivity
from calibration.sync_fit import SyncFit
from calibration.verdict import Asked, Reason, Verdict

_SPEEDS = "scan at two speeds or more, both ways"
_STILL = "check that nothing moved between the sweeps, or calibrate at the speed of your scans"


def judge_sync(fit: SyncFit, model: RigModel | None, asked: Asked | None) -> Verdict:
    """Judge a fit. model, asked: of the rig, None where nothing tells what a lag is worth in depth."""
    found = []
    if not fit.steady:
        text = (
            f"the lag is not the same at all speeds: chi squared {fit.chi2:.1f} for {fit.dof} degrees of freedom; it "
            "holds for the speeds scanned only"
        )
        found.append(Reason("lag-by-speed", text, fit.chi2, float(fit.dof), _STILL))
    if fit.common:
        text = "one speed both ways tells the mean of the two lags only"
        found.append(Reason("one-speed", text, 1.0, 2.0, _SPEEDS))
    if len(fit.told) < 2:
        text = f"only sweeps {'up' if 1 in fit.told else 'down'} were scanned; the other lag is taken to be the same"
        found.append(Reason("one-way", text, 1.0, 2.0, _SPEEDS))
    if model is not None and asked is not None:
        worth_m = sensitivity(model, asked.at_m).per_command_m * fit.speed_range_per_s[1]
        error_m = worth_m * float(max(fit.sd_s[:2][fit.sd_s[:2] >= 0], default=0.0))
        if not error_m <= asked.accuracy_m:
            text = (
                f"the lags are known to {error_m / worth_m * 1e6:.2g} us, at {asked.at_m:g} m and the highest speed "
                f"{error_m * 1e3:.3g} mm of depth, asked for are {asked.accuracy_m * 1e3:.3g} mm"
            )
            found.append(
                Reason("imprecise-lag", text, error_m, asked.accuracy_m, "raise scan.power, or scan more sweeps")
            )
    return Verdict(not found, tuple(found))
