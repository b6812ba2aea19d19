"""A scene in one air, opened for strategies to measure it. It is kept open until another one is wanted."""

import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from drivers.errors import DeviceError
from rig.batch.case import current_checksum, files_of
from rig.config.models import RigConfig
from rig.config.overrides import configure
from rig.errors import UsageError
from rig.plan.scan_plan import column_command
from rig.progress import tell_stage
from rig.run_folder.plain_json import json_line
from rig.strategies.apparatus import Apparatus, MakesApparatus, Rule
from rig.strategies.comparison.places import rig_model, scene_file
from rig.strategies.comparison.score import scored_pixels
from rig.strategies.strategy import ColumnGeometry
from rig.tradeoff.effects import open_world

LINES: Final = 8
"""The number of columns is a multiple of this, so that as many lines can share them."""


@dataclass(frozen=True, slots=True)
class Place:
    """A scene in an air, and what is seen of it.

    name: name of the scene in the table. scene: a bundled name, `ramp`, a file or a folder. air: None for the scene's
    own. rows: number of image rows, from the middle of the picture. lux: ambient light; None for the scene's own.
    """

    name: str
    scene: str
    air: str | None
    rows: int
    lux: float | None


class OpenScene:
    """The world of a place, opened for the scan of a config, with its truth and the geometry of its columns.

    Raises UsageError if the scene cannot be used.
    """

    def __init__(self, config: RigConfig, place: Place) -> None:
        self.place = place
        model = rig_model(config)
        with ExitStack() as stack, TemporaryDirectory() as made:
            file = scene_file(place.scene, place.air, place.lux, model, Path(made))
            self.config = configure(config, scene=str(file))
            scan = self.config.scan
            self._columns = scan.columns // LINES * LINES
            commands = [column_command(column, scan.command_range, self._columns) for column in range(self._columns)]
            height = model.camera.height
            measured = min(place.rows, height)
            rows = np.arange(measured) + (height - measured) // 2
            self.geometry = ColumnGeometry(model, np.array(commands), scan.depth_range, rows)
            world, self.power_w = stack.enter_context(open_world(self.config))
            opened: Any = world
            if not isinstance(opened, MakesApparatus):
                raise UsageError("this world cannot be measured in other ways than with a scanned line")
            self._world = opened
            self.truth = world.truth(self.geometry.commands)
            self.scored = scored_pixels(self.truth, self.geometry)
            if not self.scored.any():
                raise UsageError(f"scene {place.name}: the source lights nothing that the camera sees; check the scene")
            self.true_m = self.truth.depth_m[rows][self.scored]
            weakref.finalize(self, stack.pop_all().close)

    def apparatus(self, rule: Rule, seed: int) -> Apparatus:
        """Make a new apparatus before this scene. Raises UsageError if there can be none."""
        scan = self.config.scan
        try:
            made: Apparatus = self._world.apparatus(
                rows=self.geometry.rows, columns=self._columns, command_range=scan.command_range, power_w=self.power_w,
                rule=rule, seed=seed, depth_range_m=scan.depth_range, spad_frame_s=float(1 / scan.frame_rate),
            )  # fmt: skip
        except DeviceError as error:
            raise UsageError(f"scene {self.place.name}: {error}") from error
        except ValueError as error:  # the config asks for what no apparatus has
            raise UsageError(f"{self.config.name}: {error}") from error
        return made


_kept: dict[str, OpenScene] = {}


def open_scene(config: Mapping[str, Any], place: Place) -> OpenScene:
    """Open a scene, or return the one that was opened last if it is the same, with unchanged files.

    config: a config's content, with absolute paths.
    """
    sums = {path: current_checksum(path) for path in files_of(config, place.scene)}
    key = json_line({"config": config, "place": asdict(place), "files": sums})
    opened = _kept.get(key)
    if opened is None:
        close_scene()
        tell_stage("making the scene")
        opened = OpenScene(RigConfig.model_validate(config), place)
        opened.apparatus("energy", 0)  # light that all ways share is on nobody's computing time
        _kept[key] = opened
    return opened


def close_scene() -> None:
    """Give up the scene that was opened last."""
    _kept.clear()
