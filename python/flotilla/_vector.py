"""Environments of many teams, stepped with actions."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import ArraySupply, Floats, aligned, floats, whole
from flotilla._config import Config, check_config, jitters
from flotilla._errors import Error

if TYPE_CHECKING:
    from gymnasium import spaces

    Base = object
else:
    try:
        from gymnasium.vector import VectorEnv as Base
    except ImportError:
        Base = object

Reward = str
Autoreset = Literal["next_step", "same_step", "disabled"]
Layout = Literal["leaders", "team", "flat"]
Horizon = Literal["truncated", "terminated"]
RENDER_MODES = ("rgb_array",)
MAX_TEAMS = 1 << 20
# Pixels of a picture's longer side.
PIXELS = 480


class TeamBatch:
    """Teams of one world that step together. Both kinds of environments are views of it.

    Observations are copied out of Rust's memory while the interpreter's lock is held, so that no thread ever reads an
    array that Rust is writing.
    """

    def __init__(
        self,
        config: Config,
        teams: int,
        reward: str,
        render_mode: str | None,
        jitter: float | None = None,
        poi_jitter: float | None = None,
    ) -> None:
        check_config(config)
        if reward not in _native.FITNESSES:
            raise ValueError(f"reward {reward!r}, allowed are {', '.join(_native.FITNESSES)}")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode {render_mode!r}, allowed are None and 'rgb_array'")
        self.config, self.reward, self.render_mode = config, reward, render_mode
        self.count = whole("the number of teams", teams, 1, MAX_TEAMS)
        # Otherwise rewards need a record of the episode, and are given at its end.
        self.by_step = reward == "G" and not config._native.needs_paths
        self.stepper = self._make_stepper()
        self.leaders, (self.agents, self.pois, self.length) = config.num_learners, config._native.sizes
        self.jitters = jitters(config, jitter, poi_jitter)
        self.seed: int | None = None
        self.drawn = 0
        self.started = False
        self.rewards = np.zeros((self.count, self.leaders), np.float32)
        self.worth = np.array(config._native.worth)
        self.new_inputs = ArraySupply((self.count, self.leaders, config.num_inputs))

    def _make_stepper(self) -> _native.Stepper:
        # The fitness decides what the stepper records.
        scored = self.config._native.with_fitness(self.reward)
        return _native.Stepper(scored, self.count, not self.by_step)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "stepper": self.stepper.save()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.stepper = self._make_stepper()
        self.stepper.restore(state["stepper"])

    @property
    def steps(self) -> NDArray[np.uint32]:
        """Steps that each team has played in its episode, `[teams]`."""
        return self.stepper.steps

    @property
    def observed(self) -> NDArray[np.bool_]:
        """POIs that each team has observed in its episode, `[teams, pois]`."""
        return self.stepper.observed

    @property
    def g(self) -> NDArray[np.float64]:
        """G of each team's episode so far, `[teams]`."""
        if self.config._native.needs_paths:
            scores = np.empty((self.count, self.leaders), np.float32)
            self.stepper.fitness("G", scores)
            return scores[:, 0].astype(np.float64)
        g: NDArray[np.float64] = self.observed @ self.worth / self.worth.sum()
        return g

    def inputs(self, out: Floats | None = None) -> Floats:
        """Returns what every leader senses, `[teams, leaders, inputs]`, in a new array or in `out`."""
        if out is None:
            out = self.new_inputs()
        self.stepper.read_inputs(out)
        return out

    def reset(self, seed: int | None = None, chosen: NDArray[np.bool_] | None = None) -> None:
        """Starts episodes of all teams, or of the chosen ones."""
        if seed is not None:
            self.seed, self.drawn = whole("seed", seed, 0, 2**63 - 1), 0
        starts = None
        if max(self.jitters) > 0 or self.config._native.draws_starts:
            if self.seed is None:
                self.seed = secrets.randbits(63)
            starts = _native.starts(self.config._native, self.seed, *self.jitters, self.drawn, self.count)
            self.drawn += self.count
        self.stepper.reset(chosen, starts)
        self.started = True

    def step(self, actions: Floats, idle: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Plays a step and sets `rewards`. Returns which teams have just finished, except the `idle` ones."""
        if not self.started:
            raise Error("step was called before the first reset; call reset() first")
        finished_before = None if self.by_step else self.steps >= self.length
        self.stepper.step(actions, self.rewards if finished_before is None else None)
        finished: NDArray[np.bool_] = self.steps >= self.length
        if idle is not None:
            finished &= ~idle
        if finished_before is not None and finished.any():
            self.stepper.fitness(self.reward, self.rewards)
            # A team that had finished before this step has already received its reward.
            self.rewards[~finished | finished_before] = 0
        elif finished_before is not None:
            self.rewards.fill(0)
        return finished

    def state(self) -> Floats:
        """Returns the full state of each team, `[teams, agents * 5 + pois]`."""
        positions, headings, speeds = self.stepper.states()
        parts = (positions, headings, speeds[..., None])
        moving = np.concatenate(parts, axis=-1).reshape(self.count, -1)
        return np.concatenate((moving, self.observed.astype(np.float32)), axis=-1)


class VectorEnv(Base):
    """Many teams of one world that step together: a `gymnasium.vector.VectorEnv` if gymnasium is installed.

    An episode takes `world.steps` steps. With a jitter, every team of every episode starts from a place of its own,
    drawn from the seed of `reset`; otherwise all teams start where the config says. With a POI jitter, the same
    holds for the POIs. An environment can be pickled and deep-copied: the copy continues with the same bits.

    A leader's observation is the density of POIs, then of agents, in four quadrants around its heading: back right,
    front right, front left, back left. Its action is a turn, from -1 (half a turn to the right) to 1 (half a turn to the
    left), and a speed, from -1 (standing still) to 1 (the largest speed).

    A config with `[[agents]]` says what each class senses, channel by channel. Observations have `config.num_inputs` numbers,
    and those of classes with fewer inputs end with zeros. The action of an agent with free motion is its velocity along x
    and y. The first action of an agent that chooses another to move to is its choice: from -1, the first agent of the class,
    to 1, nobody, in equal steps.

    Args:
        config: the world. Of its learning section, only the paradigm and the jitter of starts matter here.
        num_envs: number of teams.
        reward: `"G"` gives what the newly observed POIs add to G at each step, the same to all leaders;
            `"D"`, `"Df"`, `"D++"` and `"Dt"` give each leader that fitness at the last step, and 0 before. So does `"G"` if
            POIs count by distance or by when, or the start counts.
        layout: shape of rewards and environments. `"leaders"`: one environment per team and one reward per leader,
            `[num_envs, leaders]`. `"team"`: one environment per team and one reward, `[num_envs]`, the mean over its
            leaders, as gymnasium's wrappers expect. `"flat"`: one environment per leader, `num_envs * leaders` in all,
            teams one after the other, as trainers with shared parameters expect.
        autoreset: what happens to a finished team, in gymnasium's terms (`metadata["autoreset_mode"]`):
            `"next_step"` resets it at the next step and ignores that step's action; `"same_step"` resets it at
            once and returns its last observation in `infos["final_obs"]`; `"disabled"` leaves it until `reset` with
            `options={"reset_mask": mask}`.
        copy: return new arrays at every step. If False, observations and rewards are the same arrays at every step,
            with new values: faster, but wrong in a replay buffer that keeps references.
        horizon: how the end of an episode is reported, `"truncated"` or `"terminated"`.
        time_input: append the played share of the episode to each leader's observation, which then has one more number.
        render_mode: None or `"rgb_array"`.
        jitter: largest offset of a start on each axis, in map units; None takes the config's `learning.start_jitter`.
        poi_jitter: the same for POIs; None takes the config's `learning.poi_jitter`.

    Raises:
        ValueError: a number or word is not allowed.
        MemoryError: there is not enough memory for that many teams.

    Example:
        >>> env = flotilla.VectorEnv(flotilla.Config.paper(), num_envs=64)
        >>> observations, infos = env.reset(seed=1)
        >>> ahead = np.tile(np.float32([0, 1]), (64, 4, 1))
        >>> observations, rewards, terminated, truncated, infos = env.step(ahead)
        >>> observations.shape, rewards.shape, bool(truncated.any())
        ((64, 4, 8), (64, 4), False)
    """

    observation_space: spaces.Box
    action_space: spaces.Box
    single_observation_space: spaces.Box
    single_action_space: spaces.Box

    def __init__(
        self,
        config: Config,
        num_envs: int,
        reward: Reward = "G",
        *,
        layout: Layout = "leaders",
        autoreset: Autoreset = "next_step",
        copy: bool = True,
        horizon: Horizon = "truncated",
        time_input: bool = False,
        render_mode: str | None = None,
        jitter: float | None = None,
        poi_jitter: float | None = None,
    ) -> None:
        one_of("layout", layout, ("leaders", "team", "flat"))
        one_of("autoreset", autoreset, ("next_step", "same_step", "disabled"))
        one_of("horizon", horizon, ("truncated", "terminated"))
        self._teams = TeamBatch(config, num_envs, reward, render_mode, jitter, poi_jitter)
        self.config, self.render_mode = config, render_mode
        self.num_learners, self.layout, self.autoreset = self._teams.leaders, layout, autoreset
        self.copy, self.horizon, self.time_input = bool(copy), horizon, bool(time_input)
        self.num_teams = self._teams.count
        self.num_envs = self.num_teams * (self.num_learners if layout == "flat" else 1)
        self.metadata: dict[str, Any] = {
            "render_modes": list(RENDER_MODES),
            "autoreset_mode": _autoreset_mode(autoreset),
            "render_fps": max(round(1 / config["world.dt"]), 1),
        }
        self.closed = False
        self._finished = np.zeros(self._teams.count, np.bool_)
        self._any_finished = False
        inputs = config.num_inputs + self.time_input
        self._single = (inputs,) if layout == "flat" else (self.num_learners, inputs)
        self._make_arrays()
        self._make_spaces()

    def _make_arrays(self) -> None:
        """Makes the arrays that are reused at every step, if `copy` is False."""
        teams, leaders = self._teams.count, self.num_learners
        self._inputs = aligned((teams, leaders, self.config.num_inputs))
        self._observations = aligned((teams, leaders, self._single[-1])) if self.time_input else self._inputs
        self._rewards = aligned((self.num_envs,) + ((leaders,) if self.layout == "leaders" else ()))
        self._new_observations, self._new_rewards = (ArraySupply(own.shape) for own in (self._observations, self._rewards))

    def __getstate__(self) -> dict[str, Any]:
        scratch = ("_inputs", "_observations", "_rewards", "_new_observations", "_new_rewards")
        return {name: value for name, value in self.__dict__.items() if name not in scratch}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._make_arrays()

    def _make_spaces(self) -> None:
        """Makes the spaces once, so that a seed given to one of them stays."""
        try:
            from gymnasium import spaces
        except ImportError:
            return
        action = (*self._single[:-1], _native.OUTPUTS)
        least = self.config._native.least_input
        self.single_observation_space = spaces.Box(least, np.inf, self._single, np.float32)
        self.single_action_space = spaces.Box(-1, 1, action, np.float32)
        self.observation_space = spaces.Box(least, np.inf, (self.num_envs, *self._single), np.float32)
        self.action_space = spaces.Box(-1, 1, (self.num_envs, *action), np.float32)

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_space"):
            raise ImportError(f"{name}: gymnasium is not installed; pip install flotilla-teams[gymnasium]")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def unwrapped(self) -> VectorEnv:
        """This environment."""
        return self

    def _observe(self, copy: bool) -> Floats:
        """Returns the observations of all environments, `[num_envs, ...]`."""
        if not self.time_input:
            found = self._teams.inputs(None if copy else self._inputs)
        else:
            found = self._new_observations() if copy else self._observations
            found[..., :-1] = self._teams.inputs(self._inputs)
            found[..., -1] = (self._teams.steps / np.float32(self._teams.length))[:, None]
        return found.reshape(self.num_envs, *self._single)

    def _per_environment(self, teams: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Converts one value per team to a new array with one value per environment."""
        return np.repeat(teams, self.num_learners) if self.layout == "flat" else teams.copy()

    def _reward(self) -> Floats:
        """Returns rewards in the layout's shape, in a new array if `copy` is set, else in the reused one."""
        out = self._new_rewards() if self.copy else self._rewards
        if self.layout == "team":
            np.mean(self._teams.rewards, axis=1, out=out)
        else:
            out[...] = self._teams.rewards.reshape(out.shape)
        return out

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: seed of the drawn starts. None continues with the seed before; the first time it takes one from the
                operating system, so that workers differ.
            options: `{"reset_mask": mask}` resets only the teams that a bool array `[teams]` marks. In the layout
                `"flat"` the mask is `[num_envs]`, and a team is reset if all its leaders are marked.

        Returns:
            observations, float32 `[num_envs, leaders, inputs]` (`[num_envs, inputs]` in the layout `"flat"`), and an
            empty dictionary.

        Raises:
            ValueError: the seed or the mask is not allowed, or another thread is stepping this environment.

        Example:
            >>> env = flotilla.VectorEnv(flotilla.Config.paper(), 2)
            >>> env.reset(seed=0)[0].shape
            (2, 4, 8)
        """
        chosen: NDArray[np.bool_] | None = None
        if options and options.get("reset_mask") is not None:
            mask = np.array(options["reset_mask"])
            if mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
                raise ValueError(f"reset_mask is {mask.dtype} {mask.shape}, allowed is bool ({self.num_envs},)")
            chosen = np.all(mask.reshape(self._teams.count, -1), axis=1)
        self._teams.reset(seed, chosen)
        self._finished = np.zeros_like(self._finished) if chosen is None else self._finished & ~chosen
        self._any_finished = bool(self._finished.any())
        return self._observe(self.copy), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Plays one step of every team.

        Args:
            actions: `[num_envs, leaders, 2]` (`[num_envs, 2]` in the layout `"flat"`). Numbers beyond -1..1 are
                clipped. C-contiguous float32 arrays are not copied.

        Returns:
            observations, rewards, terminated, truncated and infos, see `VectorEnv` for their shapes. With
            `autoreset="same_step"`, infos of a step that finished teams hold `final_obs` and `final_info`: `g`,
            `observed` (`[num_envs, pois]`) and `state`; names with an underscore in front mark the finished ones.

        Raises:
            ValueError: the actions have another shape or are not all finite, or another thread is stepping this
                environment. No team has moved then.
            Error: the environment was never reset.

        Example:
            >>> env = flotilla.VectorEnv(flotilla.Config.paper(), 2, reward="Df", autoreset="same_step")
            >>> _ = env.reset()
            >>> for _ in range(25):
            ...     _, rewards, _, truncated, infos = env.step(np.zeros((2, 4, 2)))
            >>> truncated, rewards.shape, infos["final_obs"].shape
            (array([ True,  True]), (2, 4), (2, 4, 8))
        """
        teams, infos = self._teams, dict[str, Any]()
        array = floats("actions", actions, "num_envs, 2" if self.layout == "flat" else "num_envs, leaders, 2")
        if self.layout == "flat":
            if array.shape != (self.num_envs, _native.OUTPUTS):
                raise ValueError(f"actions are {list(array.shape)}, allowed is [num_envs, 2] = [{self.num_envs}, 2]")
            array = array.reshape(teams.count, self.num_learners, _native.OUTPUTS)
        if self.autoreset == "next_step" and self._any_finished:
            # These teams ignore this step's action.
            fresh = self._finished
            finished = teams.step(array, fresh)
            teams.reset(None, fresh)
        else:
            finished = teams.step(array)
        self._any_finished = bool(finished.any())
        rewards = self._reward()
        ended = self._per_environment(finished)
        if self.autoreset == "same_step" and self._any_finished:
            infos["final_obs"], infos["_final_obs"] = self._observe(True), ended.copy()
            infos["final_info"], infos["_final_info"] = self._final_info(ended), ended.copy()
            teams.reset(None, finished)
        self._finished = finished
        never = np.zeros(self.num_envs, np.bool_)
        terminated, truncated = (ended, never) if self.horizon == "terminated" else (never, ended)
        return self._observe(self.copy), rewards, terminated, truncated, infos

    def _final_info(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Returns G, observed POIs and state of finished teams, before they are reset. Masks mark these teams."""
        copies = self.num_learners if self.layout == "flat" else 1
        found: dict[str, Any] = {}
        teams = self._teams
        for name, values in (("g", teams.g), ("observed", teams.observed), ("state", teams.state())):
            found[name], found[f"_{name}"] = np.repeat(values, copies, axis=0), ended.copy()
        return found

    @property
    def states(self) -> tuple[Floats, Floats, Floats]:
        """Positions and headings `[teams, agents, 2]` and speeds `[teams, agents]`, leaders first.

        Example:
            >>> flotilla.VectorEnv(flotilla.Config.paper(), 2).states[0].shape
            (2, 12, 2)
        """
        return self._teams.stepper.states()

    @property
    def agents_at_poi(self) -> NDArray[np.bool_]:
        """Agents within the observation radius of each POI after the last step, `[teams, pois, agents]`.

        Example:
            >>> flotilla.VectorEnv(flotilla.Config.paper(), 2).agents_at_poi.shape
            (2, 4, 12)
        """
        return self._teams.stepper.near

    @property
    def observed(self) -> NDArray[np.bool_]:
        """POIs observed since the start of each team's episode, `[teams, pois]`."""
        return self._teams.observed

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of all environments, uint8 `[height, width, 3]`, if the render mode is `"rgb_array"`.

        In the layout `"flat"`, a team's leaders have the same picture.

        Example:
            >>> pictures = flotilla.VectorEnv(flotilla.Config.paper(), 2, render_mode="rgb_array").render()
            >>> len(pictures), pictures[0].shape
            (2, (480, 480, 3))
        """
        if self.render_mode != "rgb_array":
            return None
        pictures = [self._teams.stepper.render(team, PIXELS) for team in range(self.num_teams)]
        copies = self.num_envs // self.num_teams
        return tuple(picture for picture in pictures for _ in range(copies))

    def close(self, **_: Any) -> None:
        """Marks the environment as closed. It holds nothing that has to be freed."""
        self.closed = True

    def __repr__(self) -> str:
        return f"<flotilla.VectorEnv: {self._teams.count} teams of {self.num_learners} leaders, {self.autoreset} reset>"


def one_of(what: str, word: str, allowed: tuple[str, ...]) -> None:
    """Raises a ValueError unless a word is one of those allowed."""
    if word not in allowed:
        raise ValueError(f"{what} {word!r}, allowed are {', '.join(map(repr, allowed))}")


def _autoreset_mode(mode: str) -> Any:
    """Returns gymnasium's constant for the mode, or its value if gymnasium is not installed."""
    try:
        from gymnasium.vector import AutoresetMode
    except ImportError:
        return {"next_step": "NextStep", "same_step": "SameStep", "disabled": "Disabled"}[mode]
    return getattr(AutoresetMode, mode.upper())
