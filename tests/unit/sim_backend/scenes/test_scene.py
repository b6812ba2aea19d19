"""Scene files and folders: what they say, what they refuse, and the bundled street."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibration.files.rig_file import save_rig_model
from drivers.errors import DeviceError
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.light.optics import Line, Optics, Sensor, ambient_irradiance, detections_per_radiance
from sim_backend.light.view import make_view
from sim_backend.scenes import scene
from sim_backend.scenes.medium import Medium
from sim_backend.scenes.scene import bundled_scenes, load_folder, load_scene, load_surfaces, with_fog
from sim_backend.scenes.street import street
from sim_backend.world import WorldConfig
from tests.stability.inventory import covers
from tests.system.small_rig import calibration
from tests.unit.sim_backend.rigs import made_world, rig

covers(make_view, scene, Medium)


def test_bundled_scenes_load() -> None:
    there = {}
    for name in bundled_scenes():
        scene, _ = load_scene(name)
        there[name] = [
            part for part in ("medium", "rain", "snow", "ambient", "motion") if getattr(scene, part) is not None
        ]
    assert there["street"] == there["street-smoke"] == ["medium", "ambient"]
    assert there["street-clear"] == ["ambient"]
    assert there["street-everything"] == ["medium", "rain", "snow", "ambient", "motion"]


PLACE = "rotation: [0 deg, 0 deg, 0 deg]\n  position: [0 m, 0 m, 1 m]"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("surfaces: street\nfogg: 3", ":2: unknown key 'fogg'; keys here are surfaces, board"),
        ("fog: 20", "unknown key 'fog'; did you mean 'medium.fog'. write for example 'fog: {visibility: 30 m}'"),
        ("medium: {fog: 20}", "medium.fog is 20, it must be keys and values; write for example 'fog: {visibility: 30"),
        ("seed: true", "seed is true, it must be a whole number; write for example 'seed: 1'"),
        ("snow: {rate: 2 mm/h, albedo: true}", "snow.albedo is true, it must be a number"),
        ("snow: {rate: 200 mm/h}", "snow.rate is '200 mm/h', it must be at most 50 mm/h"),
        ("motion: {velocity: [1 m/s, 2 m/s]}", "motion.velocity has 2 values, too few; write for example 'velocity: "),
        ("medium: {extinction: 0.1 /m, phase: 5}", "medium.phase is 5, it must be 'isotropic' or keys and values"),
        ("medium: {extinction: 0.1 /m, phase: {g: 2}}", "medium.phase.g is 2, it must be less than 1"),
        (
            f"surfaces: board\nboard:\n  {PLACE}\n  mirorred: true",
            ":5: unknown key 'board.mirorred'; did you mean 'board.mir",
        ),
        (f"surfaces: board\nboard:\n- {PLACE}\n  mirrored: 3", ":5: board.0.mirrored is 3, it must be true or false"),
        ("", "is empty; a scene must hold keys and values, e.g. 'surfaces: street'"),
        ("medium: {fog: {visibility: -30 m}}", "more than 0 m"),
        ("medium: {fog: {visibility: 30 m}, extinction: 0.1 /m}", "exactly one"),
        ("medium: {fog: {visibility: 40 m}, smoke: {extinction: 1 /m}}", "exactly one"),
        ("medium: {smoke: {}}", "exactly one"),
        ("medium: {extinction: 0.1 /m, phase: {terms: [[0.5, 0.9]]}}", "sum to 0.5"),
        ("medium: {extinction: 0.1 /m, phase: isotropic, backscatter: 0.05 /sr}", "the same thing"),
        ("medium: {extinction: 0.1 /m, forward_share: 0.6}", "forward_share is 0.6, it must be at most 0.5"),
        ("surfaces: board", "both or neither"),
        (
            "surfaces: board\nboard: {rotation: [0, 0 deg, 0 deg], position: [0 m, 0 m, 0 m]}",
            "board.rotation.0: 0 has no unit",
        ),
        ("medium: {extinction: 0.1 /m, backscatter: 0.05}", "/sr"),
    ],
)
def test_a_wrong_scene_file_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(DeviceError, match=message) as caught:
        load_scene(str(file))
    assert "\n" not in str(caught.value)
    assert "wrong.yaml" in str(caught.value)


def test_all_problems_of_a_scene_file_are_listed_in_its_order(tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("rain: {rate: 20}\nseed: -1\nsnow: {rat: 2 mm/h}\n")
    with pytest.raises(DeviceError) as caught:
        load_scene(str(file))
    assert [line.removeprefix(f"{file}:")[:14] for line in str(caught.value).splitlines()] == [
        "1: rain.rate: ",
        "2: seed is -1,",
        "3: 'snow.rate'",
        "3: unknown key",
    ]


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "/some/folder/strete"])
def test_an_unknown_scene_lists_the_bundled_ones_and_suggests_the_nearest(name: str) -> None:
    with pytest.raises(
        DeviceError, match="did you mean 'street'.*street-clear" if "strete" in name else "street-clear"
    ):
        load_scene(name)


def test_the_street_lies_within_its_depths() -> None:
    seen = street(*rig(size=(240, 320), focal_px=330.0).camera.tangents())
    assert 1.4 < seen.depth_m.min() < seen.depth_m.max() < 8.2
    assert 0.05 <= seen.albedo.min() < seen.albedo.max() <= 0.9
    assert seen.albedo.std() > 0.05


def test_a_prepared_folder_is_taken_as_it_is(tmp_path: Path) -> None:
    depth, albedo = np.full((20, 30), 2.5, np.float32), np.full((20, 30), 0.4, np.float32)
    np.savez(tmp_path / "world.npz", depth_m=depth, albedo=albedo, trusted=depth > 0)
    scene, folder = load_scene(str(tmp_path))
    u, v = rig(size=(20, 30)).camera.tangents()
    surfaces = load_surfaces(scene, folder, u, v)
    assert np.array_equal(surfaces.depth_m, depth)
    with pytest.raises(DeviceError, match="30 x 20 pixels, the camera 64 x 48"):
        load_folder(tmp_path, (48, 64))


def test_impossible_surfaces_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"no world\.npz"):
        load_folder(tmp_path, (48, 64))
    depth = np.full((20, 30), 2.0)
    for key, wrong in (("depth_m", np.nan), ("depth_m", -1.0), ("albedo", 1.5)):
        arrays = {"depth_m": depth.copy(), "albedo": depth * 0.2}
        arrays[key][3, 3] = wrong
        np.savez(tmp_path / "world.npz", **arrays)
        with pytest.raises(DeviceError, match=key):
            load_folder(tmp_path, (20, 30))


def test_photons_of_a_worked_example() -> None:
    """20 mW over 40 degrees, f/2.8, 10 us, albedo 0.5: about 70 at 1 m per exposure and f = 488 px; 0.08 of 100 lux."""
    optics, sensor = Optics(f_number=2.8), Sensor()
    gain = detections_per_radiance(optics, sensor, Line())
    radiance = 0.5 / np.pi * 0.020 / np.radians(40) * 488 / (1 + 0.2**2) ** 0.5
    assert gain * radiance * 1e-5 == pytest.approx(70, rel=0.05)
    ambient = 0.5 / np.pi * ambient_irradiance(100.0, optics)
    assert gain * ambient * 1e-5 == pytest.approx(0.08, rel=0.2)


@pytest.mark.parametrize("scene", ["bare", "street"])
def test_an_effect_that_is_not_called_for_is_not_even_imported(tmp_path: Path, scene: str) -> None:
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(calibration()))
    config: dict[str, Any] = {"geometry": str(tmp_path / "rig.yaml"), "scene": scene}
    if scene == "bare":
        (tmp_path / "bare.yaml").write_text("surfaces: street\n")
        config |= {"scene": str(tmp_path / "bare.yaml"), "sensor": {"dark_rate": "0 cps"}}
    program = (
        "import json, sys; from sim_backend.world import KIND, WorldConfig;"
        "from drivers.registry import Surroundings; from drivers.clock import VirtualClock;"
        "config = WorldConfig(**json.loads(sys.argv[1]));"
        "KIND.create(config, Surroundings(VirtualClock(), None, 0)).flux_model;"
        "print(json.dumps(list(sys.modules)))"
    )
    command, root = [sys.executable, "-c", program, json.dumps(config)], Path(__file__).parents[4]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root)
    setting = made_world(**config).setting
    called = {
        entry.name: entry.code.partition(":")[0] for entry in CATALOGUE if entry.code and entry.called(setting)[0]
    }
    assert set(called) == {"stripe"} | ({"fog", "ambient", "airlight", "dark counts"} if scene == "street" else set())
    loaded = {
        module.rpartition(".")[2] for module in json.loads(done.stdout) if module.startswith("sim_backend.effects.")
    }
    assert loaded - {"catalogue", "setting"} == set(called.values())


def test_the_report_says_which_effects_are_on_and_what_they_weigh() -> None:
    def report(scene: str) -> dict[str, dict[str, Any]]:
        world = made_world(scene=scene)
        return {line["effect"]: line for line in world.effects_report(0.05, 1e-5, 10)["effects"]}

    foggy, clear = report("street"), report("street-clear")
    assert list(foggy) == [entry.name for entry in CATALOGUE]
    assert {"stripe", "fog", "ambient", "airlight", "dark counts"} <= {name for name in foggy if foggy[name]["on"]}
    assert sum(line["share"] for line in foggy.values()) == pytest.approx(1)
    assert foggy["fog"]["cost_us_per_frame"] > 0
    assert not foggy["stripe"]["removable"]
    assert not clear["fog"]["on"]
    assert clear["fog"]["share"] == clear["fog"]["cost_us_per_frame"] == 0
    assert "no medium" in clear["airlight"]["why"]


def test_the_flux_of_a_row_is_the_sum_of_its_effects() -> None:
    world = made_world(scene="street")
    parts = world.flux_row(200, 0.1, 0.05, 1e-5)
    assert list(parts) == [entry.name for entry in CATALOGUE if entry.kind in ("laser", "steady")]
    whole = world.flux_model.flux(world.model.planes(0.1), 1e-5, 0.05)[200]
    np.testing.assert_allclose(sum(parts.values()), whole, rtol=1e-12)
    assert min(parts[name].sum() for name in (*world.flux_model.laser, *world.flux_model.steady)) > 0


def test_a_world_without_a_light_source_is_refused(tmp_path: Path) -> None:
    save_rig_model(replace(rig(), source_m=None), tmp_path / "rig.yaml")
    with pytest.raises(DeviceError, match="source_m"):
        made_world(geometry=str(tmp_path / "rig.yaml"))


def test_another_fog_changes_how_dense_a_medium_is_and_nothing_else():
    scene, _ = load_scene("street")
    thick = with_fog(scene, "20m")
    assert thick.extinction_per_m == pytest.approx(3.912 / 20)
    assert thick.medium.backscatter == scene.medium.backscatter
    assert thick.medium.multiple_scattering == scene.medium.multiple_scattering
    smoke, _ = load_scene("street-smoke")
    thin = with_fog(smoke, "50 m")
    assert thin.extinction_per_m == pytest.approx(3.912 / 50)
    assert thin.medium.mean_cosine == smoke.medium.mean_cosine
    assert thin.medium.back_per_sr == smoke.medium.back_per_sr
    assert with_fog(load_scene("street-clear")[0], "20 m").extinction_per_m == pytest.approx(3.912 / 20)
    assert with_fog(thick, "clear").medium is None
    world = made_world(fog="20 m")
    assert world.scene == with_fog(scene, "20 m")


@pytest.mark.parametrize(
    ("fog", "named"),
    [(20, "20 has no unit"), (True, "no unit"), ("20", "no unit"), ("-1 m", "more than 0 m"), ("thick", "write clear")],
)
def test_a_fog_that_is_none_is_refused(fog, named):
    with pytest.raises(ValueError, match=named):
        WorldConfig(fog=fog)
