"""Random faults on a LaserCube's cable.

python -m tests.campaigns.lasercube_faults --sequences 10000 --seed 1
"""

import logging
import sys

from sim_backend.wire.dac_history import DacHistory
from sim_backend.wire.lasercube import BLUE, GREEN, PLAYING, LaserCubeModel
from sim_backend.wire.usb_model import UsbModel
from tests.campaigns.scanner_sequences import Subject, run


def _model() -> tuple[UsbModel, DacHistory]:
    model = LaserCubeModel()
    return model, model.history


SUBJECT = Subject("lasercube", _model, {"buffer": "20 ms", "colours": "markers"}, BLUE, GREEN, PLAYING, 1.01 / 4095)

if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    sys.exit(run(SUBJECT, __doc__ or ""))
