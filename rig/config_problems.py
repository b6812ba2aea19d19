"""What is particular to a rig's config when it is checked: options that stand for keys, kinds that slots name."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from calibration.files.problems import Key
from drivers.errors import UnknownKind
from drivers.registry import SLOTS, lookup

FLAGS: Mapping[Key, str] = {
    ("world", "scene"): "--scene",
    ("world", "fog"): "--fog",
    ("scan", "exposures"): "--exposures",
    ("estimate", "estimator"): "--estimator",
    ("estimate", "filter"): "--filter",
    ("estimate", "min_confidence"): "--min-confidence",
    ("estimate", "temporal_prior"): "--temporal-prior",
    ("estimate", "threads"): "--threads",
}
"""Keys that the command line has an option for."""


def kind_of(slot: str, content: Any) -> type[BaseModel] | None:
    """The config model of the kind that a slot's content names; None where it names none."""
    if slot not in SLOTS or not isinstance(content, Mapping):
        return None
    try:
        return lookup(slot, str(content.get("kind"))).config
    except UnknownKind:
        return None
