"""The reference of the Python API: what `rig.api` and the interfaces of devices say of themselves, through autodoc."""

import re
from collections.abc import Sequence

import rig.api

INTERFACES = ("device", "spad", "scanner", "laser", "sync", "world", "grab")
"""Modules of `drivers.interfaces`, in the order of their importance to those who write a driver."""
_ARGUMENT = re.compile(r"([a-z_]\w*(?:, [a-z_]\w*)*): (.*)")


def page() -> str:
    """Directives for Sphinx: the calls of `rig.api`, its requests and results, and the interfaces of devices."""
    functions = [name for name in rig.api.__all__ if name[0].islower()]
    classes = [name for name in rig.api.__all__ if isinstance(getattr(rig.api, name), type)]
    parts = [
        _part("Calls", [f".. autofunction:: rig.api.{name}" for name in functions]),
        _part("Requests and results", [f".. autoclass:: rig.api.{name}\n   :members:" for name in classes]),
        *(_module(f"drivers.interfaces.{name}") for name in INTERFACES),
        _module("drivers.registry"),
    ]
    return "\n".join(parts)


def _module(name: str) -> str:
    return _part(name, [f".. automodule:: {name}\n   :members:"])


def _part(title: str, directives: Sequence[str]) -> str:
    return f"## {title}\n\n```{{eval-rst}}\n" + "\n\n".join(directives) + "\n```\n"


def as_rst(lines: Sequence[str]) -> list[str]:
    """The lines of a docstring with its arguments (`name: meaning`, further lines indented) as a list of RST."""
    out: list[str] = []
    within = False
    for line in lines:
        argument = _ARGUMENT.fullmatch(line)
        continues = within and line.startswith(" ")
        if out and out[-1] and not continues and within != bool(argument):
            out.append("")
        out.append(f"* `{argument[1]}`: {argument[2]}" if argument else line)
        within = bool(argument) or continues
    return out
