"""Training by ask and tell: the caller decides what policies are worth."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import Floats, floats, word
from flotilla._config import Config, check_config
from flotilla._run import Generation, Run, first_policies, init_file


class Proposal(NamedTuple):
    """What a generation plays, see `Coevolution`."""

    policies: Floats
    """`[trials, leaders, policies + 1, parameters]`, or `[trials, 1, ...]` if leaders share a policy. The last is the
    champion of the previous generation. With `learning.hall_of_fame` past champions follow."""
    teams: NDArray[np.uint32]
    """The policy of each leader in each team, `[trials, teams, leaders]`. Teams with past champions are the last."""
    starts: Floats
    """Start positions of agents, leaders first, `[trials, episodes, agents, 2]`; if POIs move, their positions follow, and then
    headings if any are drawn."""


class Played(NamedTuple):
    """The scores of a generation's teams, as means over episodes, see `Coevolution`."""

    g: NDArray[np.float64]
    """G, `[trials, teams]`."""
    fitness: Floats
    """The config's fitness of each leader, `[trials, teams, leaders]`."""


# The parts of the native state. `Coevolution.state` also has the digests of the config and of the initial policies.
STATE = ("generation", "policies", "fitness", "pending", "rows", "own_fitness")


class Coevolution:
    """Training by ask and tell, with a fitness of your own for each leader of each team.

    With the config's own fitness, the result has the digest of `train`. With any other, the run says so: see
    `Run.own_fitness`. It can be pickled between generations.

    Args:
        config: what to train.
        seed: replaces the config's `learning.seed`.
        init: initial policies, see `train`; arrays only.
        backend: where to play, see `train`.

    Raises:
        ConfigError: the config or the seed is wrong.
        ValueError: `init` has another shape.
        MemoryError: there is not enough memory for the populations.

    Example:
        >>> config = flotilla.Config.paper().replace(learning={"trials": 2, "generations": 5})
        >>> coevolution = flotilla.Coevolution(config, seed=7)
        >>> while not coevolution.done:
        ...     played = coevolution.play()
        ...     _ = coevolution.tell(played.fitness)
        >>> coevolution.run.digest == flotilla.train(config, seed=7).digest
        True

        A reward of your own takes one line: a leader's fitness plus a share of its team's G.

        >>> coevolution = flotilla.Coevolution(config, seed=7)
        >>> for _ in range(3):
        ...     played = coevolution.play()
        ...     _ = coevolution.tell(played.fitness + 0.1 * played.g[..., None])
        >>> coevolution.generation, coevolution.best.shape
        (3, (2, 4, 112))
    """

    def __init__(
        self,
        config: Config,
        seed: int | None = None,
        *,
        init: ArrayLike | Sequence[ArrayLike] | None = None,
        backend: str | int = "auto",
    ) -> None:
        check_config(config)
        self.config = config if seed is None else config.replace(learning={"seed": seed})
        self._backend = word("backend", backend)
        self._native = _native.Coevolution(self.config._native)
        self._trials = int(self.config["learning.trials"])
        # In the format of `run.json`.
        self._started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        self._init: str | None = None
        if init is not None:
            self._native.start_from(first_policies(init))
            with tempfile.TemporaryDirectory(prefix="flotilla-") as aside:
                file = Path(init_file(init, self.config, aside))
                self._init = hashlib.sha256(file.read_bytes()).hexdigest()

    @property
    def generation(self) -> int:
        """The generation that plays next; 0 is the initial one."""
        return self._native.generation

    @property
    def own_fitness(self) -> bool:
        """Whether any fitness so far was not the config's."""
        return self._native.own_fitness

    @property
    def done(self) -> bool:
        """Whether all generations have a fitness."""
        return self._native.done

    def ask(self) -> Proposal:
        """Returns the generation's policies, teams and starts. Asking again returns the same.

        Example:
            >>> asked = flotilla.Coevolution(flotilla.Config.paper()).ask()
            >>> asked.policies.shape, asked.teams.shape, asked.starts.shape
            ((5, 4, 51, 112), (5, 50, 4), (5, 1, 12, 2))
        """
        return Proposal(*self._native.ask())

    def play(self) -> Played:
        """Plays the generation's teams, and returns their G and the config's fitness."""
        return Played(*self._native.play(self._backend))

    def tell(self, fitness: ArrayLike) -> list[Generation]:
        """Breeds the next generation.

        The generation is also played for its G, unless `play` did so. After the last generation its champions play.

        Args:
            fitness: what each leader of each team was worth, `[trials, teams, leaders]`.

        Returns:
            the generations that became complete: usually the one before, because champions play one generation later.

        Raises:
            ValueError: the fitness has another shape or is not finite, or all generations have one.
        """
        values = floats("fitness", fitness, "trials, teams, leaders")
        shape = (self._trials, self._native.teams, self.config.num_learners)
        if not self.done and values.shape != shape:
            raise ValueError(f"fitness has the shape {values.shape}, allowed is [trials, teams, leaders] = {shape}")
        return self._native.tell(values, self._backend)

    @property
    def best(self) -> Floats:
        """The champion of the last generation with a fitness, `[trials, leaders, parameters]`, or `[trials, 1,
        parameters]` if leaders share a policy.

        Raises:
            ValueError: no generation has a fitness yet.
        """
        if self.generation == 0:
            raise ValueError("no generation has a fitness yet, so there is no best policy")
        return self._native.best()

    @property
    def state(self) -> dict[str, Any]:
        """The state between two generations, as NumPy arrays and numbers. Setting it continues from there.

        Raises:
            ValueError: a state that is set is of another config.
        """
        return {**dict(zip(STATE, self._native.state())), "config": self._config_digest(), "init": self._init}

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        if state["config"] != self._config_digest():
            raise ValueError("the state is of another config")
        self._native.restore(tuple(state[name] for name in STATE))
        self._init = state["init"]

    def _config_digest(self) -> str:
        return hashlib.sha256(self.config.to_toml().encode()).hexdigest()

    @property
    def run(self) -> Run:
        """The results, once all generations have a fitness.

        Raises:
            ValueError: generations are left.
        """
        if not self.done:
            raise ValueError(f"generation {self.generation} has no fitness yet; a run has results once all generations have one")
        threads = _native.threads()
        played = ("cpu", "ask and tell", None, None, threads, self._started, self._init, self.own_fitness)
        return Run(self._native.finish(), played, None, None)

    def __getstate__(self) -> dict[str, Any]:
        return {"config": self.config, "backend": self._backend, "state": self.state, "started": self._started}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        Coevolution.__init__(self, saved["config"], backend=saved["backend"])
        self.state, self._started = saved["state"], saved["started"]

    def __repr__(self) -> str:
        last = self.config["learning.generations"]
        return f"<flotilla.Coevolution: generation {min(self.generation, last)} of {last}{', done' if self.done else ''}>"
