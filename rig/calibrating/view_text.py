"""What is said of a view when it was taken."""

from calibration.errors import Degenerate
from calibration.rig_fit.sightings import FEWEST_PASSAGES, shows_line
from calibration.views import View


def told(view: View, refused: Degenerate | None) -> str:
    """One line: what is seen in it, or why nothing is. refused: why there are no corners."""
    if refused is not None:
        return f"view {view.name}: {refused}"
    parts = [] if view.corners is None else [f"{len(view.corners.ids)} corners"]
    if view.passages:
        counts = ", ".join(str(len(sweep.command)) for sweep in view.passages)
        parts.append(f"{counts} passages of the line" + ("" if shows_line(view) else _too_few(view)))
    return f"view {view.name}: {', '.join(parts) or 'neither corners nor passages'}"


def _too_few(view: View) -> str:
    """Why that is as good as none, and what to do about it."""
    where = "" if view.corners is None else ", or hold the board where the line passes"
    return (
        f", too few to count (limit {FEWEST_PASSAGES} a sweep): the line does not stand out in single pixels; give it "
        f"more exposures per column (2 to 5 do in a dark room) or more power{where}"
    )
