"""Requests: every field is an option of its command, with the same phrase in help and docstring."""

from dataclasses import fields

import pytest
import typer

from rig import requests
from rig.cli.main import app


@pytest.mark.parametrize("command", ["scan", "replay", "reconstruct", "tradeoff", "cut", "import", "export"])
def test_a_field_of_a_request_is_an_option_and_is_described_once(command: str) -> None:
    request = getattr(requests, f"{command.capitalize()}Request")
    options = {each.name: each for each in typer.main.get_command(app).commands[command].params}  # type: ignore[attr-defined]
    for field in fields(request):
        about = field.metadata["about"]
        assert options[field.name].help == about
        assert f"{field.name}: {about} (default: " in request.__doc__
