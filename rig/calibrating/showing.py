"""How the board gets where it is wanted: a person is asked to hold it there, or the simulated world moves it."""

from collections.abc import Callable

from calibration.guide.poses import Candidate
from calibration.views import BoardPose
from drivers.units import format_quantity
from rig.arming import require_simulated_or_armed
from rig.config import RigConfig
from rig.config_files import parse_config
from rig.errors import UsageError

Tell = Callable[[str], None]
"""Takes a line for people."""
Ask = Callable[[str], None]
"""Says what to do with the board and returns once it is done; raises KeyboardInterrupt to end the session."""


def world_moves_board(config: RigConfig) -> bool:
    """Whether this rig's world holds the board itself."""
    return config.world is not None and "board_pose" in type(config.world).model_fields


def with_board_pose(config: RigConfig, pose: BoardPose) -> RigConfig:
    """The config of a simulated rig whose world holds the board at `pose`."""
    content = config.model_dump(mode="json")
    content["world"]["board_pose"] = {
        "rotation": [format_quantity(float(angle), "angle") for angle in pose.rotation],
        "position": [format_quantity(float(length), "length") for length in pose.position_m],
    }
    return parse_config(content)


def require_live(config: RigConfig | None, ask: Ask | None, arm: bool) -> None:
    """UsageError where a live rig may not shine, or nobody is there to move its board; None: no live rig."""
    if config is None:
        return
    problems = require_simulated_or_armed(config, arm)
    if ask is None and not world_moves_board(config):
        problems.append(
            f"{config.name} is a real rig, and nobody is there to move the board; run this at a terminal, pass "
            "ask=..., or give recorded runs as sources"
        )
    if problems:
        raise UsageError.of(problems)


def shown(config: RigConfig, what: str, pose: Candidate, ask: Ask | None, tell: Tell | None) -> RigConfig:
    """The config to capture the next pose with, once the board is there; `what` says where."""
    if world_moves_board(config):
        if tell is not None:
            tell(what)
        return with_board_pose(config, pose.pose)
    assert ask is not None, "required before the first pose"
    ask(what)
    return config
