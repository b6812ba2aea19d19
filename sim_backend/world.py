"""The simulated world: a scene in front of a rig, the bench its devices stand on, and the truth of a sweep."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from calibration.errors import CalibrationError
from calibration.files import load_rig_model
from calibration.model import RigModel
from drivers.errors import DeviceError
from drivers.interfaces import SweepTruth
from drivers.registry import Kind, KindConfig, Surroundings
from sim_backend.bench import Bench
from sim_backend.command_grid import column_grid, fine_grid
from sim_backend.effects.setting import Setting
from sim_backend.flux import FluxModel
from sim_backend.optics import Line, Optics, Sensor, detections_per_radiance
from sim_backend.scene import load_scene, load_surfaces
from sim_backend.view import make_view

Array = NDArray[np.float64]

DEFAULT_GEOMETRY = Path(__file__).parent.parent / "config" / "simulated-rig.yaml"


class CommandGridConfig(BaseModel):
    """Mirror commands of the first and last column's centre, and the number of columns."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    first: float
    last: float
    columns: int = Field(ge=1)


class WorldConfig(KindConfig):
    """Config of the simulated world."""

    real_time: ClassVar[bool] = False

    kind: str = "simulated"
    geometry: str | None = None
    """Rig-model file of the rig as it really is; the bundled simulated rig by default."""
    scene: str = "street"
    """A bundled scene's name, a scene file, or a folder of surfaces."""
    optics: Optics = Field(default_factory=Optics)
    sensor: Sensor = Field(default_factory=Sensor)
    line: Line = Field(default_factory=Line)
    command_grid: CommandGridConfig | None = None
    """Mirror commands at which the flux is held, for use without an application that says `hold_columns`."""


class SimulatedWorld:
    """One scene, one rig, one bench. Reading is safe from any thread."""

    def __init__(self, config: WorldConfig, surroundings: Surroundings) -> None:
        """DeviceError where the geometry or the scene cannot be used."""
        self.config = config
        self.model = _load_geometry(DEFAULT_GEOMETRY if config.geometry is None else Path(config.geometry))
        camera = self.model.camera
        self.scene, folder = load_scene(config.scene)
        u, v = camera.tangents()
        self.surfaces = load_surfaces(self.scene, folder, u, v)
        """Depth, albedo and where they are trusted; the truth behind `truth`."""
        gain = detections_per_radiance(config.optics, config.sensor, config.line)
        self.setting = Setting(
            make_view(self.model, self.surfaces), self.scene, config.optics, config.sensor, config.line, gain
        )
        self.flux_model = FluxModel(self.setting)
        self.bench = Bench(surroundings.clock, self.model.lag_s)
        self.grid = fine_grid(camera.width, self.model.scanner.command_range)
        """Mirror positions the flux is computed at."""
        if config.command_grid is not None:
            grid = config.command_grid
            self.hold_columns(np.linspace(grid.first, grid.last, grid.columns))

    @property
    def size(self) -> tuple[int, int]:
        """Rows and width of the camera in pixels."""
        return self.model.camera.height, self.model.camera.width

    def hold_columns(self, commands: Array) -> None:
        """Hold the flux at these mirror commands (columns,): all frames of a column then share the p of its centre.

        To be called before the run; without it the stripe moves within a column, as the mirror does.
        """
        self.grid = column_grid(commands, self.model.scanner.command_range)

    def truth(self, commands: Array) -> SweepTruth:
        """Where the stripe of each column (commands (columns,)) truly is, and the depth of every pixel."""
        view = self.setting.view
        x_px = np.full((view.rows, len(commands)), np.nan, np.float32)
        for column, plane in enumerate(self.model.planes(np.asarray(commands, dtype=np.float64))):
            x_px[:, column] = view.sheet(plane).x_stripe_px
        depth = self.surfaces.depth_m.copy()
        depth[~np.isfinite(depth) | np.isnan(view.u)] = np.nan
        return SweepTruth(x_px=x_px, depth_m=depth)

    def effects_report(
        self, power_w: float = 0.05, exposure_s: float = 1e-5, exposures: int = 10
    ) -> list[dict[str, Any]]:
        """Each effect: on or off, why, its share of the photons, and what leaving it out would cost."""
        from sim_backend.effects_report import effects_report

        return effects_report(self, power_w=power_w, exposure_s=exposure_s, exposures=exposures)


def _load_geometry(path: Path) -> RigModel:
    try:
        model = load_rig_model(path)
    except CalibrationError as error:
        raise DeviceError(f"world geometry: {error}") from error
    if model.source_m is None:
        raise DeviceError(
            f"world geometry {path} has no source_m; add where the light leaves the mirror, e.g. [-0.3, 0, 0]"
        )
    return model


KIND = Kind(config=WorldConfig, create=SimulatedWorld)
