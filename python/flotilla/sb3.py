"""An adapter for Stable-Baselines3 (`pip install flotilla-teams[sb3]`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from flotilla._config import Config
from flotilla._vector import VectorEnv


class LeaderVecEnv(VecEnv):  # type: ignore[misc, unused-ignore]
    """Every leader of many teams as an environment of Stable-Baselines3, so that all leaders share one policy.

    Args:
        config: the world.
        num_teams: number of teams; there are `num_teams * leaders` environments, teams one after the other.
        options: further arguments of `flotilla.VectorEnv`, such as `reward` and `time_input`. With
            `layout="team"` an environment is a whole team, whose actions and observations are those of all leaders.

    Example:
        >>> from stable_baselines3 import PPO
        >>> env = LeaderVecEnv(flotilla.Config.paper(), 16, reward="Df")
        >>> model = PPO("MlpPolicy", env, n_steps=25, batch_size=400, device="cpu").learn(3200)
        >>> model.predict(env.reset())[0].shape
        (64, 2)
    """

    def __init__(self, config: Config, num_teams: int, **options: Any) -> None:
        self.teams = VectorEnv(config, num_teams, **{"layout": "flat", **options, "autoreset": "same_step"})
        self.render_mode = self.teams.render_mode
        self._actions: Any = None
        spaces = self.teams.single_observation_space, self.teams.single_action_space
        super().__init__(self.teams.num_envs, *spaces)

    def reset(self) -> NDArray[np.float32]:
        seed = self._seeds[0]
        self._reset_seeds()
        self._reset_options()
        return self.teams.reset(seed=seed)[0]

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        seen, rewards, terminated, truncated, infos = self.teams.step(self._actions)
        done = terminated | truncated
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            last = infos["final_info"]
            each[index] = {
                "terminal_observation": infos["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "g": float(last["g"][index]),
            }
        return seen, rewards, done, each

    def close(self) -> None:
        self.teams.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        # One per team, because the pictures of its leaders are the same.
        return (self.teams.render() or ())[:: self.num_envs // self.teams.num_teams]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.teams, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("teams share one world, so no attribute can be set for some of them")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise NotImplementedError("teams step together; call methods of .teams")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
