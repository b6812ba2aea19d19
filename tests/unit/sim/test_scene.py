"""Scene files and folders: what they say, what they refuse, and the bundled street."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.clock import VirtualClock
from drivers.errors import DeviceError
from drivers.registry import Surroundings
from sim_backend.optics import Line, Optics, Sensor, ambient_irradiance, dark_rates, detections_per_radiance
from sim_backend.scene import SceneFile, bundled_scenes, load_scene, load_surfaces
from sim_backend.scenes.prepared import load_folder
from sim_backend.scenes.stereo import prepare
from sim_backend.scenes.street import street
from sim_backend.world import KIND, WorldConfig
from tests.unit.sim.rigs import rig

SCENES = Path(__file__).parents[4] / "shared" / "scenes"


@pytest.mark.parametrize("name", ["street", "street-clear", "street-dense-fog"])
def test_bundled_scenes_load(name: str) -> None:
    assert name in bundled_scenes()
    scene, _ = load_scene(name)
    assert (scene.medium is None) == (name == "street-clear")


def test_visibility_is_that_of_two_percent_contrast() -> None:
    scene = SceneFile.model_validate({"medium": {"fog": {"visibility": "30 m"}}})
    assert scene.extinction_per_m == pytest.approx(3.912 / 30)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("surfaces: street\nfogg: 3", "fogg"),
        ("medium: {fog: {visibility: 30}}", "no unit"),
        ("medium: {fog: {visibility: -30 m}}", "greater than 0"),
        ("medium: {fog: {visibility: 30 m}, extinction: 0.1 /m}", "exactly one"),
        ("medium: {}", "exactly one"),
        ("medium: {extinction: 0.1 /m, backscatter: 0.05}", "/sr"),
        ("ambient: {illuminance: 100 m}", "lux"),
        ("[1, 2", "cannot be read"),
        ("- 3", "file"),
    ],
)
def test_a_wrong_scene_file_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(DeviceError, match=message) as caught:
        load_scene(str(file))
    assert "\n" not in str(caught.value)
    assert "wrong.yaml" in str(caught.value)


def test_an_unknown_scene_lists_the_bundled_ones() -> None:
    with pytest.raises(DeviceError, match="street-clear"):
        load_scene("strete")


def test_the_street_is_the_same_every_time_and_lies_within_its_depths() -> None:
    u, v = rig(size=(240, 320), focal_px=330.0).camera.tangents()
    first, second = street(u, v), street(u, v)
    assert np.array_equal(first.depth_m, second.depth_m)
    assert np.array_equal(first.albedo, second.albedo)
    assert first.depth_m.min() > 1.4
    assert first.depth_m.max() < 8.2
    assert first.albedo.min() >= 0.05
    assert first.albedo.max() <= 0.9
    assert first.albedo.std() > 0.05


def test_a_prepared_folder_is_taken_as_it_is(tmp_path: Path) -> None:
    depth, albedo = np.full((20, 30), 2.5, np.float32), np.full((20, 30), 0.4, np.float32)
    np.savez(tmp_path / "world.npz", depth_m=depth, albedo=albedo, trusted=depth > 0)
    scene, folder = load_scene(str(tmp_path))
    u, v = rig(size=(20, 30)).camera.tangents()
    surfaces = load_surfaces(scene, folder, u, v)
    assert np.array_equal(surfaces.depth_m, depth)
    with pytest.raises(DeviceError, match="30 x 20 pixels, the camera 64 x 48"):
        load_folder(tmp_path, (48, 64))


def test_a_folder_without_a_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"neither world\.npz nor"):
        load_folder(tmp_path, (48, 64))


def test_impossible_surfaces_are_refused(tmp_path: Path) -> None:
    depth = np.full((20, 30), 2.0)
    for key, wrong in (("depth_m", np.nan), ("depth_m", -1.0), ("albedo", 1.5)):
        arrays = {"depth_m": depth.copy(), "albedo": depth * 0.2}
        arrays[key][3, 3] = wrong
        np.savez(tmp_path / "world.npz", **arrays)
        with pytest.raises(DeviceError, match=key):
            load_folder(tmp_path, (20, 30))


@pytest.mark.skipif(not SCENES.is_dir(), reason="no scene folder beside this checkout")
@pytest.mark.parametrize("name", ["cones", "aloe", "motorcycle"])
def test_a_stereo_scene_is_prepared_like_the_prepared_one(name: str) -> None:
    folder = SCENES / name
    ours, theirs = prepare(folder / "disparity.npy", folder / "left.png", (512, 512)), load_folder(folder, (512, 512))
    difference = np.abs(1 / ours.depth_m - 1 / theirs.depth_m)
    assert np.median(difference) < 0.002
    assert np.percentile(difference, 99) < 0.02
    assert np.median(np.abs(ours.albedo - theirs.albedo)) < 0.01
    assert (ours.trusted == theirs.trusted).mean() > 0.9


def test_photons_of_a_worked_example() -> None:
    """20 mW over 40 degrees, f/2.8, 10 us, albedo 0.5: about 70 at 1 m per exposure and f = 488 px; 0.08 of 100 lux."""
    optics, sensor = Optics(f_number=2.8), Sensor()
    gain = detections_per_radiance(optics, sensor, Line())
    radiance = 0.5 / np.pi * 0.020 / np.radians(40) * 488 / (1 + 0.2**2) ** 0.5
    assert gain * radiance * 1e-5 == pytest.approx(70, rel=0.05)
    ambient = 0.5 / np.pi * ambient_irradiance(100.0, optics)
    assert gain * ambient * 1e-5 == pytest.approx(0.08, rel=0.2)


def test_dark_rates_have_a_heavy_tail_and_belong_to_the_sensor() -> None:
    rates = dark_rates(Sensor(), (512, 512))
    assert np.median(rates) == pytest.approx(20, rel=0.05)
    assert np.mean(rates > 200) == pytest.approx(0.01, rel=0.2)
    assert np.mean(rates > 2000) == pytest.approx(0.002, rel=0.3)
    assert np.array_equal(rates, dark_rates(Sensor(), (512, 512)))


def test_effects_that_are_not_called_for_are_not_imported() -> None:
    program = (
        "import sys; from sim_backend.world import KIND, WorldConfig;"
        "from drivers.registry import Surroundings; from drivers.clock import VirtualClock;"
        "config = WorldConfig(scene='street-clear', sensor={'dark_rate': '0 cps'});"
        "KIND.create(config, Surroundings(VirtualClock(), None, 0));"
        "print(sorted(m.rpartition('.')[2] for m in sys.modules if m.startswith('sim_backend.effects.')))"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "['ambient', 'catalogue', 'setting', 'stripe']"


def test_the_report_says_which_effects_are_on_and_what_they_weigh() -> None:
    foggy = KIND.create(WorldConfig(scene="street"), Surroundings(VirtualClock(), None, 0))
    report = {line["effect"]: line for line in foggy.effects_report(power_w=0.05)}
    assert set(report) == {"stripe", "fog", "ambient", "airlight", "dark counts", "saturation"}
    assert all(line["on"] for line in report.values())
    shares = [line["share"] for name, line in report.items() if name != "saturation"]
    assert sum(shares) == pytest.approx(1)
    assert not report["stripe"]["negligible"]
    more = {line["effect"]: line for line in foggy.effects_report(power_w=0.05, exposures=20)}
    assert more["fog"]["divergence"] == pytest.approx(2 * report["fog"]["divergence"])
    clear = KIND.create(WorldConfig(scene="street-clear"), Surroundings(VirtualClock(), None, 0))
    off = {line["effect"]: line for line in clear.effects_report()}
    assert not off["fog"]["on"]
    assert off["fog"]["share"] == 0
    assert "no medium" in off["airlight"]["why"]


def test_a_world_without_a_light_source_is_refused(tmp_path: Path) -> None:
    from dataclasses import replace

    from calibration.files import save_rig_model

    save_rig_model(replace(rig(), source_m=None), tmp_path / "rig.yaml")
    with pytest.raises(DeviceError, match="source_m"):
        KIND.create(WorldConfig(geometry=str(tmp_path / "rig.yaml")), Surroundings(VirtualClock(), None, 0))
