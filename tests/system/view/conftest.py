"""Serves the page as `rig view` does, in a process of its own, and looks at it in headless Chromium.

Chromium is that of the system (`apt install chromium`); without it the tests of the page are skipped. Screenshots are
kept in `runs/screenshots`, which git ignores.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from rig.live import slot_files

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PATIENCE_S = 60.0
"""A test that waits so long for something has failed."""
LEAST_PX = 3000
"""Pixels of the point cloud's canvas that are coloured once points are drawn; viser itself colours some hundred."""
SCREENSHOTS = Path(__file__).parents[3] / "runs" / "screenshots"
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
"""WebGL without a graphics card."""


@dataclass(frozen=True, slots=True)
class Served:
    """A viewer that runs. url: of its page. pid: of its process. said: lines of its stderr."""

    url: str
    pid: int
    said: list[str]

    @property
    def port(self) -> int:
        port = urlsplit(self.url).port
        assert port is not None
        return port


@contextmanager
def served(*arguments: object, folder: Path) -> Iterator[Served]:
    """`rig view` with these arguments on a free port. folder: that of the slots of running scans."""
    command = [sys.executable, "-m", "rig", "view", "--port", "0", *map(str, arguments)]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    said: list[str] = []
    lines: Queue[str] = Queue()

    def read() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            said.append(line.rstrip())
            lines.put(line.rstrip())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        with suppress(Empty):
            while not (line := lines.get(timeout=PATIENCE_S)).startswith("page: "):
                pass
            yield Served(line.removeprefix("page: "), process.pid, said)
            return
        raise AssertionError(f"rig view said nothing of its page: {said}")
    finally:
        process.terminate()
        out, _ = process.communicate(timeout=PATIENCE_S)
        reader.join(PATIENCE_S)
        assert process.returncode == 0, "\n".join(said)
        assert out == "", "whatever viser prints is not for stdout"


@pytest.fixture(scope="module")
def slots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder for the slots of running scans that only this module's viewers see."""
    folder = tmp_path_factory.mktemp("slots")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        assert slot_files.slot_folder().is_relative_to(folder)
        yield folder


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    """Headless Chromium, one for a module."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("there is no Chromium to look at the page with: apt install chromium")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=list(SOFTWARE_GL))
        yield started
        started.close()


@dataclass(slots=True)
class Tab:
    """A page in the browser. asked: every address that it asked for. errors: what its scripts complained of."""

    page: "Page"
    asked: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def until(self, script: str) -> None:
        """Wait until an expression of the page is true."""
        self.page.wait_for_function(script, timeout=PATIENCE_S * 1000)

    def tells(self, topic: str) -> dict[str, object]:
        """The newest message of a topic."""
        found: dict[str, object] = self.page.evaluate(f"latest[{topic!r}]")
        return found

    def hover(self, what: str, row: int, x: int) -> None:
        """Move the mouse over a pixel of a picture, and wait until the page is told about it."""
        canvas = self.page.locator(f"#{what}")
        canvas.scroll_into_view_if_needed()
        box = canvas.bounding_box()
        assert box is not None
        width, rows = (self.page.evaluate(f"latest['picture-{what}'].{name}") for name in ("width", "rows"))
        self.page.mouse.move(box["x"] + box["width"] * (x + 0.5) / width, box["y"] + box["height"] * (row + 0.5) / rows)
        self.until(f"latest.row && latest.row.row === {row} && latest.row.x === {x}")

    def colours(self) -> dict[str, int]:
        """How many pixels of the point cloud's canvas have each colour but white, as drawn now."""
        script = """() => {
            const cloud = cloudCanvas(), copy = document.createElement("canvas");
            [copy.width, copy.height] = [cloud.width, cloud.height];
            const pen = copy.getContext("2d");
            pen.drawImage(cloud, 0, 0);
            const bytes = pen.getImageData(0, 0, copy.width, copy.height).data, found = {};
            for (let i = 0; i < bytes.length; i += 4) {
                const colour = [bytes[i], bytes[i + 1], bytes[i + 2]].join(",");
                if (bytes[i + 3] && colour !== "255,255,255") { found[colour] = (found[colour] || 0) + 1; }
            }
            return found; }"""
        found: dict[str, int] = self.page.evaluate(script)
        return found

    def cloud(self, unlike: dict[str, int] | None = None) -> dict[str, int]:
        """Colours of the point cloud, as soon as LEAST_PX pixels are coloured and most of them not as in `unlike`."""
        self.until("cloudCanvas() && latest.map")
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            found = self.colours()
            same = sum(min(count, (unlike or {}).get(colour, 0)) for colour, count in found.items())
            if (total := sum(found.values())) > LEAST_PX and same < total / 2:
                return found
            self.page.wait_for_timeout(100)
        raise AssertionError(f"the point cloud stays as it was: {sorted(found.items(), key=lambda one: -one[1])[:9]}")

    def screenshot(self, name: str) -> None:
        """Keep a picture of the whole page for people."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        self.page.evaluate("scrollTo(0, 0)")
        self.page.screenshot(path=str(SCREENSHOTS / f"{name}.png"), full_page=True)


Open = Callable[..., Tab]


@pytest.fixture
def open_tab(browser: "Browser") -> Iterator[Open]:
    """Opens pages; each has cookies of its own. At the end no script may have complained, nor anything been asked of
    another host."""
    tabs: list[tuple[str, Tab]] = []
    contexts = []

    def open_it(url: str, width: int = 1280, height: int = 900) -> Tab:
        context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True)
        context.set_default_timeout(PATIENCE_S * 1000)
        contexts.append(context)
        tab = Tab(context.new_page())
        tab.page.on("request", lambda request: tab.asked.append(request.url))
        tab.page.on("websocket", lambda socket: tab.asked.append(socket.url))
        tab.page.on("pageerror", lambda error: tab.errors.append(str(error)))
        tab.page.goto(url)
        tabs.append((urlsplit(url).netloc, tab))
        return tab

    yield open_it
    for context in contexts:
        context.close()
    for netloc, tab in tabs:
        assert tab.errors == []
        for address in tab.asked:
            parts = urlsplit(address.removeprefix("blob:"))
            assert parts.scheme == "data" or parts.netloc == netloc, address
