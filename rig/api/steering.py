"""A callback after each map that may change the next scan: what it sees and may change, and how that is checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Final

from rig.config.models import EstimateConfig, RigConfig, ScanConfig
from rig.config.overrides import with_settings
from rig.count.sweeps import SweepAccount
from rig.depth.reconstruct import MapResult
from rig.errors import UsageError
from rig.requests import ScanRequest
from rig.scan.counting import AcquiredMap
from rig.scan.run import RunResult

SETTINGS: Final[Mapping[str, str]] = {
    **{name: f"scan.{name}" for name in ScanConfig.model_fields},
    **{name: f"estimate.{name}" for name in EstimateConfig.model_fields},
}
"""Keys of the config that may change from scan to scan, by their short names. Devices and world stay as they are."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenMap:
    """A map that was just made, for `on_map`.

    number: that of the map, from 0, over all scans of the call.
    left: number of maps still to come.
    result: depth, stripes, counts.
    sweep: its frames and gaps.
    taken: `utc` of its first and last frame and `utc_uncertainty_s`.
    config: the one with which it was taken.
    """

    number: int
    left: int
    result: MapResult
    sweep: SweepAccount
    taken: Mapping[str, Any]
    config: RigConfig


OnMap = Callable[[SeenMap], Mapping[str, Any] | None]
"""Returns None to go on, or settings by their names in the config: {"exposures": 20, "power": "10 mW"}."""


class Steering:
    """Asks `on_map` after each map, and makes the next scan from the settings that it returns.

    If the callback raises, the scan ends after the present map, which is kept.
    """

    def __init__(self, on_map: OnMap | None, config: RigConfig, request: ScanRequest) -> None:
        self._on_map = on_map
        self._config = config
        self._request = request
        self._out = request.out
        self._taken = 0
        self._maps = request.maps or 1
        self._changes: Mapping[str, Any] | None = None
        self._error: BaseException | None = None

    def enough(self, found: AcquiredMap) -> bool:
        """Take a map; returns whether the scan is to end with it, although maps are left."""
        number, self._taken = self._taken, self._taken + 1
        left = self._maps - self._taken
        if self._on_map is None:
            return False
        try:
            seen = SeenMap(number, left, found.result, found.sweep, found.taken, self._config)
            said: Any = self._on_map(seen)
            if not isinstance(said, Mapping | None):
                raise UsageError(f"on_map returned {said!r}; return None or a dictionary of settings")
            self._changes = said or None
        except Exception as error:  # of the caller's code: the maps so far are kept
            self._error = error
        return left > 0 and (self._changes is not None or self._error is not None)

    def next(self, result: RunResult) -> tuple[RigConfig, ScanRequest, dict[str, Any]] | None:
        """Config, request and manifest keys of the scan that follows one with this result; None if no scan follows.

        Raises the callback's own error, or UsageError in one line for changes that no config may have; both have a note
        that names the folder with the maps so far.
        """
        changes, self._changes = self._changes, None
        left = self._maps - self._taken
        try:
            if self._error is not None:
                raise self._error
            if changes is None or left == 0:
                return None
            config = changed(self._config, changes)
        except Exception as error:
            note(error, result)
            raise
        follows = {"folder": None if result.folder is None else str(result.folder), "changes": dict(changes)}
        self._config = config
        self._request = replace(self._request, maps=left, out=_next_folder(self._out))
        return config, self._request, {"follows": follows}


def changed(config: RigConfig, changes: Mapping[str, Any]) -> RigConfig:
    """The config with these settings, given by their short names. Raises UsageError in one line if one is unknown or
    not allowed."""
    unknown = [str(name) for name in changes if name not in SETTINGS]
    if unknown:
        raise UsageError(f"on_map asks for {', '.join(unknown)}, which is no setting of a scan; those are "
                         f"{', '.join(SETTINGS)}")  # fmt: skip
    try:
        return with_settings(config, {SETTINGS[name]: value for name, value in changes.items()})
    except UsageError as error:
        raise UsageError(f"on_map asks for what cannot be: {'; '.join(error.problems)}") from None


def note(error: BaseException, result: RunResult) -> None:
    """Note on an error where the maps made before it are."""
    if result.folder is not None:
        error.add_note(f"the {result.summary.maps} maps before are in {result.folder}")


def _next_folder(out: Any) -> Path | None:
    """The folder of the next scan of a call whose first one is in `out`: NAME-2, NAME-3, ... as far as these are
    free."""
    if out is None:
        return None
    beside = (Path(out).with_name(f"{Path(out).name}-{each}") for each in count(2))
    return next(path for path in beside if not path.exists())
