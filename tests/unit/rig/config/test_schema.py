"""The JSON schema of a config, as an editor uses it: it accepts what the program accepts, and says what is wrong."""

from functools import cache
from typing import Any

import jsonschema
import pytest
import yaml

from rig.config.bundled import bundled_rigs
from rig.config.files import config_schema

RIGS = {rig.name: rig for rig in bundled_rigs()}


@cache
def validator() -> jsonschema.Draft202012Validator:
    schema = config_schema()
    found = jsonschema.validators.validator_for(schema)
    found.check_schema(schema)
    assert found is jsonschema.Draft202012Validator
    return found(schema)


def content(name: str) -> dict[str, Any]:
    return yaml.safe_load(RIGS[name].file.read_text())


@pytest.mark.parametrize("name", RIGS)
def test_every_bundled_rig_is_valid(name: str) -> None:
    assert [error.message for error in validator().iter_errors(content(name))] == []


@pytest.mark.parametrize(
    ("section", "key", "value", "said"),
    [
        ("scan", "exposure_count", 3, "'exposure_count' was unexpected"),
        ("scan", "exposures", "ten", "is not of type 'integer'"),
        ("scan", "frame_rate", 100_000, "is not of type 'string'"),
        ("estimate", "estimator", "best", "'best' is not one of ['auto', 'argmax'"),
        ("laser", "max_powr", "50 mW", "is not valid under any of the given schemas"),
        ("laser", "kind", "torch", "is not valid under any of the given schemas"),
    ],
)
def test_mistakes_that_a_person_makes_are_marked(section: str, key: str, value: object, said: str) -> None:
    changed = content("simulated")
    changed[section] = {**changed[section], key: value}
    errors = list(validator().iter_errors(changed))
    assert [error.absolute_path[0] for error in errors] == [section]
    assert said in errors[0].message


def test_keys_have_descriptions_to_show_beside_them() -> None:
    schema = config_schema()
    keys = schema["$defs"]["ScanConfig"]["properties"]
    assert [key for key, about in keys.items() if not about.get("description")] == []
    assert schema["$defs"]["laser.obis"]["required"][0] == "kind"
