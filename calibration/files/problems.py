"""Checks the content of a file against its model. Each problem becomes one line: file, line, key, value, limit and what
to write instead.
"""

import difflib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from calibration.errors import FileError

Key = tuple[str, ...]
Model = TypeVar("Model", bound=BaseModel)
KindOf = Callable[[str, Any], type[BaseModel] | None]

MAX_PROBLEMS = 100
"""Most problems that are told one by one: a file of another kind may have a million."""
MAX_VALUE_CHARACTERS = 60
"""Longer values are cut in messages, so that a message stays one line."""

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
"""Values that pydantic's error types ask for, by the first word of the type."""
_BOUNDS = {
    "greater_than": ("more than", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("less than", "lt"),
    "less_than_equal": ("at most", "le"),
}
_READS_ON = ("is ", "has ", "runs ", "begins ")
"""A validator's message that begins with one of these is put after the key as a sentence; others follow a colon."""
_WORDS = {True: "true", False: "false", None: "null"}


@dataclass(frozen=True)
class ValueSources:
    """The origin of values. file: name of a file, for messages. lines_of: gives the line of each key in it. options:
    keys whose values were given as options. flags: the options' names, by key."""

    file: str
    lines_of: Callable[[], Mapping[Key, int]] = dict
    options: frozenset[Key] = field(default_factory=frozenset)
    flags: Mapping[Key, str] = field(default_factory=dict)

    @cached_property
    def lines(self) -> Mapping[Key, int]:
        """The line of each key."""
        return self.lines_of()

    def line(self, key: Key) -> int | None:
        """Line of a key, or of the nearest section that contains it; None if the file has neither."""
        return next((self.lines[key[:n]] for n in range(len(key), 0, -1) if key[:n] in self.lines), None)

    def flag(self, key: Key) -> str | None:
        """The name of the option by which the value of a key was given; None if it was given otherwise or the option
        has no name."""
        return f"`{self.flags[key]}`" if self._is_option(key) and key in self.flags else None

    def place(self, key: Key) -> str:
        """The beginning of a message: 'option:', or the file, with the line if it has one."""
        if self._is_option(key):
            return "option:"
        line = self.line(key)
        return f"{self.file}:" if line is None else f"{self.file}:{line}:"

    def _is_option(self, key: Key) -> bool:
        return any(key[: len(option)] == option for option in self.options)


@dataclass(frozen=True, slots=True)
class _Schema:
    """The models behind a file's mappings."""

    model: type[BaseModel]
    content: Mapping[str, Any]
    kind_of: KindOf

    def section(self, path: Key) -> type[BaseModel] | None:
        """The model that validates the mapping at `path`; None if there is none."""
        here: type[BaseModel] | None = self.model
        content: Any = self.content
        for part in path:
            content = _below(content, part)
            if part.isdigit() and here is not None and part not in here.model_fields:
                continue  # an item of a list has the model of the list's items
            if here is None or part not in here.model_fields:
                return None
            here = self.of(part, here.model_fields[part], content)
        return here

    def of(self, name: str, info: FieldInfo, content: Any) -> type[BaseModel] | None:
        """The model of a field's content if it holds mappings; else None."""
        models = (kind for kind in plain_types(info.annotation) if issubclass(kind, BaseModel))
        return self.kind_of(name, content) or next(models, None)

    def field(self, key: Key) -> FieldInfo | None:
        """The field at `key`, None if there is none. For an item of a list, the field of the list."""
        named = _named(key)
        section = self.section(named[:-1])
        return section.model_fields.get(named[-1]) if section is not None and named else None

    def keys_called(self, name: str) -> Iterator[Key]:
        """All keys of that name in the model, the outermost first."""
        level: list[tuple[Key, type[BaseModel], Any]] = [((), self.model, self.content)]
        while level:
            yield from ((*path, name) for path, model, _ in level if name in model.model_fields)
            level = [
                ((*path, part), below, _below(content, part))
                for path, model, content in level
                for part, info in model.model_fields.items()
                if (below := self.of(part, info, _below(content, part))) is not None and part not in path
            ]


def validated(
    model: type[Model],
    content: Mapping[str, Any],
    sources: ValueSources,
    kind_of: KindOf = lambda name, content: None,
    context: Mapping[str, Any] | None = None,
) -> Model:
    """The content as a model. Raises FileError with a line for each problem, in the order of the file; of very many
    problems only the first ones have a line.

    Stricter than pydantic: true and false are not numbers, and numbers must be finite. kind_of: gives the model of a
    section whose model depends on its content, from the section's name and content. context: for pydantic's validators.
    """
    schema = _Schema(model, content, kind_of)
    found: dict[Key, list[ErrorDetails]] = {}
    result = None
    try:
        result = model.model_validate(content, context=context)
    except ValidationError as error:
        for problem in error.errors():
            found.setdefault(_key(problem, content), []).append(problem)
    no_numbers = {}
    for key, value, words in _no_numbers(schema, model, content, ()):
        if all(problem["type"] in _BOUNDS for problem in found.get(key, [])):  # pydantic compares true as 1, and NaN
            found.pop(key, None)
            no_numbers[key] = value, words
    outer = {key[:n] for key in (*found, *no_numbers) for n in range(len(key))}
    # If a value may have several forms and has problems inside, it is no news that other forms do not fit.
    wrong = [*no_numbers, *(key for key, problems in found.items() if not (key in outer and _of_form(problems)))]
    if result is not None and not wrong:
        return result
    wrong.sort(key=lambda key: sources.line(key) or 0)
    lines = []
    for key in wrong[:MAX_PROBLEMS]:
        flag = sources.flag(key)
        if key in no_numbers:
            value, words = no_numbers[key]
            text = f"{flag or '.'.join(key)} is {_shown(value)}, it must be {words}{_then(key, schema, flag)}"
        else:
            text = _text(found[key], key, schema, flag)
        lines.append(text if flag else f"{sources.place(key)} {text}")
    if len(wrong) > MAX_PROBLEMS:
        lines.append(f"{sources.file}: {len(wrong) - MAX_PROBLEMS} more problems; is it a file of another kind?")
    raise FileError(*dict.fromkeys(lines))


def _of_form(problems: list[ErrorDetails]) -> bool:
    """Whether the problems of a value say no more than that it has another form."""
    return all(one["type"] == "literal_error" or one["type"].endswith("_type") for one in problems)


def _no_numbers(
    schema: _Schema, model: type[BaseModel], content: Mapping[str, Any], path: Key
) -> Iterator[tuple[Key, Any, str]]:
    """Truth values, NaN and infinities where finite numbers are expected: key, value and what it must be."""
    for name, value in content.items():
        info = model.model_fields.get(name)
        if info is None:
            continue
        below = schema.of(name, info, value)
        words = _number_words(info.annotation)
        for key, leaf in _leaves(value, (*path, name)):
            if isinstance(leaf, Mapping) and below is not None:
                yield from _no_numbers(schema, below, leaf, key)
            elif words is not None and isinstance(leaf, bool):
                yield key, leaf, words
            elif words is not None and isinstance(leaf, float) and not math.isfinite(leaf):
                yield key, leaf, "a finite number"


def _leaves(value: Any, key: Key) -> Iterator[tuple[Key, Any]]:
    """The values in nested lists and tuples, each with its key. A mapping counts as one value."""
    if isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _leaves(item, (*key, str(i)))
    else:
        yield key, value


def _number_words(annotation: Any) -> str | None:
    """Words for the number that a field asks for; None if it takes truth values or no numbers."""
    kinds = set(plain_types(annotation))
    if bool in kinds or not kinds & {int, float}:
        return None
    return _TYPES["float" if float in kinds else "int"]


def plain_types(annotation: Any) -> Iterator[type]:
    """The types that a field's annotation consists of."""
    return (part for part in _parts(annotation) if isinstance(part, type) and not getattr(part, "__args__", ()))


def _parts(annotation: Any) -> Iterator[Any]:
    """An annotation, then all that it is made of."""
    yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _parts(part)


def _key(problem: ErrorDetails, content: Any) -> Key:
    """The key of a problem, without pydantic's own names for validators and members of unions."""
    key: list[str] = []
    for i, part in enumerate(problem["loc"]):
        last = i == len(problem["loc"]) - 1
        in_list = isinstance(part, int) and isinstance(content, list | tuple)
        missing = last and problem["type"] == "missing"
        if in_list or (isinstance(content, Mapping) and (part in content or missing)):
            key.append(str(part))
            content = _below(content, part)
    return tuple(key)


def _below(content: Any, part: str | int) -> Any:
    if isinstance(content, Mapping):
        return content.get(part)
    try:
        return content[int(part)] if isinstance(content, list | tuple) else None
    except (IndexError, ValueError):
        return None


def _named(key: Key) -> Key:
    while key and key[-1].isdigit():
        key = key[:-1]
    return key


def _text(problems: list[ErrorDetails], key: Key, schema: _Schema, flag: str | None) -> str:
    """The message for the problems of one key. flag: the option that the value was given with."""
    # If a value may have several forms, the error of the form that fits says more than those of the others.
    problem = next((one for one in problems if one["type"] == "value_error"), problems[0])
    dotted = flag or ".".join(key)
    kind, context = problem["type"], problem.get("ctx", {})
    then = _then(key, schema, flag)
    if kind == "invalid_key":
        return f"key {dotted} is no text; put it in quotes"
    if kind == "extra_forbidden":
        return _unknown_key(key, schema)
    if kind == "missing" and key[-1].isdigit():
        return f"{'.'.join(key[:-1])} has {key[-1]} values, too few{then}"
    if kind == "missing":
        return f"'{dotted}' is missing{then or '; add it'}"
    if kind == "value_error":
        message = str(context["error"])
        between = "" if not dotted else " " if message.startswith(_READS_ON) else ": "
        return f"{dotted}{between}{message}"
    value = _shown(problem["input"])
    if kind in _BOUNDS:
        words, name = _BOUNDS[kind]
        return f"{dotted} is {value}, it must be {words} {_limit(schema.field(key), context[name])}{then}"
    if kind == "literal_error" and len(problems) == 1:
        return f"{dotted} is {value}; choose {context['expected']}{_meant(problem['input'], context['expected'])}"
    if kind in ("too_short", "too_long"):
        return f"{dotted} is {value}, of the wrong length{then}"
    words = " or ".join(dict.fromkeys(filter(None, map(_asked_for, problems))))
    if words:
        return f"{dotted} is {value}, it must be {words}{then}"
    return f"{dotted} is {value}: {problem['msg'][:1].lower()}{problem['msg'][1:]}{then}"


def _limit(info: FieldInfo | None, value: float) -> str:
    """A limit as text. If its field has a unit, `written` in the field's metadata adds that unit."""
    marks = [] if info is None else list(info.metadata)
    for part in () if info is None else _parts(info.annotation):
        marks += getattr(part, "__metadata__", ())
    written = next((mark.written for mark in marks if hasattr(mark, "written")), None)
    return f"{float(value):g}" if written is None else str(written(value))


def _asked_for(problem: ErrorDetails) -> str:
    if problem["type"] == "literal_error":
        return str(problem["ctx"]["expected"])
    return _TYPES.get(problem["type"].split("_")[0], "")


def _then(key: Key, schema: _Schema, flag: str | None) -> str:
    info = schema.field(key)
    if info is None or not info.examples:
        return ""
    example = info.examples[0]
    said = f"'{_named(key)[-1]}: {example}'" if flag is None else f"{flag[:-1]}={example}`"
    return f"; write for example {said}"


def _unknown_key(key: Key, schema: _Schema) -> str:
    section = schema.section(key[:-1])
    known = list(section.model_fields) if section is not None else []
    elsewhere = next(schema.keys_called(key[-1]), None)
    close = difflib.get_close_matches(key[-1], known, n=1)
    if elsewhere is not None:
        meant = f"did you mean '{'.'.join(elsewhere)}'?{_then(elsewhere, schema, None).replace(';', '', 1)}"
    else:
        meant = f"did you mean '{'.'.join((*key[:-1], *close))}'?" if close else f"keys here are {', '.join(known)}"
    return f"unknown key '{'.'.join(key)}'; {meant}"


def _meant(value: object, expected: str) -> str:
    choices = [part.strip("' ") for part in expected.replace(" or ", ", ").split(",")]
    close = difflib.get_close_matches(str(value), choices, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def _shown(value: object) -> str:
    text = _WORDS[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[: MAX_VALUE_CHARACTERS - 3]}..."
