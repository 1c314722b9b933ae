"""Exceptions."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterable
from difflib import get_close_matches
from typing import NamedTuple


class Problem(NamedTuple):
    """One thing that is wrong with a config.

    Example:
        >>> Problem(3, "world.steps", "found 0, allowed 1 to 10000")
        Problem(line=3, key='world.steps', message='found 0, allowed 1 to 10000')
    """

    line: int | None
    """Line of the text, from 1. None for a problem outside the text."""
    key: str
    """Dotted key, or "" if the problem has none."""
    message: str
    """What was found, and what is allowed."""


class Error(RuntimeError):
    """The arguments were right, but the work failed: a file cannot be read, a GPU fails, a run is not finished.

    Example:
        >>> try:
        ...     flotilla.Run.open("nowhere")
        ... except flotilla.Error as error:
        ...     print(error)
        nowhere: no such folder
    """


class ConfigError(ValueError):
    """Everything that is wrong with a config.

    Attributes:
        problems: a list of `Problem`, by line.

    Example:
        >>> try:
        ...     flotilla.Config.parse("[world]\\nleaders = [[1, 1]]\\npois = [[2, 2]]\\nsteps = 0")
        ... except flotilla.ConfigError as error:
        ...     print(error.problems[0].line, error.problems[0].key)
        4 world.steps
    """

    def __init__(self, text: str, problems: list[Problem] | None = None) -> None:
        super().__init__(text, problems or [])
        self.problems: list[Problem] = list(problems or [])

    def __str__(self) -> str:
        return str(self.args[0])


# Flags without a value.
SWITCHES = ("force", "paired", "resume", "unverified")
PACKAGE = os.path.dirname(__file__) + os.sep


def keywords(text: str) -> str:
    """Returns a message of the program with its flags as arguments. Commands in backticks stay.

    Example:
        >>> keywords("--at 9: choose an earlier one, or pass --force to `flotilla train --force`")
        'at=9: choose an earlier one, or pass force=True to `flotilla train --force`'
    """

    def argument(flag: re.Match[str]) -> str:
        name = flag[1].replace("-", "_")
        return f"{name}=True" if name in SWITCHES else f"{name}={flag[2] or ''}"

    parts = text.split("`")
    parts[::2] = [re.sub(r"(?<![\w-])--([a-z][a-z-]*)(?: ([^\s:]+)(?=: ))?", argument, part) for part in parts[::2]]
    return "`".join(parts)


def warn(text: str, category: type[Warning]) -> None:
    """Warns the code that called the package, whichever function it called."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(keywords(text), category, stacklevel=level)


def no_key(key: object, kind: str, names: Iterable[str]) -> KeyError:
    """Returns the error of a key that does not exist. It offers similar ones, or else all."""
    every, key = list(names), str(key)
    similar = [name for name in every if name.rpartition(".")[2] == key] or get_close_matches(key, every)
    return KeyError(f"{key}: no such {kind}; {'did you mean' if similar else 'there are'} {', '.join(similar or every)}")


def config_error(text: str, problems: list[tuple[int | None, str, str]]) -> ConfigError:
    return ConfigError(text, [Problem(*problem) for problem in problems])
