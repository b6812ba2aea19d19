"""The suite of every line laser, on all of ours."""

from spadrig.conformance import LineLaserSuite


class TestLineLaser(LineLaserSuite):
    """Over the factories of `conftest.py`."""
