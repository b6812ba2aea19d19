"""Random faults on a LaserCube's cable.

python -m tests.campaigns.devices.lasercube_faults --sequences 10000 --seed 1
"""

import sys
from functools import partial

from sim_backend.wire.firmware.lasercube import BLUE, GREEN, PLAYING, LaserCubeModel
from tests.campaigns.devices.scanner_sequences import Subject, scanner_sequence
from tests.campaigns.outcomes import run

SUBJECT = Subject(
    "lasercube", LaserCubeModel, {"buffer": "20 ms", "colours": "markers"}, BLUE, GREEN, PLAYING, 1.01 / 4095
)
sequence = partial(scanner_sequence, SUBJECT)

if __name__ == "__main__":
    sys.exit(run(sequence, __doc__))
