"""Makes the cases of a study. Everything that can be wrong with a setting is found here, before any case is done."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rig.batch.case import Case, files_of
from rig.config.estimators import estimator_names
from rig.config.files import load_config, portable_content
from rig.config.models import AUTO, RigConfig
from rig.config.overrides import SIMULATED
from rig.devices.open import open_rig
from rig.devices.prepare import prepare
from rig.errors import DamagedRecordingError, UsageError, noted
from rig.estimate.registry import estimate_problems
from rig.recording.inputs import holds_frames_alone
from rig.recording.open import require_recording
from rig.requests import ReconstructRequest
from rig.study.definition import KEY_OF, Setting, Study, left_out

ACTIONS: Final = "rig.api.studies.cases"


def cases_of(study: Study) -> list[Case]:
    """The cases of a study whose action is done case by case (not `tradeoff` or `strategies`). Raises UsageError with
    the problems of all settings."""
    cases: list[Case] = []
    problems: list[str] = []
    alone: dict[str, bool] = {}
    for setting in study.combinations():
        with noted(problems):
            made = _reconstruct(setting, alone) if study.do == "reconstruct" else _of_rig(study, setting)
            told = {key: setting[key] for key in study.labels if key in setting}
            seeds = study.seeds if study.do != "reconstruct" else study.seeds[:1]  # nothing in it is drawn
            for seed in seeds:
                seeded = {} if study.do == "reconstruct" else {"seed": seed}
                inputs, labels = {**made.inputs, **seeded}, {**told, **seeded}
                cases.append(Case(f"{ACTIONS}:{study.do}_once", inputs, labels, made.files, keeps=study.keep))
    if problems:
        raise UsageError.of(problems)
    if not cases:
        raise UsageError("the study has no case: omit leaves all of them out")
    return cases


@dataclass(frozen=True, slots=True)
class _Inputs:
    inputs: Mapping[str, Any]
    files: tuple[str, ...]


def _of_rig(study: Study, setting: Setting) -> _Inputs:
    """A scan or a calibration of a simulated rig."""
    overrides = {KEY_OF.get(key, key): value for key, value in setting.items() if key not in ("config", *_COUNTS)}
    config = load_config(str(setting.get("config", SIMULATED)), overrides)
    require_simulated(config)
    with open_rig(config) as rig:  # opened to hold the plan against the limits of the devices
        prepare(rig)
    content = portable_content(config)
    name, usual = ("maps", 1) if study.do == "scan" else ("poses", 12)
    count = setting.get(name, usual)
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise UsageError(f"{name} is {count!r}; it must be a whole number, at least 1")
    return _Inputs({"config": content, name: count}, files_of(content))


_COUNTS: Final = "maps", "poses"


def _reconstruct(setting: Setting, alone: dict[str, bool]) -> _Inputs:
    """The reconstruction of a recording. alone: whether the recordings that were looked at before hold frames alone."""
    if "recording" not in setting:
        raise UsageError("reconstruct needs the setting 'recording', the folder of a run or an .npy of frames")
    paths = {key: setting[key] for key in _FILES if key in setting}
    asked = {key: value for key, value in setting.items() if key not in paths}
    problems = [f"{key} is {value!r}; it must be text" for key, value in paths.items() if not isinstance(value, str)]
    with noted(problems):
        ReconstructRequest(**asked)
    if problems:
        raise UsageError.of(problems)
    paths = {key: str(Path(value).absolute()) for key, value in paths.items()}
    problems += [f"{path} does not exist; correct the path" for path in paths.values() if not Path(path).exists()]
    estimator, filter, least = (asked.get(key) for key in ("estimator", "filter", "min_confidence"))
    if estimator == AUTO:
        problems.append(f"estimator {AUTO!r} depends on the computer; name one, so that the result does not")
        estimator = None
    problems += estimate_problems(estimator, filter, least, estimator_names())
    if problems:
        raise UsageError.of(problems)
    recording = paths["recording"]
    if recording not in alone:
        alone[recording] = _holds_frames_alone(Path(recording))
    if alone[recording] and len(paths) < len(_FILES):
        missing = " and ".join(key for key in _FILES if key not in paths)
        raise UsageError(f"{recording} holds frames alone; add {missing} to say how they were taken")
    return _Inputs({**asked, **paths}, tuple(paths.values()))


_FILES: Final[tuple[str, ...]] = "recording", "plan", "calibration"


def _holds_frames_alone(recording: Path) -> bool:
    """Whether a recording is frames without a plan. Raises UsageError if it cannot be read."""
    if recording.is_file():
        return True
    require_recording(recording)
    try:
        return holds_frames_alone(recording)
    except DamagedRecordingError as error:
        raise UsageError(str(error)) from error


def require_simulated(config: RigConfig) -> None:
    """Raise UsageError unless a rig is simulated and runs on virtual time: a case must not depend on the time of
    day."""
    if config.world is None:
        raise UsageError(f"{config.name} is a real rig, and cases are done on any computer; name a simulated one")
    if config.world.real_time:
        raise UsageError(f"{config.name} runs in the host's time; name a rig that does not, such as {SIMULATED!r}")


def kept_cases(cases: Sequence[Case], omit: Sequence[Mapping[str, Any]]) -> list[bool]:
    """For each case, False if its labels have all settings of a group in `omit`, else True."""
    return [not left_out(case.labels, omit) for case in cases]
