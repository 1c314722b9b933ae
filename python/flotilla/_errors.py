"""Exceptions."""

from __future__ import annotations

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


def config_error(text: str, problems: list[tuple[int | None, str, str]]) -> ConfigError:
    return ConfigError(text, [Problem(*problem) for problem in problems])
