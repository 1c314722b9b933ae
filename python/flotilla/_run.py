"""Training and its results."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import Floats, count, floats, text, whole, word
from flotilla._config import Config, check_config
from flotilla._errors import Error, no_key
from flotilla._show import Figure, Replay

if TYPE_CHECKING:
    import pandas

Generation = _native.Generation
Callback = Callable[[Generation], Any]
Init = Any

METRICS = ("best_g", "mean_g", "champion_g", "test_g")


class Metrics(dict[str, NDArray[np.float64]]):
    """A run's metrics by name."""

    def __missing__(self, name: object) -> Any:
        raise no_key(name, "metric", self)


class Run:
    """The results of training. `train` and `Run.open` return one.

    Attributes:
        config: the config that was trained. If a callback stopped training, it has fewer generations.
        metrics: `best_g`, `mean_g` and `champion_g`, each float64 `[trials, generations + 1]`, the random start
            first: the share of POIs observed, 0 to 1, by each generation's best and mean team, and by the team of every
            population's best policy. `test_g`, the best team's in its test episodes, is there if
            `learning.test_episodes` is.
        policies: one float32 array `[populations, policies, parameters]` per trial. There is a population per leader, per
            group, or one for all (`learning.sharing`). The best policy is first, so that team 0 of a rollout is the champion.
            These arrays and those of `metrics` are read-only: copy them to change them.
        digest: a checksum of the results, equal to the command line's for this config and seed.
        backend: the processor that trained it, in words.
        unverified: True if its files were not compared with their digests.
        own_fitness: True if a `Coevolution` was told another fitness than the config's. Only the first generation's best
            team and the last champion can be replayed then, and the run cannot be extended.

    Example:
        >>> config = flotilla.Config.paper("chaotic").replace(learning={"generations": 3, "trials": 2})
        >>> run = flotilla.train(config, seed=7)
        >>> run.metrics["champion_g"].shape, run.policies[0].shape
        ((2, 4), (4, 50, 112))
    """

    def __init__(self, outcome: _native.Outcome, played: _native.Played, times: list[float] | None, folder: str | None):
        config, metrics, policies, digest, self._end = outcome
        self.config = Config._of(config)
        self._metrics, self._policies = tuple(metrics), tuple(policies)
        self.digest: str = digest
        self._show_arrays()
        self.backend = played[1]
        self.own_fitness = played[7]
        self._played, self._times, self._folder = played, times, folder
        # Whether the folder is a temporary one of this process.
        self._temporary = False
        self.unverified = False

    def _show_arrays(self) -> None:
        """Sets the public attributes to read-only arrays. `save` uses the private ones, even if these are replaced."""
        for metric in self._metrics:
            metric.flags.writeable = False
        for policies in self._policies:
            policies.flags.writeable = False
        self.metrics = Metrics(zip(METRICS, self._metrics))
        self.policies: list[Floats] = list(self._policies)

    @classmethod
    def open(cls, folder: str | os.PathLike[str], unverified: bool = False) -> Run:
        """Reads a finished run of the command line or of Python.

        Args:
            folder: a run directory that `flotilla train`, a sweep or `train` wrote.
            unverified: read files that differ from their digests in `run.json`, too.

        Raises:
            Error: the folder holds no run, or one that is not finished, or its files are damaged or not as the run left
                them.

        Example:
            >>> config = flotilla.Config.paper().replace(learning={"generations": 2})
            >>> run = flotilla.train(config, out="runs/first")
            >>> flotilla.Run.open("runs/first").digest == run.digest
            True
        """
        path = os.fspath(folder)
        outcome, played, times = _native.open(path, unverified)
        run = cls(outcome, played, times, os.path.abspath(path))
        run.unverified = unverified
        return run

    @property
    def folder(self) -> str:
        """Where the run's files are; of a run that was trained in memory a temporary folder, which goes with it.

        Raises:
            Error: the folder holds another run by now.
        """
        if self._folder is None:
            folder = os.path.join(self._temporary_folder(), "run")
            self._write(folder, force=False)
            self._folder = folder
        elif not self._holds(self._folder, missing=True) and not self.unverified:
            raise Error(f"{self._folder} holds another run by now: open that, or train this one again")
        return self._folder

    def _holds(self, folder: str, missing: bool) -> bool:
        """Returns whether a folder holds this run, or `missing` if its record cannot be read."""
        try:
            with open(os.path.join(folder, "run.json"), encoding="utf-8") as file:
                return bool(json.load(file)["digest"] == self.digest)
        except (OSError, ValueError, KeyError, TypeError):
            return missing

    def _temporary_folder(self) -> str:
        """Makes a folder that is removed together with this run."""
        folder = tempfile.mkdtemp(prefix="flotilla-")
        self._own(folder)
        return folder

    def _own(self, folder: str) -> None:
        """Has a folder removed together with this run, but not by a forked process."""
        weakref.finalize(self, _remove, folder, os.getpid())
        self._temporary = True

    def save(self, folder: str | os.PathLike[str], force: bool = False) -> None:
        """Writes the run as `flotilla train` does, so that the program reads it, too.

        Args:
            folder: the directory to create.
            force: overwrite an existing run.

        Raises:
            FileExistsError: there is a run, and `force` was not given.
            Error: the files cannot be written.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> run.save("runs/saved")
            >>> sorted(os.listdir("runs/saved"))[-3:]
            ['metrics.csv', 'policies.safetensors', 'run.json']
        """
        own = self._folder is not None and os.path.realpath(folder) == os.path.realpath(self._folder)
        if own and force and self._holds(os.fspath(folder), missing=False):
            # Its files are there, with checkpoints that this object does not have.
            return
        self._write(os.fspath(folder), force)
        if self._temporary and self._folder is not None and self._played[6] is not None:
            # Only its checkpoints have the policies that it started from.
            shutil.copytree(self._folder, folder, dirs_exist_ok=True)

    def _write(self, folder: str, force: bool) -> None:
        metrics, policies = list(self._metrics), list(self._policies)
        times = self._times or [0.0] * metrics[0].shape[-1]
        arguments = (self.config._native, metrics, policies, self._end, times, self._played, folder, force, _command())
        _native.save(*arguments)

    def to_pandas(self) -> pandas.DataFrame:
        """The metrics as `metrics.csv` has them: one row per trial and generation.

        Needs pandas (`pip install flotilla-teams[pandas]`).

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> list(run.to_pandas().columns)
            ['trial', 'generation', 'best_g', 'mean_g', 'champion_g']
        """
        import pandas

        trials, generations = self.metrics["best_g"].shape
        trial, generation = np.indices((trials, generations))
        columns = {"trial": trial.T.ravel(), "generation": generation.T.ravel()}
        return pandas.DataFrame({**columns, **{name: self.metrics[name].T.ravel() for name in self.metrics}})

    def replay(
        self,
        trial: int | str = 0,
        generation: int | None = None,
        compare: int | None = None,
        backend: str | int = "auto",
        *,
        team: int | str = "champion",
    ) -> Replay:
        """The episode of one team of a trial and generation, as it was scored.

        Args:
            trial: from 0; or `"best"` or `"worst"`, the one with the largest or smallest G of that generation.
            generation: None is the last.
            compare: another generation, side by side.
            backend: as of `train`.
            team: `"champion"`, `"best"`, or the number of a team, from 0.

        Raises:
            ValueError: there is no such trial, generation or team, or the worlds of the two generations differ: they are of
                different stages, or POIs move (`learning.poi_jitter`).
            Error: the run was made with another version of the program or with a fitness that is not its config's, or the
                backend fails.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 5}))
            >>> [episode.generation for episode in run.replay(compare=0).episodes]
            [0, 5]
            >>> champion = run.replay(trial="best").episodes[0]
            >>> bool(champion.best_g == run.metrics["champion_g"][:, -1].max())
            True
        """
        last = int(self.config["learning.generations"])
        shown = [generation if generation is not None else last]
        if compare is not None:
            shown.insert(0, compare)
        generations = [whole("generation", shown_one, 0, 2**63 - 1) for shown_one in shown]
        chosen = word("trial", trial), word("team", team)
        return Replay(_native.replay(self.folder, *chosen, generations, self.unverified, word("backend", backend)))

    def plot(self, measure: str | None = None) -> Figure:
        """The learning curves: champion, best team and mean team, each with its 95 % interval over trials.

        Args:
            measure: draw only one of them: `"best"`, `"champion"`, `"mean"` or `"test"`.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> run.plot()
            <flotilla.Figure: .save(path) writes it as .svg, .pdf or .png>
        """
        return plot(self, measure)

    def __getstate__(self) -> dict[str, Any]:
        # A temporary folder belongs to this process. A copy of the run makes its own.
        folder = None if self._temporary else self._folder
        return {**self.__dict__, "_temporary": False, "_folder": folder, "config": self.config}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._show_arrays()

    def __repr__(self) -> str:
        g = self.metrics["champion_g"]
        last = g[:, -1]
        where = f", in {self._folder}" if self._folder is not None and not self._temporary else ""
        where += ", unverified" if self.unverified else ""
        where += ", by a fitness that is not the config's" if self.own_fitness else ""
        return (
            f"<flotilla.Run: {count(len(last), 'trial')}, {count(g.shape[1] - 1, 'generation')}, champion's G "
            f"{last.mean():.3f} ({last.min():.3f} to {last.max():.3f}){where}, digest {self.digest[:12]}…>"
        )


Runs = Union[Run, str, os.PathLike[str], Iterable[Union[Run, str, os.PathLike[str]]]]


def _remove(folder: str, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(folder, True)


def run_folders(runs: Runs) -> tuple[list[str], bool, list[Any]]:
    """Returns the directories of one run or of several, whether any was opened unverified, and the runs.

    Temporary folders are there for as long as the caller keeps the runs.
    """
    if isinstance(runs, (Run, str, os.PathLike)):
        runs = [runs]
    if not isinstance(runs, Iterable):
        raise TypeError(f"runs is {type(runs).__name__}, allowed are runs and their directories, one or a list")
    every = list(runs)
    folders = [text("a run", run.folder if isinstance(run, Run) else os.fspath(run)) for run in every]
    return folders, any(isinstance(run, Run) and run.unverified for run in every), every


def plot(runs: Runs, measure: str | None = None) -> Figure:
    """The learning curves of one run, or one kind of team of several runs side by side.

    Args:
        runs: runs or their directories, one or a list.
        measure: the teams that are drawn: `"best"`, `"champion"`, `"mean"` or `"test"`. None draws all of one run, and the
            champions of several.

    Raises:
        ValueError: there are no runs or too many, or there is no such measure.
        Error: a run cannot be read.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"generations": 3})
        >>> runs = [flotilla.train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
        >>> flotilla.plot(runs).svg()[:4]
        '<svg'
    """
    folders, unverified, _kept = run_folders(runs)
    if not 1 <= len(folders) <= 24:
        raise ValueError(f"{len(folders)} runs, allowed are 1 to 24")
    return Figure(_native.figure(folders, None if measure is None else text("measure", measure), unverified))


def _command() -> str:
    """Returns the command that started this process as a shell reads it, for a run's record."""
    program, *words = sys.orig_argv or ["python"]
    # Arguments may be any bytes.
    return shlex.join([os.path.basename(program), *words]).encode(errors="replace").decode()[:8000]


def _shown_by_default() -> bool:
    shell = sys.modules.get("IPython")
    if shell is not None and shell.get_ipython() is not None:
        return True
    return sys.stderr is not None and sys.stderr.isatty()


def _with_bar(called: list[Callback], config: Config, progress: bool | None) -> tuple[Callback | None, Callable[[], None]]:
    """Returns all callbacks as one, with a progress bar if that is wanted, and a function that closes the bar."""

    def told(generation: Generation) -> Any:
        answers = [callback(generation) for callback in called]
        # A wrong answer is reported as it is.
        no = [answer is None or isinstance(answer, (bool, np.bool_)) and not answer for answer in answers]
        return next((answer for answer, is_no in zip(answers, no) if not is_no), None)

    inner = called[0] if len(called) == 1 else told if called else None
    if progress is False or (progress is None and not _shown_by_default()):
        return inner, lambda: None
    try:
        from tqdm.auto import tqdm
    except ImportError:
        if progress:
            raise ImportError("progress=True draws a bar by tqdm: pip install tqdm") from None
        return inner, lambda: None
    bar = tqdm(total=config["learning.generations"] + 1, unit="generation", leave=False)

    def moved(generation: Generation) -> Any:
        bar.update(generation.generation + 1 - bar.n)
        return inner(generation) if inner is not None else None

    return moved, bar.close


def train(
    config: Config,
    seed: int | None = None,
    out: str | os.PathLike[str] | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    init: Run | str | os.PathLike[str] | ArrayLike | Sequence[ArrayLike] | None = None,
    backend: str | int = "auto",
    callback: Callback | Sequence[Callback] | None = None,
    champions: bool = False,
    progress: bool | None = None,
) -> Run:
    """Trains the teams of a config.

    Args:
        config: what to train.
        seed: replaces the config's `learning.seed`.
        out: a directory that keeps the run while it trains, as `flotilla train CONFIG --out DIR` does, so that it can be
            resumed. None trains in memory; `Run.save` writes it later.
        resume: continue the run in `out`, or start it if there is none.
        force: overwrite the run in `out`.
        init: initial policies in place of random ones: a `Run`, a `policies.safetensors`, or arrays
            `[populations, policies, parameters]`, one for each trial or one for all. Trial i starts from trial i of a run or
            file. Larger populations are filled with random policies. A run that starts from policies is kept in `out`,
            or else in a temporary folder that is removed with the `Run`.
        backend: where to play, with the same bits: `"auto"` (a GPU if it is expected to finish first), `"cpu"`,
            `"gpu"`, or an adapter's number or name.
        callback: called with every `Generation` once it has played, or several such functions. The training stops
            if one returns True. The results are then those of a config with that many generations. A callback with a method
            `close` is closed at the end, however the training ends.
        champions: give every generation its `champions`. The populations then stay in the host's memory, and the run is
            trained in memory.
        progress: draw a progress bar with tqdm. None does so in notebooks and terminals if tqdm is installed.

    Returns:
        the `Run`.

    Raises:
        ConfigError: the config or the seed is wrong.
        FileExistsError: `out` holds a run, and neither `resume` nor `force` was given.
        MemoryError: there is not enough memory for the populations.
        Error: a folder or `init` cannot be used, or the backend fails.
        KeyboardInterrupt: Ctrl-C. A run in a directory is saved first, and `resume` continues it.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"trials": 2, "generations": 50})
        >>> def enough(generation):
        ...     return generation.champion_g.min() == 1
        >>> run = flotilla.train(config, seed=7, callback=enough)
        >>> bool(run.metrics["champion_g"].shape[1] <= 51)
        True
    """
    check_config(config)
    called = _together(callback)
    if out is None and (resume or force):
        raise ValueError("resume and force apply to a run directory; pass out=")
    if champions and (out is not None or init is not None):
        raise ValueError("champions are given for training in memory from random policies; leave out out= and init=")
    if resume and force:
        raise ValueError("resume continues a run and force overwrites it: leave out one of the two")
    if seed is not None:
        config = config.replace(learning={"seed": seed})
    name = word("backend", backend)
    told, end = _with_bar(called, config, progress)
    temporary = init is not None and out is None
    folder = tempfile.mkdtemp(prefix="flotilla-") if temporary else "" if out is None else os.fspath(out)
    try:
        if out is None and init is None:
            outcome, played, times = _native.train(config._native, name, told, bool(champions))
            return Run(outcome, played, times, None)
        where = os.path.join(folder, "run") if temporary else folder
        absolute = os.path.abspath(where)
        start = "resume" if resume else "force" if force else "fresh"
        with tempfile.TemporaryDirectory(prefix="flotilla-") as aside:
            first = None if init is None else init_file(init, config, aside)
            _native.train_into(config._native, where, start, first, name, _command(), told)
        # A callback may change the working directory.
        run = Run.open(where if os.path.abspath(where) == absolute else absolute)
        if temporary:
            run._own(folder)
            temporary = False
        return run
    finally:
        if temporary:
            shutil.rmtree(folder, True)
        end()
        for each in called:
            if callable(getattr(each, "close", None)):
                each.close()  # type: ignore[attr-defined]


def _together(callback: Any) -> list[Callback]:
    """Returns one or several callbacks as a list."""
    called = [] if callback is None else [callback] if callable(callback) else callback
    if not isinstance(called, (list, tuple)) or not all(map(callable, called)):
        raise TypeError(f"callback is {type(callback).__name__}, allowed are functions of a generation, one or a list")
    return list(called)


def first_policies(init: Any) -> list[Floats]:
    """Returns initial policies as one array `[populations, policies, parameters]` per trial, or one for all."""
    trials = init if isinstance(init, (list, tuple)) and len(init) and np.ndim(init[0]) == 3 else [init]
    try:
        if np.ndim(init) == 0:
            raise TypeError
        return [floats("init", trial, "populations, policies, parameters") for trial in trials]
    except TypeError:
        kind = type(init).__name__
        raise TypeError(f"init is {kind}, allowed are a Run, a file of policies, or arrays [populations, policies, parameters]") from None


def init_file(init: Any, config: Config, aside: str) -> str:
    """Returns a file with initial policies. Arrays are written to a folder."""
    if isinstance(init, Run):
        return os.path.join(init.folder, "policies.safetensors")
    if isinstance(init, (str, os.PathLike)):
        return os.fspath(init)
    policies = first_policies(init)
    trials = int(config["learning.trials"])
    if len(policies) not in (1, trials):
        raise ValueError(f"init has policies of {len(policies)} trials, allowed are {trials}, or one array for all")
    populations = config._native.populations
    population = policies[0].shape[1]
    shape = (populations, population, config.parameters)
    for trial in policies:
        if trial.shape != shape or population < 2:
            allowed = f"[populations, policies, parameters] = [{populations}, 2 or more, {config.parameters}]"
            raise ValueError(f"init has the shape {list(trial.shape)}, allowed is {allowed}, the same for all trials")
    sizes = {"population": population, "trials": trials, "elites": 1, "team_elites": 0, "team_g_elites": 0}
    sized = config.replace(learning=sizes)
    path = os.path.join(aside, "policies.safetensors")
    _native.write_policies(sized._native, policies * (trials // len(policies)), path)
    return path
