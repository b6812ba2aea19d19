"""The call that lists runs: `runs`. It imports no more than it needs, since the answer is awaited at a terminal."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.requests import RunsRequest
from rig.run_folder.runs import RunEntry, list_runs

if TYPE_CHECKING:
    from rig.config.overrides import PathLike


def runs(folder: "PathLike" = "runs", request: RunsRequest | None = None, **changes: Any) -> list[RunEntry]:
    """List the runs in a folder and up to three levels below it, the oldest first (`rig runs`).

    request, changes: filters, as a `RunsRequest` or by the names of its fields: `runs("runs", tags=["fog"])`.

    A run with damaged files is listed with the verdict 'damaged' and its `problem`. Raises UsageError for a folder that
    does not exist and for filters that cannot be read.
    """
    return list_runs(Path(folder), replace(request or RunsRequest(), **changes))
