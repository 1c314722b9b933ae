"""Many teams at once, stepped by actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import Floats, floats, whole
from flotilla._config import Config
from flotilla._play import _near

if TYPE_CHECKING:
    from gymnasium import spaces

Reward = str
Autoreset = Literal["next_step", "same_step", "disabled"]
RENDER_MODES = ("rgb_array",)
MAX_TEAMS = 1 << 20
# Pixels of a picture's longer side.
PIXELS = 480


class Teams:
    """Teams of one world, with starts that are drawn where the config says so: what both environments stand on."""

    def __init__(self, config: Config, teams: int, reward: str, render_mode: str | None) -> None:
        if not isinstance(config, Config):
            raise TypeError(f"config is {type(config).__name__}, allowed is flotilla.Config")
        if reward not in _native.FITNESSES:
            raise ValueError(f"reward {reward!r}, allowed are {', '.join(_native.FITNESSES)}")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode {render_mode!r}, allowed are None and 'rgb_array'")
        self.config, self.reward, self.render_mode = config, reward, render_mode
        self.count = whole("the number of teams", teams, 1, MAX_TEAMS)
        # What is recorded hangs on what is to be scored by.
        scored = config.replace(learning={"fitness": reward})
        self.stepper = _native.Stepper(scored._native, self.count, reward != "G")
        self.leaders, self.length = config.leaders, int(config["world.steps"])
        self.agents = len(config["world.leaders"]) + len(config["world.followers"])
        self.jitter = float(config["learning.start_jitter"])
        self.seed, self.drawn = int(config["learning.seed"]), 0
        # Where these lie does not change.
        self.inputs, self.steps, self.observed = self.stepper.inputs, self.stepper.steps, self.stepper.observed
        self.rewards = np.zeros((self.count, self.leaders), np.float32)

    def reset(self, seed: int | None = None, chosen: NDArray[np.bool_] | None = None) -> None:
        """Puts all teams, or the chosen ones, at a start: the config's, or each at one drawn for it."""
        if seed is not None:
            self.seed, self.drawn = whole("seed", seed, 0, 2**63 - 1), 0
        starts = None
        if self.jitter > 0:
            starts = _native.starts(self.config._native, self.seed, self.jitter, self.drawn, self.count)
            self.drawn += self.count
        self.stepper.reset(chosen, starts)

    def step(self, actions: Floats, rested: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Plays a step, and rewards it; which teams but those that have rested have played their last one."""
        had = None if self.reward == "G" else self.steps >= self.length
        self.stepper.step(actions, self.rewards if had is None else None)
        over: NDArray[np.bool_] = self.steps >= self.length
        if rested is not None:
            over &= ~rested
        if had is not None and over.any():
            self.stepper.fitness(self.reward, self.rewards)
            # Who was over before has had its reward.
            self.rewards[~over | had] = 0
        elif had is not None:
            self.rewards.fill(0)
        return over

    def state(self) -> Floats:
        """Everything that is to be known of each team, ``[teams, agents * 5 + pois]``."""
        positions, headings, speeds = self.stepper.states()
        parts = (positions, headings, speeds[..., None])
        moving = np.concatenate(parts, axis=-1).reshape(self.count, -1)
        return np.concatenate((moving, self.observed.astype(np.float32)), axis=-1)


class VectorEnv:
    """Many teams of one world, stepped together: leaders along an axis, float32 arrays that are reused between steps.

    Every episode takes ``world.steps`` steps; then it is *truncated*. Where the config's ``learning.start_jitter`` is above
    0, every team of every episode starts from a place of its own, drawn from the seed of :meth:`reset`; else all start
    where the config says. POIs stay where the config has them. ``close`` gives nothing back, for there is nothing to give.

    Leaders sense the density of POIs, then of agents, in four quadrants around their heading: back right, front right, front
    left, back left. They are told a turn, in parts of a half turn to the left, and a speed, from -1 for standing still to 1
    for the highest. The spaces need gymnasium.

    Args:
        config: the world. Of its learning only who leads and the jitter of starts counts here.
        num_envs: how many teams.
        reward: ``"G"`` gives the newly observed share of POIs at each step, the same to all leaders, which adds up to G;
            ``"D"``, ``"Df"``, ``"D++"`` and ``"Dt"`` give each leader that fitness at the last step, and 0 before.
        autoreset: what becomes of a team whose episode is over, as gymnasium has it (``metadata["autoreset_mode"]``):
            ``"next_step"`` starts it at the step after the last, whose action counts for nothing; ``"same_step"`` starts it
            at once, with what it saw last in ``infos["final_obs"]``; ``"disabled"`` leaves it until ``reset`` with
            ``options={"reset_mask": mask}``.
        copy: give every step's observations as arrays of their own.
        render_mode: None or ``"rgb_array"``.

    Raises:
        ValueError: a number or word is not allowed.
        MemoryError: there is not enough for so many teams.

    Example:
        >>> env = flotilla.VectorEnv(flotilla.Config.paper(), num_envs=64)
        >>> observations, infos = env.reset(seed=1)
        >>> ahead = np.tile(np.float32([0, 1]), (64, 4, 1))
        >>> observations, rewards, terminated, truncated, infos = env.step(ahead)
        >>> observations.shape, rewards.shape, bool(truncated.any())
        ((64, 4, 8), (64, 4), False)
    """

    def __init__(
        self,
        config: Config,
        num_envs: int,
        reward: Reward = "G",
        *,
        autoreset: Autoreset = "next_step",
        copy: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if autoreset not in ("next_step", "same_step", "disabled"):
            raise ValueError(f"autoreset {autoreset!r}, allowed are 'next_step', 'same_step' and 'disabled'")
        self._teams = Teams(config, num_envs, reward, render_mode)
        self.config, self.num_envs, self.render_mode = config, self._teams.count, render_mode
        self.leaders, self.autoreset, self.copy = self._teams.leaders, autoreset, bool(copy)
        self.metadata: dict[str, Any] = {
            "render_modes": list(RENDER_MODES),
            "autoreset_mode": _autoreset_mode(autoreset),
            "render_fps": max(round(1 / config["world.dt"]), 1),
        }
        self.closed = False
        self._over = np.zeros(self.num_envs, np.bool_)
        self._any_over = False

    @property
    def single_observation_space(self) -> spaces.Box:
        """What is seen of one team, ``Box [leaders, 8]``."""
        from gymnasium import spaces

        return spaces.Box(0, np.inf, (self.leaders, _native.INPUTS), np.float32)

    @property
    def single_action_space(self) -> spaces.Box:
        """What one team is told, ``Box [leaders, 2]``."""
        from gymnasium import spaces

        return spaces.Box(-1, 1, (self.leaders, _native.OUTPUTS), np.float32)

    @property
    def observation_space(self) -> spaces.Box:
        """What is seen of all teams, ``Box [num_envs, leaders, 8]``."""
        from gymnasium import spaces

        return spaces.Box(0, np.inf, (self.num_envs, self.leaders, _native.INPUTS), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        """What all teams are told, ``Box [num_envs, leaders, 2]``."""
        from gymnasium import spaces

        return spaces.Box(-1, 1, (self.num_envs, self.leaders, _native.OUTPUTS), np.float32)

    @property
    def unwrapped(self) -> VectorEnv:
        """Itself."""
        return self

    def _observations(self) -> Floats:
        return self._teams.inputs.copy() if self.copy else self._teams.inputs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Starts episodes anew.

        Args:
            seed: of starts; None goes on drawing from the seed before, at first the config's.
            options: ``{"reset_mask": mask}`` starts the teams anew that a bool ``[num_envs]`` marks, and leaves the others.

        Returns:
            observations, float32 ``[num_envs, leaders, 8]`` (not to be written to), and an empty dictionary.

        Example:
            >>> env = flotilla.VectorEnv(flotilla.Config.paper(), 2)
            >>> env.reset(seed=0)[0].shape
            (2, 4, 8)
        """
        chosen = None
        if options and options.get("reset_mask") is not None:
            chosen = np.array(options["reset_mask"])
            if chosen.dtype != np.bool_ or chosen.shape != (self.num_envs,):
                raise ValueError(f"reset_mask is {chosen.dtype} {chosen.shape}, allowed is bool ({self.num_envs},)")
        self._teams.reset(seed, chosen)
        self._over = np.zeros_like(self._over) if chosen is None else self._over & ~chosen
        self._any_over = bool(self._over.any())
        return self._observations(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Plays one step of every team.

        Args:
            actions: ``[num_envs, leaders, 2]``; numbers beyond -1..1 are taken as -1 or 1. Not copied where they are
                C-contiguous float32.

        Returns:
            observations float32 ``[num_envs, leaders, 8]``, rewards float32 ``[num_envs, leaders]``, terminated and truncated
            bool ``[num_envs]``, and infos. Observations and rewards are the same arrays at every step, with other values,
            unless ``copy`` was asked for.

        Raises:
            ValueError: the actions have another shape, or are not all finite; no team has moved then.

        Example:
            >>> env = flotilla.VectorEnv(flotilla.Config.paper(), 2, reward="Df", autoreset="same_step")
            >>> _ = env.reset()
            >>> for _ in range(25):
            ...     _, rewards, _, truncated, infos = env.step(np.zeros((2, 4, 2)))
            >>> truncated, rewards.shape, infos["final_obs"].shape
            (array([ True,  True]), (2, 4), (2, 4, 8))
        """
        teams, infos = self._teams, dict[str, Any]()
        array = floats("actions", actions, 3)
        if self.autoreset == "next_step" and self._any_over:
            # Teams that are over stay where they are at this step.
            fresh = self._over
            over = teams.step(array, fresh)
            teams.reset(None, fresh)
        else:
            over = teams.step(array)
        self._any_over = bool(over.any())
        if self.autoreset == "same_step" and self._any_over:
            infos["final_obs"], infos["_final_obs"] = teams.inputs.copy(), over
            teams.reset(None, over)
        self._over = over.copy()
        rewards = teams.rewards.copy() if self.copy else teams.rewards
        return self._observations(), rewards, np.zeros(self.num_envs, np.bool_), over, infos

    def states(self) -> tuple[Floats, Floats, Floats]:
        """Where everyone is: positions and headings ``[num_envs, agents, 2]``, speeds ``[num_envs, agents]``, leaders first.

        Example:
            >>> flotilla.VectorEnv(flotilla.Config.paper(), 2).states()[0].shape
            (2, 12, 2)
        """
        return self._teams.stepper.states()

    def near(self) -> NDArray[np.bool_]:
        """Which agents were near which POI after the last step, ``[num_envs, pois, agents]``.

        Example:
            >>> flotilla.VectorEnv(flotilla.Config.paper(), 2).near().shape
            (2, 4, 12)
        """
        return _near(self._teams.stepper.near, self._teams.agents)

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which POIs have been observed since the start, ``[num_envs, pois]``."""
        return self._teams.observed

    def render(self) -> NDArray[np.uint8] | None:
        """The first team as a picture, uint8 ``[height, width, 3]``, where the render mode is ``"rgb_array"``.

        Example:
            >>> flotilla.VectorEnv(flotilla.Config.paper(), 2, render_mode="rgb_array").render().shape
            (480, 480, 3)
        """
        return self._teams.stepper.render(0, PIXELS) if self.render_mode == "rgb_array" else None

    def close(self, **_: Any) -> None:
        """Ends it."""
        self.closed = True

    def __repr__(self) -> str:
        return f"<flotilla.VectorEnv: {self.num_envs} teams of {self.leaders} leaders, {self.autoreset} reset>"


def _autoreset_mode(mode: str) -> Any:
    """As gymnasium calls it, where that is installed; else its word."""
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:
        return {"next_step": "NextStep", "same_step": "SameStep", "disabled": "Disabled"}[mode]
    return getattr(AutoresetMode, mode.upper())
