"""The parts of a report on how a run was made: calibration, commands that make it again, settings, versions."""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibration.depth_error import depth_uncertainty
from calibration.errors import CalibrationError
from rig.report.calibration import age_words
from rig.report.compared import Cell, compared, value_at
from rig.report.page import paragraph, preformatted, table
from rig.report.run_facts import RunFacts


def calibration_section(runs: Sequence[RunFacts]) -> str:
    """HTML table with a column for each run, on its calibration: id and file, verdicts, age at the run, what it was
    made from, and the depth error that it leaves. Rows on which no run says anything are left out."""

    def provenance(run: RunFacts) -> str:
        said = {**(value_at(run.manifest, "calibration.provenance") or {})}
        return ", ".join(f"{key} {value}" for key, value in said.items() if isinstance(value, str | int)) or "-"

    def age(run: RunFacts) -> str:
        if run.calibration_age is None:
            return "not dated" if run.model is not None else "-"
        return age_words(run.calibration_age)

    def verdict(run: RunFacts) -> str:
        identity = None if run.model is None else run.model.identity
        return "none stated" if identity is None or identity.verdict is None else str(identity.verdict)

    rows: list[tuple[str, Cell]] = [
        ("id", lambda run: str(value_at(run.manifest, "calibration.id") or "none")),
        ("file", lambda run: Path(str(value_at(run.manifest, "config.calibration") or "-")).name),
        ("compared with the rig", lambda run: str(value_at(run.manifest, "calibration.check") or "-")),
        ("its own verdict", verdict),
        ("age at the run", age),
        ("made from", provenance),
        ("expected error of depth", _expected_error),
    ]
    return compared(runs, rows)


def _expected_error(run: RunFacts) -> str:
    """The depth error that the calibration leaves at the median depth, in words."""
    if run.model is None:
        return "-"
    if run.model.covariance is None:
        return "not known: the calibration states no covariance"
    known = np.zeros(0) if run.depth_m is None else run.depth_m[np.isfinite(run.depth_m)]
    at_m = float(f"{np.median(known):.2g}") if known.size else 2.0
    try:
        return depth_uncertainty(run.model, at_m).line()
    except CalibrationError as error:
        return f"not known: {error}"


def commands_section(runs: Sequence[RunFacts]) -> str:
    """Commands that make the run, its maps and this report again."""
    lines = []
    for run in runs:
        command, folder = run.manifest.get("command"), _quoted(run.folder)
        if command == "scan":
            lines.append(f"rig scan --like {folder}   # the same scan: settings, seed, calibration")
        if run.recorded and run.number is not None:
            estimator = run.summary.get("estimator")
            with_it = f" --estimator {estimator}" if estimator else ""
            new = _quoted(run.folder.with_name(f"{run.folder.name}-again"))
            lines.append(f"rig reconstruct {folder}{with_it} --out {new}   # the same maps from the same frames")
    lines.append(f"rig report {' '.join(_quoted(run.folder) for run in runs)}   # this page")
    return preformatted("\n".join(lines))


def settings_section(runs: Sequence[RunFacts]) -> str:
    """HTML with the whole config and the request of each run; for two runs, the settings that differ come first."""
    asked = [{"config": run.manifest.get("config") or {}, "request": run.manifest.get("request") or {}} for run in runs]
    html = ""
    if len(runs) == 2:
        rows = list(_differences(asked[0], asked[1]))
        html = (
            table(("differs", *(run.name for run in runs)), rows) if rows else paragraph("All settings are the same.")
        )
    for run, each in zip(runs, asked, strict=True):
        if each["config"] or each["request"]:
            html += f"<h3>{escape(run.name)}</h3>" if len(runs) > 1 else ""
            html += preformatted(yaml.safe_dump(each, sort_keys=False, allow_unicode=True, width=100))
    return html


def versions_section(runs: Sequence[RunFacts]) -> str:
    """Devices with their serial numbers, and versions of the programs."""
    names = sorted({name for run in runs for name in run.manifest.get("versions") or {}})
    slots = sorted({slot for run in runs for slot in run.manifest.get("devices") or {}})

    def device(slot: str) -> Cell:
        def cell(run: RunFacts) -> str:
            about = value_at(run.manifest, f"devices.{slot}") or {}
            serial = value_at(run.manifest, f"rig.serials.{slot}")
            return " ".join(filter(None, (str(about.get("name") or "-"), serial and f"serial {serial}")))

        return cell

    rows: list[tuple[str, Cell]] = [(slot, device(slot)) for slot in slots]
    rows += [
        (name, lambda run, name=name: str((run.manifest.get("versions") or {}).get(name, "-")))  # type: ignore[misc]
        for name in names
    ]
    return compared(runs, rows) if rows else ""


def _differences(first: Any, second: Any, path: str = "") -> Iterator[tuple[str, str, str]]:
    """Keys, joined by dots, at which two nested mappings differ, with both values as text; '-' for a missing one."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for key in [*first, *(key for key in second if key not in first)]:
            yield from _differences(first.get(key), second.get(key), f"{path}.{key}".lstrip("."))
    elif first != second:
        texts = (
            "-" if each is None else "(given)" if isinstance(each, Mapping) else str(each) for each in (first, second)
        )
        yield (path, *texts)  # type: ignore[misc]  # there are two


def _quoted(folder: Path) -> str:
    return shlex.quote(str(folder))
