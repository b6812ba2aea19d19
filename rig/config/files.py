"""Finds and reads config files: bundled ones by name, others by path, with options overriding their values.

All problems are listed at once, each by the name under which the user gave the value: a key of the file or an option.
"""

import copy
import difflib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from calibration.errors import FileError
from calibration.files.problems import Key, ValueSources, plain_types, validated
from calibration.files.rig_file import CAMERA_FORMAT
from calibration.files.sections import FORMAT, YamlFile, load_yaml, parse_yaml
from drivers.errors import UnknownKind
from drivers.registry import SLOTS, kinds, lookup
from rig.config.bundled import BUNDLED, bundled_rigs, bundled_scenes
from rig.config.completion import block_text, completed
from rig.config.models import CubePlan, RigConfig
from rig.errors import UsageError, similar_beside

FLAGS: Mapping[Key, str] = {
    ("world", "scene"): "scene",
    ("world", "fog"): "fog",
    ("scan", "exposures"): "exposures",
    ("estimate", "estimator"): "estimator",
    ("estimate", "filter"): "filter",
    ("estimate", "min_confidence"): "min_confidence",
    ("estimate", "temporal_prior"): "temporal_prior",
    ("estimate", "learned"): "learned",
    ("estimate", "threads"): "threads",
}
"""Names of the options of a call that set a key of the config, by this key."""


def kind_of(slot: str, content: Any) -> type[BaseModel] | None:
    """The config model of the kind that the section of a slot (device or world) names; None if either is unknown."""
    if slot not in SLOTS or not isinstance(content, Mapping):
        return None
    try:
        return lookup(slot, str(content.get("kind"))).config
    except UnknownKind:
        return None


SUFFIXES = (".yaml", ".yml")
PLAN_FORMAT = "spadrig-plan"
"""`format` of the compiled plan that lies beside a recording's frames."""
_OTHERS = {
    PLAN_FORMAT: "the compiled plan of a recording, which is found beside its frames",
    FORMAT: "a calibration",
    CAMERA_FORMAT: "the calibration of a camera alone",
}
"""Other files of this program that a user may mistake for a config, by their key `format`."""
_CONFIG = ("a config", "scan: {columns: 500}")
DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""The form of JSON schema that pydantic writes, by its name."""
MAX_PATH = 1000
"""Text of this many characters or more is not taken for a path."""
SCENE = ("world", "scene")
"""Key of the scene: a path, or a bundled scene's name."""
NO_CONFIG = "no config"
"""Beginning of the message about a name that means no config."""

Model = TypeVar("Model", bound=BaseModel)


def load_config(name_or_path: str | Path = "simulated", overrides: Mapping[str, object] | None = None) -> RigConfig:
    """Load the rig config of a bundled name ("simulated") or a file, with values replaced by `overrides`.

    overrides: value by dotted key, e.g. {"scan.exposures": 4, "world.scene": "street"}; None values are skipped. Paths
    in the file are relative to the file's folder, and so are `calibration` and `estimate.learned` in overrides. Other
    paths in overrides are relative to the working directory. Raises UsageError with one line per problem, all problems
    at once.
    """
    path = find_config(name_or_path)
    read = read_config(path)
    content = read.content
    _refuse_others(path, content, f"name the config of a rig, such as {bundled_configs()[0]}")
    _anchor_paths(content, path.parent)
    given = {key: value for key, value in (overrides or {}).items() if value is not None}
    for key, value in given.items():
        _lay_over(content, key, value)
    sources = ValueSources(_shown(path), read.lines, _keys(given), FLAGS)
    return _validated(RigConfig, content, sources, path.parent)


def load_cube_plan(path: str | Path) -> CubePlan:
    """Load the `plan.yaml` of a bare cube of frames (`rig reconstruct`). Raises UsageError, with a line per problem."""
    read = _read(Path(path), "a plan", "columns: 500")
    keys = f"the plan of frames alone has {', '.join(CubePlan.model_fields)}"
    if {"spad", "scanner"} <= read.content.keys():
        raise UsageError(f"{path} is the config of a rig; {keys}")
    leave = "leave `plan` out; " if read.content.get("format") == PLAN_FORMAT else ""
    _refuse_others(path, read.content, f"{leave}{keys}")
    return _validated(CubePlan, read.content, ValueSources(_shown(Path(path)), read.lines), Path(path).parent)


def completed_text(name_or_path: str | Path) -> str:
    """The text of a config, including comments, with every default filled in and every path absolute.

    The text means the same in a file of any folder. If defaults cannot be filled in, for example because of aliases,
    the text is written anew without comments. Raises UsageError as `load_config` does.
    """
    path = find_config(name_or_path)
    read = read_config(path)
    anchored = copy.deepcopy(read.content)
    _anchor_paths(anchored, path.parent)
    full = portable_content(load_config(path))
    if anchored.get("calibration") is not None:
        anchored["calibration"] = full["calibration"]
    if (anchored.get("estimate") or {}).get("learned") is not None:
        anchored["estimate"]["learned"] = full["estimate"]["learned"]
    text = completed(read.text, read.node, anchored, full)
    try:
        same = portable_content(parse_config(config_content(text))) == full
    except UsageError:
        same = False
    if same:
        return text
    return f"# {_shown(path)}, written anew without its comments\n{block_text(full)}"


def config_content(text: str) -> dict[str, Any]:
    """The keys and values of a config's text, unchecked. Raises UsageError if it is not a YAML mapping."""
    try:
        return parse_yaml(text, *_CONFIG, "config").content
    except FileError as error:
        raise UsageError(*error.problems) from error


def parse_config(content: Mapping[str, object], options: Iterable[str] = ()) -> RigConfig:
    """Validate a config from a mapping, such as a notebook's or a manifest's. Raises UsageError with one line per
    problem.

    options: dotted keys whose values were given as options, so that problems name the options.
    """
    return _validated(RigConfig, dict(content), ValueSources("config", options=_keys(options), flags=FLAGS))


def _keys(dotted: Iterable[str]) -> frozenset[Key]:
    return frozenset(tuple(key.split(".")) for key in dotted)


def portable_content(config: RigConfig) -> dict[str, Any]:
    """A config as plain values that have the same meaning in a file of any folder: every path in it is absolute. Text
    of devices and world that begins with ~ is left as it is.

    Relative paths of `config` count from the working directory.
    """
    content: dict[str, Any] = config.model_dump(mode="json")
    here = Path.cwd()
    _anchor_paths(content, here)
    if config.calibration is not None:
        content["calibration"] = _absolute(here / config.calibration)
    if config.estimate.learned is not None:
        content["estimate"]["learned"] = _absolute(here / config.estimate.learned)
    return content


def bundled_configs() -> tuple[str, ...]:
    """Names of the rigs that come with the program, sorted."""
    return tuple(one.name for one in bundled_rigs())


def find_config(name_or_path: str | Path) -> Path:
    """Find the file that a bundled name or a path means. A file of that path goes before a bundled config of that name.
    Raises UsageError if there is none."""
    path = Path(name_or_path)
    if os.path.isfile(path):  # unlike Path.is_file, it takes any text for a name
        return path
    plain = path.suffix not in SUFFIXES and path.parent == Path(".")
    names = bundled_configs()
    if plain and path.name in names:
        return BUNDLED / f"{path.name}.yaml"
    if os.path.isdir(path):
        raise UsageError(f"config {path} is a folder; name the YAML file in it")
    close = difflib.get_close_matches(path.stem, names, n=1)
    similar = close[0] if close else similar_beside(path, lambda one: one.suffix in SUFFIXES and one.is_file())
    meant = "" if similar is None else f"did you mean '{similar}'? "
    if path.name in (one.name for one in bundled_scenes()):
        meant = f"it is a scene, which is chosen by `scene={path.name}`; "
    missing = "" if plain and not str(name_or_path).endswith(("/", os.sep)) else "that path does not exist; "
    raise UsageError(
        f"{NO_CONFIG} '{name_or_path}': {missing}{meant}bundled configs are {', '.join(names) or 'none'}; "
        "anything else is the path of a YAML file; 'rig config show' prints one to begin with"
    )


def config_schema() -> dict[str, Any]:
    """JSON schema of a rig config, with the installed kinds of the world and each device, and the estimators.

    Editors of YAML check a file by it if the file begins with `# yaml-language-server: $schema=FILE`.
    """
    schema = {"$schema": DIALECT, **RigConfig.model_json_schema()}
    definitions = schema.setdefault("$defs", {})
    definitions.pop("KindConfig", None)
    for slot in SLOTS:
        choices = []
        for name in kinds(slot):
            kind = lookup(slot, name).config.model_json_schema(ref_template=f"#/$defs/{slot}.{name}.{{model}}")
            for key, value in kind.pop("$defs", {}).items():
                definitions[f"{slot}.{name}.{key}"] = value
            kind["properties"]["kind"] = {"const": name}
            kind["required"] = ["kind", *(key for key in kind.get("required", ()) if key != "kind")]
            definitions[f"{slot}.{name}"] = kind
            choices.append({"$ref": f"#/$defs/{slot}.{name}"})
        described = {k: v for k, v in schema["properties"][slot].items() if k in ("description", "default")}
        schema["properties"][slot] = {**described, "oneOf": choices or [{"type": "object"}]}
    return schema


def read_config(path: Path) -> YamlFile:
    """Read a config file without filling anything in. Raises UsageError, also for a key given twice."""
    return _read(path, *_CONFIG)


def _read(path: Path, what: str, example: str) -> YamlFile:
    try:
        return load_yaml(path, what, example, _shown(path))
    except FileError as error:
        raise UsageError(*error.problems) from error


def _refuse_others(path: str | Path, content: Mapping[str, Any], then: str) -> None:
    """Raise UsageError for a file of this program that is of another kind (`_OTHERS`). then: the next step."""
    if (what := _OTHERS.get(str(content.get("format")))) is not None:
        raise UsageError(f"{path} is {what}; {then}")


def _validated(
    model: type[Model], content: Mapping[str, Any], sources: ValueSources, folder: Path | None = None
) -> Model:
    try:
        return validated(model, content, sources, kind_of, {"folder": folder})
    except FileError as error:
        raise UsageError(*error.problems) from error


def _anchor_paths(content: dict[str, Any], folder: Path) -> None:
    """Make relative paths in the sections of devices and world absolute, since these do not know the file's folder.

    These count as paths: a scene that is not bundled, a value whose field is a path, and text that begins with ./ or
    ../, ends in .yaml or .yml, or has a slash and exists in the folder. Text that begins with ~ is left as it is.
    """

    def anchored(value: object) -> object:
        if isinstance(value, str) and _is_path(value, folder):
            return _absolute(folder / value)
        if isinstance(value, dict):
            return {key: anchored(part) for key, part in value.items()}
        return value

    scenes = {one.name for one in bundled_scenes()}
    for slot in SLOTS:
        if slot in content:
            content[slot] = anchored(content[slot])
            kind = kind_of(slot, content[slot])
            for name, info in ({} if kind is None else kind.model_fields).items():
                value = content[slot].get(name)
                named = Path in plain_types(info.annotation) or ((slot, name) == SCENE and str(value) not in scenes)
                if named and isinstance(value, str) and not value.startswith("~"):
                    content[slot][name] = _absolute(folder / value)


def _absolute(path: Path) -> str:
    """Make a path absolute. Links and '..' in its folder are resolved. Its last part is kept even if it is a link:
    names in /dev/serial/by-id/ are stable."""
    return str(path.parent.resolve() / path.name)


def _is_path(value: str, folder: Path) -> bool:
    if value.startswith("~") or len(value) >= MAX_PATH:
        return False
    return (
        value.startswith(("./", "../")) or value.endswith(SUFFIXES) or ("/" in value and os.path.exists(folder / value))
    )


def _lay_over(content: dict[str, Any], key: str, value: object) -> None:
    *parents, last = key.split(".")
    place = content
    for parent in parents:
        below = place.get(parent)
        place[parent] = dict(below) if isinstance(below, dict) else {}
        place = place[parent]
    place[last] = copy.deepcopy(value)


def _shown(path: Path) -> str:
    return path.name if path.parent == BUNDLED else str(path)
