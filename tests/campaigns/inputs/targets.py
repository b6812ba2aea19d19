"""All targets by name."""

from tests.campaigns.inputs import foreign, pages, recordings, settings, wires
from tests.campaigns.inputs.fuzz import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for target in (*recordings.TARGETS, *settings.TARGETS, *foreign.TARGETS, *pages.TARGETS, *wires.TARGETS)
}
