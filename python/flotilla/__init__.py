"""flotilla trains cooperative teams by coevolution: thousands at a time, on any GPU, with the same bits on a CPU.

Example:
    >>> config = flotilla.Config.paper("generally_forward").replace(learning={"generations": 20})
    >>> run = flotilla.train(config, seed=7)
    >>> run.metrics["champion_g"].shape
    (5, 21)
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from flotilla import _native, loggers
from flotilla._coevolution import Coevolution, Played, Proposal
from flotilla._config import Config, Key
from flotilla._errors import ConfigError, Error, Problem
from flotilla._play import Collected, Rollout, Scores, Trace, collect, forward, replay, rollout, score, to_onnx
from flotilla._program import Comparison, compare, devices, paper, verify
from flotilla._run import Generation, Run, plot, train
from flotilla._show import Episode, Figure, Replay
from flotilla._sweep import Point, Sweep, sweep
from flotilla._vector import VectorEnv

if TYPE_CHECKING:
    from flotilla._parallel import TeamEnv
    from flotilla._single import SingleEnv

__version__: str = _native.__version__

__all__ = [
    "Coevolution",
    "Collected",
    "Comparison",
    "Config",
    "ConfigError",
    "Episode",
    "Error",
    "Figure",
    "Generation",
    "Key",
    "Played",
    "Point",
    "Problem",
    "Proposal",
    "Replay",
    "Rollout",
    "Run",
    "Scores",
    "Sweep",
    "Trace",
    "VectorEnv",
    "collect",
    "compare",
    "devices",
    "forward",
    "loggers",
    "paper",
    "parallel_env",
    "plot",
    "replay",
    "rollout",
    "score",
    "sweep",
    "team_env",
    "to_onnx",
    "train",
    "verify",
]


def parallel_env(
    config: Config,
    render_mode: str | None = None,
    reward: str = "G",
    jitter: float | None = None,
    poi_jitter: float | None = None,
) -> TeamEnv:
    """One team as a PettingZoo `ParallelEnv`: agents `leader_0`, `leader_1`, …

    Needs PettingZoo (`pip install flotilla-teams[pettingzoo]`). Observations are float32 `[inputs]`, actions float32
    `[2]` in -1..1, see `VectorEnv`. `state()` is float32 `[agents * 5 + pois]`: everyone's x, y, heading and speed, and which POIs have been
    observed. An episode takes `world.steps` steps, and is *truncated* then.

    Args:
        config: the world.
        render_mode: None or `"rgb_array"`.
        reward: see `VectorEnv`, as for the next two.
        jitter: largest offset of a start on each axis, in map units.
        poi_jitter: the same for POIs.

    Raises:
        ImportError: PettingZoo is not installed.
        ValueError: a word is not allowed.

    Example:
        >>> env = flotilla.parallel_env(flotilla.Config.paper())
        >>> observations, infos = env.reset(seed=1)
        >>> env.agents, observations["leader_0"].shape
        (['leader_0', 'leader_1', 'leader_2', 'leader_3'], (8,))
    """
    from flotilla._parallel import TeamEnv

    return TeamEnv(config, render_mode, reward, jitter, poi_jitter)


def team_env(config: Config, render_mode: str | None = None, reward: str = "G", **options: Any) -> SingleEnv:
    """One team as a `gymnasium.Env`, whose learner controls all leaders at once.

    Needs gymnasium (`pip install flotilla-teams[gymnasium]`). Observations are float32 `[leaders, inputs]`, actions
    float32 `[leaders, 2]` in -1..1, see `VectorEnv`. The reward is the mean over the leaders. The last step's info has `g`.

    Args:
        config: the world.
        render_mode: None or `"rgb_array"`.
        reward: see `VectorEnv`.
        options: `copy`, `horizon`, `time_input`, `jitter` and `poi_jitter` of `VectorEnv`.

    Raises:
        ImportError: gymnasium is not installed.
        ValueError: a word is not allowed.

    Example:
        >>> env = flotilla.team_env(flotilla.Config.paper(), jitter=1.0)
        >>> observation, info = env.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, reward
        ((4, 8), 0.0)
    """
    from flotilla._single import SingleEnv

    return SingleEnv(config, render_mode, reward, **options)


if hasattr(os, "register_at_fork"):
    # A forked process does not have its parent's threads and devices.
    os.register_at_fork(after_in_child=_native.forked)
