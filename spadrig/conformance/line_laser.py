"""The suite of every line laser: power limits, arm, pause and disarm, what it says of itself, dark when left."""

import pytest

from drivers.errors import LimitExceeded
from drivers.interfaces import DeviceState
from spadrig.conformance.cases import LaserCase, require_final

WARM_UP_S = 600.0
"""Longer than any laser warms up."""
_LOOK_S = 0.5


def arm(case: LaserCase) -> None:
    """Arm in the middle of the power range and wait for emission, which may follow after a warm-up or a safety delay.
    Fails after WARM_UP_S."""
    limits = case.device.limits
    case.device.arm((limits.min_power_w + limits.max_power_w) / 2)
    for _ in range(int(WARM_UP_S / _LOOK_S)):
        if case.device.status.emission:
            return
        case.clock.sleep(_LOOK_S)
    pytest.fail("no emission")


def check_dark(case: LaserCase, *, armed: bool) -> None:
    """Assert that the laser is dark. If only a gate ends its light, assert that it shines and says so.

    armed: what its status must say.
    """
    status = case.device.status
    assert (status.emission, status.armed) == (case.device.gate_only, armed)
    assert case.shining() == case.device.gate_only


class LineLaserSuite:
    """Tests of a laser. The fixture `laser` gives a `LaserCase`."""

    def test_it_is_found_dark_describes_itself_and_is_not_armed_beyond_its_limits(self, laser: LaserCase) -> None:
        limits, status = laser.device.limits, laser.device.status
        assert laser.device.name
        assert 0 <= limits.min_power_w <= limits.max_power_w
        assert laser.device.gate_only or limits.min_power_w < limits.max_power_w
        assert status.interlock_closed is not False
        assert status.fault is None
        assert status.input_mode
        for power_w in (limits.max_power_w * 1.01, limits.min_power_w - 1e-3, float("nan"), float("inf")):
            with pytest.raises(LimitExceeded) as refused:
                laser.device.arm(power_w)
            for number in (power_w, limits.max_power_w):
                assert f"{number:g} W" in str(refused.value)
        for _ in range(2):  # possible in any state
            laser.device.pause()
            check_dark(laser, armed=False)
            laser.device.disarm()
            check_dark(laser, armed=False)
        assert laser.device.state is DeviceState.READY

    def test_armed_it_emits_under_the_gate_also_at_its_limit_and_disarmed_it_is_dark(self, laser: LaserCase) -> None:
        arm(laser)
        laser.device.arm(laser.device.limits.max_power_w)
        status = laser.device.status
        assert status.armed
        assert not status.warming_up
        assert laser.shining()
        assert laser.device.state is DeviceState.RUNNING
        laser.device.disarm()
        check_dark(laser, armed=False)
        assert laser.device.state is DeviceState.READY

    def test_a_pause_is_dark_and_armed_and_ends_with_the_next_arm_and_a_close_for_good(self, laser: LaserCase) -> None:
        device = laser.device
        arm(laser)
        for _ in range(2):
            device.pause()
            check_dark(laser, armed=True)
            assert device.state is DeviceState.CONFIGURED
        arm(laser)
        require_final(device, lambda: device.arm(0.0), device.pause, device.disarm, lambda: device.status)
        assert laser.shining() == device.gate_only

    def test_a_pause_while_it_warms_up_holds(self, laser: LaserCase) -> None:
        laser.device.arm(laser.device.limits.max_power_w)
        laser.device.pause()
        laser.clock.sleep(WARM_UP_S)
        check_dark(laser, armed=True)
