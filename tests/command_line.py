"""The command line, built once for all tests: that takes 0.1 s of processor time."""

from __future__ import annotations

from typer.main import get_command

from perrin.cli.app import app

command_line = get_command(app)
