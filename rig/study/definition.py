"""A study: the content of its YAML file, and the combinations of settings that it names."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from calibration.errors import FileError
from calibration.files.problems import MAX_VALUE_CHARACTERS
from calibration.files.sections import load_yaml
from rig.config.overrides import MAX_SEED, PathLike
from rig.errors import UsageError

Action = Literal["scan", "reconstruct", "tradeoff", "strategies", "calibrate"]
Setting = dict[str, Any]

_OF_RIG: Final = ("config", "scene", "fog", "exposures", "estimator", "filter", "min_confidence", "temporal_prior")
KEYS: Final[Mapping[Action, tuple[str, ...]]] = {
    "scan": (*_OF_RIG, "maps"),
    "reconstruct": ("recording", "plan", "calibration", "estimator", "filter", "min_confidence"),
    "tradeoff": ("config", "scene", "fog", "exposures", "lines", "estimator", "filter", "limits"),
    "strategies": ("config", "scene", "fog", "strategy", "time", "rule", "rows", "lux"),
    "calibrate": ("config", "scene", "exposures", "poses"),
}
"""Settings of each action. Those that simulate a rig take keys of its config too: `scan.columns`."""
KEY_OF: Final[Mapping[str, str]] = {
    "scene": "world.scene",
    "fog": "world.fog",
    "exposures": "scan.exposures",
    "estimator": "estimate.estimator",
    "filter": "estimate.filter",
    "min_confidence": "estimate.min_confidence",
    "temporal_prior": "estimate.temporal_prior",
}
"""Keys of the config by the short names of settings."""
WHOLE: Final[tuple[Action, ...]] = ("tradeoff", "strategies")
"""Actions whose lists are all combined in one table of their own."""
OF_A_CASE: Final[Mapping[Action, tuple[str, ...]]] = {
    "tradeoff": ("scene", "fog", "exposures", "lines"),
    "strategies": ("scene", "fog", "time", "rule", "strategy"),
}
"""Settings of such an action that tell its cases apart. Each case has all of the others, such as all estimators."""
PATHS: Final = "config", "scene", "recording", "plan", "calibration"
NAMES: Final = "config", "scene"
"""Those that may also be names of what is built in."""
SIZES: Final = {"MB": 1e6, "GB": 1e9}
TIMES_S: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}
_AMOUNT: Final = re.compile(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*([A-Za-z]+)\s*", re.ASCII)
MOST_CASES: Final = 1_000_000


class Study(BaseModel):
    """A study, as in its YAML file.

    do: what is done in each case.
    vary: lists by setting; every combination is a case.
    also: further cases, each with its own settings.
    set: settings that hold for all cases.
    omit: groups of settings; a combination that has all settings of one group is left out.
    repeat, seed: each case is done `repeat` times, with the seeds seed, seed + 1, ...
    keep: whether each case keeps its files, such as depth maps.
    time_limit, memory_limit: of a case, as text such as '10 min' and '500 MB'.
    retries: how often a case is done again if its process died, hung or took too much memory.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    do: Action
    vary: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    also: list[Setting] = []
    set: Setting = {}
    omit: list[Annotated[Setting, Field(min_length=1)]] = []
    repeat: int = Field(default=1, ge=1)
    seed: int = Field(default=0, ge=0, le=MAX_SEED - 1_000_000)
    keep: bool = False
    time_limit: str = "1 h"
    memory_limit: str = "2 GB"
    retries: int = Field(default=2, ge=0)

    @field_validator("time_limit", mode="before")
    @classmethod
    def _time(cls, text: Any) -> Any:
        if not _amount(text, TIMES_S):
            raise ValueError(f"{text!r} is no time for a case; write it like '90 s', '10 min' or '2 h'")
        return text

    @field_validator("memory_limit", mode="before")
    @classmethod
    def _memory(cls, text: Any) -> Any:
        if not _amount(text, SIZES):
            raise ValueError(f"{text!r} is no size of memory; write it like '2 GB' or '500 MB'")
        return text

    @property
    def time_limit_s(self) -> float:
        """Longest wall time of a case in seconds."""
        return _amount(self.time_limit, TIMES_S)

    @property
    def memory_limit_bytes(self) -> int:
        """Most memory of a case."""
        return int(_amount(self.memory_limit, SIZES))

    @property
    def seeds(self) -> range:
        """The seeds of every combination."""
        return range(self.seed, self.seed + self.repeat)

    def combinations(self) -> Iterator[Setting]:
        """The settings of every case, without its seed: the combined lists first, then `also`."""
        lists = [[(key, value) for value in values] for key, values in self.vary.items()]
        varied = [dict(each) for each in product(*lists)] if lists or not self.also else []
        for one in [*varied, *self.also]:
            setting = {**self.set, **one}
            if not left_out(setting, self.omit):
                yield setting

    def problems(self) -> list[str]:
        """A line for each problem that a single field does not show, such as a setting that the action does not
        have."""
        given = [*self.vary, *self.set, *(key for one in [*self.also, *self.omit] for key in one)]
        known = KEYS[self.do]
        dotted = self.do in ("scan", "calibrate")
        problems = [
            f"{key!r} is no setting but a key of the study itself, beside vary"
            if key in Study.model_fields
            else f"{self.do} has no setting {key!r}; it has {', '.join(known)}"
            + (", and keys of the config such as scan.columns" if dotted else "")
            for key in dict.fromkeys(given)
            if key not in known and not (dotted and key.count(".") == 1)
        ]
        if self.do == "reconstruct" and self.repeat != 1:
            problems.append("repeat is for what is drawn, and reconstruct draws nothing; leave it out")
        problems += [
            f"set gives {key} a list; set is for what all cases share, name the values under vary"
            for key, value in self.set.items()
            if isinstance(value, list) and "." not in key
        ]
        problems += [f"{key} is under set and under vary; name it once" for key in self.set if key in self.vary]
        problems += [
            f"{short} and {key} are the same setting; write it in one way everywhere"
            for short, key in KEY_OF.items()
            if short in given and key in given
        ]
        if self.do in WHOLE and self.also:
            problems.append(f"also is not for {self.do}, which combines all lists; add its values to vary")
        problems += self._problems_of_omit()
        size = len(self.seeds) * len(self.also)
        combined = len(self.seeds)
        for values in self.vary.values():
            combined *= len(values)
        if size + combined > MOST_CASES:
            problems.append(f"{size + combined} cases are too many, at most {MOST_CASES}; make several studies of it")
        return problems

    def _problems_of_omit(self) -> list[str]:
        """A line for each setting or value of `omit` that no case has, so that nothing would be left out."""
        problems = []
        apart = OF_A_CASE.get(self.do, KEYS[self.do])
        for key, value in (item for one in self.omit for item in one.items()):
            values = [*self.vary.get(key, []), *(one[key] for one in [self.set, *self.also] if key in one)]
            if key in KEYS[self.do] and key not in apart:
                problems.append(f"omit has {key!r}, but every case of {self.do} has all of them; make two studies")
            elif values and value not in values:
                problems.append(f"omit has {key} {value!r}, which no case has; {key} is one of {values}")
            elif not values and (key in apart or "." in key) and self.do not in WHOLE:  # those have usual values
                problems.append(f"omit has {key}, which no case names; add it to vary, or leave it out of omit")
        return problems

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the settings that tell the cases from each other, with 'seed' at the end."""
        keys = [*self.vary, *(key for one in self.also for key in one)]
        return (*dict.fromkeys(keys), "seed")


def _amount(text: Any, units: Mapping[str, float]) -> float:
    """A number with one of these units; 0 if it is none, or no text."""
    match = _AMOUNT.fullmatch(text) if isinstance(text, str) else None
    return float(match[1]) * units.get(match[2], 0.0) if match else 0.0


def left_out(setting: Mapping[str, Any], omit: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a setting has all values of one of the groups to be left out."""
    return any(all(key in setting and setting[key] == value for key, value in one.items()) for one in omit)


def load_study(study: Study | PathLike | Mapping[str, Any]) -> Study:
    """A study, from its file or its content. Raises UsageError with one line per problem.

    Paths in a file are relative to its folder, those in a mapping to the current folder. A config or scene may be a
    name instead. A Study is returned as it is.
    """
    if isinstance(study, Study):
        return study
    where, folder = "study", Path.cwd()
    content: Mapping[str, Any]
    if isinstance(study, Mapping):
        content = study
    else:
        file = Path(study)
        where, folder = str(file), file.absolute().parent
        try:
            content = load_yaml(file, "a study", "do: scan").content
        except FileError as error:
            raise UsageError.of(error.problems) from error
    try:
        made = Study.model_validate(content)
    except ValidationError as error:
        raise UsageError.of(_in_a_line(where, dict(each)) for each in error.errors()) from error
    if problems := made.problems():
        raise UsageError.of(f"{where}: {problem}" for problem in problems)
    return made.model_copy(
        update={
            "vary": {key: [_anchored(key, value, folder) for value in values] for key, values in made.vary.items()},
            **{name: [_anchored_all(one, folder) for one in getattr(made, name)] for name in ("also", "omit")},
            "set": _anchored_all(made.set, folder),
        }
    )


def _anchored_all(setting: Setting, folder: Path) -> Setting:
    return {key: _anchored(key, value, folder) for key, value in setting.items()}


def _anchored(key: str, value: Any, folder: Path) -> Any:
    if key not in PATHS or not isinstance(value, str | os.PathLike):
        return value
    value = os.fspath(value)
    path = folder / os.path.expanduser(value)
    name = key in NAMES and Path(value).name == value and not value.endswith((".yaml", ".yml"))
    # A folder may have the name of a config by chance: that of the results, for example. Some are scenes.
    there = os.path.isfile(path) or os.path.exists(path / "world.npz")
    return value if name and not there else str(path)


def _in_a_line(where: str, error: Mapping[str, Any]) -> str:
    key = ".".join(map(str, error["loc"])) or "its content"
    said = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "list_type":
        given = str(error["input"]) if isinstance(error["input"], str | int | float) else ""
        shown = given if given.isprintable() and len(given) <= MAX_VALUE_CHARACTERS else ""
        name = key.rpartition(".")[2]
        return f"{where}: {key} is {shown or 'something else'}, not a list; write {name}: [{shown or '...'}]"
    if error["type"] == "extra_forbidden" and any(key in known for known in KEYS.values()):
        return f"{where}: {key!r} is a setting; it belongs under vary (a list) or set (one value for all cases)"
    if error["type"] == "extra_forbidden":
        return f"{where}: {key!r} is no key of a study; its keys are {', '.join(Study.model_fields)}"
    return f"{where}: {key}: {said[:1].lower()}{said[1:]}"
