"""The command line: it parses and prints, the work is done elsewhere."""

from equipix.cli.app import app, main

__all__ = ["app", "main"]
