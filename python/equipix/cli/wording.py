"""Messages in the terms of the command line: options in the place of Python's keywords."""

from __future__ import annotations

import inspect
import re
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_VALUE = r"(?:'([^']*)'|(\w+(?:\.\w+)*))"


def in_options(message: str, called: Any) -> str:
    """Name the options of a command, or group, where a message names Python's keywords.

    A keyword that is no option stays where it is a key of a manifest or an argument of the command;
    of any other the message says that it is one of Python.
    """
    parameters = _parameters(called)
    options = {
        each.name: max(each.opts, key=len)
        for each in parameters
        if each.param_type_name == "option"
    }
    for name, option in options.items():
        message = _with_values(message, name, option)
    if ".toml: " in message:
        return message  # its quoted words are keys of that file
    for name, option in options.items():
        message = re.sub(rf"(?<!key )'{name}'(?! (?:in|of) )", option, message)
        if "_" in name:
            message = re.sub(rf"(?<![\w'/.\\-]){name}(?![\w'=/\\]|\.\w)", option, message)
    for name in _python_only() - {each.name for each in parameters}:
        message = message.replace(f"'{name}'", f"'{name}' (in Python)")
    return message


def _with_values(message: str, name: str, option: str) -> str:
    """Write ``name='value'`` and ``'name' (--name value)`` as ``--name value``."""
    message = re.sub(rf"'{name}' \(({option}[^)]*)\)", r"\1", message)
    message = re.sub(rf"\b{name}={_VALUE}", rf"{option} \1\2", message)
    message = message.replace(f"{option} True", option)
    return re.sub(rf"({option}(?: \w+)?)(?:, \1| \(\1\))", r"\1", message)


def _parameters(called: Any) -> list[Any]:
    """Parameters of a command, or of all commands of a group."""
    inner = getattr(called, "commands", {}).values()
    return [*called.params, *(each for command in inner for each in _parameters(command))]


@cache
def _python_only() -> frozenset[str]:
    """Keywords of what commands call that are no keys of manifests."""
    # Imported where there is a message: pydantic takes as long as the rest of `equipix --help`.
    from equipix.calibration.calibrate import calibrate
    from equipix.experiment.manifest import KEYS
    from equipix.frames import average
    from equipix.nuc.fit import fit
    from equipix.scene import METHODS

    called: list[Callable[..., object]] = [calibrate, average, fit, *METHODS.values()]
    return frozenset(name for each in called for name in inspect.signature(each).parameters) - KEYS
