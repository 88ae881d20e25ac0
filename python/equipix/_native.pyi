"""The compiled part of equipix: private; the docs stand in the Python modules that wrap it."""

__version__: str
