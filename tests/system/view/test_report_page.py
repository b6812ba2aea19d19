"""Reports in a real browser: nothing is wider than a phone, and nothing is asked of anybody."""

from pathlib import Path

import pytest

from rig.report.run import run_report
from rig.report.run_facts import read_run
from tests.system.view.conftest import Open
from tests.unit.rig.report.pages import made_run

PHONE_PX = 390


@pytest.mark.parametrize("runs", [("foggy",), ("foggy", "another-run-with-quite-a-long-name")])
def test_a_report_is_as_wide_as_a_phone(runs: tuple[str, ...], open_tab: Open, tmp_path: Path) -> None:
    """`open_tab` fails if the page asks for any address but its own."""
    file = tmp_path / "report.html"
    file.write_text(run_report([read_run(made_run(tmp_path / name)) for name in runs]))
    tab = open_tab(file.as_uri(), PHONE_PX, 844)
    assert tab.page.evaluate("document.documentElement.scrollWidth") == PHONE_PX
    wide = tab.page.evaluate("[...document.querySelectorAll('.wide')].filter((one) => one.scrollWidth > 390).length")
    assert wide == 0, "no table has to be moved sideways, those of errors by distance neither"
    tab.screenshot(f"report-{len(runs)}-phone")
