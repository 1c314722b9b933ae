"""Rollouts and traces of given policies, and the forward pass of a policy."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import Floats, floats, whole, word
from flotilla._config import Config, check_config, jitters
from flotilla._errors import no_key, warn
from flotilla._show import Replay

MAX_EPISODES = 1_000_000
# Inputs of a policy without a config.
INPUTS = 8


@dataclass(frozen=True)
class Trace:
    """What teams did at every step of one episode. Fields that were not recorded are None.

    Attributes:
        positions: positions from the start on, `[teams, steps + 1, agents, 2]`, leaders first, in map units.
        headings: unit vectors, of the same shape.
        speeds: `[teams, steps + 1, agents]`, in units per second.
        inputs: what leaders sense, `[teams, steps, leaders, inputs]`, see `VectorEnv`.
        outputs: the answers of their policies, `[teams, steps, leaders, 2]` in -1..1, which lead to the next step's
            states.
        agents_at_poi: which agents are within the observation radius of each POI after each step,
            `[teams, steps, pois, agents]`, bool.
        poi_distances: the distance from each POI to each agent after each step, `[teams, steps, pois, agents]`, in map
            units. The nearest agents of a POI are the first of `np.sort(trace.poi_distances)`.
        agent_distances: the distance from each agent to the nearest other agent after each step,
            `[teams, steps, agents]`; infinite for an agent that is alone.

    Example:
        >>> config = flotilla.Config.paper()
        >>> still = np.zeros((4, 1, config.parameters), np.float32)
        >>> trace = flotilla.rollout(config, still, record=("positions",)).trace
        >>> trace.positions.shape, trace.speeds
        ((1, 26, 12, 2), None)
    """

    positions: Any = None
    headings: Any = None
    speeds: Any = None
    inputs: Any = None
    outputs: Any = None
    agents_at_poi: Any = None
    poi_distances: Any = None
    agent_distances: Any = None


@dataclass(frozen=True)
class Rollout:
    """The scores of teams; means over episodes. `rollout["Df"]` is a score by the name of the fitness.

    Attributes:
        observed: POIs observed, weighted by their values if these differ, `[teams]`: G times the number of POIs.
        g: G, the value of the POIs observed as a share of all, float64 `[teams]`, as in a run's metrics.
        d: what the team would have lost without each leader, `[teams, leaders]`, as the next three.
        df: without the leader and the followers that it led.
        dpp: D, or the gain per added copy of the leader if that is larger.
        dt: without the leader and, at each step, the followers that it led then; None unless the config's fitness is Dt.
        trace: what the teams did, if that was asked for.
        deviation: the standard deviation of G over episodes, `[teams]`, if `spread` was asked for, as the next two.
        interval: the 95 % interval of the mean G, `[teams, 2]`, as `flotilla rollout` computes it.
        episodes: G of each episode, `[episodes, teams]`.

    Example:
        >>> config = flotilla.Config.paper()
        >>> scores = flotilla.rollout(config, np.zeros((1, 3, config.parameters), np.float32))
        >>> scores.g, scores["Df"].shape
        (array([1., 1., 1.]), (3, 4))
    """

    observed: NDArray[np.float64]
    g: NDArray[np.float64]
    d: Floats
    df: Floats
    dpp: Floats
    dt: Floats | None = None
    trace: Trace | None = None
    deviation: NDArray[np.float64] | None = None
    interval: NDArray[np.float64] | None = None
    episodes: NDArray[np.float64] | None = None

    def __getitem__(self, fitness: str) -> NDArray[Any]:
        """Returns a score by the name of the fitness: `"G"`, `"D"`, `"Df"`, `"D++"` or `"Dt"`."""
        scores: dict[str, NDArray[Any] | None] = {"G": self.g, "D": self.d, "Df": self.df, "D++": self.dpp, "Dt": self.dt}
        found = scores.get(fitness)
        if found is None:
            raise no_key(fitness, "score", [name for name in scores if scores[name] is not None])
        return found

    def __repr__(self) -> str:
        teams, leaders = self.d.shape
        return f"<flotilla.Rollout: {teams} teams of {leaders} leaders, G {self.g.mean():.3f} on average>"


@dataclass(frozen=True)
class Scores:
    """The scores of given paths. `scores["Df"]` is a score by the name of the fitness.

    Attributes:
        value: the values of the POIs observed, weighted by their scores, float64 `[teams]`.
        g: G, this as a share of the values of all POIs, `[teams]`.
        d: what the team would have lost without each learner, `[teams, learners]`, or without the agents of
            `credit.removes`.
        df: without the learner and the agents that it led.
        dpp: D, or the gain per added copy of the learner if that is larger.
        dt: without the learner and, at each step, the agents that it led then.
        fitness: what each learner's policies would be selected by, with G if `credit.add_g` is set.
    """

    value: NDArray[np.float64]
    g: Floats
    d: Floats
    df: Floats
    dpp: Floats
    dt: Floats
    fitness: Floats

    def __getitem__(self, fitness: str) -> Floats:
        """Returns a score by the name of the fitness: `"G"`, `"D"`, `"Df"`, `"D++"` or `"Dt"`."""
        scores = {"G": self.g, "D": self.d, "Df": self.df, "D++": self.dpp, "Dt": self.dt}
        if fitness not in scores:
            raise no_key(fitness, "score", list(scores))
        return scores[fitness]


def score(config: Config, positions: ArrayLike) -> Scores:
    """Scores paths from anywhere, such as a real experiment or another simulator. Nothing is simulated.

    Args:
        config: the world. Its start positions and rules of motion do not matter.
        positions: the positions of all agents at the start and after each step, in map units,
            `[teams, steps + 1, agents, 2]`; classes follow each other in the order of the config.

    Raises:
        ValueError: the positions have another shape, or hold a NaN or an infinity; or POIs come after others, or are drawn
            from regions.

    Example:
        >>> config = flotilla.Config.paper()
        >>> still = np.tile(np.zeros((12, 2)), (1, 26, 1, 1))
        >>> flotilla.score(config, still).g
        array([0.], dtype=float32)
    """
    check_config(config)
    axes = "[teams, steps + 1, agents, 2]"
    array = floats("positions", positions, axes)
    shape = (config._native.sizes[2] + 1, config._native.sizes[0], 2)
    if array.shape[1:] != shape or array.shape[0] == 0:
        expected = ["1 or more", *shape]
        raise ValueError(f"positions are {list(array.shape)}, allowed is {axes} = {expected}")
    return Scores(*_native.score(config._native, array))


FIELDS = ("positions", "headings", "speeds", "inputs", "outputs", "agents_at_poi", "poi_distances", "agent_distances")
# Seconds that a block of episodes should take, so that Ctrl-C is answered soon.
BLOCK_SECONDS = 0.2
# Steps of agents in the first block, before it is known how long they take.
FIRST_BLOCK = 4_000_000


def _checked(config: Any, policies: ArrayLike) -> Floats:
    """Returns policies as an array `[leaders, teams, parameters]` with at least one team."""
    check_config(config)
    array = floats("policies", policies, "leaders, teams, parameters")
    if array.shape[1] == 0:
        raise ValueError(f"policies are {list(array.shape)}: no teams; pass [leaders, teams, parameters] with 1 team or more")
    return array


def _shapes(config: Config, teams: int) -> dict[str, tuple[int, ...]]:
    """Returns the shape of every array of steps."""
    (agents, pois, steps), leaders = config._native.sizes, config.num_learners
    return {
        "positions": (teams, steps + 1, agents, 2),
        "headings": (teams, steps + 1, agents, 2),
        "speeds": (teams, steps + 1, agents),
        "inputs": (teams, steps, leaders, config.num_inputs),
        "outputs": (teams, steps, leaders, _native.OUTPUTS),
        "actions": (teams, steps, leaders, _native.OUTPUTS),
        "agents_at_poi": (teams, steps, pois, agents),
        "poi_distances": (teams, steps, pois, agents),
        "agent_distances": (teams, steps, agents),
    }


Starts = tuple[int, int, float, float]


def _drawn(config: Config, episodes: int, seed: int, jitter: float | None, poi_jitter: float | None) -> Starts:
    """Returns the number of held-out starts, their seed and their jitters."""
    reaches = jitters(config, jitter, poi_jitter)
    return (whole("episodes", episodes, 1, MAX_EPISODES), whole("seed", seed, 0, 2**63 - 1), *reaches)


def _starts(
    config: Config, episodes: int | None, seed: int, jitter: float | None, poi_jitter: float | None
) -> Starts | None:
    """Returns held-out starts, or None for the config's own start. A config with regions has none."""
    if episodes is not None or config._native.draws_starts:
        return _drawn(config, 1 if episodes is None else episodes, seed, jitter, poi_jitter)
    if jitter is not None or poi_jitter is not None:
        raise ValueError("a jitter applies to drawn starts; pass episodes= with their number")
    return None


def _record(
    config: Config,
    policies: Floats,
    starts: Starts | None,
    noise: tuple[int, Floats] | None,
    arrays: dict[str, Any],
) -> list[Any]:
    """Plays in blocks and fills the arrays. Returns scores.

    Blocks are episodes of all teams, or if there is one episode, some teams of it.
    """
    teams, episodes = policies.shape[1], 1 if starts is None else starts[0]
    whole_teams = episodes > 1 or noise is not None
    agents, _, steps = config._native.sizes
    cost = agents * steps * (teams if whole_teams else 1)
    total, block, first = (episodes if whole_teams else teams), max(FIRST_BLOCK // cost, 1), 0
    parts: list[tuple[Any, ...]] = []
    while first < total:
        count = min(block, total - first)
        chosen = policies if count == teams or whole_teams else np.ascontiguousarray(policies[:, first : first + count])
        begin, end = (first * teams, (first + count) * teams) if whole_teams else (first, first + count)
        of_block = {name: array[begin:end] for name, array in arrays.items()}
        states, distances = ([of_block.get(name) for name in names] for names in ((*FIELDS[:5], "actions"), FIELDS[6:]))
        near, observed_at = of_block.get("agents_at_poi"), of_block.get("observed_at")
        span = (first, first + count) if whole_teams else (0, 1)
        began = time.perf_counter()
        parts.append(_native.record(config._native, chosen, starts, span, noise, states, near, observed_at, distances))
        took = time.perf_counter() - began
        first += count
        block = block * 2 if took < BLOCK_SECONDS / 2 else max(block // 2, 1) if took > BLOCK_SECONDS * 2 else block
    return [None if part[0] is None else np.concatenate(part) for part in zip(*parts)]


def rollout(
    config: Config,
    policies: ArrayLike,
    *,
    episodes: int | None = None,
    seed: int = 0,
    jitter: float | None = None,
    poi_jitter: float | None = None,
    spread: bool = False,
    trace: bool = False,
    record: Sequence[str] = (),
    out: Mapping[str, NDArray[Any]] | None = None,
    backend: str | int = "auto",
) -> Rollout:
    """Plays teams of given policies, and scores every leader. Ctrl-C stops it.

    Args:
        config: the world, and the policies' network.
        policies: float32 `[leaders, teams, parameters]`: team `t` is made of every leader's policy `t`; or
            `[populations, teams, parameters]` if leaders share policies (`learning.sharing`; 1 if all share one).
            C-contiguous float32 arrays are not copied.
            A policy's parameters are its layers in order, each as weights `W[in, out]` (row-major), then biases `b[out]`.
        episodes: number of held-out starts that every team plays from. None plays once, from the config's own start
            or from a drawn one if it has regions.
        seed: seed of these starts, which are the same for all policies.
        jitter: largest offset of a start on each axis, in map units; None takes the config's `learning.start_jitter`.
        poi_jitter: the same for POIs; None takes the config's `learning.poi_jitter`.
        spread: also return G of each episode, its standard deviation and its interval.
        trace: also return all fields of a `Trace`, of the first episode.
        record: the fields of the trace to return, if not all: `("positions",)`. Steps are recorded on the CPU, to the
            same bits as on any GPU.
        out: C-contiguous arrays for fields of the trace, by name, which are then not allocated: float32, and bool for
            `agents_at_poi`.
        backend: where to play, with the same bits: `"auto"`, `"cpu"`, `"gpu"`, or an adapter's number or name.

    Raises:
        ValueError: the policies have another shape, or hold a NaN, an infinity or a size above 1e6; or another argument is
            not allowed.
        TypeError: the policies are no numbers.
        MemoryError: there is not enough memory for that many teams.
        Error: the backend fails.

    Example:
        >>> config = flotilla.Config.paper("generally_forward")
        >>> run = flotilla.train(config.replace(learning={"trials": 1, "generations": 20}))
        >>> scores = flotilla.rollout(config, run.policies[0])
        >>> bool(scores.g[0] == run.metrics["champion_g"][0, -1])
        True
        >>> held_out = flotilla.rollout(config, run.policies[0][:, :1], episodes=100, jitter=1.0, spread=True)
        >>> held_out.episodes.shape, held_out.interval.shape
        ((100, 1), (1, 2))
    """
    array, name = _checked(config, policies), word("backend", backend)
    fields = _fields(record, trace, out)
    starts = _starts(config, episodes, seed, jitter, poi_jitter)
    if starts is not None and starts[0] > 1 and max(starts[2:]) == 0 and not config._native.draws_starts:
        warn(f"{episodes} episodes without jitter are all the same; pass jitter= or poi_jitter=", UserWarning)
    total = sum(config._native.worth)
    # What a POI is worth on average. It is 1 if all have the same value.
    unit = total / config._native.sizes[1]
    traced = None
    if fields:
        first = None if starts is None else (1, *starts[1:])
        arrays = _allocate(_shapes(config, array.shape[1]), fields, out)
        worth, d, df, dpp, dt = _record(config, array, first, None, arrays)
        traced = Trace(**arrays)
        if starts is None and not spread:
            return Rollout(worth / unit, worth / total, d, df, dpp, dt, traced)
    (worth, d, df, dpp, dt), spreads = _native.rollout(config._native, array, starts, name, bool(spread))
    scores = Rollout(worth / unit, worth / total, d, df, dpp, dt, traced)
    if spreads is not None:
        rows, each = spreads
        pois = config._native.sizes[1]
        scores = replace(scores, deviation=rows[:, 0] / pois, interval=rows[:, 1:] / pois, episodes=each / total)
    return scores


def _fields(record: Sequence[str], trace: bool, out: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Returns the fields of a trace that are wanted."""
    named = (record,) if isinstance(record, str) else record
    fields = tuple(dict.fromkeys([*(FIELDS if trace else ()), *named, *(out or ())]))
    for field in fields:
        if field not in FIELDS:
            raise ValueError(f"record {field!r}, allowed are {', '.join(map(repr, FIELDS))}")
    return fields


def _allocate(
    shapes: Mapping[str, tuple[int, ...]], fields: Sequence[str], out: Mapping[str, NDArray[Any]] | None
) -> dict[str, Any]:
    """Returns the arrays to record fields in: those of `out`, or new ones."""
    arrays: dict[str, Any] = {}
    for field in fields:
        kind = np.dtype(np.bool_ if field == "agents_at_poi" else np.float32)
        given = None if out is None else out.get(field)
        if given is None:
            arrays[field] = np.empty(shapes[field], kind)
            continue
        right = isinstance(given, np.ndarray) and given.dtype == kind and given.shape == shapes[field]
        if not right or not given.flags.c_contiguous or not given.flags.writeable:
            text = f"out[{field!r}] must be a writable C-contiguous {kind} array of shape {shapes[field]}"
            raise ValueError(text)
        arrays[field] = given
    return arrays


@dataclass(frozen=True)
class Collected:
    """Episodes with noise on the actions, for trainers such as PPO. Episodes of a team follow each other by teams.

    Attributes:
        observations: what leaders sense, `[episodes * teams, steps, leaders, inputs]`.
        actions: what they did before it was clamped to -1..1: their policy's answer plus noise,
            `[episodes * teams, steps, leaders, 2]`.
        means: the answers of their policies, of the same shape.
        rewards: `[episodes * teams, steps, leaders]`, as of `VectorEnv`.
        masks: False at the last step of an episode, else True, `[episodes * teams, steps]`.
        g: G, `[episodes * teams]`.
    """

    observations: Floats
    actions: Floats
    means: Floats
    rewards: Floats
    masks: NDArray[np.bool_]
    g: NDArray[np.float64]


def collect(
    config: Config,
    policies: ArrayLike,
    noise: ArrayLike = 0.1,
    seed: int = 0,
    *,
    episodes: int = 1,
    jitter: float | None = None,
    poi_jitter: float | None = None,
    reward: str = "G",
) -> Collected:
    """Plays episodes with normal noise on the actions, at a rollout's speed, and returns what a trainer needs.

    Args:
        config: the world, and the policies' network.
        policies: see `rollout`.
        noise: the standard deviation of the noise: one number, `[2]` for turn and speed, or `[leaders, 2]`.
        seed: seed of the noise and of the starts.
        episodes: number of episodes per team.
        jitter: see `rollout`; here, too, None takes the config's.
        poi_jitter: the same for POIs.
        reward: see `VectorEnv`.

    Raises:
        ValueError: an argument is not allowed.
        MemoryError: there is not enough memory for that many teams.

    Example:
        >>> config = flotilla.Config.paper()
        >>> policies = np.zeros((1, 1, config.parameters), np.float32)
        >>> batch = flotilla.collect(config, policies, noise=0.3, seed=1, episodes=64)
        >>> batch.observations.shape, batch.actions.shape, batch.rewards.shape
        ((64, 25, 4, 8), (64, 25, 4, 2), (64, 25, 4))
        >>> bool((batch.rewards.sum(1)[:, 0] == batch.g).all())
        True
    """
    array = _checked(config, policies)
    if reward not in _native.FITNESSES:
        raise ValueError(f"reward {reward!r}, allowed are {', '.join(_native.FITNESSES)}")
    scored = Config._of(config._native.with_fitness(reward))
    deviations = np.asarray(noise, np.float32)
    if deviations.shape not in ((), (2,), (config.num_learners, 2)) or not (np.isfinite(deviations) & (deviations >= 0)).all():
        raise ValueError("noise must be a number from 0 on, or an array of them, [2] or [leaders, 2]")
    deviations = np.ascontiguousarray(np.broadcast_to(deviations, (config.num_learners, 2)))
    starts = _drawn(config, episodes, seed, jitter, poi_jitter)
    total = starts[0] * array.shape[1]
    shapes = _shapes(config, total)
    arrays: dict[str, NDArray[Any]] = {name: np.empty(shapes[name], np.float32) for name in ("inputs", "outputs", "actions")}
    _, pois, steps = config._native.sizes
    values = np.array(config._native.worth)
    at = np.empty((total, pois), np.uint32)
    by_step = reward == "G" and not config._native.needs_paths
    if by_step:
        arrays["observed_at"] = at
    worth, d, df, dpp, dt = _record(scored, array, starts, (starts[1], deviations), arrays)
    rewards = np.zeros((total, steps, config.num_learners), np.float32)
    if by_step:
        team, poi = np.nonzero(at)
        gains = np.bincount(team * steps + at[team, poi] - 1, values[poi], total * steps)
        rewards[...] = gains.reshape(total, steps, 1).astype(np.float32) / np.float32(values.sum())
    else:
        g = np.repeat((worth / values.sum())[:, None], config.num_learners, axis=1)
        rewards[:, -1] = {"G": g, "D": d, "Df": df, "D++": dpp, "Dt": dt}[reward]
    masks = np.ones((total, steps), np.bool_)
    masks[:, -1] = False
    return Collected(arrays["inputs"], arrays["actions"], arrays["outputs"], rewards, masks, worth / values.sum())


def replay(
    config: Config,
    policies: ArrayLike,
    team: ArrayLike = 0,
    *,
    episodes: int | None = None,
    seed: int = 0,
    jitter: float | None = None,
    poi_jitter: float | None = None,
) -> Replay:
    """Plays teams of policies from anywhere, such as another optimiser. `Run.replay` does so for trained teams.

    Args:
        config: the world, and the policies' network.
        policies: see `rollout`.
        team: the team that plays, from 0; or a list of teams, side by side.
        episodes: see `rollout`, as for the next three. The first episode is played.
        seed: seed of held-out starts.
        jitter: largest offset of a start on each axis, in map units.
        poi_jitter: the same for POIs.

    Raises:
        ValueError: the policies have another shape, there is no such team, or another argument is not allowed.

    Example:
        >>> config = flotilla.Config.paper()
        >>> policies = np.random.default_rng(0).normal(size=(4, 200, config.parameters))
        >>> best = int(flotilla.rollout(config, policies).g.argmax())
        >>> flotilla.replay(config, policies, best).save("found.gif", width=300)
    """
    array = _checked(config, policies)
    starts = _starts(config, episodes, seed, jitter, poi_jitter)
    teams = [whole("team", each, 0, array.shape[1] - 1) for each in np.atleast_1d(np.asarray(team))]
    if not 1 <= len(teams) <= 24:
        raise ValueError(f"{len(teams)} teams, allowed are 1 to 24")
    chosen = [(each, np.ascontiguousarray(array[:, each : each + 1])) for each in teams]
    return Replay(_native.replay_policies(config._native, chosen, starts))


def _layers(config: Config | None, parameters: int) -> list[int]:
    """Returns the widths of a policy's layers, inputs and outputs included.

    Without a config, the policy has at most one hidden layer, whose width follows from the number of parameters.
    """
    if config is None:
        ins, outs = INPUTS, _native.OUTPUTS
        units = (parameters - outs) // (ins + 1 + outs)
        found = [ins, outs] if parameters == (ins + 1) * outs else [ins, max(units, 1), outs]
    else:
        check_config(config)
        found = config._native.widths
    expected = sum((before + 1) * after for before, after in zip(found, found[1:]))
    if expected != parameters:
        named = ", ".join(map(str, found))
        hint = "" if config is not None else "; pass config= to give its layers"
        raise ValueError(f"a policy has {parameters} parameters, but layers of {named} units take {expected}{hint}")
    return found


def forward(policies: ArrayLike, inputs: ArrayLike, config: Config | None = None) -> Floats:
    """Returns the outputs of policies, with the bits of an episode.

    A policy is a fully connected network with a bias and tanh in every layer. If a config says that policies choose among
    behaviours, the answer is the turn and speed of the chosen one.

    Args:
        policies: `[..., parameters]`, see `rollout`.
        inputs: `[..., inputs]`; the axes before the last are broadcast against those of the policies.
        config: the config of the policies; None if they have 8 inputs and at most one hidden layer, and answer directly.

    Returns:
        float32 `[..., 2]` in -1..1: the turn, as a fraction of a half turn to the left, and the speed, from standing still
        to the largest.

    Raises:
        ValueError: the shapes do not fit, or policies of the config choose agents to move to.

    Example:
        >>> ahead = np.zeros(112, np.float32)
        >>> flotilla.forward(ahead, np.ones((5, 8))).shape
        (5, 2)
    """
    weights, given = np.asarray(policies), np.asarray(inputs)
    for what, array in (("policies", weights), ("inputs", given)):
        if array.dtype.kind not in "fiu" or array.ndim == 0:
            raise ValueError(f"{what} are {array.dtype} of shape {array.shape}, allowed are arrays of numbers")
    layers = _layers(config, weights.shape[-1])
    if config is not None and config._native.chooses_agents:
        raise ValueError("policies of this config choose agents to move to: forward computes no choices; use a trace")
    if given.shape[-1] != layers[0]:
        raise ValueError(f"inputs have the shape {given.shape}, allowed is [..., {layers[0]}]")
    shape = np.broadcast_shapes(weights.shape[:-1], given.shape[:-1])
    rows = np.ascontiguousarray(np.broadcast_to(given, (*shape, layers[0])), np.float32).reshape(-1, layers[0])
    if not np.isfinite(rows).all():
        raise ValueError("inputs hold a NaN or an infinity")
    table = np.ascontiguousarray(weights, np.float32).reshape(-1, weights.shape[-1])
    chosen = np.arange(len(table), dtype=np.int64).reshape(weights.shape[:-1])
    answers = np.empty((len(rows), _native.OUTPUTS), np.float32)
    _native.forward(layers, table, rows, np.ascontiguousarray(np.broadcast_to(chosen, shape)).reshape(-1), answers)
    return answers.reshape(*shape, _native.OUTPUTS)


def to_onnx(policy: ArrayLike, path: str | os.PathLike[str], config: Config | None = None) -> None:
    """Writes one policy's network as an ONNX model with an input `inputs [n, inputs]` and an output `outputs [n, 2]`.

    Needs the package `onnx` (`pip install flotilla-teams[onnx]`). If a config says that policies choose among
    behaviours, the output is `[n, 5]`, one value per behaviour. If policies choose agents to move to, it has one value per
    agent of the largest class, and one for nobody.

    Args:
        policy: `[parameters]`.
        path: file to write.
        config: as of `forward`.

    Raises:
        ValueError: the shape does not fit.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = floats("policy", policy, "parameters")
    layers, at, value = _layers(config, weights.size), 0, "inputs"
    nodes, tensors = [], []
    for index, (before, after) in enumerate(zip(layers, layers[1:])):
        layer = weights[at : at + (before + 1) * after].reshape(before + 1, after)
        at += layer.size
        tensors.append(numpy_helper.from_array(layer[:-1], f"weights.{index}"))
        tensors.append(numpy_helper.from_array(layer[-1], f"biases.{index}"))
        result = "outputs" if index == len(layers) - 2 else f"layer.{index}"
        nodes.append(helper.make_node("Gemm", [value, f"weights.{index}", f"biases.{index}"], [f"sums.{index}"]))
        nodes.append(helper.make_node("Tanh", [f"sums.{index}"], [result]))
        value = result
    given = helper.make_tensor_value_info("inputs", TensorProto.FLOAT, ["n", layers[0]])
    answered = helper.make_tensor_value_info("outputs", TensorProto.FLOAT, ["n", layers[-1]])
    graph = helper.make_graph(nodes, "policy", [given], [answered], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, os.fspath(path))
