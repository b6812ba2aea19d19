"""Commands for devices (`rig doctor`, `align`, `devices`, `laser off`), configs (`config`) and scenes (`scenes`)."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.command import (
    EXIT_ABORTED,
    EXIT_DEVICE,
    CommandResult,
    Commands,
    ConfigArgument,
    api,
    asks,
    in_options,
    print_json,
    say,
    show_page,
    tell,
)
from rig.cli.progress import progress
from rig.errors import UsageError
from rig.requests import AlignRequest


def doctor_command(
    config: ConfigArgument = "simulated",
    out: Annotated[Path, typer.Option("--out", help="folder that a scan would write to")] = Path("runs"),
) -> CommandResult:
    """Open everything, look at the stream with the gate low, and say whether a scan could run."""
    with progress():
        findings = api.doctor(config, out=out)
    could_scan = all(one.ok for one in findings)
    lines = [f"{'ok  ' if one.ok else 'FAIL'}  {one.name:<12}{one.text}" for one in findings]
    content = {"could_scan": could_scan, "findings": [asdict(one) for one in findings]}
    return CommandResult(content, lambda: tell(in_options("\n".join(lines))), 0 if could_scan else EXIT_DEVICE)


@asks(AlignRequest)
def align_command(
    request: AlignRequest,
    config: ConfigArgument = "simulated",
    view: Annotated[
        bool | None, typer.Option("--view/--no-view", help="show it in the browser", show_default="if viser is there")
    ] = None,
) -> CommandResult:
    """Look at the laser line at low power while setting a rig up: sum image, line width, saturation; until Ctrl-C."""
    from rig.live.page import page_problem

    shown = view or (view is None and page_problem() is None)
    if shown and (problem := page_problem()) is not None:
        raise UsageError(problem)

    def begun(power_w: float, limit_w: float) -> None:
        if shown:
            show_page()
        share = f"{power_w * 1e3:g} mW, {power_w / limit_w:.0%} of its limit"
        say(f"laser at {share}; --power sets another. Ctrl-C ends it")

    with progress():
        found = api.align(config, request, begun=begun, tell=lambda figures: say(figures.line))
    last = found.last
    code = EXIT_ABORTED if last is None else 0 if found.found else 1
    note = "no line stands out: check beam, focus and gate, or raise --power or --exposures" if code == 1 else ""
    said = "aborted before the first sweep was whole" if last is None else last.line
    return CommandResult(found.as_json(), lambda: tell(said), code, note)


def devices_command() -> CommandResult:
    """List what is attached: USB devices that a driver knows, NI cards, Ether Dreams and Pulse Streamers on the
    network, and serial ports."""
    with progress(compiles=False):
        found = api.devices()
    lines = [f"{one.address:<32}{one.what}" for one in found]
    said = "\n".join(lines or ["no USB device, card, network device or serial port that a driver knows is attached"])
    return CommandResult({"devices": [asdict(one) for one in found]}, lambda: tell(said))


def laser_off_command(config: ConfigArgument = "simulated") -> int:
    """Set the gate low and switch the laser's emission off for good."""
    with progress():
        done = api.laser_off(config)
    for line in done:
        tell(line)
    return 0


def check_command(config: ConfigArgument = "simulated") -> CommandResult:
    """Say whether a config is valid and the files that it names can be read; list all problems at once."""
    with progress():
        checked = api.check_config(config)
    content = {"config": config, "name": checked.name, "valid": True}
    return CommandResult(content, lambda: tell(f"{config}: valid, rig '{checked.name}'"))


def show_command(config: ConfigArgument = "simulated") -> CommandResult:
    """Print a config as it is written, with every default filled in and every path absolute."""
    from rig.config.files import completed_text, config_content

    text = completed_text(config)
    return CommandResult(config_content(text), lambda: tell(text, end=""))


def schema_command() -> int:
    """Print the JSON schema of a config, for editors."""
    from rig.config.files import config_schema

    with progress():
        schema = config_schema()
    print_json(schema)
    return 0


def scenes_command() -> CommandResult:
    """List the bundled scenes (--scene) and rigs (CONFIG), with a sentence on each."""
    listed = {"scenes": api.bundled_scenes(), "rigs": api.bundled_rigs()}
    wide = max(len(one.name) for members in listed.values() for one in members)

    def show() -> None:
        for group, members in listed.items():
            tell(f"{group}:")
            for one in members:
                tell(f"  {one.name:<{wide}}  {one.about}")

    return CommandResult({group: [asdict(one) for one in members] for group, members in listed.items()}, show)


SCENES: Commands = {
    "config": (
        "Check, show or describe a config.",
        {"check": check_command, "show": show_command, "schema": schema_command},
    ),
    "scenes": scenes_command,
}
COMMANDS: Commands = {
    "doctor": doctor_command,
    "align": align_command,
    "devices": devices_command,
    "laser": ("The laser's safe state.", {"off": laser_off_command}),
}
