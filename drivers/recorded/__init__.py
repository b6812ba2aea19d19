"""Recordings on disk: segments of SPB1 blocks and their index, and the reader that replay and all other parts use."""

from drivers.recorded.contents import INDEX_FILE, segment_name
from drivers.recorded.reader import RecordedRun, RunRecording

__all__ = ["INDEX_FILE", "RecordedRun", "RunRecording", "segment_name"]
