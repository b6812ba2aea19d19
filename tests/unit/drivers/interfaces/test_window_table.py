"""The table of moving windows: which window a frame has, and which tables a sensor refuses."""

import numpy as np
import pytest

from drivers.errors import LimitExceeded
from drivers.frames import Mark
from drivers.interfaces import WindowTable

OUT, BACK = np.array([0, 64, 128], np.int32), np.array([192, 128, 64], np.int32)
BOTH_WAYS = WindowTable(64, (OUT, BACK))

NONE, LINE, SCAN = 0, int(Mark.LINE), int(Mark.SCAN)


@pytest.mark.parametrize(
    ("marks", "line", "sweep", "x0"),
    [
        *((NONE, 0, -1, 0), (SCAN, 0, 0, 0), (NONE, 0, 0, 0)),  # before, with and behind the very first scan marker
        *((LINE, 1, 0, 0), (NONE, 1, 0, 64)),  # the marker came during this frame: the next one is moved
        *((LINE, 2, 0, 64), (NONE, 2, 0, 128), (NONE, 7, 0, 128)),  # more markers than entries
        *((SCAN, 0, 1, 128), (SCAN | LINE, 1, 1, 128)),  # still the last window of the sweep before
        *((NONE, 0, 1, 192), (NONE, 1, 1, 128), (SCAN, 0, 2, 64), (NONE, 0, 2, 0), (NONE, 2, 65537, 64)),
        (SCAN | int(Mark.GATE_EDGE) | 0x1200, 0, 2, 64),  # other bits change nothing
    ],
)
def test_a_frame_has_the_window_of_the_markers_before_it(marks: int, line: int, sweep: int, x0: int) -> None:
    found = BOTH_WAYS.x0_of(np.array([marks], np.uint32), np.array([line], np.uint16), np.array([sweep], np.int32))
    assert found.tolist() == [x0]
    assert found.dtype == np.int32


@pytest.mark.parametrize(
    ("table", "sensor", "step", "said"),
    [
        (WindowTable(96, (OUT,)), 512, 32, "windows of 96 pixels; widths must be multiples of 64"),
        (WindowTable(0, (OUT,)), 512, 64, "windows of 0 pixels"),
        (WindowTable(64, (np.array([0, 32], np.int32),)), 512, 8, "from pixel 32 on; windows must start at multiples"),
        (WindowTable(128, (OUT,)), 512, 128, "from pixel 64 on; windows must start at multiples of 128"),
        (WindowTable(128, (OUT,)), 192, 64, "128 pixels from pixel 128 on reaches beyond the sensor's rows of 192"),
        (WindowTable(64, (np.array([-64], np.int32),)), 192, 64, "from pixel -64 on reaches beyond"),
        (WindowTable(64, (OUT, np.zeros(0, np.int32))), 192, 64, "give every sweep of the period at least one entry"),
        (WindowTable(64, ()), 192, 64, "a table without windows"),
    ],
)
def test_a_table_the_sensor_cannot_follow_is_refused(table: WindowTable, sensor: int, step: int, said: str) -> None:
    with pytest.raises(LimitExceeded, match=said):
        table.check(sensor, step)
    WindowTable(64, (OUT,)).check(150, 16)  # the last window may end in the padding of the rows
