"""The lab configs that travel with the program, and what it installs."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from drivers.registry import SLOTS, lookup
from rig.config.bundled import BUNDLED
from rig.config.models import EstimateConfig, RigConfig, ScanConfig

ROOT = Path(__file__).parents[4]


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
        for folder in ("rig", "drivers", "calibration", "sim_backend")
        for file in (ROOT / folder).rglob("*.py")
    )
    for name, packages in extras.items():
        if name != "tests":
            modules = [re.match(r"[\w-]+", package)[0] for package in packages]
            assert all(re.search(rf"^\s*import {module}\b", code, re.MULTILINE) for module in modules), name
