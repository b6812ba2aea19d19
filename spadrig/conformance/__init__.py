"""Conformance suites: the tests that every device, estimator and strategy must pass, for packages that add their own.

Input: a class of tests in your package that inherits a suite, and a fixture that gives it your device. Output: pytest's
verdict. `spadrig.pytest_plugin` has the default fixtures. docs/how-to/plugin.md shows an example.
"""

from spadrig.conformance.beam_scanner import BeamScannerSuite
from spadrig.conformance.cases import LaserCase, ScannerCase, SpadCase, SyncCase, Taken
from spadrig.conformance.estimator import EstimatorSuite
from spadrig.conformance.line_laser import LineLaserSuite
from spadrig.conformance.spad_array import SpadArraySuite
from spadrig.conformance.strategy import StrategySuite
from spadrig.conformance.sync_source import SyncSourceSuite

__all__ = [
    "BeamScannerSuite",
    "EstimatorSuite",
    "LaserCase",
    "LineLaserSuite",
    "ScannerCase",
    "SpadArraySuite",
    "SpadCase",
    "StrategySuite",
    "SyncCase",
    "SyncSourceSuite",
    "Taken",
]
