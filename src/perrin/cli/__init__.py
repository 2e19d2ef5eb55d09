"""The command line."""

from perrin.cli.app import main

__all__ = [
    "main",
]
