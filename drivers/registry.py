"""Kinds of devices and worlds by name, found through entry points, so that any installed package can add one."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from drivers.clock import Clock, SystemClock
from drivers.errors import LimitExceeded, UnknownKind
from drivers.interfaces import World
from drivers.optional_packages import added
from drivers.transports.endpoints import Endpoint
from drivers.transports.tap import Tap
from drivers.units import IN_NAMES, dimension_of, format_quantity

SLOTS = ("spad", "scanner", "laser", "sync", "world")
"""The parts of a rig. The kinds of slot `spad` are the entry points of group `spadrig.spad`, and so on."""


class KindConfig(BaseModel):
    """Base of every kind's config. Unknown keys are refused, and values cannot be changed. `kind` names the entry
    point."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    real_time: ClassVar[bool] = True
    """Whether the kind runs in the host's time. A laser or sync source that does is owned by the guard. If the world
    does not, the whole rig runs on virtual time."""

    kind: str


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The things that a device needs besides its config. Real devices use clock, ports and tap; simulated devices use
    clock, world and seed (of their random numbers)."""

    clock: Clock
    world: World | None
    seed: int
    ports: Mapping[str, Endpoint] = field(default_factory=dict)
    """Ports that an emulating world created, by name; a device's `port: emulated:NAME` means one of them."""
    tap: Tap | None = None
    """Tap that records everything that passes the device's port. None: nothing is recorded."""


@dataclass(frozen=True, slots=True)
class Kind:
    """The object that an entry point loads: the config model of a kind and the function that opens the device.

    `create(config, surroundings)` gets an instance of `config` and returns a device with the interface of its part of
    the rig (see SLOTS), or a `World`. It raises a `DeviceError` if the device cannot be opened.
    """

    config: type[BaseModel]
    create: Callable[[Any, Surroundings], Any]
    check_files: Callable[[Any], object] | None = None
    """Function that opens the files which a config names, as `create` does, but no device. It raises `DeviceError` if
    one cannot be used. None: the config names no file, or the kind is a world (creating the world is the check).
    """
    off: Callable[[Any], bytes] | None = None
    """Function that returns, for a config, the bytes that switch off a laser on a serial port, whatever state it is
    in. They are sent if there is no time to open the laser first."""


Config = TypeVar("Config", bound=BaseModel)
Loaded = TypeVar("Loaded")


def config_of(kind: type[Config], **fields: object) -> Config:
    """The config of a device that is opened by itself, without a file.

    A field with a unit takes text, as in a file: `max_power="50 mW"`. Or the unit is added to its name, and it takes a
    number in SI units: `max_power_w=0.05`; None counts as not given. Raises `LimitExceeded`, with one line, for the
    first wrong field.
    """
    given: dict[str, str] = {}
    for name, about in kind.model_fields.items():
        dimension = dimension_of(about)
        if dimension is None:
            continue
        key = "_".join(filter(None, (name, IN_NAMES[dimension])))
        if not isinstance(fields.get(name, ""), str) and key != name:
            raise LimitExceeded(f"{name} is {fields[name]!r}; give {key}, a number in SI units")
        if key in fields and key != name:
            value = fields.pop(key)
            if isinstance(value, str):
                raise LimitExceeded(f"{key} is {value!r}; give a number in SI units, or {name}={value!r}")
            if value is not None:
                fields[name] = _quantity(key, value, dimension)
                given[name] = f"{key} = {value!r}"
        elif key in fields and fields[key] is None:
            del fields[key]
        elif key in fields and not isinstance(fields[key], str):
            fields[name] = _quantity(key, fields[key], dimension)
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        wrong = error.errors()[0]
        where = ".".join(str(part) for part in wrong["loc"])
        raise LimitExceeded(
            f"{given.get(where, where) or kind.__name__}: {wrong['msg']}; correct this argument"
        ) from None


def _quantity(name: str, value: Any, dimension: str) -> str:
    """An argument in SI units, written as text with a unit. Raises `LimitExceeded` if it is no finite number."""
    try:
        return format_quantity(value, dimension)
    except (TypeError, ValueError):
        raise LimitExceeded(f"{name} is {value!r}; give a number in SI units") from None


def alone() -> Surroundings:
    """The surroundings of a real device that is opened by itself: the system's clock, and no world, emulated ports or
    tap."""
    return Surroundings(SystemClock(), None, 0)


def kinds(slot: str) -> tuple[str, ...]:
    """Names of the kinds installed for a slot, sorted. Does not import them. Raises ValueError for an unknown slot."""
    return tuple(sorted({entry.name for entry in _entries(slot)}))


def lookup(slot: str, kind: str) -> Kind:
    """Load the kind of a slot. Raises `UnknownKind`, with the choices or with the reason why the entry cannot be used,
    and ValueError for an unknown slot."""
    return load_entry(slot, kind, _entries(slot), Kind)


def load_entry(slot: str, kind: str, entries: Iterable[EntryPoint], wanted: type[Loaded]) -> Loaded:
    """Load the only entry point named `kind` among `entries`, which are those of a slot. The loaded object must be a
    `wanted`. Raises `UnknownKind`, with the choices or with the reason why the entry cannot be used."""
    entries = tuple(entries)
    found = {entry.value: entry for entry in entries if entry.name == kind}
    if not found:
        choices = ", ".join(sorted({entry.name for entry in entries})) or "none installed"
        raise UnknownKind(
            f"{slot}: unknown kind {kind!r}; choose one of: {choices}, or install the package that has it"
        )
    if len(found) > 1:
        raise UnknownKind(f"{slot}: kind {kind!r} is offered twice ({', '.join(sorted(found))}); uninstall one package")
    entry = next(iter(found.values()))
    try:
        loaded = entry.load()
    except (ImportError, AttributeError, TypeError) as error:
        raise UnknownKind(f"{slot}: kind {kind!r} cannot be loaded from {entry.value}: {error}") from error
    if not isinstance(loaded, wanted):
        what = f"{wanted.__module__}.{wanted.__name__}"
        members = {*vars(wanted), *inspect.get_annotations(wanted)} if getattr(wanted, "_is_protocol", False) else set()
        lacking = sorted(name for name in members if not name.startswith("_") and not hasattr(loaded, name))
        why = f"without {', '.join(lacking)}" if lacking else f"of type {type(loaded).__name__}"
        if isinstance(loaded, type):
            why = "a class, where an instance is needed"
        raise UnknownKind(f"{slot}: entry point {entry.value} of kind {kind!r} is no {what}, but {why}")
    return loaded


def _entries(slot: str) -> tuple[EntryPoint, ...]:
    if slot not in SLOTS:
        raise ValueError(f"no slot {slot!r} in a rig; slots are {', '.join(SLOTS)}")
    return added(f"spadrig.{slot}")
