"""The simulated world: a scene in front of a rig, the `Bench` that its devices share, and the truth of a sweep."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BeforeValidator, Field

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import Lag, RigModel
from drivers.errors import DeviceError
from drivers.interfaces import Rule, SweepTruth
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.units import parse_quantity
from sim_backend.bench import Bench, BenchState
from sim_backend.effect_planner import MOST, SAMPLED_COLUMNS, EffectPlan, Wanted, is_active, plan_effects
from sim_backend.effects.catalogue import CATALOGUE
from sim_backend.effects.setting import Array, FrameTimes, PlannedFor, Setting
from sim_backend.frames.flux import ROUNDING, FluxModel, column_grid, fine_grid
from sim_backend.frames.photons import PhotonSource
from sim_backend.light.line import ONE_LINE, LineFan, line_width
from sim_backend.light.optics import Line, Optics, Sensor, detections_per_radiance
from sim_backend.light.view import CameraView, make_view
from sim_backend.projector.hardware import ConventionalCamera, PulsedSource
from sim_backend.scenes.medium import Section
from sim_backend.scenes.scene import CLEAR, BoardPlace, load_scene, load_surfaces, with_board_at, with_fog

if TYPE_CHECKING:
    from sim_backend.projector.apparatus import SimulatedApparatus
    from sim_backend.projector.transport import Transport

LEAST_PIXELS = 2
"""Least width and height of the camera, in pixels: light is computed from the rays' change from pixel to pixel."""
DEFAULT_GEOMETRY = Path(__file__).parent.parent / "config" / "simulated-rig.yaml"


def _known(wanted: Wanted) -> Wanted:
    names = [entry.name for entry in CATALOGUE]
    unknown = [name for name in wanted if name not in names] if isinstance(wanted, tuple) else []
    if unknown:
        raise ValueError(f"unknown effect {unknown[0]!r}; name some of: {', '.join(names)}; or write planned or all")
    return wanted


def _known_fog(fog: object) -> object:
    if fog is None or fog == CLEAR:
        return fog
    try:
        visibility_m = parse_quantity(fog, "length")
    except ValueError as error:
        raise ValueError(f"{error}; or write {CLEAR}") from error
    if visibility_m <= 0:
        raise ValueError(f"is {fog!r}; a visibility is more than 0 m; for air without fog write {CLEAR}")
    return fog


class CommandGridConfig(Section):
    """Number of columns, and the mirror commands at the centres of the first and the last."""

    first: float
    """Mirror command at the centre of the first column."""
    last: float
    """Mirror command at the centre of the last column."""
    columns: int = Field(ge=1)
    """Number of columns."""


class WorldConfig(KindConfig):
    """Config of the simulated world."""

    real_time: ClassVar[bool] = False

    kind: str = "simulated"
    geometry: str | None = None
    """Calibration file, with `source_m`, of the rig as it really is; the bundled simulated rig by default. To try the
    effect of a wrong calibration, give another file here than in `calibration`. Its sheets are simulated even if
    they bow, pass beside the mirror's axis or are tilted towards it (`cone_rad`), and so is its row delay."""
    scene: str = "street"
    """A bundled scene's name, a scene file, or a folder of surfaces."""
    fog: Annotated[str | None, BeforeValidator(_known_fog)] = None
    """Visibility in the scene's air, in place of the scene's own: a distance such as `20 m`, or `clear`."""
    board_pose: BoardPlace | None = None
    """Pose of the scene's (first) calibration board, in place of the scene's own."""
    optics: Optics = Field(default_factory=Optics)
    sensor: Sensor = Field(default_factory=Sensor)
    line: Line = Field(default_factory=Line)
    effects: Annotated[Wanted, AfterValidator(_known)] = "planned"
    """Effects that are simulated, of those that the scene calls for. `planned`: all but those that provably change next
    to nothing; `all`; or a list of names (for ablations)."""
    conventional_camera: ConventionalCamera = Field(default_factory=ConventionalCamera)
    pulsed_source: PulsedSource = Field(default_factory=PulsedSource)
    command_grid: CommandGridConfig | None = None
    """Columns whose frames get the light of one mirror position; `hold_columns` replaces them. None: finer cells."""

    @property
    def has_board(self) -> bool:
        """Whether the scene contains a calibration board. Raises DeviceError if the scene cannot be read."""
        return bool(load_scene(self.scene)[0].boards)


LONGEST = PlannedFor(power_w=1.0, exposure_s=1.0, exposures=100_000)
"""Power, time and frames of a pattern for which the effects are chosen that an apparatus has."""
MOST_VIEWS, TIME_STEP_S = 64, 1e-3
"""A moving scene's truth is put together from about `MOST_VIEWS` moments at most, at least `TIME_STEP_S` apart."""


class SimulatedWorld:
    """One scene, one rig, and the `Bench` of its devices. Methods that set nothing may be called from any thread."""

    def __init__(self, config: WorldConfig, surroundings: Surroundings) -> None:
        """Raises DeviceError if the geometry, the scene, its board's pose or the focus cannot be used."""
        self.config = config
        wrong: list[str] = []
        try:
            self.model = _load_geometry(DEFAULT_GEOMETRY if config.geometry is None else Path(config.geometry))
        except DeviceError as error:
            wrong.append(str(error))
        try:
            self.scene, folder = load_scene(config.scene)
        except DeviceError as error:
            wrong.append(str(error))
        if wrong:
            raise DeviceError("\n".join(wrong))
        camera = self.model.camera
        if config.fog is not None:
            self.scene = with_fog(self.scene, config.fog)
        if config.board_pose is not None:
            self.scene = with_board_at(self.scene, config.board_pose)
        u, v = camera.tangents()
        self.surfaces = load_surfaces(self.scene, folder, u, v)
        """Depth, albedo and where they are trusted. `truth` is computed from them."""
        gain = detections_per_radiance(config.optics, config.sensor, config.line)
        motion = None
        if self.scene.motion is not None and is_active("motion", config.effects):
            from sim_backend.effects.motion import MovingSurfaces

            motion = MovingSurfaces(self.scene.motion.velocity).view
        view = make_view(self.model, self.surfaces, motion, (u, v))
        line_width(view, config.optics, config.sensor, config.line)  # refuses a focus within the lens, before any plan
        self.setting = Setting(view, self.scene, config.optics, config.sensor, config.line, gain, _own(self.model))
        self._planned_for = MOST
        self._planned: tuple[EffectPlan, FluxModel] | None = None
        self._shown: tuple[object, Transport, FluxModel] | None = None
        self.bench = Bench(surroundings.clock, self.model.lag_s)
        self.fan: LineFan = ONE_LINE
        """The lines that leave the mirror together."""
        self.grid = fine_grid(camera.width, self.model.scanner.command_range)
        """Cells of mirror positions. Frames in one cell get the light of one position, jitter apart."""
        if config.command_grid is not None:
            grid = config.command_grid
            self.hold_columns(np.linspace(grid.first, grid.last, grid.columns))

    def plan_for(self, power_w: float, exposure_s: float, exposures: int) -> None:
        """Choose the effects for columns of `exposures` frames of `exposure_s` each, at `power_w` or less.

        Call it before the SPAD is configured. Without a call the effects are chosen for `MOST`.
        """
        frames = exposures + 1  # as many as a column can get, since the clocks are independent
        # Photons of several lines add up: an effect that is negligible for one line of their total power is so for all.
        planned_for = PlannedFor(power_w * self.fan.total, frames * exposure_s, frames)
        if planned_for != self._planned_for:
            self._planned_for, self._planned = planned_for, None
        self._plan()

    @property
    def effect_plan(self) -> EffectPlan:
        """The effects that are simulated, and why. They are decided by `plan_for`, or else at first use. Use this only
        once the devices are made, since devices report effects of their own."""
        return self._plan()[0]

    @property
    def flux_model(self) -> FluxModel:
        """The effects that are simulated: their light, counts and changes of bits."""
        return self._plan()[1]

    def _plan(self) -> tuple[EffectPlan, FluxModel]:
        if self._planned is None:
            self._planned = plan_effects(self.setting, self.sampled_planes, self._planned_for, self.config.effects)
        return self._planned

    @cached_property
    def sampled_planes(self) -> Array:
        """Light planes nx, ny, nz, d, float64 (n, 4), at n mirror positions spread over the command range."""
        low, high = self.model.scanner.command_range
        return self.model.planes(low + (np.arange(SAMPLED_COLUMNS) + 0.5) * (high - low) / SAMPLED_COLUMNS)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and width of the camera in pixels."""
        return self.model.camera.height, self.model.camera.width

    def project_lines(self, offsets: Sequence[float], *, shared: bool) -> None:
        """Project several lines, each at one of these offsets (in units of the mirror command) from where a single line
        would be.

        shared: whether the lines share the laser's power; if not, each has all of it. Call this method before
        `plan_for` and before the SPAD is configured.
        """
        self.fan = LineFan(tuple(offsets), 1 / len(offsets) if shared else 1.0)

    def hold_columns(self, commands: Array) -> None:
        """Treat the mirror as held within columns at these mirror commands (columns,): all frames of a column get the
        light of one position, apart from jitter.

        Call it before the run. Unless it is called or the config has a `command_grid`, the stripe moves in steps of
        about a quarter of a pixel.
        """
        self.grid = column_grid(commands, self.model.scanner.command_range)

    def cover_lens(self) -> None:
        """Let no more light in. Dark counts and effects on bits remain if the config wants them, even if negligible.

        Call it before the SPAD is configured. `effect_plan` stays as it was. A later `plan_for` with other values
        undoes the call.
        """
        kept = [entry for entry in CATALOGUE if entry.of_sensor or entry.kind == "bits"]
        wanted = [e for e in kept if e.called(self.setting)[0] and is_active(e.name, self.config.effects)]
        self._planned = self._plan()[0], FluxModel(self.setting, wanted)

    def mirror_positions(self, state: BenchState, period_s: float) -> Array:
        """Mirror positions (n,) from which the n frames of `state` get their light. The position of a frame is the mean
        one of all frames in its cell of `grid`, plus the frame's own jitter, limited to the command range. period_s:
        from frame to frame.

        If rows are exposed one after the other, (n, 2) for the first and the last row. NaN outside the grid.
        """
        low, high = self.model.scanner.command_range
        first = self.grid.hold(state.mirror, state.velocity_per_s * period_s) + state.jitter
        if self.model.row_delay_s == 0:
            return np.clip(first, low, high)
        later = np.rint(state.velocity_per_s * self._frame_delay_s / ROUNDING) * ROUNDING
        return np.clip(np.stack([first, first + np.nan_to_num(later)], axis=-1), low, high)

    @property
    def _frame_delay_s(self) -> float:
        """Time from the exposure of the first row to that of the last."""
        return self.model.row_delay_s * (self.size[0] - 1)

    def true_model(self) -> RigModel:
        """The rig as it really is, which is what a calibration should find."""
        return self.model

    def truth(self, commands: Array, velocity_per_s: float = 0.0, time_s: Array | None = None) -> SweepTruth:
        """The true position of a single line's stripe for each column, and the depth of every pixel.

        Arguments as in `drivers.interfaces.World.truth`. If surfaces move, a column's stripe is that of the column's
        time, and a pixel's depth that of the time at which the line passed the pixel.
        """
        first = np.asarray(commands, dtype=np.float64)
        held = np.stack([first, first + velocity_per_s * self._frame_delay_s], axis=-1)
        held = np.clip(held, *self.model.scanner.command_range) if self._frame_delay_s else first
        still, at_s = self.setting.view, np.zeros(len(first))
        if still.motion is not None and time_s is not None:
            at_s = self.bench.spad_start_s + np.nan_to_num(_in_steps(time_s))
        x_px = np.full((still.rows, len(first)), np.nan, np.float32)
        for column, (sheet,) in enumerate(ONE_LINE.sheets(self.model.sheets, held, still.rows, at_s.tolist())):
            still.trace(sheet, 0, still.rows)
            x_px[:, column] = sheet.x_stripe_px
        if still.motion is None:
            depth = self.surfaces.depth_m.copy()
        else:
            with np.errstate(divide="ignore"):
                depth = (1 / surface_passed(still, x_px, at_s)).astype(np.float32)
        depth[~np.isfinite(depth) | np.isnan(still.u)] = np.nan
        return SweepTruth(x_px=x_px, depth_m=depth, trusted=self.surfaces.trusted)

    def effects_report(self, power_w: float, exposure_s: float, exposures: int) -> dict[str, Any]:
        """Each effect as planned: on or off, why, its share of the photons, what it can change and what it costs.
        Arguments and keys are those of `sim_backend.effects_report.effects_report`."""
        from sim_backend.effects_report import effects_report

        return effects_report(self, power_w=power_w, exposure_s=exposure_s, exposures=exposures)

    def flux_row(self, row: int, command: float, power_w: float, exposure_s: float) -> Mapping[str, Array]:
        """Mean detections per exposure along an image row at a mirror command: (width,) for each effect on light and
        for dark counts. Effects on bits (hot and dead pixels, crosstalk, afterpulsing, ...) are left out."""
        from sim_backend.effects_report import flux_row

        return flux_row(self, row, command, power_w, exposure_s)

    def apparatus(
        self, *, rows: ArrayLike, columns: int, command_range: tuple[float, float], power_w: float, rule: Rule,
        seed: int, depth_range_m: tuple[float, float], spad_frame_s: float = 1e-5,
    ) -> "SimulatedApparatus":  # fmt: skip
        """An apparatus with light sources and cameras of other kinds in front of the scene. Its time begins at 0.
        Arguments are explained, and errors named, in `rig.strategies.apparatus.MakesApparatus`.

        The light transport of the latest rows, columns and command range is kept. Effects are those that the scene
        calls for, except those that are negligible up to `LONGEST`.
        """
        from sim_backend.projector.apparatus import Hardware, Request, SimulatedApparatus

        request = Request(power_w, rule, seed, depth_range_m, spad_frame_s)
        hardware = Hardware(self.config.conventional_camera, self.config.pulsed_source)
        return SimulatedApparatus(*self._transport(rows, columns, command_range), hardware, request)

    def _transport(
        self, rows: ArrayLike, columns: int, command_range: tuple[float, float]
    ) -> "tuple[Transport, FluxModel]":
        from sim_backend.projector.transport import Transport, checked_columns, checked_rows

        at = checked_rows(rows, self.size[0])
        commands = checked_columns(columns, command_range, self.model.scanner.command_range)
        key, kept = (at.tobytes(), commands.tobytes()), self._shown
        if kept is None or kept[0] != key:
            self._shown = kept = None  # the new one may need the memory of the old one
            _, flux = plan_effects(self.setting, self.sampled_planes, LONGEST, self.config.effects)
            self._shown = kept = key, Transport(self.model, flux, at, commands), flux
        return kept[1:]

    def photons(self, times: FrameTimes, seed: int, threads: int) -> PhotonSource:
        """A source of frames with this timing; the caller closes it. threads: most threads that it uses."""
        model = self.model
        return PhotonSource(self.flux_model, model.sheets, times, seed, threads, self.fan, model.scanner.command_range)


def _own(model: RigModel) -> dict[str, str]:
    """The effects that the rig model itself has, and how large each is."""
    found = {}
    if bow := getattr(model.scanner, "bow_per_rad", 0.0):
        found["sheet bow"] = f"the sheet leaves its plane by {bow:g} rad times the square of the angle within its fan"
    if model.row_delay_s:
        found["row delay"] = f"each row is exposed {1e9 * model.row_delay_s:g} ns later than the one above"
    return found


def _in_steps(time_s: Array) -> Array:
    """Times (n,) rounded down to at most MOST_VIEWS + 1 values, since each value needs a view of its own."""
    low, high = float(np.nanmin(time_s)), float(np.nanmax(time_s))
    step_s = max((high - low) / MOST_VIEWS, TIME_STEP_S)
    return low + np.floor((time_s - low) / step_s) * step_s


def surface_passed(still: CameraView, x_px: NDArray[np.float32], at_s: Array) -> Array:
    """Inverse depth in 1/m (rows, width) that every pixel saw when the line passed it. still: the view at time 0.

    x_px: (rows, columns), the stripe; at_s: (columns,), times of the bench. A pixel between stripes has the time of the
    nearest one, and a row without stripes the median time.
    """
    pixels = np.arange(still.width)
    passed_s = np.full((still.rows, still.width), float(np.median(at_s)))
    for y in range(still.rows):
        lit = np.flatnonzero(np.isfinite(x_px[y]))
        lit = lit[np.argsort(x_px[y, lit])]
        if len(lit):
            middles = (x_px[y, lit[1:]] + x_px[y, lit[:-1]]) / 2
            passed_s[y] = at_s[lit[np.searchsorted(middles, pixels)]]
    surface: Array = np.empty_like(still.surface)
    for time_s in np.unique(passed_s):
        here = passed_s == time_s
        surface[here] = still.at(float(time_s)).surface[here]
    return surface


def _load_geometry(path: Path) -> RigModel:
    try:
        model = load_rig_model(path)
    except CalibrationError as error:
        raise DeviceError(f"world geometry: {error}") from error
    if model.source_m is None:
        raise DeviceError(
            f"world geometry {path} has no source_m; add where the light leaves the mirror, e.g. [-0.3, 0, 0]"
        )
    camera = model.camera
    if min(camera.width, camera.height) < LEAST_PIXELS:
        raise DeviceError(
            f"world geometry {path} has a camera of {camera.width} x {camera.height} pixels; simulated light needs at "
            f"least {LEAST_PIXELS} each way, give it more rows and columns"
        )
    return model


def bench_of(surroundings: Surroundings) -> Bench:
    """The simulated world's `Bench`. If the rig has no simulated world, a new one, for a simulated device among real
    ones."""
    world = surroundings.world
    return world.bench if isinstance(world, SimulatedWorld) else Bench(surroundings.clock, Lag())


def note_effect(surroundings: Surroundings, effect: str, why: str) -> None:
    """Tell a simulated world that a device has an effect, of kind `within` in the catalogue, and why. Other worlds are
    told nothing."""
    if isinstance(surroundings.world, SimulatedWorld):
        surroundings.world.setting.devices[effect] = why


KIND = Kind(config=WorldConfig, create=SimulatedWorld)
