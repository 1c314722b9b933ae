"""Use cases of the program as functions. Each returns what the command prints with `--json`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any, SupportsIndex, overload

from flotilla import _native
from flotilla._arrays import number, text, whole, word
from flotilla._errors import keywords
from flotilla._run import Runs, _command, run_folders


def program(use_case: str, backend: str = "auto", **request: Any) -> dict[str, Any]:
    """Runs a use case and returns its outcome. Values that are None have the program's defaults."""
    given = {name: value for name, value in request.items() if value is not None}
    line = json.dumps({"use_case": use_case, **given})
    outcome: dict[str, Any] = json.loads(_native.answer(line, backend, _command()))
    return outcome


class Comparison(list[dict[str, Any]]):
    """The result of `compare`: a list of rows that `pandas.DataFrame(comparison)` reads, one per measure and arm.

    A row has `measure`, `generation`, `arm`, `trials`, the mean `value` and its 95 % interval from `low` to `high`, and what
    `flotilla compare --json` has besides.

    Attributes:
        pairs: rows, too, one per measure and pair of arms: `arm` and `other`, the difference of their means as `value`,
            `low` and `high`, and the test of it: `a`, `p` and `p_holm`.
        json: the whole object that `docs/reference/json.md` describes for `flotilla compare RUN RUN --json`. Its entries
            can be read from the comparison, too: `comparison["test"]`.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"generations": 3})
        >>> runs = [flotilla.train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
        >>> comparison = flotilla.compare(runs)
        >>> [(row["measure"], row["arm"]) for row in comparison[:2]]
        [('champion_g', 'fitness G'), ('champion_g', 'fitness Df')]
        >>> comparison.pairs[0]["arm"], comparison.pairs[0]["other"], comparison["test"]
        ('fitness G', 'fitness Df', 'mann-whitney')
    """

    def __init__(self, outcome: dict[str, Any]) -> None:
        super().__init__()
        self.json, self.pairs = outcome, list[dict[str, Any]]()
        for contest in outcome["comparisons"]:
            arms = [{"arm": arm["name"], "trials": arm["trials"]} for arm in contest["arms"]]
            place = {"where": contest["where"]} if contest["where"] else {}
            for measured in contest["measures"]:
                what = {**place, **{name: value for name, value in measured.items() if name not in ("arms", "pairs")}}
                self += [{**what, **arm, **mean} for arm, mean in zip(arms, measured["arms"])]
                for pair in measured["pairs"]:
                    one, other = (arms[index]["arm"] for index in pair["arms"])
                    self.pairs.append({**what, **pair, "arm": one, "other": other})
        for pair in self.pairs:
            del pair["arms"]

    @overload
    def __getitem__(self, key: SupportsIndex) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, key: slice) -> list[dict[str, Any]]: ...
    @overload
    def __getitem__(self, key: str) -> Any: ...
    def __getitem__(self, key: SupportsIndex | slice | str) -> Any:
        return self.json[key] if isinstance(key, str) else super().__getitem__(key)

    def __reduce__(self) -> tuple[Any, ...]:
        return Comparison, (self.json,)

    def __repr__(self) -> str:
        return f"<flotilla.Comparison: {len(self)} means, {len(self.pairs)} differences>"


def compare(
    runs: Runs,
    *,
    at: str | int | Sequence[str | int] = "last",
    paired: bool = False,
    reach: float = 0.75,
    by: str | None = None,
) -> Comparison:
    """Runs side by side: means, 95 % intervals, and a test of every pair, as `flotilla compare` prints them.

    Args:
        runs: at least two runs or their directories, or the directory of one sweep.
        at: generations to compare at: `[0, 50, "last"]`.
        paired: compare pair by pair: trials with one seed and number are pairs.
        reach: also compare the first generation whose champion has this G, 0 to 1.
        by: the axis of a sweep whose values are compared. None is the only axis.

    Raises:
        ValueError: there is nothing to compare.
        Error: a run cannot be read, or has only one trial.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"generations": 3})
        >>> runs = [flotilla.train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
        >>> import pandas
        >>> table = pandas.DataFrame(flotilla.compare(runs, at=[0, 3], reach=1))
        >>> table.groupby("measure")["generation"].max().to_dict()
        {'best_g': 3, 'champion_g': 3, 'generations_to_reach': 3}
    """
    folders, unverified, _kept = run_folders(runs)
    if not folders:
        raise ValueError("no runs, allowed are two at least or the folder of a sweep")
    wanted = at if isinstance(at, Sequence) and not isinstance(at, str) else [at]
    generations = [part.strip() for each in wanted for part in word("at", each).split(",")]
    if not generations:
        raise ValueError("at is empty, allowed are generations: a number, 'last', or a list of these")
    outcome = program(
        "compare",
        folders=folders,
        at=generations,
        paired=bool(paired),
        reach=number("reach", reach, 0, 1),
        by=None if by is None else text("by", by),
        unverified=unverified,
    )
    outcome["notes"] = [keywords(note) for note in outcome["notes"]]
    return Comparison(outcome)


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
    return program("paper", word("backend", backend), out=folder, start=start, set=set_)


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
    return program("verify", adapter=None if adapter is None else word("adapter", adapter), **counts)


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
