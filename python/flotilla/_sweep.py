"""Sweeps: grids of runs, trained in this process, in other processes or on other machines."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flotilla import _native
from flotilla._arrays import count, word
from flotilla._arrays import text as check_text
from flotilla._config import Config
from flotilla._errors import Error, warn
from flotilla._program import program
from flotilla._run import Run, train

if TYPE_CHECKING:
    import pandas

# Attempts per point on an executor's workers. If all of these are lost, the point is trained in this process.
TRIES = 3


class Point(NamedTuple):
    """One run of a sweep."""

    number: int
    """Its place among all combinations."""
    values: dict[str, Any]
    """By the axes' keys."""
    run: Run


class Sweep:
    """The results of a sweep; `len()`, iteration and `sweep[0]` are over its points.

    Attributes:
        axes: the keys that vary.
        points: every `Point`, in the order of the grid.
    """

    def __init__(self, axes: list[str], points: list[Point]) -> None:
        self.axes, self.points = axes, points

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: int) -> Point:
        return self.points[index]

    def __iter__(self) -> Iterator[Point]:
        return iter(self.points)

    def metric(self, name: str = "champion_g") -> NDArray[np.float64]:
        """A metric of the last generation, float64 `[points, trials]`, NaN for missing trials."""
        rows = [point.run.metrics[name][:, -1] for point in self.points]
        table = np.full((len(rows), max(map(len, rows), default=0)), np.nan)
        for row, values in zip(table, rows):
            row[: len(values)] = values
        return table

    def to_pandas(self) -> pandas.DataFrame:
        """One row per point and trial: the values of the axes, and the last generation's metrics."""
        import pandas

        rows = []
        for point in self.points:
            for trial in range(len(point.run.policies)):
                last = {name: values[trial, -1] for name, values in point.run.metrics.items()}
                rows.append({"point": point.number, **point.values, "trial": trial, **last})
        return pandas.DataFrame(rows)

    def __repr__(self) -> str:
        return f"<flotilla.Sweep: {count(len(self), 'point')} over {', '.join(self.axes)}>"


def _play(config: str, backend: str) -> Run:
    """Trains a point in a worker. It is at module level so that it can be pickled."""
    return train(Config.parse(config), backend=backend, progress=False)


def sweep(
    sweep: str | os.PathLike[str] | Config,
    executor: Any = None,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    out: str | os.PathLike[str] | None = None,
    skip_impossible: bool = False,
    backend: str | int = "auto",
    progress: Callable[[int, int], Any] | None = None,
) -> Sweep:
    """Trains every point of a grid.

    Args:
        sweep: a `Config`, with a grid; or a sweep file, or its text: a config with a section `[grid]`.
        grid: lists of values by dotted keys, for a config: `{"world.coupling": [1, 3]}`.
        executor: trains the points: any `concurrent.futures.Executor`, with processes or with workers of Dask, MPI or
            Slurm (submitit). Points are sent as configs, and results return as arrays. If a worker is lost, its points
            are trained again, to the same bits. None trains them in this process, side by side.
        out: a directory that keeps the sweep, as `flotilla sweep SWEEP --out DIR` does. Not with `executor`.
        skip_impossible: leave out points that cannot run.
        backend: as of `train`.
        progress: called with the number of finished points and of all points. Without `executor` it is called once, at the
            end.

    Raises:
        ConfigError: everything that is wrong with the sweep and any of its points.
        Error: a point cannot be played.

    Example:
        >>> config = flotilla.Config.paper("chaotic").replace(learning={"trials": 1, "generations": 2})
        >>> found = flotilla.sweep(config, grid={"world.coupling": [1, 3]})
        >>> [point.values for point in found], found[0].run.config["world.coupling"]
        ([{'world.coupling': 1}, {'world.coupling': 3}], 1)
    """
    if isinstance(sweep, Config) != (grid is not None):
        raise TypeError("a config needs grid={key: values}; a sweep file or text has its own")
    given = _with_grid(sweep, grid) if isinstance(sweep, Config) and grid is not None else os.fspath(sweep)  # type: ignore[arg-type]
    is_text = not isinstance(sweep, os.PathLike) and "\n" in given
    name, text = ("the sweep", given) if is_text else (given, _text(given))
    machine = word("backend", backend)
    axes, points, normal = _native.sweep(text, name, skip_impossible)
    values = [dict(zip(axes, of)) for _, of, _ in points]
    if executor is None:
        runs = _here(normal, out, machine)
        if progress is not None:
            progress(len(points), len(points))
    elif out is not None:
        raise ValueError("out keeps what is trained here; save the runs of an executor one by one")
    else:
        runs = _there(executor, [config.to_toml() for _, _, config in points], machine, progress)
    return Sweep(axes, [Point(point[0], of, run) for point, of, run in zip(points, values, runs)])


def _with_grid(config: Config, grid: Mapping[str, Sequence[Any]]) -> str:
    """Returns the text of a sweep: a config without the keys of a grid, and the grid."""
    if not isinstance(grid, Mapping) or not grid:
        raise TypeError("grid must map dotted keys to lists of values, and not be empty")
    lines = ["[grid]"]
    for key, values in grid.items():
        if isinstance(values, (str, bytes)) or not isinstance(values, (Sequence, np.ndarray)):
            raise TypeError(f"grid[{key!r}] is {type(values).__name__}, allowed is a list of values")
        texts = [_native.value_as_toml(f"grid[{key!r}]", value) for value in values]
        lines.append(f'"{key}" = [{", ".join(texts)}]')
    return _without(config.to_toml(), grid) + "\n" + "\n".join(lines) + "\n"


def _without(text: str, keys: Mapping[str, Any]) -> str:
    """Returns a config's text without some keys."""
    kept, section = [], ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        if f"{section}.{line.partition(' = ')[0]}" not in keys:
            kept.append(line)
    return "\n".join(kept)


def _text(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError as error:
        raise Error(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise Error(f"{path}: it is not UTF-8 text") from None


def _here(text: str, out: str | os.PathLike[str] | None, backend: str) -> list[Run]:
    with tempfile.TemporaryDirectory(prefix="flotilla-") as folder:
        kept = os.path.join(folder, "out") if out is None else check_text("out", os.fspath(out))
        start = "fresh" if out is None else "resume"
        found = program("sweep", backend, text=text, name="sweep", out=kept, named=True, start=start)
        runs = [Run.open(point["folder"]) for point in found["points"]]
        if out is None:
            for run in runs:
                run._folder = None
        return runs


def _there(executor: Any, configs: list[str], backend: str, progress: Callable[[int, int], Any] | None) -> list[Run]:
    handed: list[Any] = [_hand(executor, config, backend) for config in configs]
    runs: list[Run] = []
    try:
        for config, future in zip(configs, handed):
            runs.append(_taken(executor, config, backend, future))
            if progress is not None:
                progress(len(runs), len(configs))
    except BaseException:
        # Cancel the remaining points, so that shutting down the executor does not wait for them.
        for future in handed:
            if hasattr(future, "cancel"):
                future.cancel()
        raise
    return runs


def _hand(executor: Any, config: str, backend: str) -> Any:
    try:
        return executor.submit(_play, config, backend)
    except (RuntimeError, OSError):
        # The executor has no workers left. The point is then trained in this process.
        return None


def _taken(executor: Any, config: str, backend: str, future: Any) -> Run:
    lost: BaseException | None = None
    for attempt in range(1, TRIES + 1):
        if future is None:
            break
        try:
            run: Run = future.result()
            return run
        except (Error, ValueError, TypeError, MemoryError, ImportError):
            raise
        except Exception as error:
            # Any other error means that a worker is lost.
            lost = error
            future = _hand(executor, config, backend) if attempt < TRIES else None
    warn(f"a point is trained here, since no worker plays it: {lost or 'none is left'!r}", RuntimeWarning)
    return _play(config, backend)
