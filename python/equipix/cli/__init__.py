"""The command line: it parses options and prints results."""

import sys


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit status is 0, 1 (failed), 2 (usage) or 130 (Ctrl-C).

    What it needs is imported here, so that Ctrl-C ends that without a traceback too.
    """
    given = sys.argv[1:] if arguments is None else arguments
    try:
        from equipix.cli.app import run

        run(given)
    except KeyboardInterrupt:
        told = "equipix: error: stopped by Ctrl-C"
        if "--json" in given:
            told = '{"error": "stopped by Ctrl-C", "code": "interrupted"}'
        print(told, file=sys.stderr)  # noqa: T201
        raise SystemExit(130) from None
