"""The reference of commands, made of the command line itself: usage, arguments and options as `--help` shows them."""

from collections.abc import Iterator
from typing import Any

import typer

from docs.generate.tables import code, table
from rig.cli.main import app


def page() -> str:
    """Every command with its arguments and options, in the order of `rig --help`."""
    root = typer.main.get_command(app)
    return "\n".join(_section(name, command) for name, command in commands(root, "rig") if command is not root)


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """A command and all below it, each with its full name."""
    yield name, command
    for key, each in getattr(command, "commands", {}).items():
        if not each.hidden:
            yield from commands(each, f"{name} {key}")


def _section(name: str, command: Any) -> str:
    level = "#" * (len(name.split()))
    text = f"{level} {name}\n\n{command.help or ''}\n"
    if hasattr(command, "commands"):
        return text
    context = command.context_class(command, info_name=name)
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    usage = " ".join(["[OPTIONS]", *(_in_usage(one, context) for one in arguments)])
    text += f"\n```\n{name} {usage}\n```\n"
    for kind, head in (("argument", "argument"), ("option", "option")):
        records = [one.get_help_record(context) for one in command.params if one.param_type_name == kind]
        rows = [(code(record[0]), *_told(record[1])) for record in records if record]
        if rows:
            text += "\n" + table((head, "meaning", "default"), rows)
    return text


def _in_usage(argument: Any, context: Any) -> str:
    """An argument's name in brackets if it may be left out, with dots if there may be several."""
    name = str(argument.get_help_record(context)[0]).partition(" <")[0]
    return f"{name}..." if argument.nargs == -1 and not name.endswith("...") else name


def _told(help_text: str) -> tuple[str, str]:
    """The meaning of an option and its default, out of what `--help` says."""
    meaning, found, default = help_text.rpartition("  [")
    if not found:
        return _escaped(help_text), ""
    default = default.removesuffix("]").removeprefix("default: ")
    return _escaped(meaning), _escaped(default.removeprefix("(").removesuffix(")") if default[:1] == "(" else default)


def _escaped(text: str) -> str:
    """Text whose characters all stand for themselves in Markdown."""
    return "".join(f"\\{one}" if one in "*_<>[]" else one for one in text)
