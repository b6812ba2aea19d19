"""Says in one line each what is wrong in a config: file, line, key, value, limit and what to write instead."""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from drivers.errors import UnknownKind
from drivers.registry import SLOTS, KindConfig, lookup

Key = tuple[str, ...]

MAX_VALUE_CHARACTERS = 60
"""Values longer than this are cut in messages, which stay one line."""

_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "dict": "keys and values",
    "model": "keys and values",
    "list": "a list",
    "tuple": "a list",
    "path": "a path",
}
"""What pydantic's error types ask for, by their first word."""
_BOUNDS = {
    "greater_than": ("more than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
}
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
_READS_ON = ("is ", "has ", "runs ", "begins ")
"""A validator's message that begins so reads on from the key; any other follows a colon."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Where values came from: a file with the line of each key, and the keys that were given as options."""

    file: str
    lines: Mapping[Key, int]
    options: frozenset[Key] = field(default_factory=frozenset)

    def line(self, key: Key) -> int | None:
        """Line of a key, or of the nearest one that contains it."""
        return next((self.lines[key[:n]] for n in range(len(key), 0, -1) if key[:n] in self.lines), None)

    def is_option(self, key: Key) -> bool:
        """Whether a key, or one that contains it, was given as an option."""
        return any(key[: len(option)] == option for option in self.options)

    def place(self, key: Key) -> str:
        """What a message begins with: the option, or the file with the line."""
        if self.is_option(key):
            return "option:"
        line = self.line(key)
        return f"{self.file}:" if line is None else f"{self.file}:{line}:"


def explain(
    error: ValidationError, model: type[BaseModel], content: Mapping[str, Any], sources: Sources
) -> Iterator[str]:
    """One line per problem, in the order of the file."""
    found = []
    for problem in error.errors():
        key = _key(problem)
        flag = FLAGS.get(key) if sources.is_option(key) else None
        text = _text(problem, key, _Schema(model, content), flag)
        found.append((sources.line(key) or 0, text if flag else f"{sources.place(key)} {text}"))
    for _, text in sorted(found, key=lambda item: item[0]):
        yield text


@dataclass(frozen=True, slots=True)
class _Schema:
    """The models behind a config's mappings; those of a slot depend on the kind that the content names."""

    model: type[BaseModel]
    content: Mapping[str, Any]

    def section(self, path: Key) -> type[BaseModel] | None:
        """The model that validates the mapping at `path`."""
        here: type[BaseModel] | None = self.model
        for part in path:
            if here is None or part not in here.model_fields:
                return None
            here = _model_in(here.model_fields[part].annotation)
            if here is KindConfig and part in SLOTS:
                here = self._kind(part)
        return here

    def field(self, key: Key) -> FieldInfo | None:
        """The field at `key`; for an item of a list, the list's."""
        named = _named(key)
        section = self.section(named[:-1])
        return section.model_fields.get(named[-1]) if section is not None and named else None

    def _kind(self, slot: str) -> type[BaseModel] | None:
        given = self.content.get(slot)
        try:
            return lookup(slot, str(given.get("kind"))).config if isinstance(given, Mapping) else None
        except UnknownKind:
            return None


def _key(problem: ErrorDetails) -> Key:
    return tuple(str(part) for part in problem["loc"] if not str(part).startswith(("function-", "lax-or-strict")))


def _named(key: Key) -> Key:
    while key and key[-1].isdigit():
        key = key[:-1]
    return key


def _text(problem: ErrorDetails, key: Key, schema: _Schema, flag: str | None) -> str:
    """flag: the option that the value was given with."""
    dotted = flag or ".".join(key)
    kind, context = problem["type"], problem.get("ctx", {})
    example = _example(f"{_named(key)[-1]}: " if flag is None else f"{flag} ", schema.field(key)) if key else ""
    if kind == "extra_forbidden":
        return _unknown_key(key, schema.section(key[:-1]))
    if kind == "missing":
        return f"'{dotted}' is missing; {example or 'add it'}"
    if kind == "value_error":
        message = str(context["error"])
        between = "" if not dotted else " " if message.startswith(_READS_ON) else ": "
        return f"{dotted}{between}{message}"
    value = _shown(problem["input"])
    then = f"; {example}" if example else ""
    if kind in _BOUNDS:
        words, name = _BOUNDS[kind]
        return f"{dotted} is {value}, it must be {words} {float(context[name]):g}{then}"
    if kind == "literal_error":
        return f"{dotted} is {value}; choose {context['expected']}{_meant(problem['input'], context['expected'])}"
    words = _TYPES.get(kind.split("_")[0], "")
    if kind in ("too_short", "too_long"):
        return f"{dotted} is {value}, of the wrong length{then}"
    if words:
        return f"{dotted} is {value}, it must be {words}{then}"
    return f"{dotted} is {value}: {problem['msg'][:1].lower()}{problem['msg'][1:]}{then}"


def _unknown_key(key: Key, section: type[BaseModel] | None) -> str:
    known = list(section.model_fields) if section is not None else []
    close = difflib.get_close_matches(key[-1], known, n=1)
    meant = f"did you mean '{close[0]}'?" if close else f"keys here are {', '.join(known)}"
    return f"unknown key '{'.'.join(key)}'; {meant}"


def _example(name: str, info: FieldInfo | None) -> str:
    if info is None or not info.examples:
        return ""
    return f"write for example '{name}{info.examples[0]}'"


def _meant(value: object, expected: str) -> str:
    choices = [part.strip("' ") for part in expected.replace(" or ", ", ").split(",")]
    close = difflib.get_close_matches(str(value), choices, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[: MAX_VALUE_CHARACTERS - 3]}..."


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type):
        return annotation if issubclass(annotation, BaseModel) else None
    return next((found for part in getattr(annotation, "__args__", ()) if (found := _model_in(part)) is not None), None)
