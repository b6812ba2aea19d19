"""The pipeline's recorder: a thread that hands the blocks of one start of the SPAD to the recording.

It has a required place in the ring: where the disk is slower than the stream, the ring fills and the overload policy
decides. Blocks are written by the recording's own threads, several at a time, from the slots they lie in.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future

from drivers.frames import FrameBlock
from drivers.ring import RingReader
from rig.recording.writer import Recording
from rig.stage_thread import StageThread


class Recorder:
    """Records the blocks of one start of the SPAD, up to the last one. on_failure: called on its thread.

    reader: holds as many blocks as are to be written at a time.
    """

    def __init__(self, reader: RingReader, recording: Recording, on_failure: Callable[[], None]) -> None:
        self._reader = reader
        self._recording = recording
        self._on_failure = on_failure
        self._thread = StageThread(self._run, "recorder")
        self._before = recording.busy_s, recording.blocks, recording.bytes
        self.error: BaseException | None = None

    @property
    def busy_s(self) -> float:
        """Time of all writers together, for checksums and writing."""
        return self._recording.busy_s - self._before[0]

    @property
    def blocks(self) -> int:
        """Blocks written of this start."""
        return self._recording.blocks - self._before[1]

    @property
    def bytes(self) -> int:
        """What they take in the recording."""
        return self._recording.bytes - self._before[2]

    def start(self) -> None:
        """Begin to record."""
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait until everything is written; False where that takes longer."""
        return self._thread.join(timeout_s)

    def _run(self) -> None:
        with self._reader:
            under_way: deque[Future[None]] = deque()
            try:
                while (block := self._next()) is not None:
                    under_way.append(self._recording.submit(block))
                    while len(under_way) >= self._reader.holds:  # asking for the next block gives the oldest one back
                        under_way.popleft().result()
                while under_way:
                    under_way.popleft().result()
            except BaseException as error:  # raised again on the caller's thread
                self.error = error
                for each in under_way:
                    each.exception()  # slots go back only once nobody reads them
                self._on_failure()

    def _next(self) -> FrameBlock | None:
        """The next block; None where none will come. An error of the source is for counting to tell."""
        try:
            return self._reader.next()
        except Exception:
            return None
