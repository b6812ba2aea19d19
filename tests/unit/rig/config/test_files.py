import inspect
import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml

from drivers.registry import SLOTS, lookup
from rig.config.bundled import BUNDLED
from rig.config.files import (
    FLAGS,
    bundled_configs,
    completed_text,
    config_content,
    find_config,
    load_config,
    load_cube_plan,
    portable_content,
)
from rig.config.models import EstimateConfig, RigConfig, ScanConfig
from rig.config.overrides import configure
from rig.errors import UsageError

ROOT = Path(__file__).parents[4]

RIG = """\
name: test
world: {kind: simulated}
spad: {kind: simulated}
scanner: {kind: simulated}
laser: {kind: simulated, max_power: 50 mW}
sync: {kind: simulated}
scan:
  columns: 100
  exposures: 4
  frame_rate: 97.7 kHz
  depth_range: [1 m, 8 m]
"""


@pytest.fixture
def write(tmp_path):
    def write(text, name="rig.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def problems(path, overrides=None):
    with pytest.raises(UsageError) as caught:
        load_config(path, overrides)
    assert caught.value.exit_code == 2
    return [line.replace(str(path), "rig.yaml") for line in str(caught.value).splitlines()]


def test_all_problems_are_listed_at_once_in_the_order_of_the_file(write):
    path = write(
        RIG.replace("columns: 100", "colums: 100")
        .replace("exposures: 4", "exposures: -3")
        .replace("97.7 kHz", "97700")
        .replace("[1 m, 8 m]", "[8 m, 1 m]")
        .replace("max_power: 50 mW", "max_power: 50")
        .replace("sync: {kind: simulated}", "sync: {kind: simulate}")
    )
    assert problems(path) == [
        'rig.yaml:5: laser.max_power: 50 has no unit; write the power with a unit, like "50 mW"',
        "rig.yaml:6: sync: unknown kind 'simulate'; choose one of: prawndo, pulsestreamer, replay, "
        "simulated, teensy, or install the package that has it",
        "rig.yaml:8: unknown key 'scan.colums'; did you mean 'scan.columns'?",
        "rig.yaml:9: scan.exposures is -3, it must be at least 1; write for example 'exposures: 10'",
        'rig.yaml:10: scan.frame_rate: 97700 has no unit; write the frequency with a unit, like "100 kHz"',
        "rig.yaml:11: scan.depth_range runs from 8 m to 1 m; it must be [near, far] with 0 m < near < far",
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("columns: 100", "columns: true"), "scan.columns is true, it must be a whole number; write for example 'col"),
        (("exposures: 4", "dark_fraction: .nan"), "scan.dark_fraction is nan, it must be a finite number"),
        (("exposures: 4", "command_range: [-0.5, true]"), "scan.command_range.1 is true, it must be a number"),
        (("exposures: 4", "power: 0 W"), "scan.power is '0 W', it must be more than 0 W"),
        (("name: test", "name: test\nfog: 20 m"), "unknown key 'fog'; did you mean 'world.fog'?"),
        (("name: test", "name: test\n3: 5"), "key 3 is no text; put it in quotes"),
        (("name: test", "name: test\nestimate: 5"), "estimate is 5, it must be keys and values"),
        (("exposures: 4", "bidirectional: maybe"), "scan.bidirectional is 'maybe', it must be true or false"),
        (("exposures: 4", "command_range: [-2, 1]"), "scan.command_range.0 is -2, it must be at least -1"),
        (("exposures: 4", "command_range: [0.5, 0.5]"), "scan.command_range begins and ends at 0.5"),
        (("exposures: 4", "exposure: 20 us"), "scan: exposure is 20 us, longer than the 10.2354 us of a frame"),
        (("exposures: 4", "exposure: 20 m"), "scan.exposure: '20 m': 'm' is no unit of time"),
        (("  frame_rate: 97.7 kHz\n", ""), "'scan.frame_rate' is missing; write for example 'frame_rate: 100 kHz'"),
        (("name: test", "estimate: {estimator: likelyhood}\nname: t"), "did you mean 'likelihood'?"),
        (
            ("name: test", "estimate: {estimator: edge, temporal_prior: true}\nname: t"),
            "estimate.temporal_prior is for the estimator joint",
        ),
        (
            ("sync: {kind: simulated}", "sync: {}"),
            "sync has no 'kind'; add one of: prawndo, pulsestreamer, replay, simulated, teensy",
        ),
        (("sync: {kind: simulated}", "sync: 3"), "sync is 3; it must be a mapping that names a kind"),
        (
            ("sync: {kind: simulated}", "sync: {kind: simulated, port: 1}"),
            "unknown key 'sync.port'; keys here are kind",
        ),
        (("  exposures: 4", "  exposures: 4\n  exposures: 5"), "'scan.exposures' is given twice; keep one"),
        (("  exposures: 4", " exposures: 4"), "not YAML"),
    ],
)
def test_a_mistake_is_one_line_with_file_line_key_value_and_next_step(write, change, message):
    before, after = change
    assert before in RIG
    (line,) = problems(write(RIG.replace(before, after)))
    assert line.startswith("rig.yaml:")
    assert line.split(":")[1].isdigit()
    assert message in line


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "is empty"), ("- 1", "holds a list"), ("a: [", "not YAML"), (b"\xff\xfe\x00a", "not text")],
)
def test_a_file_that_is_no_config_says_so(tmp_path, text, message):
    path = tmp_path / "rig.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    (line,) = problems(path)
    assert message in line


def test_a_name_that_means_no_config_is_told_what_it_is(tmp_path):
    with pytest.raises(UsageError, match=r"no config 'simulatd': did you mean 'simulated'[?] bundled configs are "):
        load_config("simulatd")
    for absent in ("none.yaml", "nodir/", "nodir/none"):
        assert "that path does not exist" in problems(absent)[0]
    assert "is a folder" in problems(tmp_path)[0]
    (tmp_path / "bench-rig.yaml").touch()
    assert f"did you mean '{tmp_path / 'bench-rig.yaml'}'?" in problems(tmp_path / "bench-rg.yaml")[0]
    assert "did you mean" not in problems(tmp_path / "another.yaml")[0]


def test_overrides_lie_over_the_file_and_none_leaves_it_alone(write):
    config = load_config(
        write(RIG), {"scan.exposures": 7, "estimate.filter": "median", "scan.columns": None, "world.scene": "x/y"}
    )
    assert (config.scan.exposures, config.scan.columns, config.estimate.filter) == (7, 100, "median")
    assert config.world is not None
    assert config.world.model_dump()["scene"] == "x/y"


def test_a_mistake_in_an_override_is_called_an_option(write):
    assert problems(write(RIG), {"scan.exposures": 0, "scan.colum": 3}) == [
        "option: unknown key 'scan.colum'; did you mean 'scan.columns'?",
        "`exposures` is 0, it must be at least 1; write for example `exposures=10`",
    ]


def test_every_option_that_replaces_a_key_of_the_config_has_its_name_in_messages(write):
    assert inspect.signature(configure).parameters.keys() - {"config"} <= set(FLAGS.values())
    (line,) = problems(write(RIG), {"estimate.learned": 3})
    assert line.startswith("`learned` is 3, it must be a path")


def test_a_calibration_may_lie_at_home(write, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name, meant in (
        ("~/cal.yaml", tmp_path / "cal.yaml"),
        ("~nobody-here/c.yaml", tmp_path / "~nobody-here/c.yaml"),
    ):
        file = write(RIG.replace("name: test", f"name: test\ncalibration: {name}"))
        assert load_config(file).calibration == meant


def test_a_config_named_by_a_relative_path_is_written_out_for_any_folder(write, tmp_path, monkeypatch):
    for name in ("rig", "rig/scenes", "art", "street", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "rig" / "scenes" / "hall.yaml").write_text("surfaces: street\n", encoding="utf-8")
    text = RIG.replace("name: test", "name: test\ncalibration: cal.yaml")
    write(
        text.replace("kind: simulated}", "kind: simulated, scene: scenes/hall.yaml, geometry: ./m.yaml}", 1),
        "rig/r.yaml",
    )
    monkeypatch.chdir(tmp_path / "art")
    for scene, meant in (
        (None, "rig/scenes/hall.yaml"),
        ("../art", "art"),
        ("../rig/scenes/hall.yaml", "rig/scenes/hall.yaml"),
    ):
        content = portable_content(load_config("../rig/r.yaml", {"world.scene": scene}))
        assert content["calibration"] == str(tmp_path / "rig" / "cal.yaml")
        assert content["world"]["geometry"] == str(tmp_path / "rig" / "m.yaml")
        assert content["world"]["scene"] == str(tmp_path / meant)
    monkeypatch.chdir(tmp_path)
    for scene, meant in (("street", "street"), ("art", str(tmp_path / "art"))):
        assert portable_content(load_config("rig/r.yaml", {"world.scene": scene}))["world"]["scene"] == meant


@pytest.mark.parametrize("name", bundled_configs())
def test_a_config_shown_keeps_what_is_written_and_is_the_very_same(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = find_config(name).read_text(encoding="utf-8")
    shown = completed_text(name)
    file = tmp_path / "shown.yaml"
    file.write_text(shown, encoding="utf-8")
    assert load_config(file) == load_config(name)
    assert completed_text(file) == shown
    absolute = rf"calibration: {BUNDLED.resolve()}/\1"
    kept = [re.sub(r"^calibration: (\w+-rig\.yaml)", absolute, line) for line in written.splitlines()]
    rest = iter(shown.splitlines())
    left = [line for line in kept if "{" not in line and not any(line == other for other in rest)]
    assert left == []  # every line is there, in the same order; those with braces may be filled in
    assert "0 %" not in shown
    full = load_config(name).model_dump(mode="json")
    assert set(full) == set(config_content(shown))
    assert set(full["scan"]) == set(config_content(shown)["scan"])


@pytest.mark.parametrize(
    "text",
    [
        RIG,
        RIG.rstrip(),
        RIG.replace("\n", "\r\n"),
        RIG + "estimate: {}\n",
        RIG + "estimate: {filter: none,}  # behind\n",
        RIG + "estimate:\n    filter: none # two\n    # the end\n",
        RIG.replace("world: {kind: simulated}", "world:\n  kind: simulated\n  fog:\n  effects: [fog,\n    stripe]"),
        RIG.replace("name: test", "name: |\n  test"),
        RIG.replace("name: test", 'name: "t: {ü} # 1"  # said'),
        json.dumps(yaml.safe_load(RIG)),
        json.dumps(yaml.safe_load(RIG), indent=2),
        "---\n" + RIG + "...\n",
        RIG.replace("world: {kind: simulated}", "world: {kind: simulated, scene: 'my hall.yaml', geometry: ./g.yaml}"),
    ],
)
def test_a_config_in_any_style_is_completed_in_place(write, text):
    path = write(text)
    shown = completed_text(path)
    again = write(shown, "again.yaml")
    assert load_config(again) == load_config(path)
    assert completed_text(again) == shown
    assert not shown.startswith("# ")
    assert "depth_range" in shown


def test_a_config_with_aliases_is_written_anew(write):
    path = write(
        "# mine\n" + RIG.replace("spad: {kind", "spad: &a {kind").replace("scanner: {kind: simulated}", "scanner: *a")
    )
    shown = completed_text(path)
    assert shown.startswith(f"# {path}, written anew without its comments\n")
    assert load_config(write(shown, "again.yaml")) == load_config(path)


def test_a_plan_is_checked_as_a_config_is(write):
    def refused(text):
        with pytest.raises(UsageError) as caught:
            load_cube_plan(write(text, "plan.yaml"))
        return [line.rpartition("plan.yaml")[2] for line in caught.value.problems]

    plan = load_cube_plan(write("{columns: 500, exposures: 10, frame_rate: 100 kHz, depth_range: [1 m, 8 m]}"))
    assert (plan.columns, plan.exposures, plan.frame_rate, plan.depth_range) == (500, 10, 100_000, (1.0, 8.0))
    assert refused("") == [" is empty; a plan must hold keys and values, e.g. 'columns: 500'"]
    assert refused("columns: true\nexposures: .nan\nframe_rate: 100\ndepth_range: 5") == [
        ":1: columns is true, it must be a whole number; write for example 'columns: 500'",
        ":2: exposures is nan, it must be a finite number; write for example 'exposures: 10'",
        ':3: frame_rate: 100 has no unit; write the frequency with a unit, like "100 kHz"',
        ":4: depth_range is 5, it must be a list; write for example 'depth_range: [1 m, 8 m]'",
    ]


@pytest.mark.parametrize("name", ["lab", "lab-spad512s"])
def test_a_lab_config_has_every_key_of_its_devices_and_of_the_scan(name: str) -> None:
    text = (BUNDLED / f"{name}.yaml").read_text()
    content = yaml.safe_load(text)
    top = set(re.findall(r"^(?:# )?(\w+):", text, re.MULTILINE))
    assert set(RigConfig.model_fields) - {"world"} <= top
    models = {slot: lookup(slot, content[slot]["kind"]).config for slot in SLOTS if slot != "world"}
    for section, model in {**models, "scan": ScanConfig, "estimate": EstimateConfig}.items():
        part = re.split(r"^(?=\w)", text.partition(f"\n{section}:\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
        named = set(re.findall(r"^  (?:# )?(\w+):", part, re.MULTILINE))
        assert set(model.model_fields) <= named, section


def test_every_extra_is_imported_somewhere() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    code = "".join(
        file.read_text()
        for folder in ("rig", "drivers", "calibration", "sim_backend", "spadrig")
        for file in (ROOT / folder).rglob("*.py")
    )
    for name, packages in extras.items():
        if name not in ("docs", "tests", "tracer"):
            modules = [re.match(r"[\w-]+", package)[0].replace("-", "_") for package in packages]
            assert all(re.search(rf"^\s*import {module}\b|\"{module}\"", code, re.MULTILINE) for module in modules), (
                name
            )
