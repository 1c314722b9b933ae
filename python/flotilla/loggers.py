"""Callbacks for `flotilla.train` that log every generation elsewhere, each some ten lines to start from."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from flotilla._config import Config
from flotilla._run import Generation

class Logger:
    """A callback that logs elsewhere. `flotilla.train` closes it at the end, also if it stops early or fails."""

    def __init__(self, log: Callable[[Generation], Any], close: Callable[[], Any]) -> None:
        self._log, self._close, self.closed = log, close, False

    def __call__(self, generation: Generation) -> None:
        self._log(generation)

    def close(self) -> None:
        """Ends the log. Closing it again does nothing."""
        if not self.closed:
            self.closed = True
            self._close()


def scalars(generation: Generation) -> dict[str, float]:
    """A generation's numbers, means over trials.

    Example:
        >>> told = []
        >>> config = flotilla.Config.paper().replace(learning={"generations": 1})
        >>> run = flotilla.train(config, callback=lambda generation: told.append(flotilla.loggers.scalars(generation)))
        >>> sorted(told[0])
        ['best_g', 'champion_g', 'mean_g']
    """
    numbers = {
        "best_g": float(generation.best_g.mean()),
        "mean_g": float(generation.mean_g.mean()),
        "champion_g": float(generation.champion_g.mean()),
    }
    if generation.test_g is not None:
        numbers["test_g"] = float(generation.test_g.mean())
    return numbers


def tensorboard(folder: str | os.PathLike[str]) -> Logger:
    """Event files in a directory, written with tensorboardX (`pip install flotilla-teams[tensorboard]`)."""
    from tensorboardX import SummaryWriter

    # The writer has its own thread. `flush` does not wait for queued rows, but `close` does.
    writer = SummaryWriter(os.fspath(folder), flush_secs=1)

    def log(generation: Generation) -> None:
        for name, value in scalars(generation).items():
            writer.add_scalar(name, value, generation.generation)

    return Logger(log, writer.close)


def wandb(config: Config, **options: Any) -> Logger:
    """A run of Weights & Biases; `options` are those of `wandb.init`, such as `mode="offline"`."""
    import wandb as client

    run = client.init(config=config.to_dict(), **options)

    def log(generation: Generation) -> None:
        run.log(scalars(generation), step=generation.generation)

    return Logger(log, run.finish)


def mlflow(config: Config, **options: Any) -> Logger:
    """A run of MLflow at `mlflow.set_tracking_uri`; `options` are those of `mlflow.start_run`."""
    import mlflow as client

    run = client.start_run(**options)
    client.log_dict(config.to_dict(), "config.json")

    def log(generation: Generation) -> None:
        client.log_metrics(scalars(generation), step=generation.generation, run_id=run.info.run_id)

    return Logger(log, client.end_run)
