"""One team as a gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla._arrays import Floats
from flotilla._config import Config
from flotilla._vector import VectorEnv


class SingleEnv(gymnasium.Env[NDArray[Any], NDArray[Any]]):  # type: ignore[misc, unused-ignore]
    """See `flotilla.team_env`."""

    def __init__(self, config: Config, render_mode: str | None = None, reward: str = "G", **options: Any) -> None:
        options = {**options, "layout": "team", "autoreset": "disabled", "render_mode": render_mode}
        self._team = VectorEnv(config, 1, reward, **options)
        self.config, self.render_mode = config, render_mode
        self.metadata: dict[str, Any] = {name: self._team.metadata[name] for name in ("render_modes", "render_fps")}
        self.observation_space = self._team.single_observation_space
        self.action_space = self._team.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        return self._team.reset(seed=seed)[0][0], {}

    def step(self, action: ArrayLike) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        seen, rewards, terminated, truncated, _ = self._team.step(np.asarray(action)[None])
        infos = {"g": float(self._team._teams.g[0])} if terminated[0] or truncated[0] else {}
        return seen[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), infos

    def render(self) -> NDArray[np.uint8] | None:
        pictures = self._team.render()
        return None if pictures is None else pictures[0]
