"""Files of YAML, with or without a format and a version: read whole, checked, their problems in one line."""

from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from calibration.errors import CalibrationError
from calibration.files.sections import explain

Content = TypeVar("Content", bound=BaseModel)


def read_yaml(file: Path, what: str) -> dict[str, Any]:
    """The keys and values of a file. what: 'a calibration', for messages. Raises CalibrationError, one line."""
    try:
        content: Any = yaml.load(file.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise CalibrationError(
            f"cannot read {what.split()[-1]} {file}: {error.strerror or error}; check the path"
        ) from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{file} is not text; {what} is a YAML file") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise CalibrationError(f"{file}{where} is not YAML: {problem}") from error
    if not isinstance(content, dict | None):
        raise CalibrationError(f"{file} is not {what}: it must hold keys and values")
    return content or {}


def read_yaml_file(file: Path, what: str, format_name: str, version: int, model: type[Content]) -> Content:
    """The content of a file that must say that format and version.

    Raises CalibrationError, one line: the file, the key, what is wrong and what would be right.
    """
    content = read_yaml(file, what)
    if content.get("format") != format_name:
        raise CalibrationError(f"{file} is not {what}: its first entry must be 'format: {format_name}'")
    if content.get("version") != version:
        raise CalibrationError(f"{file} has version {content.get('version')!r}; this program reads version {version}")
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{file}: {explain(error)}") from error
