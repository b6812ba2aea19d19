"""The call that makes depth of frames that are there: `reconstruct`."""

from pathlib import Path

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from rig.api_config import PathLike
from rig.api_scan import replay
from rig.config import CubePlan, EstimateConfig, Estimator, Filter
from rig.config_files import load_cube_plan
from rig.errors import UsageError
from rig.estimators import ESTIMATORS, FILTERS
from rig.progress import Progress
from rig.recording.inputs import holds_frames_alone
from rig.recording.opening import require_recording
from rig.run import OutFolder, RunResult


def reconstruct(
    source: PathLike,
    plan: CubePlan | PathLike | None = None,
    calibration: RigModel | PathLike | None = None,
    *,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    accept_calibration: bool = False,
    out: OutFolder = None,
    progress: Progress | None = None,
) -> RunResult:
    """Depth from a recording, or from packed frames that any program made (`rig reconstruct`).

    source: folder of a run taken with `record`; or frames alone: an .npy of uint8 (maps x columns x exposures, height,
    ceil(width/8)), or the folder that `rig import` made of such. plan, calibration: frames alone need both; a run has
    its own, but may be given a calibration file that was made since.
    Settings that are None are those of the recording; of a cube likelihood, none and 0.5. accept_calibration: as of
    `scan`. out: a folder to write, None to write nothing. progress: called with frames or maps done and all. Raises
    UsageError, a line per problem, for files that do not fit together. An interrupt ends the run after its last whole
    map, with verdict 'aborted'.
    """
    source = Path(source)
    if source.is_dir():
        require_recording(source)
    if source.is_dir() and not holds_frames_alone(source):
        if plan is not None:
            raise UsageError(f"{source} is a recording, which has the plan it was taken with; leave --plan out")
        if isinstance(calibration, RigModel):
            raise UsageError("the calibration for a recording is a file; calibration.save_rig_model writes one")
        return replay(
            source,
            clock="max",
            calibration=calibration,
            estimator=estimator,
            filter=filter,
            min_confidence=min_confidence,
            accept_calibration=accept_calibration,
            out=out,
            progress=progress,
        )
    from rig.calibration_identity import cube_calibration_use
    from rig.cube import open_cube
    from rig.cube_depth import reconstruct_cube

    if plan is None or calibration is None:
        if not source.exists():
            said = "does not exist; name the folder of a run taken with --record, or an .npy of frames"
            raise UsageError(f"{source} {said}")
        missing = [name for name, given in (("--plan", plan), ("--calibration", calibration)) if given is None]
        raise UsageError(f"{source} holds frames alone; add {' and '.join(missing)}, which say how they were taken")
    estimate = _estimate(
        "likelihood" if estimator is None else estimator,
        "none" if filter is None else filter,
        0.5 if min_confidence is None else min_confidence,
    )
    cube_plan = plan if isinstance(plan, CubePlan) else load_cube_plan(Path(plan))
    model = calibration if isinstance(calibration, RigModel) else _load_calibration(calibration)
    file = None if isinstance(calibration, RigModel) else Path(calibration)
    use = cube_calibration_use(model, file, accept=accept_calibration)
    return reconstruct_cube(open_cube(source, cube_plan, model), use, estimate, out, progress)


def _load_calibration(path: PathLike) -> RigModel:
    try:
        return load_rig_model(path)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


def _estimate(estimator: str, filter: str, min_confidence: float) -> EstimateConfig:
    problems = []
    if estimator not in ESTIMATORS:
        problems.append(f"estimator {estimator!r} is unknown; choose one of {', '.join(ESTIMATORS)}")
    if filter not in FILTERS:
        problems.append(f"filter {filter!r} is unknown; choose one of {', '.join(FILTERS)}")
    if not 0 <= min_confidence <= 1:
        problems.append(f"min_confidence is {min_confidence:g}; it is a probability from 0 to 1")
    if problems:
        raise UsageError.of(problems)
    content = {"estimator": estimator, "filter": filter, "min_confidence": min_confidence}
    return EstimateConfig.model_validate(content)
