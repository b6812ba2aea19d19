"""The page of all reports: one HTML file with its style, tables, pictures and charts in it, and no reference outside.

A page begins with the verdict in a sentence. It can be read on a phone, where pictures stand one below the other and
wide tables scroll, and on paper, where no picture or row of a table is cut by the end of a sheet. Numbers have units
and only the digits that are known.
"""

import base64
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.report.charts import FAINT, INK, Panel, legend, panel_svg
from rig.run_folder.pictures import Picture, Scale, png_bytes

_STYLE: Final = f"""
:root {{ color-scheme: light }}
* {{ box-sizing: border-box }}
body {{ font: 15px/1.45 Helvetica, Arial, sans-serif; color: {INK}; background: #fff; max-width: 1060px;
  margin: 0 auto; padding: 1em 16px 3em; overflow-wrap: break-word }}
h1 {{ font-size: 1.5em; margin: 0.5em 0 }} h2 {{ font-size: 1.15em; margin: 2em 0 0.4em }} p {{ margin: 0.5em 0 }}
h3 {{ font-size: 1em; margin: 1em 0 0.2em }}
.good, .bad {{ padding: 0.6em 1em; margin: 0 0 1em; border-left: 6px solid; background: #f6f8fa }}
.good {{ border-color: #009e73 }} .bad {{ border-color: #d55e00 }}
.wide {{ overflow-x: auto; margin: 0.4em 0 }}
table {{ border-collapse: collapse; font-size: 0.92em }}
td, th {{ padding: 0.15em 1.1em 0.15em 0; text-align: left; vertical-align: top }}
.many td {{ white-space: nowrap }} .many th {{ vertical-align: bottom }}
tr + tr td {{ border-top: 1px solid #eef1f4 }}
td.number, th.number {{ text-align: right; font-variant-numeric: tabular-nums }} td.number {{ white-space: nowrap }}
.side {{ display: flex; flex-wrap: wrap; gap: 4px 20px; align-items: flex-start }}
.side > * {{ min-width: 0; max-width: 100% }}
.pictures {{ display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 4px 20px }}
figure {{ margin: 0.4em 0; min-width: 0; max-width: 640px }}
figcaption, .small {{ color: #5f6d7b; font-size: 0.88em }}
img, svg {{ max-width: 100%; height: auto; display: block }}
.scale {{ position: relative; margin: 4px 2.2em 0; padding-bottom: 1.6em; font-size: 0.85em; white-space: nowrap }}
.scale img {{ width: 100%; height: 10px; image-rendering: pixelated }}
.scale span {{ position: absolute; top: 11px; transform: translateX(-50%) }}
.none {{ display: inline-block; width: 0.8em; height: 0.8em; background: #000; print-color-adjust: exact }}
.legend {{ margin: 0.2em 0 }} .legend span {{ display: inline-block; margin-right: 1.4em }}
.key {{ display: inline-block; vertical-align: -2px }}
.side > svg {{ flex: 1 1 300px; min-width: 0; max-width: 400px }}
pre {{ background: #f6f8fa; padding: 0.6em 0.8em; font-size: 12px; line-height: 1.35; overflow-x: auto;
  white-space: pre-wrap; overflow-wrap: anywhere }}
@media (max-width: 480px) {{ body {{ font-size: 16px; padding: 0.5em 12px 2em }} .pictures {{ display: block }}
  td, th {{ padding-right: 0.7em }} .many {{ font-size: 0.78em }} .many :is(td, th) {{ padding-right: 0.5em }} }}
@media print {{
  body {{ max-width: none; padding: 0; font-size: 10pt }} h2, h3, .legend {{ break-after: avoid }}
  figure, img, svg, tr, .good, .bad, .short, pre:not(.long) {{ break-inside: avoid }} .wide {{ overflow: visible }}
  pre.long {{ columns: 2; font-size: 7pt }}
  .good, .bad, pre {{ background: none; border: 1px solid {FAINT}; border-left-width: 6px }}
  .side figure {{ flex-basis: 45% }} .side > svg {{ flex-basis: 30% }}
}}
"""
GENERATOR: Final = "spadrig"
"""Name of the generator in the head of a page, by which a report is recognised."""
MOST_BYTES: Final = 2_000_000
"""Largest size of a report."""
MANY_COLUMNS: Final = 5
"""Cells of tables with so many columns keep their lines, and the table scrolls where it is too wide."""
_SHORT_ROWS: Final = 30
"""A table or text with at most so many lines is kept on one sheet of paper if it fits."""
PICTURE_PX: Final = (512, 400, 320, 240, 120)
"""Longest side of embedded pictures; the smaller ones are for reports that would otherwise be too large."""
JPEG_QUALITY: Final = 82
"""Quality of embedded photographs, of 0 to 100: finer structures than noise stay."""

_NUMBER = re.compile(r"-|[-+]?[\d.]+(e[-+]?\d+)?( of \d+| to [\d.]+)?")

Section = tuple[str, str]
"""A part of a page: its title, and its HTML."""
Rows = Sequence[tuple[str, str]]


def is_report(file: Path) -> bool:
    """Whether a file is a report that this program wrote. Raises OSError."""
    with file.open("rb") as stream:
        return f'<meta name="generator" content="{GENERATOR}">'.encode() in stream.read(400)


def page(title: str, top: Sequence[str], sections: Sequence[Section]) -> str:
    """The text of the HTML file: the title, pieces of HTML below it, and the sections; those without HTML are left out.

    title, and the titles of sections, are plain text.
    """
    shown = escape(title)
    parts = [
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="{GENERATOR}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{shown}</title><style>{_STYLE}</style></head><body><h1>{shown}</h1>",
        *top,
        *(f"<h2>{escape(name)}</h2>\n{body}" for name, body in sections if body),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def verdict_box(word: str, line: str, reasons: Sequence[str], *, good: bool) -> str:
    """The verdict in a box, with its sentence and the reasons for it."""
    said = f"<p>{escape(line)}</p>" if line else ""
    why = "".join(f"<p>{escape(reason.rstrip('.'))}.</p>" for reason in reasons)
    return f'<div class="{"good" if good else "bad"}"><p><b>{escape(word.upper())}</b></p>{said}{why}</div>'


def paragraph(text: str, *, small: bool = False) -> str:
    """A paragraph of plain text."""
    kind = ' class="small"' if small else ""
    return f"<p{kind}>{escape(text)}</p>"


def preformatted(text: str) -> str:
    """HTML that shows plain text with its line breaks, such as a command or a config. The text is escaped. On paper,
    long texts are set small, in two columns."""
    kind = ' class="long"' if text.count("\n") > _SHORT_ROWS else ""
    return f"<pre{kind}>{escape(text)}</pre>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table. Columns of numbers (or dashes in their place) are aligned right; a wide table scrolls.

    On paper a short table stays on one sheet, and a long one repeats its head on each sheet.
    """
    numbers = [bool(rows) and all(_NUMBER.fullmatch(row[i]) for row in rows) for i in range(len(head))]

    def cells(row: Sequence[str], tag: str) -> str:
        kinds = (' class="number"' if number else "" for number in numbers)
        return "".join(f"<{tag}{kind}>{escape(text)}</{tag}>" for kind, text in zip(kinds, row, strict=True))

    top = f"<thead><tr>{cells(head, 'th')}</tr></thead>" if any(head) else ""
    kinds = ["many"] * (len(head) >= MANY_COLUMNS) + ["short"] * (len(rows) <= _SHORT_ROWS)
    kind = f' class="{" ".join(kinds)}"' if kinds else ""
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f'<div class="wide"><table{kind}>{top}<tbody>{body}</tbody></table></div>'


def picture(pixels: Picture, caption: str) -> str:
    """Embed a picture as PNG, with a caption below it."""
    return _figure(png_bytes(pixels, small=True), "png", caption)


def scaled_picture(values: NDArray[np.floating], scale: Scale, caption: str) -> str:
    """Embed values (rows, width) as a picture in the colours of a scale, with the scale and a caption below it.

    The labels of the scale are text of the page, so they can be read however small the picture is shown.
    """
    marks = "".join(
        f'<span style="left:{100 * (share if scale.brighter else 1 - share):.1f}%">{escape(text)}</span>'
        for share, text in scale.marks()
    )
    bar = f'<div class="scale"><img alt="" src="{_embedded(png_bytes(scale.bar()), "png")}">{marks}</div>'
    absent = f' <i class="none"></i> {escape(scale.absent)}'
    return _figure(png_bytes(scale.colours(values), small=True), "png", caption, bar, absent)


def photograph(pixels: Picture, caption: str, most_px: int) -> str:
    """Embed a grey picture full of noise as JPEG, its longer side at most `most_px`, with a caption."""
    share = most_px / max(pixels.shape[:2])
    if share < 1:
        pixels = np.asarray(cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return _figure(bytes(data), "jpeg", caption)


def _figure(data: bytes, kind: str, caption: str, below: str = "", behind: str = "") -> str:
    """An embedded picture. below: HTML between it and its caption. behind: HTML behind the caption."""
    alt = escape(caption)
    shown = f'<img alt="{alt}" src="{_embedded(data, kind)}">'
    return f"<figure>{shown}{below}<figcaption>{alt}{behind}</figcaption></figure>"


def _embedded(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def pictures(parts: Sequence[str]) -> str:
    """Pictures in rows of two; on a phone one below the other."""
    return f'<div class="pictures">{"".join(parts)}</div>'


def no_picture(why: str) -> str:
    """Text in the place of a picture."""
    return f"<figure><figcaption>{escape(why)}</figcaption></figure>"


def side_by_side(parts: Sequence[str]) -> str:
    """Charts or tables beside each other, as many as fit; on a phone one below the other."""
    return f'<div class="side">{"".join(parts)}</div>'


def charts(panels: Sequence[Panel]) -> str:
    """Charts beside each other, as many as fit, with one legend of all their curves above."""
    series = {each.label: each for panel in panels for each in panel.series}
    return legend(list(series.values())) + side_by_side([panel_svg(panel) for panel in panels])
