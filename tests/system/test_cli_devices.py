"""`rig devices`, `rig doctor`, `rig laser off`: what a user sees of the devices, with and without mistakes."""

import json

import pytest
import usb.backend.libusb1


def test_devices_lists_what_is_attached_and_opens_nothing(rig):
    ran = rig("devices", "--json")
    if usb.backend.libusb1.get_backend() is None:
        assert ran.code == 3
        assert "libusb" in ran.err
        pytest.skip("libusb is not installed")
    assert ran.code == 0
    for one in json.loads(ran.out)["devices"]:
        assert set(one) == {"address", "what", "kind"}


def test_the_doctor_finds_a_simulated_rig_fit(rig, small, tmp_path):
    ran = rig("doctor", small, "--out", tmp_path, "--json")
    found = json.loads(ran.out)
    assert ran.code == 0, found
    assert found["could_scan"]
    names = [one["name"] for one in found["findings"]]
    assert {"spad", "scanner", "laser", "sync", "guard", "plan", "frames", "dark counts", "markers", "disk"} <= set(
        names
    )


def test_the_doctor_names_every_device_that_is_absent(rig):
    ran = rig("doctor", "lab")
    assert ran.code == 3
    failed = [line for line in ran.out.splitlines() if line.startswith("FAIL")]
    assert [slot for line in failed for slot in ("spad", "scanner", "laser", "sync") if f"  {slot}: " in line] == [
        "spad", "scanner", "laser", "sync",
    ]  # fmt: skip


def test_a_real_rig_is_not_scanned_without_arming(rig):
    ran = rig("scan", "lab")
    assert ran.code == 2
    assert ran.problems == [
        "error: lab has real light (laser cobolt, sync prawndo); clear the beam path, then add --arm"
    ]


def test_the_laser_is_switched_off(rig, small):
    ran = rig("laser", "off", small)
    assert ran.code == 0
    assert "all outputs low" in ran.out
    assert "emission off" in ran.out
