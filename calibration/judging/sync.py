"""The verdict on lag and row delay, by the depth error that their uncertainty makes."""

from calibration.depth.sensitivity import sensitivity
from calibration.digits import digits, mm
from calibration.judging.lags import lag_lack
from calibration.model.rig_model import RigModel
from calibration.sync.lag_fit import SyncFit
from calibration.verdict import Asked, Reason, Verdict

_STILL = "check that nothing moved between the sweeps, or calibrate at the speed of your scans"


def judge_sync(fit: SyncFit, model: RigModel | None, asked: Asked | None, changed: Reason | None = None) -> Verdict:
    """Judge a fit. model, asked: of the rig, None where nothing tells what a lag is worth in depth. changed: why the
    model cannot be right with these lags."""
    found = []
    if not fit.steady:
        text = (
            f"the lag is not the same at all speeds: chi squared {fit.chi2:.1f} for {fit.dof} degrees of freedom; it "
            "holds for the speeds scanned only"
        )
        found.append(Reason("lag-by-speed", text, fit.chi2, float(fit.dof), _STILL))
    found += lag_lack(fit.velocities_per_s, mean_will_do=False)
    if model is not None and asked is not None:
        worth_m = sensitivity(model, asked.at_m).per_command_m * fit.speed_range_per_s[1]
        error_m = worth_m * float(max(fit.sd_s[:2][fit.sd_s[:2] >= 0], default=0.0))
        if not error_m <= asked.accuracy_m:
            text = (
                f"the lags are known to {digits(error_m / worth_m * 1e6, 2)} us, at {asked.at_m:g} m and the highest "
                f"speed {mm(error_m)} of depth, asked for are {mm(asked.accuracy_m)}"
            )
            found.append(
                Reason("imprecise-lag", text, error_m, asked.accuracy_m, "raise scan.power, or scan more sweeps")
            )
    if changed is not None:
        found.append(changed)
    return Verdict(not found, tuple(found))
