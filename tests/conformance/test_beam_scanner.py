"""The suite of every beam scanner, on all of ours."""

from spadrig.conformance import BeamScannerSuite


class TestBeamScanner(BeamScannerSuite):
    """Over the factories of `conftest.py`."""
