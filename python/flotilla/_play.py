"""Rollouts and traces of given policies, and the forward pass of a policy."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flotilla import _native
from flotilla._arrays import Floats, backend_name, floats, number, whole
from flotilla._config import Config

MAX_EPISODES = 1_000_000


@dataclass(frozen=True)
class Trace:
    """All that teams did in one episode.

    Attributes:
        positions: where everyone was, from the start on, ``[teams, steps + 1, agents, 2]``, leaders first, in map units.
        headings: unit vectors, likewise.
        speeds: ``[teams, steps + 1, agents]``, in units a second.
        inputs: what leaders sensed, ``[teams, steps, leaders, 8]``: the density of POIs, then of agents, in four quadrants
            around their heading: back right, front right, front left, back left.
        outputs: what their policies answered, ``[teams, steps, leaders, 2]`` in -1..1: that leads to the next step's states.
        near: which agents were near which POI after each step, ``[teams, steps, pois, agents]``, bool.

    Example:
        >>> config = flotilla.Config.paper()
        >>> still = np.zeros((4, 1, config.parameters), np.float32)
        >>> flotilla.rollout(config, still, trace=True).trace.positions.shape
        (1, 26, 12, 2)
    """

    positions: Floats
    headings: Floats
    speeds: Floats
    inputs: Floats
    outputs: Floats
    near: NDArray[np.bool_]


@dataclass(frozen=True)
class Rollout:
    """What teams scored; of several episodes, means.

    Attributes:
        observed: POIs observed, ``[teams]``.
        g: these over all POIs, ``[teams]``.
        d: what the team would have lost without each leader, ``[teams, leaders]``, as the next two.
        df: without it and the followers that it led.
        dpp: what it would have gained by copies of it, where that is more.
        dt: without it and, at each step, the followers that it led then; None but where the config's fitness is Dt.
        trace: all that the teams did, if that was asked for.

    Example:
        >>> config = flotilla.Config.paper()
        >>> scores = flotilla.rollout(config, np.zeros((1, 3, config.parameters), np.float32))
        >>> scores.g, scores.df.shape
        (array([1., 1., 1.], dtype=float32), (3, 4))
    """

    observed: NDArray[np.float64]
    g: Floats
    d: Floats
    df: Floats
    dpp: Floats
    dt: Floats | None = None
    trace: Trace | None = None

    def __repr__(self) -> str:
        teams, leaders = self.d.shape
        return f"<flotilla.Rollout: {teams} teams of {leaders} leaders, G {self.g.mean():.3f} on average>"


def _near(words: NDArray[np.uint32], agents: int) -> NDArray[np.bool_]:
    """Converts bit sets `[..., words]` to bools `[..., agents]`. The first agent has the lowest bit."""
    bits = np.unpackbits(words.astype("<u4", copy=False).view(np.uint8), axis=-1, bitorder="little")
    return bits[..., :agents].astype(np.bool_)


def rollout(
    config: Config,
    policies: ArrayLike,
    *,
    episodes: int | None = None,
    seed: int = 0,
    jitter: float | None = None,
    poi_jitter: float | None = None,
    trace: bool = False,
    backend: str | int = "auto",
) -> Rollout:
    """Plays teams of given policies, and scores every leader.

    Args:
        config: the world, and the policies' network.
        policies: float32 ``[leaders, teams, parameters]``: team ``t`` is made of every leader's policy ``t``; or
            ``[1, teams, parameters]`` where the leaders of a team share one. Not copied where they are C-contiguous
            float32. A policy's parameters stand layer by layer, in each input by input with the bias last, in each unit by
            unit.
        episodes: play every team from so many starts that no training saw; None plays once, from the config's own.
        seed: of these starts; the same for all policies.
        jitter: how far a start is moved at most on each axis, in map units; None is the config's ``learning.start_jitter``.
        poi_jitter: likewise of each POI; None is the config's ``learning.poi_jitter``.
        trace: also give all that the teams did in the first episode.
        backend: what to play on, to the same bits: ``"auto"``, ``"cpu"``, ``"gpu"``, or an adapter's number or name.

    Raises:
        ValueError: the policies have another shape, or hold a NaN, an infinity or a size above 1e6.
        TypeError: the policies are no numbers.
        MemoryError: there is not enough for so many.
        Error: the backend fails.

    Example:
        >>> config = flotilla.Config.paper("generally_forward")
        >>> run = flotilla.train(config.replace(learning={"trials": 1, "generations": 20}))
        >>> scores = flotilla.rollout(config, run.policies[0])
        >>> bool(scores.g[0] == run.metrics["champion_g"][0, -1])
        True
    """
    if not isinstance(config, Config):
        raise TypeError(f"config is {type(config).__name__}, allowed is flotilla.Config")
    array, name = floats("policies", policies, 3), backend_name(backend)
    starts = None
    if episodes is not None:
        learning = config["learning"]
        reaches = [learning["start_jitter"] if jitter is None else jitter]
        reaches.append(learning["poi_jitter"] if poi_jitter is None else poi_jitter)
        starts = (
            whole("episodes", episodes, 1, MAX_EPISODES),
            whole("seed", seed, 0, 2**63 - 1),
            number("jitter", reaches[0], 0, 1e9),
            number("poi_jitter", reaches[1], 0, 1e9),
        )
    elif jitter is not None or poi_jitter is not None:
        raise ValueError("a jitter is of starts that are drawn, say how many by episodes")
    observed, g, d, df, dpp, dt = _native.rollout(config._native, array, starts, name)
    traced = None
    if trace:
        positions, headings, speeds, inputs, outputs, near = _native.trace(config._native, array, starts, 0, name)
        traced = Trace(positions, headings, speeds, inputs, outputs, _near(near, positions.shape[2]))
    return Rollout(observed, g, d, df, dpp, dt, traced)


def _layers(config: Config | None, parameters: int) -> list[int]:
    """Returns the widths of a policy's layers, inputs and outputs included.

    Without a config, the policy has at most one hidden layer, whose width follows from the number of parameters.
    """
    if config is not None and not isinstance(config, Config):
        raise TypeError(f"config is {type(config).__name__}, allowed is flotilla.Config")
    if config is None:
        ins, outs = _native.INPUTS, _native.OUTPUTS
        units = (parameters - outs) // (ins + 1 + outs)
        found = [ins, outs] if parameters == (ins + 1) * outs else [ins, max(units, 1), outs]
    else:
        found = config._native.widths
    expected = sum((before + 1) * after for before, after in zip(found, found[1:]))
    if expected != parameters:
        named = ", ".join(map(str, found))
        hint = "" if config is not None else "; say by config which layers it has"
        raise ValueError(f"a policy has {parameters} parameters, but layers of {named} units take {expected}{hint}")
    return found


def _chosen(inputs: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the turn and speed of the most wanted behaviour.

    Behaviours are: hold, towards POIs, away from POIs, towards agents, away from agents.
    """
    behaviour = wanted.argmax(-1)
    inputs = np.broadcast_to(inputs, (*behaviour.shape, inputs.shape[-1]))
    sensed = np.where((behaviour < 3)[..., None], inputs[..., :4], inputs[..., 4:])
    turn = np.array([-0.75, -0.25, 0.25, 0.75])[sensed.argmax(-1)]
    away = (behaviour == 2) | (behaviour == 4)
    turn = np.where(away, np.where(turn < 0, turn + 1, turn - 1), turn)
    turn = np.where(sensed.max(-1) > 0, turn, 0.0)
    hold = behaviour == 0
    return np.stack([np.where(hold, 0.0, turn), np.where(hold, -1.0, 1.0)], axis=-1)


def forward(policies: ArrayLike, inputs: ArrayLike, config: Config | None = None) -> Floats:
    """What policies answer, in plain NumPy: a fully connected network with a bias and tanh in every layer.

    Within 5e-6 of the program's answers, which have arithmetic of their own that is the same everywhere. Where a config says
    that policies choose among behaviours, this chooses too; two that are wanted alike within that much may be taken for each
    other.

    Args:
        policies: ``[..., parameters]``: layer by layer, in each input by input with the bias last, in each unit by unit.
        inputs: ``[..., 8]``; the axes before the last are broadcast against those of the policies.
        config: whose policies they are; None where they have at most one hidden layer, and answer directly.

    Returns:
        float32 ``[..., 2]`` in -1..1: the turn, in parts of a half turn to the left, and the speed, from standing still to
        the highest.

    Raises:
        ValueError: the shapes do not fit.

    Example:
        >>> ahead = np.zeros(112, np.float32)
        >>> flotilla.forward(ahead, np.ones((5, 8))).shape
        (5, 2)
    """
    weights, given = np.asarray(policies), np.asarray(inputs)
    for what, array in (("policies", weights), ("inputs", given)):
        if array.dtype.kind not in "fiu" or array.ndim == 0:
            raise ValueError(f"{what} are {array.dtype} of shape {array.shape}, allowed are arrays of numbers")
    if given.shape[-1] != _native.INPUTS:
        raise ValueError(f"inputs have the shape {given.shape}, allowed is [..., {_native.INPUTS}]")
    layers, at = _layers(config, weights.shape[-1]), 0
    values = sensed = given.astype(np.float64)
    for before, after in zip(layers, layers[1:]):
        layer = weights[..., at : at + (before + 1) * after].astype(np.float64)
        layer = layer.reshape(*weights.shape[:-1], before + 1, after)
        values = np.tanh(np.einsum("...iu,...i->...u", layer[..., :-1, :], values) + layer[..., -1, :])
        at += (before + 1) * after
    if layers[-1] != _native.OUTPUTS:
        values = _chosen(sensed, values)
    answers: Floats = values.astype(np.float32)
    return answers


def to_onnx(policy: ArrayLike, path: str | os.PathLike[str], config: Config | None = None) -> None:
    """Writes one policy's network as an ONNX model with an input ``inputs [n, 8]`` and an output ``outputs [n, 2]``.

    Needs the package ``onnx`` (``pip install flotilla-teams[onnx]``). Where a config says that policies choose among
    behaviours, the output is ``[n, 5]``: how much each is wanted.

    Args:
        policy: ``[parameters]``.
        path: file to write.
        config: as of :func:`forward`.

    Raises:
        ValueError: the shape does not fit.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = floats("policy", policy, 1)
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
