"""The reference of keys in configs, scene files and plans, made of the models that check them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docs.generate.tables import code, table
from drivers.registry import SLOTS, kinds, lookup
from drivers.units import DIMENSIONS, dimension_of, format_quantity
from rig.config.models import CubePlan, EstimateConfig, RigConfig, ScanConfig
from sim_backend.scenes.scene import SceneFile

HEAD = ("key", "quantity", "default", "limits", "meaning")
_BOUNDS = {"gt": "above ", "ge": "", "lt": "below ", "le": ""}
"""Bounds of pydantic's fields, and the words before their values."""


@dataclass(frozen=True, slots=True)
class Key:
    """A key of a file: its dotted name, and the field that holds it."""

    name: str
    field: FieldInfo

    def row(self) -> tuple[str, ...]:
        """Its row of the table."""
        dimension = dimension_of(self.field)
        default, limits = _default(self.field, dimension), _limits(self.field, dimension)
        return code(self.name), dimension or "", default, limits, self.field.description or ""


def page() -> str:
    """Tables of all keys: the config's own, those of each installed kind of device, scene files, plan.yaml."""
    own = [key for key in keys(RigConfig) if key.name.partition(".")[0] not in (*SLOTS, "scan", "estimate")]
    parts = {
        "Top level": _table(own),
        "scan": _table(keys(ScanConfig, "scan.")),
        "estimate": _table(keys(EstimateConfig, "estimate.")),
        **{f"{slot} of kind {kind}": _of_kind(slot, kind) for slot in SLOTS for kind in kinds(slot)},
        "Scene files": _table(keys(SceneFile)),
        "plan.yaml of rig reconstruct": _table(keys(CubePlan)),
        "Units": table(("quantity", "units"), [(one.name, ", ".join(one.units)) for one in DIMENSIONS.values()]),
    }
    return "\n".join(f"### {heading}\n\n{text}" for heading, text in parts.items())


def _of_kind(slot: str, kind: str) -> str:
    """The keys of a kind; without those of another kind of the slot on which it builds, which is named."""
    model = lookup(slot, kind).config
    bases = {one: lookup(slot, one).config for one in kinds(slot) if one != kind}
    base = next((one for one, config in bases.items() if issubclass(model, config)), None)
    known = set() if base is None else {key.name for key in keys(bases[base])}
    text = "" if base is None else f"All keys of kind {base}, and\n\n"
    return text + _table(key for key in keys(model, f"{slot}.") if key.name.removeprefix(f"{slot}.") not in known)


def keys(model: type[BaseModel], before: str = "") -> Iterator[Key]:
    """The keys of a model and of the sections in it, with dotted names."""
    for name, field in model.model_fields.items():
        below = list(dict.fromkeys(_models(field.annotation)))
        if name == "kind":
            continue
        if not below or field.description:
            yield Key(before + name, field)
        for section in below:
            yield from keys(section, f"{before}{name}.")


def _table(found: Iterable[Key]) -> str:
    rows = list(dict.fromkeys(key.row() for key in found))
    return table(HEAD, rows) if rows else "No keys but `kind`.\n"


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _default(field: FieldInfo, dimension: str | None) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        return ""
    if value is None or value == ():
        return "none"
    return code(_written(value, dimension))


def _written(value: Any, dimension: str | None) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(_written(one, dimension) for one in value)}]"
    if isinstance(value, float | int | Fraction) and dimension is not None:
        return format_quantity(value, dimension)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _limits(field: FieldInfo, dimension: str | None) -> str:
    choices = _choices(field.annotation)
    if choices:
        return ", ".join(code(one) for one in choices)
    marks = [*field.metadata, *_marks(field.annotation)]
    found = {name: next((getattr(mark, name) for mark in marks if hasattr(mark, name)), None) for name in _BOUNDS}
    words = {name: f"{_BOUNDS[name]}{_written(bound, dimension)}" for name, bound in found.items() if bound is not None}
    low, high = words.get("ge", words.get("gt", "")), words.get("le", words.get("lt", ""))
    if "ge" in words and not high:
        return f"{low} or more"
    return f"{low} to {high}" if low and high else low or (f"up to {high}" if high else "")


def _marks(annotation: Any) -> list[Any]:
    """What is written beside the types within a type, such as the limits of what may be null."""
    own = list(getattr(annotation, "__metadata__", ()))
    own = [mark for one in own for mark in (one.metadata if isinstance(one, FieldInfo) else (one,))]
    return own + [mark for part in get_args(annotation) for mark in _marks(part)]


def _choices(annotation: Any) -> list[str]:
    if get_origin(annotation) is Literal:
        return [str(one) for one in get_args(annotation)]
    if annotation is bool:
        return ["true", "false"]
    if get_origin(annotation) is Union:
        return [one for part in get_args(annotation) for one in _choices(part)]
    return []
