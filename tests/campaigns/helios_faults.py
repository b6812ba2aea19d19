"""Random faults on a Helios's cable.

python -m tests.campaigns.helios_faults --sequences 10000 --seed 1
"""

import logging
import sys

from sim_backend.wire.dac_history import DacHistory
from sim_backend.wire.helios import BLUE, GREEN, RED, HeliosModel
from sim_backend.wire.usb_model import UsbModel
from tests.campaigns.scanner_sequences import Subject, run


def _model() -> tuple[UsbModel, DacHistory]:
    model = HeliosModel()
    return model, model.history


SUBJECT = Subject("helios", _model, {"frame": "20 ms"}, BLUE, GREEN, RED, 1.01 / 4095)

if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    sys.exit(run(SUBJECT, __doc__ or ""))
