"""Recordings on disk: segments of SPB1 blocks and their index, and the reader that replay and all other parts use.

Input: the folder of a recording. Output: its blocks by run and frame number, each checked, and a list of what is
damaged. A run in this package is one start of the SPAD, as in SPB1; the folder of a run of `rig scan` may hold several.
"""

from drivers.recorded.contents import INDEX_FILE, segment_name
from drivers.recorded.reader import RecordedRun, RunRecording

__all__ = ["INDEX_FILE", "RecordedRun", "RunRecording", "segment_name"]
