"""``python -m equipix``: the command line."""

from equipix.cli import main

if __name__ == "__main__":
    main()
