"""Commands for recordings: `rig verify`, `repair`, `info`, `cut`, `compress`."""

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
