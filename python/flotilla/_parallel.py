"""One team as a PettingZoo environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from flotilla import _native
from flotilla._arrays import Floats
from flotilla._config import Config
from flotilla._vector import PIXELS, RENDER_MODES, TeamBatch

Array = NDArray[Any]
Space = spaces.Space[Array]


class TeamEnv(ParallelEnv[str, Array, Array]):  # type: ignore[misc, unused-ignore]
    """See `flotilla.parallel_env`."""

    def __init__(
        self,
        config: Config,
        render_mode: str | None = None,
        reward: str = "G",
        jitter: float | None = None,
        poi_jitter: float | None = None,
    ) -> None:
        self._teams = TeamBatch(config, 1, reward, render_mode, jitter, poi_jitter)
        self.config, self.render_mode = config, render_mode
        self.metadata: dict[str, Any] = {
            "name": "flotilla_v0",
            "render_modes": list(RENDER_MODES),
            "render_fps": max(round(1 / config["world.dt"]), 1),
            "is_parallelizable": True,
        }
        self.possible_agents = [f"leader_{leader}" for leader in range(self._teams.leaders)]
        self.agents: list[str] = []
        sensed = spaces.Box(config._native.least_input, np.inf, (config.num_inputs,), np.float32)
        wanted = spaces.Box(-1, 1, (_native.OUTPUTS,), np.float32)
        self.observation_spaces = {agent: sensed for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Box(-1, 1, wanted.shape, np.float32) for agent in self.possible_agents}
        size = self._teams.agents * 5 + self._teams.pois
        self.state_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def observation_space(self, agent: str) -> Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        return self.action_spaces[agent]

    def _observations(self) -> dict[str, Array]:
        return dict(zip(self.agents, self._teams.inputs()[0]))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        self._teams.reset(seed)
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Array]
    ) -> tuple[
        dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        if not self.agents and self._teams.started:
            return {}, {}, {}, {}, {}
        wanted = np.empty((1, self._teams.leaders, _native.OUTPUTS), np.float32)
        for leader, agent in enumerate(self.agents):
            if agent not in actions:
                raise ValueError(f"there is no action for {agent}")
            action = np.asarray(actions[agent])
            if action.shape != (_native.OUTPUTS,) or action.dtype.kind not in "fiu":
                raise ValueError(f"the action of {agent} is {action.dtype} {action.shape}, allowed is float32 (2,)")
            wanted[0, leader] = action
        over = bool(self._teams.step(wanted)[0])
        agents, observations = self.agents, self._observations()
        rewards = {agent: float(reward) for agent, reward in zip(agents, self._teams.rewards[0])}
        if over:
            self.agents = []
        return (
            observations,
            rewards,
            {agent: False for agent in agents},
            {agent: over for agent in agents},
            {agent: {} for agent in agents},
        )

    def state(self) -> Floats:
        state: Floats = self._teams.state()[0]
        return state

    def render(self) -> NDArray[np.uint8] | None:
        return self._teams.stepper.render(0, PIXELS) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self.agents = []
