"""`rig align`, `rig demo`, and --view of `rig scan` and `rig replay`, as a user meets them."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.live import page as page_module
from rig.scan.acquisition import Acquisition
from tests.system.conftest import Rig
from tests.system.run_files import files, strict


class Pages:
    """Stands in for the processes of pages. started: what each was started with. code: None while they run."""

    def __init__(self, code: int | None) -> None:
        self.started: list[dict[str, Any]] = []
        self.ended = 0
        self.code = code

    def start(self, **options: Any) -> SimpleNamespace:
        self.started.append(options)
        return SimpleNamespace(poll=lambda: self.code, wait=self._wait, terminate=self._end)

    def _wait(self, timeout_s: float | None = None) -> int:
        if timeout_s is None:
            raise KeyboardInterrupt
        return 0

    def _end(self) -> None:
        self.ended += 1


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def pages(monkeypatch: pytest.MonkeyPatch, code: int | None = None, problem: str | None = None) -> Pages:
    made = Pages(code)
    monkeypatch.setattr(page_module, "page_problem", lambda: problem)
    if problem is None:
        monkeypatch.setattr(page_module, "start_page", made.start)
    return made


def test_align_says_the_power_and_its_share_and_a_line_a_second(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = pages(monkeypatch)
    ran = rig("align", small, "--seconds", 0.01)
    assert ran.code == 0
    assert "laser at 10 mW, 10% of its limit; --power sets another" in ran.err
    assert ran.err.count("px wide") == 1
    assert ran.out.startswith("sweep ")
    assert opened.started == [{"stays": False, "opens": False}], "the page opens by itself where viser is installed"


def test_align_prints_one_json_object_at_the_end(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = pages(monkeypatch)
    ran = rig("align", small, "--seconds", 0.01, "--json", "--power", "20 mW", "--no-view")
    content = strict(ran.out)
    assert (ran.code, content["verdict"], content["power_w"]) == (0, "line", 0.02)
    assert opened.started == []


def test_align_without_a_line_exits_1_and_says_what_to_do(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages(monkeypatch, problem="no viser")
    ran = rig("align", small, "--seconds", 0.01, "--power", "0.000001 mW")
    assert ran.code == 1
    assert "no line stands out: check beam, focus and gate, or raise --power or --exposures" in ran.err


def test_align_that_is_interrupted_before_its_first_sweep_is_aborted(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: Acquisition) -> Any:
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(Acquisition, "run", interrupted)
    ran = rig("align", small, "--no-view", "--json")
    assert (ran.code, strict(ran.out)["verdict"]) == (4, "aborted")


def test_align_refuses_in_a_line(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages(monkeypatch, problem="the page needs viser; install it: pip")
    assert rig("align", small, "--power", "200 mW").problems == [
        "error: --power is 200 mW; simulated laser may be given 0 to 100 mW; choose a power within, or change the "
        "limit in the config"
    ]
    ran = rig("align", small, "--view")
    assert (ran.code, ran.problems) == (2, ["error: the page needs viser; install it: pip"])
    ran = rig("align", "lab")
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "--arm" in ran.problems[0]


def test_scan_and_replay_open_a_page_with_view(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = pages(monkeypatch)
    assert rig("scan", small, "--record", "--out", "take", "--view", "--json").code == 0
    assert rig("replay", "take", "--clock", "max", "--view", "--out", "again").code == 0
    assert opened.started == [{"stays": False, "opens": False}] * 2


def test_a_page_that_cannot_be_opened_ends_no_scan(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages(monkeypatch, code=2)
    ran = rig("scan", small, "--view", "--out", "run")
    assert ran.code == 0
    assert "warning: no page in the browser; everything else goes on" in ran.err


def test_demo_records_replays_and_keeps_the_page_until_ctrl_c(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = pages(monkeypatch)
    monkeypatch.setattr("rig.api.demo.SIMULATED", small)
    monkeypatch.setattr("rig.cli.scan.has_desktop", lambda: True)
    ran = rig("demo", "--out", "shown")
    assert ran.code == 0
    assert opened.started == [{"stays": True, "opens": True}]
    assert opened.ended == 1
    assert "3. the 3 depth maps of both are the same, bit for bit" in ran.err
    assert "next: rig view shown/recording" in ran.out
    assert {"recording/frames.idx", "replay/depth/000002.npy"} <= set(files(Path("shown")))


def test_demo_without_viser_says_so_and_does_the_rest(rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages(monkeypatch, problem="the page needs viser; install it: pip")
    monkeypatch.setattr("rig.api.demo.SIMULATED", small)
    ran = rig("demo")
    assert ran.code == 0
    assert "warning: no page in the browser: the page needs viser; install it: pip; everything else goes on" in ran.err
    assert len(list(Path("runs").glob("demo-*/replay/summary.json"))) == 1


def test_demo_that_is_interrupted_exits_4_and_ends_its_page(
    rig: Rig, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = pages(monkeypatch)
    monkeypatch.setattr("rig.api.demo.SIMULATED", small)

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rig.api.demo.replay", interrupted)
    ran = rig("demo", "--out", "shown", "--no-open")
    assert (ran.code, opened.ended) == (4, 1)
    assert opened.started == [{"stays": True, "opens": False}]
