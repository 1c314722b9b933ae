"""Training and its results."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flotilla import _native
from flotilla._arrays import Floats, backend_name, whole
from flotilla._config import Config
from flotilla._show import Figure, Replay, plot

if TYPE_CHECKING:
    import pandas

Generation = _native.Generation
Callback = Callable[[Generation], Any]

METRICS = ("best_g", "mean_g", "champion_g")


class Run:
    """What a training came to. :func:`train` and :meth:`Run.open` make one.

    Attributes:
        config: what was trained; where a callback stopped it, of fewer generations.
        metrics: ``best_g``, ``mean_g`` and ``champion_g``, each float64 ``[trials, generations + 1]``, the random start
            first: the share of POIs observed, 0 to 1, by each generation's best and mean team, and by the team of every
            population's best policy.
        policies: one float32 ``[leaders, policies, parameters]`` a trial, or ``[1, policies, parameters]`` where leaders
            share a policy (``learning.sharing``); best policy first, so that team 0 of a rollout is the champion. These
            arrays and those of ``metrics`` are read-only: copy them to change them.
        digest: of all of these: the same as the program's for this config and seed.
        backend: what it was trained on, in words.
        unverified: True if its files were not compared with their digests.

    Example:
        >>> config = flotilla.Config.paper("chaotic").replace(learning={"generations": 3, "trials": 2})
        >>> run = flotilla.train(config, seed=7)
        >>> run.metrics["best_g"].shape, run.policies[0].shape
        ((2, 4), (4, 50, 112))
    """

    def __init__(self, outcome: _native.Outcome, played: _native.Played, times: list[float] | None, folder: str | None):
        config, metrics, policies, digest = outcome
        self.config = Config._of(config)
        self._metrics, self._policies = tuple(metrics), tuple(policies)
        self.digest: str = digest
        self._show_arrays()
        self.backend = played[1]
        self._played, self._times, self._folder = played, times, folder
        self._kept: tempfile.TemporaryDirectory[str] | None = None
        self.unverified = False

    def _show_arrays(self) -> None:
        """Sets the public attributes to read-only arrays. `save` uses the private ones, even if these are replaced."""
        for metric in self._metrics:
            metric.flags.writeable = False
        for policies in self._policies:
            policies.flags.writeable = False
        self.metrics: dict[str, NDArray[np.float64]] = dict(zip(METRICS, self._metrics))
        self.policies: list[Floats] = list(self._policies)

    @classmethod
    def open(cls, folder: str | os.PathLike[str], unverified: bool = False) -> Run:
        """Reads a run that is done, whoever trained it.

        Args:
            folder: what ``flotilla train``, a sweep or :func:`train` wrote.
            unverified: read files that differ from their digests in ``run.json``, too.

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
        run = cls(outcome, played, times, path)
        run.unverified = unverified
        return run

    @property
    def folder(self) -> str:
        """Where the run's files are; of a run that was trained in memory a temporary folder, which goes with it."""
        if self._folder is None:
            self._kept = tempfile.TemporaryDirectory(prefix="flotilla-")
            folder = os.path.join(self._kept.name, "run")
            self._write(folder, force=False)
            self._folder = folder
        return self._folder

    def save(self, folder: str | os.PathLike[str], force: bool = False) -> None:
        """Writes the run as ``flotilla train`` does, so that the program reads it, too.

        Args:
            folder: where to; it is made.
            force: write over a run that is there.

        Raises:
            FileExistsError: there is a run, and ``force`` was not given.
            Error: the files cannot be written.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> run.save("runs/saved")
            >>> sorted(os.listdir("runs/saved"))[-3:]
            ['metrics.csv', 'policies.safetensors', 'run.json']
        """
        self._write(os.fspath(folder), force)

    def _write(self, folder: str, force: bool) -> None:
        metrics, policies = list(self._metrics), list(self._policies)
        times = self._times or [0.0] * metrics[0].shape[-1]
        arguments = (self.config._native, metrics, policies, times, self._played, folder, force, _command())
        _native.save(*arguments)

    def to_pandas(self) -> pandas.DataFrame:
        """The metrics as ``metrics.csv`` has them: a row a trial and generation.

        Needs pandas (``pip install flotilla-teams[pandas]``).

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> list(run.to_pandas().columns)
            ['trial', 'generation', 'best_g', 'mean_g', 'champion_g']
        """
        import pandas

        trials, generations = self.metrics["best_g"].shape
        trial, generation = np.indices((trials, generations))
        columns = {"trial": trial.T.ravel(), "generation": generation.T.ravel()}
        return pandas.DataFrame({**columns, **{name: self.metrics[name].T.ravel() for name in METRICS}})

    def replay(
        self, trial: int = 0, generation: int | None = None, compare: int | None = None, backend: str | int = "auto"
    ) -> Replay:
        """The episode of the best team of a trial and generation, as it was scored.

        Args:
            trial: from 0.
            generation: None is the last.
            compare: another generation, side by side.
            backend: as of :func:`train`.

        Raises:
            ValueError: there is no such trial or generation.
            Error: the run was made with another version of the program, or the backend fails.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 5}))
            >>> [episode.generation for episode in run.replay(compare=0).episodes]
            [0, 5]
        """
        last = int(self.config["learning.generations"])
        shown = [generation if generation is not None else last]
        if compare is not None:
            shown.insert(0, compare)
        generations = [whole("generation", shown_one, 0, 2**63 - 1) for shown_one in shown]
        number = whole("trial", trial, 0, 2**63 - 1)
        return Replay(_native.replay(self.folder, number, generations, self.unverified, backend_name(backend)))

    def plot(self) -> Figure:
        """The learning curves: best team, champion and mean team, mean and standard error over trials.

        Example:
            >>> run = flotilla.train(flotilla.Config.paper().replace(learning={"generations": 2}))
            >>> run.plot()
            <flotilla.Figure: .save(path) writes it as .svg, .pdf or .png>
        """
        return plot([self])

    def __getstate__(self) -> dict[str, Any]:
        # A temporary folder belongs to this process. A copy of the run makes its own.
        folder = self._folder if self._kept is None else None
        return {**self.__dict__, "_kept": None, "_folder": folder, "config": self.config}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._show_arrays()

    def __repr__(self) -> str:
        best = self.metrics["best_g"][:, -1]
        where = f", in {self._folder}" if self._folder is not None and self._kept is None else ""
        where += ", unverified" if self.unverified else ""
        last = self.metrics["best_g"].shape[1] - 1
        return (
            f"<flotilla.Run: {len(best)} trials, {last} generations, best G {best.mean():.3f} "
            f"({best.min():.3f} to {best.max():.3f}){where}, digest {self.digest[:12]}…>"
        )


def _command() -> str:
    """Returns the command that started this process as a shell reads it, for a run's record."""
    return shlex.join([os.path.basename(sys.executable or "python"), *sys.argv])[:8000]


def _shown_by_default() -> bool:
    shell = sys.modules.get("IPython")
    if shell is not None and shell.get_ipython() is not None:
        return True
    return sys.stderr is not None and sys.stderr.isatty()


def _with_bar(callback: Callback | None, config: Config, progress: bool | None) -> tuple[Callback | None, Callable[[], None]]:
    """Returns the callback, extended by a progress bar if one is wanted, and a function that closes the bar."""
    if progress is False or (progress is None and not _shown_by_default()):
        return callback, lambda: None
    try:
        from tqdm.auto import tqdm
    except ImportError:
        if progress:
            raise ImportError("progress=True draws a bar by tqdm: pip install tqdm") from None
        return callback, lambda: None
    bar = tqdm(total=config["learning.generations"] + 1, unit="generation", leave=False)

    def moved(generation: Generation) -> Any:
        bar.update(generation.generation + 1 - bar.n)
        return callback(generation) if callback is not None else None

    return moved, bar.close


def train(
    config: Config,
    seed: int | None = None,
    out: str | os.PathLike[str] | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    init: Run | str | os.PathLike[str] | None = None,
    backend: str | int = "auto",
    callback: Callback | None = None,
    progress: bool | None = None,
) -> Run:
    """Trains the teams of a config.

    Args:
        config: what to train.
        seed: instead of the config's ``learning.seed``.
        out: a folder to keep the run in as it trains, as ``flotilla train CONFIG --out DIR`` does: whatever happens, it can be gone on
            with. None trains in memory; :meth:`Run.save` still writes it.
        resume: go on with the run in ``out``, or start it where there is none.
        force: write over the run in ``out``.
        init: what to start from in place of random policies: a :class:`Run`, or a ``policies.safetensors``; trial i
            starts from its trial i. It has as many leaders and parameters as the config; populations that take more policies
            are filled up at random. Needs ``out``, where generation 0 is kept.
        backend: what to play on, to the same bits: ``"auto"`` (a GPU where there is one), ``"cpu"``, ``"gpu"``, or an
            adapter's number or name.
        callback: told of every :class:`Generation` once it is played; stops the training by returning True. What comes out
            is to the bit what a config of so few generations comes to.
        progress: draw a bar by tqdm; None does so in notebooks and terminals, where tqdm is installed.

    Returns:
        the :class:`Run`.

    Raises:
        ConfigError: the config or the seed is wrong.
        FileExistsError: ``out`` holds a run, and neither ``resume`` nor ``force`` was given.
        MemoryError: there is not enough for the populations.
        Error: a folder or ``init`` cannot be used, or the backend fails.
        KeyboardInterrupt: Ctrl-C; a run in a folder is saved then, to be gone on with by ``resume``.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"trials": 2, "generations": 50})
        >>> def enough(generation):
        ...     return generation.champion_g.min() == 1
        >>> run = flotilla.train(config, seed=7, callback=enough)
        >>> bool(run.metrics["champion_g"].shape[1] <= 51)
        True
    """
    if not isinstance(config, Config):
        raise TypeError(f"config is {type(config).__name__}, allowed is flotilla.Config")
    if callback is not None and not callable(callback):
        raise TypeError(f"callback is {type(callback).__name__}, allowed is what can be called with a generation")
    if out is None and (resume or force):
        raise ValueError("resume and force are of a run in a folder, say which by out")
    if out is None and init is not None:
        raise ValueError("a run that starts from policies is kept in a folder, say which by out")
    if isinstance(init, Run):
        init = os.path.join(init.folder, "policies.safetensors")
    if resume and force:
        raise ValueError("resume goes on with a run and force writes over it, leave out one of the two")
    if seed is not None:
        config = config.replace(learning={"seed": seed})
    name = backend_name(backend)
    told, end = _with_bar(callback, config, progress)
    try:
        if out is None:
            outcome, played, times = _native.train(config._native, name, told)
            return Run(outcome, played, times, None)
        start = "resume" if resume else "force" if force else "fresh"
        folder = os.fspath(out)
        first = None if init is None else os.fspath(init)
        for note in _native.train_into(config._native, folder, start, first, name, _command(), told):
            warnings.warn(f"{folder}: {note}", RuntimeWarning, stacklevel=2)
        return Run.open(folder)
    finally:
        end()
