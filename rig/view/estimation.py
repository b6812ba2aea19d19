"""Estimates one map of a recording again, with another estimator, in a separate process.

The page goes on meanwhile. The map's frames are cut from the recording into a temporary folder, so this takes as long
for the last map of an hour as for the first. Only a recording without markers is played from its beginning.
"""

import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from rig.errors import UsageError
from rig.progress import Step, listening

_END_S: Final = 2.0
"""Longest wait for the process to end when asked to, before it is killed."""
_SAID_S: Final = 0.3
"""Shortest time from one report of its stage to the next."""


@dataclass(frozen=True, slots=True)
class EstimationRequest:
    """A wish to estimate map `number` of the recording `run` again. by_cutting: whether the map's frames can be cut
    out; a recording without markers is played from its beginning instead."""

    run: Path
    number: int
    estimator: str
    min_confidence: float
    by_cutting: bool = True


@dataclass(frozen=True, slots=True)
class Estimated:
    """An estimate that is over. folder: that of a run with the map; None if it failed. number: the map's number in that
    run. problem: why it failed; else empty. summary: that of the run."""

    request: EstimationRequest
    folder: Path | None
    number: int
    problem: str
    summary: Mapping[str, Any]


class Estimation:
    """An estimate under way; its `close` ends it and removes its files. Raises UsageError if no process can be
    started."""

    def __init__(self, request: EstimationRequest) -> None:
        self.request = request
        self.stage = "starting; code that is not yet compiled takes minutes"
        """Its present stage, in words."""
        self._folder = Path(tempfile.mkdtemp(prefix="spadrig-view-"))
        context = multiprocessing.get_context("spawn")  # threads of the server do not survive a fork
        self._answer, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_estimate, args=(request, self._folder, theirs), daemon=True)
        try:
            self._process.start()
        except OSError as error:
            self.close()
            raise UsageError(f"cannot start a process for the estimate: {error.strerror or error}") from error
        theirs.close()

    def poll(self) -> Estimated | None:
        """The result once it is there, else None, with `stage` brought up to date."""
        while self._answer.poll():
            try:
                said = self._answer.recv()
            except EOFError:
                said = "the process that made it has died", 0, {}
            if not isinstance(said, str):
                problem, number, summary = said
                return Estimated(self.request, None if problem else self._folder / "map", number, problem, summary)
            self.stage = said
        return None

    def close(self) -> None:
        """End the process, if it still runs, and remove its files."""
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(_END_S)
            if self._process.is_alive():
                self._process.kill()
        self._answer.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def _estimate(request: EstimationRequest, folder: Path, answer: Connection) -> None:
    """Runs in the process: makes folder/map, and answers with its stages, each a text, and in the end with problem,
    number of the map in it, and summary."""
    from calibration.errors import CalibrationError
    from drivers.errors import DeviceError
    from rig import api
    from rig.errors import RigError

    # A page only looks: reasons against the calibration are those of the run, which it shows.
    asked: dict[str, Any] = {
        "estimator": request.estimator,
        "min_confidence": request.min_confidence,
        "accept_calibration": True,
        "out": folder / "map",
    }
    said_s = float("-inf")

    def heard(step: Step) -> None:
        nonlocal said_s
        if time.monotonic() - said_s > _SAID_S:
            answer.send(f"{step.stage}, {step.done} of {step.total} {step.unit}" if step.total else step.stage)
            said_s = time.monotonic()

    try:
        with listening(heard):
            if request.by_cutting:
                api.cut(request.run, folder / "part", maps=str(request.number))
                result, number = api.reconstruct(folder / "part", **asked), 0
            else:
                result = api.replay(request.run, clock="max", maps=request.number + 1, save="last", **asked)
                number = request.number
        answer.send(("", number, result.summary.as_json()))
    except (RigError, DeviceError, CalibrationError) as error:
        answer.send((" ".join(str(error).split()) or type(error).__name__, 0, {}))
    except KeyboardInterrupt:
        answer.send(("interrupted", 0, {}))
