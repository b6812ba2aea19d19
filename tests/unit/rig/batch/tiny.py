"""Cases for tests: quick ones, and such that end badly."""

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any
from uuid import uuid4


def square(x: int, sleep_s: float = 0.0) -> dict[str, Any]:
    """A case that always ends well."""
    time.sleep(sleep_s)
    return {"y": x * x, "measured": {"pid": os.getpid()}}


def trouble(x: int, kind: str, counter: str, times: int = 10**9) -> dict[str, Any]:
    """A case that ends badly as often as `times` says, counted by files in the folder `counter`."""
    before = len(list(Path(counter).glob(f"{x}-*")))
    (Path(counter) / f"{x}-{before}").touch()
    if before < times:
        if kind == "raise":
            raise ValueError(f"no {x}\nsecond line")
        if kind == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "hang":
            time.sleep(1000)
        if kind == "eat":
            eaten = []
            while True:
                eaten.append(bytearray(20 << 20))
                time.sleep(0.01)
    return {"y": x * x}


def nothing() -> None:
    """A case that forgets its result."""


def keeping(x: int, keep: str) -> dict[str, Any]:
    """A case that keeps a file."""
    Path(keep).mkdir(parents=True)
    (Path(keep) / "map.txt").write_text(str(x))
    return {"y": x}


def environment(x: int) -> dict[str, Any]:
    """A case that looks at its process."""
    return {"threads": os.environ["OPENBLAS_NUM_THREADS"], "measured": {"pid": os.getpid()}}


def loud(x: int, die: bool) -> dict[str, Any]:
    """A case that prints."""
    print(f"a line of {x}", flush=True)
    if die:
        os._exit(7)
    return {"y": x}


def parent(file: str) -> dict[str, Any]:
    """A case that waits for a process of its own."""
    with subprocess.Popen(["sleep", "1000"]) as child:
        Path(file).write_text(str(child.pid))
        child.wait()
    return {}


def counted(x: int, counter: str, sleep_s: float) -> dict[str, Any]:
    """A case that ends well, and leaves a file in the folder `counter` each time that it is done to its end."""
    time.sleep(sleep_s)
    (Path(counter) / f"{x}-{uuid4().hex}").touch()
    return {"y": x * x, "text": "." * 200, "measured": {"at_s": time.time()}}
