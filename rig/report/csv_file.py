"""Lines of a table as CSV text."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any


def csv_of(lines: Sequence[Mapping[str, Any]]) -> str:
    """The text: a header with every key that any line has, in the order in which the keys first come, then the lines. A
    field is empty if its line lacks the key."""
    columns = list(dict.fromkeys(key for line in lines for key in line))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return stream.getvalue()
