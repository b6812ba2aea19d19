"""The suite of every sync source, on all of ours."""

from spadrig.conformance import SyncSourceSuite


class TestSyncSource(SyncSourceSuite):
    """Over the factories of `conftest.py`."""
