"""Use cases of the program as functions. Each returns what the command prints with `--json`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

from flotilla import _native
from flotilla._arrays import backend_name, text, whole
from flotilla._run import Run, _command


def program(use_case: str, backend: str = "auto", **request: Any) -> dict[str, Any]:
    """Runs a use case and returns its outcome. Values that are None have the program's defaults."""
    given = {name: value for name, value in request.items() if value is not None}
    line = json.dumps({"use_case": use_case, **given})
    outcome: dict[str, Any] = json.loads(_native.answer(line, backend, _command()))
    return outcome


def compare(
    runs: Sequence[Run | str | os.PathLike[str]], *, at: str | int | Sequence[str | int] = "last", paired: bool = False
) -> dict[str, Any]:
    """Runs side by side: means, 95 % intervals, and a test of every pair, as `flotilla compare` prints them.

    Args:
        runs: at least two runs or their directories, or the directory of one sweep.
        at: generations to compare at: `[0, 50, "last"]`.
        paired: compare pair by pair: trials with one seed and number are pairs.

    Returns:
        the object that `docs/reference/json.md` describes for `flotilla compare RUN RUN --json`.

    Raises:
        ValueError: there is nothing to compare.
        Error: a run cannot be read, or has only one trial.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"generations": 3})
        >>> runs = [flotilla.train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
        >>> flotilla.compare(runs)["comparisons"][0]["generation"]
        3
    """
    folders = [run.folder if isinstance(run, Run) else os.fspath(run) for run in runs]
    if not folders:
        raise ValueError("no runs, allowed are two at least or the folder of a sweep")
    wanted = [at] if isinstance(at, (str, int)) else list(at) if isinstance(at, Sequence) else []
    if not wanted or not all(isinstance(each, (str, int)) and not isinstance(each, bool) for each in wanted):
        raise TypeError(f"at is {at!r}, allowed are generations: a number, 'last', or a list of these")
    generations = [part.strip() for each in wanted for part in str(each).split(",")]
    return program("compare", folders=[text("a run", folder) for folder in folders], at=generations, paired=bool(paired))


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
    """Trains the paper's experiments into a directory: Figures 4 to 6, a verdict on each claim, and one run per experiment.

    Args:
        out: the directory.
        trials: 5 if left out.
        generations: 100 if left out.
        seed: 0 if left out.
        resume: continue the paper in the directory.
        force: overwrite it.
        backend: as of `train`.

    Returns:
        the object that `docs/reference/json.md` describes for `flotilla paper --json`.

    Raises:
        ValueError: a number is not allowed.
        Error: the directory already holds one, or cannot be written.

    Example:
        >>> found = flotilla.paper("short", trials=2, generations=2)
        >>> len(found["arms"]), flotilla.Run.open(found["arms"][0]["folder"]).config["learning.generations"]
        (33, 2)
    """
    if resume and force:
        raise ValueError("resume continues a paper and force overwrites it: leave out one of the two")
    start = "resume" if resume else "force" if force else "fresh"
    keys = {"trials": trials, "generations": generations, "seed": seed}
    given = {key: whole(key, value, 0, 2**63 - 1) for key, value in keys.items() if value is not None}
    set_ = [{"key": f"learning.{key}", "text": str(value), "name": key} for key, value in given.items()]
    folder = text("out", os.fspath(out))
    return program("paper", backend_name(backend), out=folder, start=start, set=set_)


def verify(*, worlds: int | None = None, teams: int | None = None, adapter: str | int | None = None) -> dict[str, Any]:
    """Compares every GPU with the CPU, bit for bit, over random worlds.

    Args:
        worlds: number of worlds; None takes the command line's default.
        teams: number of teams per world; None takes the default.
        adapter: compare only the adapter with this number or name.

    Returns:
        `equal`, and `comparisons`: for every adapter, pass and kernel what was compared and what differs.

    Raises:
        Error: there is no GPU at all.
    """
    given = {"worlds": worlds, "teams": teams}
    counts: dict[str, Any] = {name: whole(name, value, 1, 100_000) for name, value in given.items() if value is not None}
    return program("verify", adapter=None if adapter is None else backend_name(adapter), **counts)


def devices() -> list[dict[str, str | int]]:
    """The GPUs that drivers offer, each with the number that `backend` takes. The CPU is always available and not listed.

    Example:
        >>> all({"index", "name", "driver", "api", "kind"} == set(device) for device in flotilla.devices())
        True
    """
    rows = enumerate(_native.adapters())
    return [
        {"index": index, "name": name, "driver": driver, "api": api, "kind": kind}
        for index, (name, driver, api, kind) in rows
    ]
