"""The config of a call: loaded, changed by the call's options, validated."""

import os
from collections.abc import Mapping

from rig.config.files import bundled_configs, load_config, parse_config
from rig.config.models import MOST_LINES, Estimator, Filter, LinePower, RigConfig
from rig.errors import UsageError

PathLike = str | os.PathLike[str]
Config = RigConfig | PathLike

SIMULATED = "simulated"
"""Name of the bundled rig, and of the kinds of its devices, which need no hardware."""
MAX_SEED = 2**63 - 1
"""Largest seed: the largest number that other programs read from the manifest as an integer."""


def configure(
    config: Config = SIMULATED,
    *,
    scene: str | None = None,
    fog: str | None = None,
    exposures: int | None = None,
    estimator: Estimator | None = None,
    filter: Filter | None = None,
    min_confidence: float | None = None,
    temporal_prior: bool | None = None,
    learned: PathLike | None = None,
) -> RigConfig:
    """Load and validate a config, changed by options. An option that is None leaves the config's value.

    config: the name of a bundled rig, a file or a RigConfig.
    scene: the name of a bundled scene, or a path; only for a simulated rig.
    fog: replaces the scene's fog: a visibility such as '20 m', or 'clear'; only for a simulated rig.
    exposures: frames per column.
    estimator, filter, min_confidence: as in the config's `estimate`.
    temporal_prior: make `joint` use the last map as a weak prior for the next.
    learned: file in which scans keep what the estimator has learned.
    Raises UsageError with one line per problem.
    """
    options: dict[str, object | None] = {
        "world.scene": scene,
        "world.fog": fog,
        "scan.exposures": exposures,
        "estimate.estimator": estimator,
        "estimate.filter": filter,
        "estimate.min_confidence": min_confidence,
        "estimate.temporal_prior": temporal_prior,
        "estimate.learned": None if learned is None else os.path.abspath(learned),
    }
    loaded = config if isinstance(config, RigConfig) else load_config(os.fspath(config))
    for name, asked in (("scene", scene), ("fog", fog)):
        if asked is not None and loaded.world is None:
            raise UsageError(f"{name} {asked!r} was asked for, but {loaded.name} is a real rig; leave `{name}` out")
    if scene is not None and scene in bundled_configs() and not os.path.exists(os.path.expanduser(scene)):
        raise UsageError(f"scene {scene!r} is a rig; give it as the config, without `scene`")
    given = {key: value for key, value in options.items() if value is not None}
    if not given:
        return loaded
    return with_settings(config, given) if isinstance(config, RigConfig) else load_config(os.fspath(config), given)


def seed_problems(seed: int) -> list[str]:
    """Problems with a seed; empty if it is usable."""
    if 0 <= seed <= MAX_SEED:
        return []
    return [f"seed is {seed}; it must be 0 or more and at most 2^63 - 1 ({MAX_SEED})"]


def with_settings(config: RigConfig, options: Mapping[str, object]) -> RigConfig:
    """A config with other values for some keys, by 'SECTION.KEY': {"scan.exposures": 4}. Values are written as in a
    file.

    Raises UsageError with one line per problem.
    """
    content = config.model_dump(mode="json")
    for key, value in options.items():
        section, name = key.split(".")
        content[section][name] = value
    return parse_config(content, options=options)


def with_lines(config: RigConfig, lines: int, power: LinePower = "shared") -> RigConfig:
    """Make a config with `lines` evenly spaced lines over the same field. The mirror sweeps only the share of one line.

    config: a rig with one line. Columns are rounded down to a multiple of `lines`, but to no less than `lines`. Raises
    UsageError for a config with several lines, a number of lines out of range, and if the changed config is not valid.
    """
    if len(config.line_offsets) > 1:
        raise UsageError(f"{config.name} has {len(config.line_offsets)} lines already; name a config with one")
    if not 1 <= lines <= MOST_LINES:
        raise UsageError(f"lines is {lines}; it must be 1 to {MOST_LINES}")
    first, last = config.scan.command_range
    pitch, middle = (last - first) / lines, (first + last) / 2
    offsets = sorted((line - (lines - 1) / 2) * pitch for line in range(lines))
    content = config.model_dump(mode="json")
    content["scan"]["columns"] = max(1, config.scan.columns // lines) * lines
    if lines > 1:
        content["scan"]["command_range"] = [middle - pitch / 2, middle + pitch / 2]
    return parse_config({**content, "line_offsets": offsets if lines > 1 else [0.0], "line_power": power})
