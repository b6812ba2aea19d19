import dataclasses
import itertools

import numpy as np
import pytest

from drivers.clock import SystemClock, VirtualClock
from drivers.errors import DeviceBusy, DeviceNotFound
from drivers.interfaces import LaserStatus
from drivers.registry import Kind, KindConfig
from rig.config.files import load_config
from rig.devices import open as session
from rig.devices.doctor import laser_off
from rig.devices.open import DEVICES, open_rig
from rig.devices.prepare import HOLD_EXPOSURES, prepare
from rig.errors import DevicesError, UsageError
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from tests.unit.rig.scan.fakes import FakeMaker

SMALL = {"scan.columns": 8, "scan.exposures": 2, "scan.command_range": [-0.1, 0.1]}


class Opened:
    """A device that notes its closing."""

    name = "fake"
    gate_only = False

    def __init__(self, slot, log, emission=False):
        self.slot, self.log, self.emission = slot, log, emission

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.log.append(f"close {self.slot}")

    @property
    def status(self):
        return LaserStatus(self.emission, False, True, None, None, False, "digital")

    def pause(self):
        self.log.append("pause")


@pytest.fixture
def fake_kinds(monkeypatch):
    """Replaces what the registry finds; `make[slot]` is the device or the error of that slot."""
    make: dict[str, object] = {}

    def lookup(slot, kind):
        def create(config, surroundings):
            made = make[slot]
            if isinstance(made, Exception):
                raise made
            return made

        return Kind(config=KindConfig, create=create)

    monkeypatch.setattr(session, "lookup", lookup)
    return make


NO_WORLD = load_config("simulated").model_copy(update={"world": None})


def test_all_devices_that_do_not_open_are_listed_and_the_others_closed(fake_kinds):
    log: list[str] = []
    fake_kinds |= {slot: Opened(slot, log) for slot in ("world", *DEVICES)}  # a world that is told nothing of lines
    fake_kinds["scanner"] = DeviceNotFound("no Helios attached")
    fake_kinds["sync"] = DeviceBusy("port is taken")
    with pytest.raises(DevicesError) as caught, open_rig(load_config("simulated")):
        pass
    assert str(caught.value).splitlines() == ["scanner: no Helios attached", "sync: port is taken"]
    assert caught.value.exit_code == 3
    assert log == ["close laser", "close spad"]


def test_closing_begins_with_the_gate(fake_kinds):
    log: list[str] = []
    fake_kinds |= {slot: Opened(slot, log) for slot in DEVICES}
    with open_rig(NO_WORLD) as rig:
        assert isinstance(rig.clock, SystemClock)
    assert log == ["close sync", "close laser", "close scanner", "close spad"]


def test_a_laser_found_emitting_is_paused_and_the_rig_not_opened(fake_kinds):
    log: list[str] = []
    fake_kinds |= {slot: Opened(slot, log, emission=slot == "laser") for slot in DEVICES}
    with pytest.raises(DevicesError, match="found emitting and has been paused"), open_rig(NO_WORLD):
        pass
    assert log[0] == "pause"


@pytest.mark.parametrize("fails_at_once", [False, True])
def test_switching_the_laser_off_needs_no_working_gate(fake_kinds, fails_at_once):
    gate, laser = Opened("sync", log := []), Opened("laser", log)
    laser.disarm = lambda: log.append("disarm")  # the gate has no `abort`, as a faulty driver may
    fake_kinds |= {"sync": KeyError("x") if fails_at_once else gate, "laser": laser}
    with pytest.raises(DevicesError, match=r"sync: .* \(done: fake: emission off\)"):
        laser_off(NO_WORLD)
    assert "disarm" in log


def test_a_missing_calibration_and_a_missing_scene_are_the_users_and_listed_together():
    config = load_config("simulated", {"calibration": "/none/cal.yaml", "world.scene": "nowhere"})
    with pytest.raises(UsageError) as caught, open_rig(config):
        pass
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert "calibration: " in lines[0]
    assert "world: " in lines[1]
    assert caught.value.exit_code == 2


def test_the_simulated_rig_scans_both_ways_and_the_same_frames_with_the_same_seed():
    config = load_config("simulated", {**SMALL, "scan.bidirectional": True})
    runs = []
    for seed in (1, 1, 2):
        with open_rig(config, seed=seed) as rig:
            assert isinstance(rig.clock, VirtualClock)
            maker = FakeMaker()
            sweeps = [found.sweep for found in Acquisition(rig, *prepare(rig), maker, AcquisitionRequest(maps=2)).run()]
            assert not rig.laser.status.emission
            assert rig.sync.status.outputs == 0
            assert not rig.scanner.status.moving
        runs.append(np.concatenate([volume.counts for volume in maker.volumes]))
        assert [sweep.direction for sweep in sweeps] == [1, -1]
        assert all(sweep.synchronised and sweep.frames.lost == 0 for sweep in sweeps)
        assert all(np.abs(volume.n_frames - 2).max() <= 1 for volume in maker.volumes)
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


def test_the_plan_has_the_exposure_that_the_spad_answered():
    with open_rig(load_config("simulated", {**SMALL, "scan.exposure": "1.004 us"})) as rig:
        plan, timing = prepare(rig)
    assert (timing.exposure_ticks, timing.tick_hz, plan.exposure_s) == (100, 10**8, 1e-6)


@pytest.mark.parametrize("exposures", [1, 10])
def test_simulated_light_is_held_within_a_twentieth_of_a_columns_mean(exposures):
    config = load_config("simulated", {**SMALL, "scan.exposures": exposures, "scan.columns": 200})
    held = []
    with open_rig(config) as rig:

        @dataclasses.dataclass
        class Holder:
            def hold_columns(self, commands):
                held.append(commands)

        plan, _ = prepare(dataclasses.replace(rig, world=Holder()))
    (commands,) = held
    columns = (commands - plan.command_range[0]) / (plan.commands[1] - plan.commands[0]) - 0.5
    for phase, c in itertools.product(np.linspace(0, 0.99, 7), (3, 4)):
        frames = c - 0.5 + (np.arange(exposures) + phase) / exposures
        nearest = columns[np.abs(columns[:, None] - frames).argmin(axis=0)]
        assert abs(nearest.mean() - frames.mean()) <= 0.5 / HOLD_EXPOSURES + 1e-9
