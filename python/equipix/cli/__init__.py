"""The command line: it parses options and prints results."""

from equipix.cli.app import app, main

__all__ = ["app", "main"]
