"""The interfaces of all devices, one file each. The application uses devices only through them.

Input: a power (`LineLaser`), a waveform (`BeamScanner`), pulses of the gate (`SyncSource`), a request for frames
(`SpadArray`). Output: blocks of frames in a ring, and the limits and the status that each device reports.
"""

from drivers.interfaces.apparatus import PulseTimes as PulseTimes
from drivers.interfaces.apparatus import Rule as Rule
from drivers.interfaces.apparatus import Spent as Spent
from drivers.interfaces.device import Device as Device
from drivers.interfaces.device import DeviceState as DeviceState
from drivers.interfaces.laser import LaserLimits as LaserLimits
from drivers.interfaces.laser import LaserStatus as LaserStatus
from drivers.interfaces.laser import LineLaser as LineLaser
from drivers.interfaces.scanner import LEVEL_BACKWARD as LEVEL_BACKWARD
from drivers.interfaces.scanner import MARKER_LINE as MARKER_LINE
from drivers.interfaces.scanner import MARKER_SCAN as MARKER_SCAN
from drivers.interfaces.scanner import BeamScanner as BeamScanner
from drivers.interfaces.scanner import ScannerLimits as ScannerLimits
from drivers.interfaces.scanner import ScannerStatus as ScannerStatus
from drivers.interfaces.scanner import ScanWaveform as ScanWaveform
from drivers.interfaces.spad import BurstMode as BurstMode
from drivers.interfaces.spad import SpadArray as SpadArray
from drivers.interfaces.spad import SpadCounters as SpadCounters
from drivers.interfaces.spad import SpadHealth as SpadHealth
from drivers.interfaces.spad import SpadInfo as SpadInfo
from drivers.interfaces.spad import SpadMode as SpadMode
from drivers.interfaces.spad import SpadRequest as SpadRequest
from drivers.interfaces.spad import SpadTiming as SpadTiming
from drivers.interfaces.spad import StreamMode as StreamMode
from drivers.interfaces.spad import WindowTable as WindowTable
from drivers.interfaces.sync import HOLD_S as HOLD_S
from drivers.interfaces.sync import OUT_FRAME as OUT_FRAME
from drivers.interfaces.sync import OUT_GATE as OUT_GATE
from drivers.interfaces.sync import OUT_MARKER as OUT_MARKER
from drivers.interfaces.sync import Pulse as Pulse
from drivers.interfaces.sync import SyncSource as SyncSource
from drivers.interfaces.sync import SyncStatus as SyncStatus
from drivers.interfaces.sync import sliced as sliced
from drivers.interfaces.sync import slices as slices
from drivers.interfaces.world import SweepTruth as SweepTruth
from drivers.interfaces.world import World as World
