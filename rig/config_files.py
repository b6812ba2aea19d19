"""Finds and reads config files: bundled ones by name, others by path, options laid over them, all problems at once."""

import copy
import difflib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from calibration.files.camera_file import CAMERA_FORMAT
from calibration.files.sections import FORMAT
from drivers.registry import SLOTS, kinds, lookup
from rig.bundled import BUNDLED, SCENES, bundled_rigs, bundled_scenes
from rig.config import CubePlan, RigConfig
from rig.config_problems import Key, Sources, explain
from rig.errors import UsageError

SUFFIXES = (".yaml", ".yml")
PLAN_FORMAT = "spadrig-plan"
"""`format` of the compiled plan that lies beside a recording's frames."""
_OTHERS = {
    PLAN_FORMAT: "the compiled plan of a recording, which is found beside its frames",
    FORMAT: "a calibration",
    CAMERA_FORMAT: "the calibration of a camera alone",
}
"""Files of ours that are taken for others, by their `format`."""
NO_CONFIG = "no config"
"""Begins what is said of a name that means none."""

Model = TypeVar("Model", bound=BaseModel)


def load_config(name_or_path: str | Path = "simulated", overrides: Mapping[str, object] | None = None) -> RigConfig:
    """The rig config of a bundled name ("simulated") or a file, with `overrides` laid over it.

    overrides: value by dotted key, e.g. {"scan.exposures": 4, "world.scene": "street"}; None values are skipped. Paths
    in the file are relative to its folder, those in overrides to the working directory. Raises UsageError with one line
    per problem, all problems at once.
    """
    path = find_config(name_or_path)
    content, lines = read_yaml(path)
    _refuse_others(path, content, f"name the config of a rig, such as {bundled_configs()[0]}")
    _anchor_paths(content, path.parent)
    given = {key: value for key, value in (overrides or {}).items() if value is not None}
    for key, value in given.items():
        _lay_over(content, key, value)
    sources = Sources(_shown(path), lines, _keys(given))
    return _validated(RigConfig, content, sources, path.parent)


def load_cube_plan(path: str | Path) -> CubePlan:
    """The `plan.yaml` of a bare cube. Raises UsageError with one line per problem."""
    content, lines = read_yaml(Path(path))
    leave = "leave --plan out; " if content.get("format") == PLAN_FORMAT else ""
    _refuse_others(path, content, f"{leave}the plan of frames alone has {', '.join(CubePlan.model_fields)}")
    return _validated(CubePlan, content, Sources(_shown(Path(path)), lines), Path(path).parent)


def parse_config(content: Mapping[str, object], folder: Path | None = None, options: Iterable[str] = ()) -> RigConfig:
    """A config from a mapping, such as a notebook's or a manifest's. Raises UsageError with one line per problem.

    options: dotted keys whose values were given as options, for these problems.
    """
    return _validated(RigConfig, dict(content), Sources("config", {}, _keys(options)), folder)


def _keys(dotted: Iterable[str]) -> frozenset[Key]:
    return frozenset(tuple(key.split(".")) for key in dotted)


def portable_content(config: RigConfig) -> dict[str, Any]:
    """A config as plain values that mean the same in a file of any folder: every path in it is absolute.

    The paths of a loaded config are absolute or relative to the working directory.
    """
    content: dict[str, Any] = config.model_dump(mode="json")
    here = Path.cwd()
    _anchor_paths(content, here)
    if config.calibration is not None:
        content["calibration"] = _absolute(here / config.calibration)
    scene = (content["world"] or {}).get("scene")
    if isinstance(scene, str) and not (SCENES / f"{scene}.yaml").is_file():
        file = here / Path(scene).expanduser()  # a folder's name alone may be a scene too
        content["world"]["scene"] = _absolute(file) if file.exists() else scene
    return content


def bundled_configs() -> tuple[str, ...]:
    """Names of the rigs that travel with the program, sorted."""
    return tuple(one.name for one in bundled_rigs())


def find_config(name_or_path: str | Path) -> Path:
    """The file that a name or path means. Raises UsageError where there is none."""
    path = Path(name_or_path)
    if path.is_file():
        return path
    plain = path.suffix not in SUFFIXES and path.parent == Path(".")
    names = bundled_configs()
    if plain and path.name in names:
        return BUNDLED / f"{path.name}.yaml"
    if path.is_dir():
        raise UsageError(f"config {path} is a folder; name the YAML file in it")
    close = difflib.get_close_matches(path.stem, names, n=1)
    meant = f"did you mean '{close[0]}'? " if close else ""
    if path.name in (one.name for one in bundled_scenes()):
        meant = f"it is a scene, which is chosen by --scene {path.name}; "
    missing = "" if plain and not str(name_or_path).endswith(("/", os.sep)) else "that path does not exist; "
    raise UsageError(
        f"{NO_CONFIG} '{name_or_path}': {missing}{meant}bundled configs are {', '.join(names) or 'none'}; "
        "anything else is the path of a YAML file"
    )


def config_schema() -> dict[str, Any]:
    """JSON schema of a rig config, with the installed kinds of every slot."""
    schema = RigConfig.model_json_schema()
    definitions = schema.setdefault("$defs", {})
    definitions.pop("KindConfig", None)
    for slot in SLOTS:
        choices = []
        for name in kinds(slot):
            kind = lookup(slot, name).config.model_json_schema(ref_template=f"#/$defs/{slot}.{name}.{{model}}")
            for key, value in kind.pop("$defs", {}).items():
                definitions[f"{slot}.{name}.{key}"] = value
            kind["properties"]["kind"] = {"const": name}
            definitions[f"{slot}.{name}"] = kind
            choices.append({"$ref": f"#/$defs/{slot}.{name}"})
        described = {k: v for k, v in schema["properties"][slot].items() if k in ("description", "default")}
        schema["properties"][slot] = {**described, "oneOf": choices or [{"type": "object"}]}
    return schema


def read_yaml(path: Path) -> tuple[dict[str, Any], dict[Key, int]]:
    """A YAML file's mapping, and the line of each key by its path. Raises UsageError; a key given twice is one."""
    name = _shown(path)
    try:
        text = path.read_text(encoding="utf-8")
        loader = yaml.SafeLoader(text)
        try:
            node = loader.get_single_node()
            content = loader.construct_document(node) if node is not None else None
        finally:
            loader.dispose()
    except OSError as error:
        raise UsageError(f"cannot read {name}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{name} is not text in UTF-8; a config is a YAML file") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark is not None else ""
        why = getattr(error, "problem", None) or "unreadable"
        raise UsageError(f"{name}{where}: not YAML: {why}; check indentation, quotes and brackets there") from error
    if not isinstance(content, dict):
        kind = "is empty" if content is None else f"holds a {type(content).__name__}"
        raise UsageError(f"{name} {kind}; it must hold keys and values, e.g. 'scan: {{columns: 500}}'")
    lines: dict[Key, int] = {}
    twice = list(_walk(node, (), lines))
    if twice:
        raise UsageError.of(f"{name}:{line}: '{'.'.join(key)}' is given twice; keep one" for key, line in twice)
    return content, lines


def _refuse_others(path: str | Path, content: Mapping[str, Any], then: str) -> None:
    """UsageError for a file of ours that is neither a config nor the plan of a cube; then: the next step."""
    if (what := _OTHERS.get(str(content.get("format")))) is not None:
        raise UsageError(f"{path} is {what}; {then}")


def _walk(node: Any, path: Key, lines: dict[Key, int]) -> list[tuple[Key, int]]:
    """Note the line of every key below `node`; returns the keys that occur twice."""
    twice: list[tuple[Key, int]] = []
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*path, str(key.value))
            line = key.start_mark.line + 1
            if here in lines:
                twice.append((here, line))
            lines[here] = line
            twice += _walk(value, here, lines)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            lines[(*path, str(i))] = value.start_mark.line + 1
            twice += _walk(value, (*path, str(i)), lines)
    return twice


def _validated(model: type[Model], content: Mapping[str, Any], sources: Sources, folder: Path | None) -> Model:
    try:
        return model.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        raise UsageError.of(explain(error, model, content, sources)) from error


def _anchor_paths(content: dict[str, Any], folder: Path) -> None:
    """Make relative paths in the slots of devices absolute: their kinds do not know the file's folder.

    A path is text that begins with a dot, or that has a slash or a suffix and exists beside the file.
    """

    def anchored(value: object) -> object:
        if isinstance(value, str) and (value.startswith(("./", "../")) or _exists_beside(value, folder)):
            return _absolute(folder / value)
        if isinstance(value, dict):
            return {key: anchored(part) for key, part in value.items()}
        return value

    for slot in SLOTS:
        if slot in content:
            content[slot] = anchored(content[slot])


def _absolute(path: Path) -> str:
    """Without '..'; what is itself a link stays, as those of /dev/serial/by-id/ must."""
    return str(path.parent.resolve() / path.name)


def _exists_beside(value: str, folder: Path) -> bool:
    return ("/" in value or value.endswith(SUFFIXES)) and len(value) < 1000 and (folder / value).exists()


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
