"""Commands of the program as functions. Each runs in a child process, and returns the JSON that it prints."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from flotilla import _native
from flotilla._arrays import backend_name
from flotilla._errors import Error
from flotilla._run import Run


def program(command: str, *words: str, **flags: Any) -> dict[str, Any]:
    """Runs a command and returns its JSON. Flags that are None or False are left out; `force=True` gives `--force`."""
    line = [sys.executable, "-m", "flotilla", command, *words, "--json"]
    if command != "compare":
        line.append("--quiet")
    for name, value in flags.items():
        flag = "--" + name.rstrip("_").replace("_", "-")
        if value is True:
            line.append(flag)
        elif value is not None and value is not False:
            line += [flag, os.fspath(value) if isinstance(value, os.PathLike) else str(value)]
    # In its own session, the child does not get Ctrl-C from the terminal. It is forwarded below, and the child saves.
    pipe = subprocess.PIPE
    with subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, start_new_session=True) as running:
        try:
            printed, told = running.communicate()
        except KeyboardInterrupt:
            if os.name != "nt":
                running.send_signal(signal.SIGINT)
            running.communicate()
            raise
    text = told.decode(errors="replace").strip()
    if running.returncode == 75:
        raise KeyboardInterrupt(text)
    try:
        found = json.loads(printed)
    except ValueError:
        found = None
    if running.returncode == 2:
        raise ValueError(text.removeprefix("error: "))
    if found is None or (running.returncode != 0 and command != "verify"):
        raise Error(text.removeprefix("error: ") or f"flotilla {command} ended with {running.returncode}")
    given: dict[str, Any] = found
    return given


def compare(runs: Sequence[Run | str | os.PathLike[str]], *, at: str | int = "last", paired: bool = False) -> dict[str, Any]:
    """Runs side by side: means, 95 % intervals, and a test of every pair, as ``flotilla compare`` tells them.

    Args:
        runs: two at least, or their folders; or the folder of one sweep.
        at: generations to compare at: ``"0,50,last"``.
        paired: compare pair by pair: trials with one seed and number are pairs.

    Returns:
        what ``docs/reference/json.md`` says of ``flotilla compare RUN RUN --json``.

    Raises:
        ValueError: there is nothing to compare.
        Error: a run cannot be read, or has one trial alone.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"generations": 3})
        >>> runs = [flotilla.train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
        >>> flotilla.compare(runs)["comparisons"][0]["generation"]
        3
    """
    folders = [run.folder if isinstance(run, Run) else os.fspath(run) for run in runs]
    if not folders:
        raise ValueError("no runs, allowed are two at least or the folder of a sweep")
    return program("compare", *folders, at=at, paired=paired)


def paper(
    out: str | os.PathLike[str] = "paper",
    *,
    trials: int | None = None,
    generations: int | None = None,
    seed: int | None = None,
    resume: bool = False,
    force: bool = False,
    backend: str | int = "auto",
) -> dict[str, Any]:
    """The paper's Figures 4 to 6, its claims checked one by one, and a run for each of its arms, in a folder.

    Args:
        out: the folder.
        trials: 5 if left out.
        generations: 100 if left out.
        seed: 0 if left out.
        resume: go on with the paper in the folder.
        force: write over it.
        backend: as of :func:`train`.

    Returns:
        what ``docs/reference/json.md`` says of ``flotilla paper --json``.

    Raises:
        ValueError: a number is not allowed.
        Error: the folder holds one already, or cannot be written.

    Example:
        >>> found = flotilla.paper("short", trials=2, generations=2)
        >>> len(found["arms"]), flotilla.Run.open(found["arms"][0]["folder"]).config["learning.generations"]
        (33, 2)
    """
    machine = _machine(backend)
    return program(
        "paper", out=out, trials=trials, generations=generations, seed=seed, resume=resume, force=force, **machine
    )


def verify(*, worlds: int | None = None, teams: int | None = None, adapter: str | int | None = None) -> dict[str, Any]:
    """Compares every GPU with the CPU, bit for bit, over random worlds.

    Args:
        worlds: how many, instead of the program's default.
        teams: of each world, likewise.
        adapter: only the one of this number or name.

    Returns:
        ``equal``, and ``comparisons``: for every adapter, pass and kernel what was compared and what differs.

    Raises:
        Error: there is no GPU at all.
    """
    return program("verify", worlds=worlds, teams=teams, adapter=adapter)


def devices() -> list[dict[str, str | int]]:
    """The GPUs that a driver offers, each by the number that ``backend`` takes; the CPU is always there beside them.

    Example:
        >>> all({"index", "name", "driver", "api", "kind"} == set(device) for device in flotilla.devices())
        True
    """
    rows = enumerate(_native.adapters())
    return [
        {"index": index, "name": name, "driver": driver, "api": api, "kind": kind}
        for index, (name, driver, api, kind) in rows
    ]


def _machine(backend: str | int) -> dict[str, str]:
    name = backend_name(backend)
    return {"backend": name} if name in ("auto", "cpu", "gpu") else {"adapter": name}
