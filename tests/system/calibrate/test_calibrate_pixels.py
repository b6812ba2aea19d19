"""`rig calibrate pixels` on a simulated sensor whose faults are known: found, written, compared and used."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.files.rig_file import load_rig_model, save_rig_model
from calibration.pixel_map import frames_for, hot_flux, load_pixels
from drivers.interfaces import SpadRequest
from rig import api
from rig.api import calibrate_pixels
from rig.calibrate.pixels import PixelResult
from rig.errors import UsageError
from sim_backend.bench import Bench
from sim_backend.devices.spad import SimulatedSpad
from sim_backend.effects.dark_counts import dark_rates
from sim_backend.light.optics import Sensor
from tests.system.small_rig import HEIGHT, WIDTH, config, write_rig

FRAMES = frames_for(float(hot_flux(0.1, 0.0)))
MANY = {"hot_share": "2 %", "dead_share": "2 %"}
SENSOR: dict[str, Any] = {"dark_rate": "200 cps", "dead_share": "0.5 %", "hot_share": "0.5 %", "pixel_seed": 7}


def rig_of(folder: Path, calibration: str = "rig.yaml", columns: int = 200, **sensor: object) -> Path:
    """The small rig with a faulty sensor in room light."""
    content = config()
    content["world"]["sensor"] = {**SENSOR, **sensor}
    content["calibration"], content["scan"]["columns"] = calibration, columns
    return write_rig(folder, content)


def truth(**sensor: object) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Dark rates, stuck pixels and dead ones of that sensor."""
    of = Sensor.model_validate({**SENSOR, **sensor})
    lot = np.random.default_rng([of.pixel_seed, 2]).random((HEIGHT, WIDTH))
    return dark_rates(of, (HEIGHT, WIDTH)), lot >= 1 - of.hot_share, lot < of.dead_share


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PixelResult]:
    """The rig's config, and its pixels mapped with lit frames too."""
    folder = tmp_path_factory.mktemp("pixels")
    file = rig_of(folder / "rig")
    return file, calibrate_pixels(file, light=True, seed=3, out=folder / "out")


@pytest.mark.long
def test_hot_and_dead_pixels_and_dark_rates_are_those_of_the_sensor(mapped: tuple[Path, PixelResult]) -> None:
    pixels = mapped[1].found.pixels
    rate, stuck, dead = truth()
    assert pixels.frames >= FRAMES
    assert (pixels.dead & dead).sum() >= 0.9 * dead.sum()
    assert not (pixels.dead & ~dead).any()
    hot = (rate > pixels.limit_per_s) & ~dead | stuck
    clear = np.abs(rate / pixels.limit_per_s - 1) > 0.1
    assert np.array_equal((pixels.hot & clear), (hot & clear))
    usual = ~stuck & ~dead & (rate < 5e4)
    off = (pixels.rate_per_s - rate)[usual] / pixels.rate_sd_per_s[usual]
    assert abs(off.mean()) < 0.1
    assert off.std() == pytest.approx(1.0, abs=0.1)


def test_the_folder_holds_the_map_the_calibration_and_the_report(mapped: tuple[Path, PixelResult]) -> None:
    _, result = mapped
    assert result.verdict.passed
    assert result.exit_code == 0
    assert {file.name for file in result.folder.iterdir()} >= {
        "pixels.npz", "calibration.yaml", "dark_rate.png", "report.html", "summary.json",
    }  # fmt: skip
    summary = json.loads((result.folder / "summary.json").read_text())
    assert summary["version"] == 1
    assert summary["parent"] is None
    assert summary["drift"] is None
    assert summary["defects"] == int(result.found.pixels.defects.sum())
    model = load_rig_model(result.folder / "calibration.yaml")
    assert np.array_equal(model.defects, result.found.pixels.defects)
    assert model.dark_rate_per_s.shape == (HEIGHT, WIDTH)
    assert load_pixels(result.folder / "pixels.npz").id == result.found.id
    page = (result.folder / "report.html").read_text()
    assert "PASSED" in page
    assert "<svg" in page
    assert "data:image/png" in page
    assert {name for name, _ in result.rows()} >= {"hot", "dead", "noisy", "dark rate"}
    assert not any(re.search(r"\de[+-]\d", told) for _, told in result.rows()), "powers of ten"


def test_the_next_map_knows_the_last_one_and_says_what_changed(
    mapped: tuple[Path, PixelResult], tmp_path: Path
) -> None:
    file, first = mapped
    again = calibrate_pixels(file, seed=4, against=first.folder)
    assert (again.found.version, again.found.parent) == (2, first.found.id)
    assert again.drift.reasons == ()
    assert again.drift.ratio == pytest.approx(1, abs=0.02)
    assert again.as_json()["drift"]["became_hot"] == []
    assert dict(again.rows())["dead"] == "not judged: no lit frames"
    few = calibrate_pixels(file, frames=64)
    assert few.verdict.codes == ("too-few-frames",)
    assert few.exit_code == 1
    with pytest.raises(UsageError, match="frames is 0"):
        calibrate_pixels(file, frames=0)
    with pytest.raises(UsageError, match="cannot read"):
        calibrate_pixels(file, against=tmp_path / "none.npz")


def test_a_recorded_run_gives_its_dark_and_lit_frames(tmp_path: Path) -> None:
    file = rig_of(tmp_path / "rig")
    api.scan(file, maps=4, exposures=20, seed=1, record=True, out=tmp_path / "run")
    result = calibrate_pixels(tmp_path / "run", out=tmp_path / "out")
    rate, stuck, dead = truth()
    pixels = result.found.pixels
    assert not (pixels.dead & ~dead).any()
    assert (pixels.dead & dead).sum() > 0.8 * dead.sum()
    assert pixels.hot[stuck].all()
    assert not pixels.hot[rate < 1000][~stuck[rate < 1000]].any()
    assert result.found.sensor == "simulated SIM-0001"
    assert result.calibration is None
    assert result.verdict.passed


def test_the_default_map_to_compare_with_lies_beside_the_calibration_and_a_bad_drift_is_noted_there(
    tmp_path: Path,
) -> None:
    file = rig_of(tmp_path / "rig")
    first = calibrate_pixels(file, out=tmp_path / "out")
    assert first.drift is None
    for name in ("pixels.npz", "calibration.yaml", "calibration-defects.npy", "calibration-dark-rate.npy"):
        (first.folder / name).replace(tmp_path / "rig" / name)
    changed = rig_of(tmp_path / "rig", "calibration.yaml", pixel_seed=8)  # somebody put in another sensor
    second = calibrate_pixels(changed)
    assert second.found.version == 2
    assert second.verdict.codes[0] == "other-sensor"
    with pytest.raises(UsageError, match=r"'rig calibrate pixels' of .* failed \(other-sensor"):
        api.scan(changed)
    assert api.scan(changed, accept_calibration=True).summary.accepted_calibration[0].startswith("failed-check: ")


def test_no_light_is_let_out_and_nothing_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("the laser was armed, the gate opened or the mirror moved")

    for verb in ("play", "run_program"):
        monkeypatch.setattr(Bench, verb, never)
    asked: list[SpadRequest] = []
    configure = SimulatedSpad._do_configure

    def noted(self: SimulatedSpad, request: SpadRequest) -> Any:
        asked.append(request)
        return configure(self, request)

    monkeypatch.setattr(SimulatedSpad, "_do_configure", noted)
    calibrate_pixels(rig_of(tmp_path / "rig"), frames=320)
    assert [request.window for request in asked] == [None]


@pytest.fixture(scope="module")
def worse(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.bool_]]:
    """A folder with the rig of a sensor that has many defects, and those that were found."""
    folder = tmp_path_factory.mktemp("defects")
    result = calibrate_pixels(rig_of(folder, **MANY), frames=3200, light=True)
    return folder, result.found.pixels.defects


@pytest.mark.parametrize("estimator", ["argmax", "joint"])
def test_marking_the_defects_never_worsens_a_scan_and_helps_the_naive_estimators(
    worse: tuple[Path, NDArray[np.bool_]], estimator: Any
) -> None:
    folder, defects = worse
    plain = load_rig_model(folder / "rig.yaml")
    wrong = []
    for name, model in (("plain", plain), ("marked", replace(plain, defects=defects))):
        save_rig_model(model, folder / f"{name}.yaml")
        run = api.scan(rig_of(folder, f"{name}.yaml", 120, **MANY), estimator=estimator, seed=2)
        wrong.append(1 - run.summary.truth.stripe_error_px["within_1px"])
    assert wrong[1] <= wrong[0] + 0.003
    if estimator == "argmax":
        assert wrong[1] < 0.7 * wrong[0]
    if estimator == "joint":
        assert wrong[1] < 0.01
