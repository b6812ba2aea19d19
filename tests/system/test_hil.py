"""Hardware in the loop: a recording plays while real drivers run, and what they say is held against it."""

import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from drivers.spb1.control import ACK, COMMAND
from drivers.transports.tap import IN, OUT, read_taps
from rig import api
from rig.config.files import load_config
from rig.errors import DivergedError, UsageError
from rig.run_folder.manifest import MANIFEST, read_manifest, sealed_text
from rig.scan import replay as replay_run
from sim_backend.wire.firmware.obis import ObisModel
from tests.system.small_rig import emulated, write_rig

EMULATED = emulated()


@pytest.fixture(scope="module", autouse=True)
def _quick_laser() -> Iterator[None]:
    """Its light follows at once, not after five seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim_backend.wire.emulated_world.ObisModel", partial(ObisModel, cdrh_delay_s=0.2))
        yield


def lab() -> dict[str, Any]:
    """The small rig with emulated devices and a slow scan."""
    scan = {"frame_rate": "4 kHz", "columns": 100, "command_range": [-0.5, 0.5]}
    return EMULATED | {"scan": EMULATED["scan"] | scan}


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of emulated devices, recorded."""
    folder = tmp_path_factory.mktemp("taken")
    api.scan(write_rig(folder / "rig", lab()), out=folder / "run", record=True)
    return folder / "run"


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes are held against the recording, times only roughly: a busy machine is late."""
    monkeypatch.setattr(replay_run, "SWAP_TOLERANCE_S", 60.0)


def hil(taken: Path) -> Path:
    """The bundled config with the devices of `taken`."""
    world = {"kind": "emulated", "geometry": str(taken.parent / "rig" / "rig.yaml"), "laser": "obis"}
    devices = {"world": world, "scanner": EMULATED["scanner"], "laser": EMULATED["laser"]}
    file = taken.parent / "hil.yaml"
    file.write_text(yaml.safe_dump(load_config("hil").model_dump(mode="json") | devices))
    return file


def test_what_passed_the_ports_of_a_scan_is_recorded_with_it(taken: Path) -> None:
    passed = read_taps(taken / "control.jsonl")
    assert {one.device for one in passed} == {"spad", "scanner", "laser", "sync"}
    spad = [one for one in passed if one.device == "spad"]
    assert {(one.port, one.direction) for one in spad} == {("control", OUT), ("control", IN)}
    assert {len(one.data) % (COMMAND if one.direction == OUT else ACK).size for one in spad} == {0}
    assert any(one.data.startswith(b"SOUR:AM:STAT ON") for one in passed)
    assert api.verify(taken).exit_code == 0


@pytest.mark.usefixtures("patient")
def test_drivers_in_the_loop_say_what_they_said_and_the_depth_is_the_same(taken: Path, tmp_path: Path) -> None:
    result = api.replay(taken, config=hil(taken), out=tmp_path / "again")
    assert result.control is not None
    assert result.control.problems == ()
    assert result.control.commands > 20
    assert result.control.swaps > 0
    depth = "depth/000000.npy"
    assert (tmp_path / "again" / depth).read_bytes() == (taken / depth).read_bytes()


@pytest.fixture(scope="module")
def altered(taken: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording, but for a letter of the first command that the laser got."""
    other = shutil.copytree(taken, tmp_path_factory.mktemp("other") / "run")
    lines = [json.loads(line) for line in (taken / "control.jsonl").read_text().splitlines()]
    first = next(one for one in lines if bytes.fromhex(one["bytes"]).startswith(b"SOUR:AM:STAT OFF"))
    first["bytes"] = bytes.fromhex(first["bytes"]).replace(b"OFF", b"0FF").hex()
    (other / "control.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lines))
    return other


DIFFERENCE = r"laser: command 0: byte 13 is 0x4f, recorded was 0x30 .*STAT OFF"


@pytest.mark.usefixtures("patient")
def test_the_first_byte_that_was_not_recorded_fails_the_replay_and_is_shown(taken: Path, altered: Path) -> None:
    with pytest.raises(DivergedError, match=DIFFERENCE):
        api.replay(altered, config=hil(taken))


def test_a_difference_is_shown_where_the_replay_fails_for_another_reason(
    taken: Path, altered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = property(lambda laser: True, lambda laser, value: None)
    monkeypatch.setattr(ObisModel, "interlock_open", opened, raising=False)
    with pytest.raises(DivergedError, match=rf"{DIFFERENCE}(.*\n)+.*the interlock is open"):
        api.replay(altered, config=hil(taken))


def test_a_scan_that_ended_before_its_last_map_is_not_taken_for_drivers_that_diverge(
    taken: Path, altered: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    half = shutil.copytree(altered, tmp_path / "half")
    manifest = read_manifest(half)
    assert manifest is not None
    manifest["recording"]["starts"][0]["sweeps"] = 4
    (half / MANIFEST).write_text(sealed_text(json.dumps(manifest)))
    result = api.replay(half, config=hil(taken))
    assert (result.summary.maps, result.control) == (1, None)
    assert "were told of 4 sweeps, those of this replay are told of 1" in caplog.text


def test_no_light_is_let_out_without_a_word(taken: Path) -> None:
    content = load_config("hil").model_dump(mode="json")
    content["sync"]["port"] = "/dev/ttyACM0"
    file = taken.parent / "real.yaml"
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(UsageError, match="`arm=True`"):
        api.replay(taken, config=file)
