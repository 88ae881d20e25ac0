"""The command line: it parses options and prints results."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit status is 0, 1 (failed), 2 (usage) or 130 (Ctrl-C).

    What it needs is imported here, so that Ctrl-C ends that without a traceback too.
    """
    try:
        from equipix.cli.app import run

        run(arguments)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
