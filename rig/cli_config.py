"""Commands for configs and scenes: `rig config check`, `show`, `schema`, `rig scenes`."""

import typer

from rig.cli_command import ConfigArgument, JsonOption, command, print_json


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
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
    from rig.config_files import completed_text, config_content

    text = completed_text(config)
    if as_json:
        print_json(config_content(text))
    else:
        print(text, end="")
    return 0


@command
def schema_command() -> int:
    """Print the JSON schema of a config, for editors."""
    from rig.config_files import config_schema

    print_json(config_schema())
    return 0


@command
def scenes_command(as_json: JsonOption = False) -> int:
    """The bundled scenes (--scene) and rigs (CONFIG), with a sentence on each."""
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
