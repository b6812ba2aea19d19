"""The process that does cases one after the other: `python -m rig.batch.worker`, started by `rig.batch.pool`.

It reads tasks from its standard input and writes how they ended to its standard output, a line of JSON each. An empty
line before them says that it is ready. When the input ends, because the process that started it is gone, it ends at
once, even in the middle of a case.
"""

import json
import os
import sys
import threading
from dataclasses import asdict
from queue import SimpleQueue

from rig.batch.task import Task, perform
from rig.kernel_cache import prepare_kernels
from rig.run_folder.plain_json import json_line


def main() -> None:
    """Do tasks until the input ends. The only argument is the worker's name."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what cases print goes elsewhere
    lines: SimpleQueue[str] = SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    prepare_kernels()
    answers.write("\n")
    answers.flush()
    while True:
        ended = perform(Task(**json.loads(lines.get())), sys.argv[1])
        answers.write(json_line(asdict(ended)))
        answers.flush()


def _read(lines: "SimpleQueue[str]") -> None:
    for line in sys.stdin:
        lines.put(line)
    os._exit(0)  # a case may be at work, and nobody waits for it


if __name__ == "__main__":
    main()
