"""The commands that are ended, as a user types them.

Each runs in a folder of its own. `in` has what it reads, `out` is where it writes, and both are described by `takes`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

STUDY: Final = """\
do: scan
vary: {exposures: [2, 3, 4]}
set: {config: small}
repeat: 2
"""


@dataclass(frozen=True, slots=True)
class Command:
    """A command line of `rig`.

    words: the arguments. takes: things of the material that it reads, in the folder `in`. changes: things of the
    material that it changes, which lie in `out`. writes: whether it writes to `out`. lasts_s: how long it goes on by
    itself, at most so long as it is watched, in seconds; 0: until it is done. code: exit code if nothing ends it.
    again: whether the same command goes on where it stopped. json: whether it has that option. emulated: whether real
    drivers run on emulated wires, in real time.
    """

    words: str
    takes: Sequence[str] = ()
    changes: Sequence[str] = ()
    writes: bool = True
    lasts_s: float = 0.0
    code: int = 0
    again: bool = False
    json: bool = True
    emulated: bool = False

    def arguments(self) -> list[str]:
        """The words behind `rig`."""
        return self.words.split()


COMMANDS: Final = {
    "scan": Command("scan small --maps 2 --out out/it"),
    "scan --record": Command("scan small --maps 3 --record --out out/it"),
    "scan --record-on-request": Command(
        "scan small --maps 8 --save last --record-on-request --before 1ms --out out/it"
    ),
    "replay": Command("replay in/take --clock max --out out/it", ("take",)),
    "replay --record": Command("replay in/take --record --out out/it", ("take",)),
    "reconstruct": Command("reconstruct in/take --out out/it", ("take",)),
    "reconstruct --cluster local": Command("reconstruct in/take --cluster local --workers 2 --out out/it", ("take",)),
    "tradeoff": Command("tradeoff small --exposures 2,3 --estimators edge --filters none --no-limits --out out/it"),
    "tradeoff --strategies": Command(
        "tradeoff small --strategies line-joint,gray-spad --times 10ms --fog clear --scene street --rules energy"
        " --rows 8 --out out/it"
    ),
    "batch": Command("batch in/study.yaml --workers 2 --out out/it", ("study.yaml",), again=True),
    "calibrate planes, views": Command("calibrate planes in/views --out out/it", ("views",)),
    "calibrate planes": Command("calibrate planes --poses 6 --out out/it", lasts_s=40.0),
    "calibrate camera": Command("calibrate camera in/views --out out/it", ("views",)),
    "calibrate sync": Command("calibrate sync small --out out/it", code=1, lasts_s=40.0),
    "calibrate pixels": Command("calibrate pixels small --frames 2000 --out out/it"),
    "calibrate check": Command("calibrate check --out out/it", lasts_s=40.0),
    "warmup": Command("warmup small", writes=False),
    "bench --soak": Command("bench --soak 2 --threads 1 --estimator edge", writes=False, lasts_s=40.0),
    "verify": Command("verify in/take", ("take",), writes=False),
    "repair": Command("repair out/torn", changes=("torn",), code=1),
    "cut": Command("cut in/take --maps 0:2 --out out/it", ("take",)),
    "compress": Command("compress out/take", changes=("take",)),
    "import": Command("import photoncube in/frames.npy --out out/it", ("frames.npy",)),
    "export npy": Command("export in/take npy --out out/it", ("take",)),
    "export hdf5": Command("export in/take hdf5 --out out/it", ("take",)),
    "export mp4": Command("export in/take mp4 --out out/it", ("take",)),
    "export png": Command("export in/take png --view frames --frames 10 --out out/it", ("take",)),
    "report": Command("report in/take --out out/it.html", ("take",)),
    "view": Command("view in/take --port 0", ("take",), writes=False, lasts_s=8.0),
    "stream": Command("stream --port 0", writes=False, lasts_s=5.0),
    "align": Command("align small --no-view --seconds 3", writes=False),
    "demo": Command("demo --no-view --out out/it", lasts_s=60.0, json=False),
    "effects": Command("effects small", writes=False),
    "doctor": Command("doctor small --out out"),
    "example": Command("example --out out/it"),
    "runs": Command("runs runs", writes=False),
    "scan lab-emulated": Command(
        "scan lab-emulated --exposures 4 --maps 2 --estimator edge --record --out out/it", emulated=True, lasts_s=60.0
    ),
    "scan lab-etherdream-emulated": Command(
        "scan lab-etherdream-emulated --maps 2 --estimator edge --out out/it", emulated=True, lasts_s=60.0
    ),
}

UNDER_WAY: Final = ("Ctrl-C", "Ctrl-C twice", "SIGTERM", "SIGHUP", "closed terminal")
"""Ends after which a command has to stop."""
PIPES: Final = ("| head -1", "2>&1 | head -1")
LID: Final = "closed lid"
GONE: Final = ("renamed", "removed", "unmounted")
FULL: Final = "full disk"
ENDS: Final = (*UNDER_WAY, *PIPES, LID, FULL, *GONE)


def ends_of(command: Command) -> tuple[str, ...]:
    """Ends that can happen to this command."""
    return ENDS if command.writes else (*UNDER_WAY, *PIPES, LID)
