"""Commands for devices (`rig doctor`, `devices`, `laser off`), configs (`rig config`) and scenes (`rig scenes`)."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.command import EXIT_DEVICE, ConfigArgument, JsonOption, command, print_json


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("doctor")(doctor_command)
    app.command("devices")(devices_command)
    laser = typer.Typer(name="laser", help="The laser's safe state.", rich_markup_mode=None)
    laser.command("off")(laser_off_command)
    app.add_typer(laser)


@command
def doctor_command(
    config: ConfigArgument = "simulated",
    out: Annotated[Path, typer.Option("--out", help="folder that a scan would write to")] = Path("runs"),
    as_json: JsonOption = False,
) -> int:
    """Open everything, look at the stream with the gate low, and say whether a scan could run."""
    from rig import api

    findings = api.doctor(config, out=out)
    if as_json:
        print_json({"could_scan": all(one.ok for one in findings), "findings": [one.as_json() for one in findings]})
    else:
        for one in findings:
            print(f"{'ok  ' if one.ok else 'FAIL'}  {one.name:<12}{one.text}")
    return 0 if all(one.ok for one in findings) else EXIT_DEVICE


@command
def devices_command(as_json: JsonOption = False) -> int:
    """List what is attached: USB devices that a driver knows, and serial ports."""
    from rig import api

    found = api.devices()
    if as_json:
        print_json({"devices": [one.as_json() for one in found]})
    else:
        for one in found:
            print(f"{one.address:<32}{one.what}")
        if not found:
            print("no known USB device and no serial port is attached")
    return 0


@command
def laser_off_command(config: ConfigArgument = "simulated") -> int:
    """Take the gate low and switch the laser's emission off for good."""
    from rig import api

    for line in api.laser_off(config):
        print(line)
    return 0


def register_config(app: typer.Typer) -> None:
    """Add the commands for configs and scenes to `app`."""
    config = typer.Typer(name="config", help="Check, show or describe a config.", rich_markup_mode=None)
    config.command("check")(check_command)
    config.command("show")(show_command)
    config.command("schema")(schema_command)
    app.add_typer(config)
    app.command("scenes")(scenes_command)


@command
def check_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Say whether a config is valid and the files that it names can be used; all problems at once."""
    from rig.api import check_config

    checked = check_config(config)
    if as_json:
        print_json({"config": config, "name": checked.name, "valid": True})
    else:
        print(f"{config}: valid, rig '{checked.name}'")
    return 0


@command
def show_command(config: ConfigArgument = "simulated", as_json: JsonOption = False) -> int:
    """Print a config as it is written, with every default filled in and every path absolute."""
    from rig.config.files import completed_text, config_content

    text = completed_text(config)
    if as_json:
        print_json(config_content(text))
    else:
        print(text, end="")
    return 0


@command
def schema_command() -> int:
    """Print the JSON schema of a config, for editors."""
    from rig.config.files import config_schema

    print_json(config_schema())
    return 0


@command
def scenes_command(as_json: JsonOption = False) -> int:
    """List the bundled scenes (--scene) and rigs (CONFIG), with a sentence on each."""
    from rig import api

    listed = {"scenes": api.bundled_scenes(), "rigs": api.bundled_rigs()}
    if as_json:
        print_json({group: [one.as_json() for one in members] for group, members in listed.items()})
        return 0
    wide = max(len(one.name) for members in listed.values() for one in members)
    for group, members in listed.items():
        print(f"{group}:")
        for one in members:
            print(f"  {one.name:<{wide}}  {one.about}")
    return 0
