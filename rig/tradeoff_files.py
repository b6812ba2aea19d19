"""The files of a trade-off: tradeoff.json, .csv and .svg, and setting.yaml, the setting to use as a config."""

import csv
import io
from collections.abc import Sequence
from dataclasses import replace

import yaml

from rig.config import RigConfig
from rig.config_files import portable_content
from rig.outputs import RunFolder
from rig.run import versions
from rig.tradeoff import Tradeoff
from rig.tradeoff_figure import tradeoff_svg
from rig.tradeoff_rows import TradeoffRow

SETTING_FILE = "setting.yaml"


def write_files(folder: RunFolder, done: Tradeoff, setting: RigConfig | None) -> Tradeoff:
    """Write everything and make the folder appear; the trade-off with its folder. setting: of the answer."""
    folder.write_json("tradeoff.json", {**done.as_json(), "versions": versions()})
    folder.write_text("tradeoff.csv", csv_text(done.rows))
    folder.write_text("tradeoff.svg", tradeoff_svg(done.rows, done.ci95_by))
    if setting is not None:
        comments = [f"rig tradeoff: {done.answer}"]
        if done.accepted_calibration:
            comments.append("its calibration was accepted all the same: scan with --accept-calibration")
        folder.write_text(SETTING_FILE, config_text(setting, comments))
    return replace(done, folder=folder.publish())


def csv_text(rows: Sequence[TradeoffRow]) -> str:
    """A line for each row, columns as in the JSON; the interval in two columns."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for row in rows:
        content = row.as_json()
        low, high = content.pop("ci95")
        line = {**content, "ci95_low": low, "ci95_high": high}
        if writer is None:
            writer = csv.DictWriter(stream, line.keys(), lineterminator="\n")
            writer.writeheader()
        writer.writerow(line)
    return stream.getvalue()


def config_text(config: RigConfig, comments: Sequence[str]) -> str:
    """A config as a YAML file that every command takes, wherever it lies."""
    head = "".join(f"# {comment}\n" for comment in comments)
    return head + yaml.safe_dump(portable_content(config), sort_keys=False, allow_unicode=True)
