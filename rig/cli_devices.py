"""Commands for the devices: `rig doctor`, `devices`, `laser off`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli_command import EXIT_DEVICE, ConfigArgument, JsonOption, command, print_json


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
    """What is attached: USB devices that a driver knows, and serial ports."""
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
