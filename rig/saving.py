"""Which maps of a run are written: all, every N-th from the first on, or the last one only (`--save`)."""

import re
from dataclasses import dataclass

from rig.errors import UsageError

_EVERY = re.compile(r"every[\s:=]+(?P<step>\d+)", re.ASCII)


@dataclass(frozen=True, slots=True)
class SavePolicy:
    """step: write maps 0, step, 2 step, ...; None: the last map only."""

    step: int | None = 1

    @classmethod
    def parse(cls, text: str) -> "SavePolicy":
        """The policy that "all", "last" or "every 5" means. Raises UsageError for anything else."""
        cleaned = text.strip().lower()
        if cleaned == "all":
            return cls(1)
        if cleaned == "last":
            return cls(None)
        match = _EVERY.fullmatch(cleaned)
        if match is None or int(match["step"]) == 0:
            raise UsageError(f"--save is {text!r}; write 'all', 'last' or 'every N' with N of 1 or more")
        return cls(int(match["step"]))

    def count(self, maps: int) -> int:
        """How many of `maps` maps are written."""
        return min(maps, 1) if self.step is None else -(-maps // self.step)

    def keeps(self, index: int) -> bool:
        """Whether map `index` is written as soon as it is there."""
        return self.step is not None and index % self.step == 0
