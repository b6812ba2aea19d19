"""The device interfaces the application is written against, one file each."""

from drivers.interfaces.device import Device, DeviceState
from drivers.interfaces.laser import LaserLimits, LaserStatus, LineLaser
from drivers.interfaces.scanner import (
    LEVEL_BACKWARD,
    MARKER_LINE,
    MARKER_SCAN,
    BeamScanner,
    ScannerLimits,
    ScannerStatus,
    ScanWaveform,
)
from drivers.interfaces.spad import (
    BurstMode,
    SpadArray,
    SpadCounters,
    SpadHealth,
    SpadInfo,
    SpadMode,
    SpadRequest,
    SpadTiming,
    StreamMode,
    WindowTable,
)
from drivers.interfaces.sync import (
    HOLD_S,
    OUT_FRAME,
    OUT_GATE,
    OUT_MARKER,
    Pulse,
    SyncSource,
    SyncStatus,
    sliced,
    slices,
)
from drivers.interfaces.world import SweepTruth, World

__all__ = [
    "HOLD_S",
    "LEVEL_BACKWARD",
    "MARKER_LINE",
    "MARKER_SCAN",
    "OUT_FRAME",
    "OUT_GATE",
    "OUT_MARKER",
    "BeamScanner",
    "BurstMode",
    "Device",
    "DeviceState",
    "LaserLimits",
    "LaserStatus",
    "LineLaser",
    "Pulse",
    "ScanWaveform",
    "ScannerLimits",
    "ScannerStatus",
    "SpadArray",
    "SpadCounters",
    "SpadHealth",
    "SpadInfo",
    "SpadMode",
    "SpadRequest",
    "SpadTiming",
    "StreamMode",
    "SweepTruth",
    "SyncSource",
    "SyncStatus",
    "WindowTable",
    "World",
    "sliced",
    "slices",
]
