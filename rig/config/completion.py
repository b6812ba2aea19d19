"""Completes the text of a YAML file: missing keys are added in their places, and existing text stays as it is."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import yaml

MOST_COLUMNS = 110
"""Longest line, in characters, of keys added within braces; what would exceed it goes to the next line."""


class _Edit(NamedTuple):
    """A replacement: the text from `begin` to before `end`, and what takes its place."""

    begin: int
    end: int
    text: str


def completed(text: str, node: yaml.MappingNode, values: Mapping[str, Any], full: Mapping[str, Any]) -> str:
    """The text after two changes: strings that differ in `values` are replaced, missing keys of `full` are added.

    node: parsed node of the text. values: content of the text, in which strings may have been changed. full: content
    with all keys.
    """
    done, at = [], 0
    for edit in sorted(_edits(text, node, values, full), key=lambda edit: edit.begin):
        done += [text[at : edit.begin], edit.text]
        at = edit.end
    return "".join(done) + text[at:]


def _edits(text: str, node: yaml.MappingNode, values: Mapping[str, Any], full: Mapping[str, Any]) -> Iterator[_Edit]:
    """Replacements for the text. Of several that begin at one place, that of the inner mapping comes first."""
    for key, value in node.value:
        given = values.get(key.value)
        if isinstance(value, yaml.MappingNode) and isinstance(given, Mapping):
            below = full.get(key.value)
            yield from _edits(text, value, given, below if isinstance(below, Mapping) else {})
        elif isinstance(value, yaml.ScalarNode) and isinstance(given, str) and given != value.value:
            yield _Edit(value.start_mark.index, value.end_mark.index, _flow([given]))
    missing = {key: value for key, value in full.items() if key not in values}
    if missing:
        yield _added_inside(text, node, missing) if node.flow_style else _added_below(text, node, missing)


def _added_inside(text: str, node: yaml.MappingNode, missing: Mapping[str, Any]) -> _Edit:
    """Add keys within braces, after the last one."""
    at = node.value[-1][1].end_mark.index if node.value else node.start_mark.index + 1
    column = at - (text.rfind("\n", 0, at) + 1)
    parts: list[str] = []
    for key, value in missing.items():
        part = _flow({key: value})
        separate = "," if node.value or parts else ""
        if column + len(part) > MOST_COLUMNS:
            parts.append(f"{separate}\n{' ' * (node.start_mark.column + 1)}{part}")
            column = node.start_mark.column + 1 + len(part)
        else:
            parts.append(f"{separate}{separate and ' '}{part}")
            column += len(part) + 2
    return _Edit(at, at, "".join(parts))


def _added_below(text: str, node: yaml.MappingNode, missing: Mapping[str, Any]) -> _Edit:
    """Add keys on lines of their own, below the last one."""
    end = _end(node)
    if text[end - 1] != "\n":
        end = text.find("\n", end) + 1 or len(text)
    lines = block_text(missing, " " * node.start_mark.column)
    return _Edit(end, end, lines if text[end - 1] == "\n" else f"\n{lines}")


def _end(node: yaml.Node) -> int:
    """Index after a node's content. The end mark of a mapping or list without brackets may lie farther on."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def block_text(content: Mapping[str, Any], indent: str = "") -> str:
    """Keys and values as YAML, one line each; those of inner mappings are indented below."""
    lines = []
    for key, value in content.items():
        if isinstance(value, Mapping) and value:
            lines.append(f"{indent}{key}:\n{block_text(value, indent + '  ')}")
        else:
            lines.append(f"{indent}{_flow({key: value})}\n")
    return "".join(lines)


def _flow(content: dict[str, Any] | list[Any]) -> str:
    """A mapping or a list as YAML on one line, without its brackets."""
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=True, allow_unicode=True, width=10**9)
    return text.strip()[1:-1]
