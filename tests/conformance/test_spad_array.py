"""The suite of every SPAD array, on all of ours."""

from spadrig.conformance import SpadArraySuite


class TestSpadArray(SpadArraySuite):
    """Over the factories of `conftest.py`."""
