"""``python -m equipix``: the command line."""

from __future__ import annotations

from equipix.cli import main

if __name__ == "__main__":
    main()
