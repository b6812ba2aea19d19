"""Random faults on a Helios's cable.

python -m tests.campaigns.devices.helios_faults --sequences 10000 --seed 1
"""

import sys
from functools import partial

from sim_backend.wire.firmware.helios import BLUE, GREEN, RED, HeliosModel
from tests.campaigns.devices.scanner_sequences import Subject, scanner_sequence
from tests.campaigns.outcomes import run

SUBJECT = Subject("helios", HeliosModel, {"frame": "20 ms"}, BLUE, GREEN, RED, 1.01 / 4095)
sequence = partial(scanner_sequence, SUBJECT)

if __name__ == "__main__":
    sys.exit(run(sequence, __doc__))
