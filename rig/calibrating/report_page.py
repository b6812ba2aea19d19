"""A report as one HTML file: text first, pictures inline, nothing loaded from elsewhere."""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from calibration.verdict import Verdict
from rig.pictures import png_bytes

_STYLE = """
body { font: 15px/1.45 Helvetica, Arial, sans-serif; color: #33404d; max-width: 860px; margin: 2em auto }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em } p { margin: 0.5em 0 }
.passed, .failed { padding: 0.6em 1em; margin-bottom: 1em; border-left: 6px solid; background: #f6f8fa }
.passed { border-color: #009e73 } .failed { border-color: #d55e00 }
table { border-collapse: collapse; font-size: 0.92em } td, th { padding: 0.15em 0.9em 0.15em 0; text-align: left }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums }
img { max-width: 100%; margin-top: 0.7em; image-rendering: auto } .small { color: #7b8896; font-size: 0.88em }
"""

_NUMBER = re.compile(r"-|[-+]?[\d.]+(e[-+]?\d+)?( of \d+)?")

Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report. body: HTML."""

    title: str
    body: str


def page(
    title: str,
    verdict: Verdict,
    line: str,
    figures: Sequence[tuple[str, str]],
    sections: Sequence[Section],
    about: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole file: verdict with its reasons, the one line that matters, the figures, what it is of, the sections."""
    parts = [
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>",
        _verdict(verdict, line),
        table(("", ""), [*figures, *about]) if figures or about else "",
        *(f"<h2>{escape(section.title)}</h2>\n{section.body}" for section in sections),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def paragraph(text: str, *, small: bool = False) -> str:
    """A paragraph of plain text."""
    return f"<p{' class=' + chr(34) + 'small' + chr(34) if small else ''}>{escape(text)}</p>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; columns whose cells are all numbers, or dashes in their place, stand to the right."""
    numbers = [bool(rows) and all(_NUMBER.fullmatch(row[i]) for row in rows) for i in range(len(head))]

    def cells(row: Sequence[str], tag: str) -> str:
        kinds = (' class="number"' if number else "" for number in numbers)
        return "".join(f"<{tag}{kind}>{escape(text)}</{tag}>" for kind, text in zip(kinds, row, strict=True))

    top = f"<tr>{cells(head, 'th')}</tr>" if any(head) else ""
    return f"<table>{top}{''.join(f'<tr>{cells(row, chr(116) + chr(100))}</tr>' for row in rows)}</table>"


def picture(pixels: Picture, caption: str) -> str:
    """A picture, BGR or grey, with a line below it."""
    data = base64.b64encode(png_bytes(pixels)).decode()
    return f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">{paragraph(caption, small=True)}'


def _verdict(verdict: Verdict, line: str) -> str:
    word = "passed" if verdict.passed else "failed"
    reasons = "".join(f"<p>{escape(str(reason))}.</p>" for reason in verdict.reasons)
    said = f"<p>{escape(line)}</p>" if line else ""
    return f'<div class="{word}"><p><b>{word.upper()}</b></p>{said}{reasons}</div>'
