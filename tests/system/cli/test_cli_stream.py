"""`rig stream` as a process beside a scan: a client gets the scan's maps, and Ctrl-C ends the stream in order."""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig import api
from rig.api import SeenMap
from tests.system.conftest import Rig

PATIENCE_S = 60.0


def read_map(stream: Any) -> tuple[dict[str, Any], np.ndarray]:
    """The next map's JSON and depth, by the page."""
    while True:
        _, _, kind, json_bytes, array_bytes = struct.unpack("<4sHHII", stream.read(16))
        about, data = json.loads(stream.read(json_bytes)), stream.read(array_bytes)
        if kind == 2:
            (place,) = about["arrays"]
            return about, np.frombuffer(data, place["dtype"]).reshape(place["shape"])


@pytest.mark.skipif(os.name == "nt", reason="sends SIGINT")
def test_a_program_gets_the_maps_of_a_scan_in_another_process(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    process = subprocess.Popen(
        [sys.executable, "-c", "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
         "from rig.cli.main import main; main(['stream', '--port', '0', '--json'])"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    over = threading.Event()
    try:
        assert process.stderr is not None
        told = process.stderr.readline()
        address = re.fullmatch(r"stream: 127\.0\.0\.1:(\d+)\n", told)
        assert address is not None, told
        seen: dict[int, SeenMap] = {}

        def keep(one: SeenMap) -> None:
            seen[one.number] = one
            over.wait(0.02)
            if over.is_set():
                raise KeyboardInterrupt

        results: list[Any] = []
        scan = threading.Thread(target=lambda: results.append(api.scan(small, maps=10_000, on_map=keep)))
        with socket.create_connection(("127.0.0.1", int(address[1])), timeout=PATIENCE_S) as link:
            link.sendall(b'{"arrays": ["depth_m"]}\n')
            scan.start()
            stream = link.makefile("rb")
            indices, missed = [], 0
            for number in range(4):
                about, depth_m = read_map(stream)
                indices.append(about["index"])
                missed += about["missed"] if number else 0
                assert np.array_equal(depth_m, seen[about["index"]].result.depth_m, equal_nan=True)
                assert about["utc"] == seen[about["index"]].taken["utc"]
        over.set()
        scan.join(PATIENCE_S)
        assert indices == sorted(set(indices))
        assert missed == indices[-1] - indices[0] - 3
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=PATIENCE_S)
        counts = json.loads(out)
        assert process.returncode == 0
        assert (counts["clients"], counts["refused"]) == (1, 0)
        assert counts["maps_sent"] >= 4
        assert results[0].summary.verdict == "aborted"
        assert results[0].summary.frames.lost == 0
    finally:
        over.set()
        process.kill()
        process.communicate()


def test_a_port_that_is_taken_is_refused_in_one_line(rig: Rig) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ran = rig("stream", "--port", port)
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert f"port {port}" in ran.problems[0]
    assert "name another --port or --host" in ran.problems[0]
