"""Tests functions that play policies: `rollout` with traces, `forward`, `collect` and `to_onnx`.

Their results are compared with each other, with the program and with NumPy, mostly bit by bit.
"""

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import random_config, random_policies

import flotilla
from flotilla import Config, forward, rollout, train


def test_scores_equal_the_program_s(config, program, tmp_path):
    run = train(config, out="run")
    arguments = ("run/config.toml", "--policies", "run/policies.safetensors", "--scores", "scores.csv")
    program("rollout", *arguments, "--trial", "1")
    scores = rollout(config, run.policies[1])
    with open("scores.csv") as file:
        for row in csv.DictReader(file):
            team, leader = int(row["team"]), int(row["leader"])
            ours = (scores.g[team], scores.d[team, leader], scores.df[team, leader], scores.dpp[team, leader])
            theirs = tuple(np.float32(row[name]) for name in ("g", "d", "df", "dpp"))
            assert ours == theirs
    assert scores.g[0] == run.metrics["champion_g"][1, -1]
    assert np.array_equal(scores.observed / 4, scores.g)
    assert repr(scores).startswith("<flotilla.Rollout: 20 teams of 4 leaders")


def test_random_starts_equal_the_program_s(config, program):
    run = train(config, out="run")
    arguments = ("run/config.toml", "--policies", "run/policies.safetensors", "--scores", "scores.csv")
    program("rollout", *arguments, "--episodes", "30", "--seed", "5", "--start-jitter", "2")
    scores = rollout(config, run.policies[0], episodes=30, seed=5, jitter=2)
    with open("scores.csv") as file:
        assert [float(row["pois"]) for row in csv.DictReader(file) if row["leader"] == "0"] == list(scores.observed)
    other = rollout(config, run.policies[0], episodes=30, seed=6, jitter=2)
    assert not np.array_equal(scores.observed, other.observed)
    with pytest.raises(ValueError, match="episodes"):
        rollout(config, run.policies[0], jitter=2)


ACTIONS = ("direct", "behaviours")


@pytest.mark.parametrize("seed", range(12))
def test_a_trace_agrees_with_forward_and_with_the_world(seed):
    hidden = [[10], [], [7, 5], [1, 2, 3]][seed % 4]
    config = random_config(seed).replace(policy={"hidden": hidden, "actions": ACTIONS[seed // 8]})
    policies = random_policies(config, 9, seed)
    trace = rollout(config, policies, trace=True).trace
    agents = len(config["world.leaders"]) + len(config["world.followers"])
    steps, pois = config["world.steps"], len(config["world.pois"])
    assert trace.positions.shape == trace.headings.shape == (9, steps + 1, agents, 2)
    assert trace.speeds.shape == (9, steps + 1, agents)
    assert trace.inputs.shape == (9, steps, config.num_learners, 8)
    assert trace.outputs.shape == (9, steps, config.num_learners, 2)
    assert trace.agents_at_poi.shape == (9, steps, pois, agents) and trace.agents_at_poi.dtype == np.bool_
    # Policies [teams, 1, leaders, parameters] and inputs [teams, steps, leaders, 8] are broadcast.
    answers = forward(policies.transpose(1, 0, 2)[:, None], trace.inputs, config)
    assert np.array_equal(answers.view(np.uint32), trace.outputs.view(np.uint32))
    assert config["policy.actions"] == "direct" or set(np.unique(answers[..., 1])) <= {-1, 1}
    # Compare agents_at_poi with distances. Distances close to the radius are left out, because these are rounded.
    pois = np.asarray(config["world.pois"])[None, None, :, None]
    distance = np.linalg.norm(trace.positions[:, 1:, None] - pois, axis=-1)
    radius = config["world.observation_radius"]
    clear = np.abs(distance - radius) > 1e-3
    assert np.array_equal((distance < radius)[clear], trace.agents_at_poi[clear])
    observed = (trace.agents_at_poi.sum(-1) >= np.asarray(config["world.coupling"])).any(1).sum(1)
    assert np.array_equal(observed, rollout(config, policies).observed)


def test_one_policy_is_used_for_every_leader(config):
    shared = random_policies(config, 5, leaders=1)
    once, repeated = rollout(config, shared), rollout(config, np.repeat(shared, 4, axis=0))
    for name in ("observed", "g", "d", "df", "dpp"):
        assert np.array_equal(getattr(once, name), getattr(repeated, name))


def test_training_with_a_shared_policy(config, program):
    config = config.replace(learning={"sharing": "all"})
    run = train(config, out="run")
    assert [trial.shape for trial in run.policies] == [(1, 20, 112)] * 2
    assert rollout(config, run.policies[0]).g[0] == run.metrics["champion_g"][0, -1]
    train(config).save("saved")
    assert flotilla.Run.open("saved").digest == run.digest


def test_arrays_of_other_types_and_orders_are_converted(config):
    policies = random_policies(config, 5)
    expected = rollout(config, policies).d
    converted = (policies.astype(np.float64), np.asfortranarray(policies), policies.tolist(), policies.astype(">f4"))
    for other in (*converted, np.repeat(policies, 2, axis=1)[:, ::2]):
        assert np.array_equal(rollout(config, other).d, expected)
    assert rollout(config, policies, backend="cpu").d.flags.writeable


@pytest.mark.parametrize(
    "change, error, message",
    [
        (lambda p: p[:3], ValueError, r"policies are \[3, 5, 112\], allowed is \[leaders, teams, parameters\] = \[4, "),
        (lambda p: p[:, :, 1:], ValueError, r"\[4, 5, 111\]"),
        (lambda p: p[:, :0], ValueError, r"\[4, 0, 112\]"),
        (lambda p: p[0], ValueError, r"allowed are 3 axes: \[leaders, teams, parameters\]"),
        (lambda p: p * np.nan, ValueError, "weight 0 of the policy of leader 0 in team 0 is NaN"),
        (lambda p: np.where(p == p[2, 3, 4], np.inf, p), ValueError, "weight 4 of the policy of leader 2 in team 3 is inf"),
        (lambda p: p.astype(complex), TypeError, "policies are complex128"),
        (lambda p: p > 0, TypeError, "policies are bool"),
        (lambda p: p.astype(object), TypeError, "policies are object"),
        (lambda p: "policies", TypeError, "policies are <U8"),
        (lambda p: [[1], [1, 2]], ValueError, "policies are not an array"),
        (lambda p: None, TypeError, "policies are object"),
    ],
)
def test_invalid_policies_raise_a_one_line_error(config, change, error, message):
    with pytest.raises(error, match=message) as raised:
        rollout(config, change(random_policies(config, 5)))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("call", ["rollout(c, p)", "rollout(c, p, trace=True)", "flotilla.collect(c, p)"])
def test_policies_of_no_teams_raise(config, call):
    none = random_policies(config, 0)
    with pytest.raises(ValueError, match=r"policies are \[4, 0, 112\]: no teams; pass"):
        eval(call, {"rollout": rollout, "flotilla": flotilla, "c": config, "p": none})


@pytest.mark.parametrize("hidden", [[64, 64, 64], [64], [3, 1], []])
@pytest.mark.parametrize("actions", ACTIONS)
def test_forward_is_exact_for_any_network(hidden, actions):
    config = Config.paper("chaotic").replace(policy={"hidden": hidden, "actions": actions}, world={"steps": 20})
    policies = random_policies(config, 37, len(hidden))
    trace = rollout(config, policies, record=("inputs", "outputs")).trace
    answers = forward(policies.transpose(1, 0, 2)[:, None], trace.inputs, config)
    assert np.array_equal(answers.view(np.uint32), trace.outputs.view(np.uint32))
    # One policy with many inputs, and many policies with one input.
    one = forward(policies[2, 5], trace.inputs[5, :, 2], config)
    assert np.array_equal(one, trace.outputs[5, :, 2])
    first = forward(policies[:, :, :], trace.inputs[0, 0, 0], config)
    assert first.shape == (4, 37, 2) and np.array_equal(first[0, 0], trace.outputs[0, 0, 0])


@pytest.mark.parametrize("seed", range(10))
def test_traces_change_no_score_and_have_the_requested_parts(seed):
    config = random_config(seed)
    policies = random_policies(config, 300, seed)
    plain, traced = rollout(config, policies), rollout(config, policies, trace=True)
    for name in ("G", "D", "Df", "D++"):
        assert np.array_equal(plain[name], traced[name]), name
    assert (plain.dt is None) == (traced.dt is None) and (plain.dt is None or np.array_equal(plain.dt, traced.dt))
    drawn = {"episodes": 3, "seed": 2, "jitter": 1.0, "poi_jitter": 2.0}
    plain, traced = rollout(config, policies, **drawn), rollout(config, policies, **drawn, trace=True)
    assert np.array_equal(plain.df, traced.df)
    # With several episodes, the trace is that of the first.
    first = rollout(config, policies, **{**drawn, "episodes": 1}, trace=True)
    for name in flotilla._play.FIELDS:
        whole = getattr(traced.trace, name)
        assert np.array_equal(whole, getattr(first.trace, name))
        part = rollout(config, policies, **{**drawn, "episodes": 1}, record=(name,)).trace
        assert np.array_equal(whole, getattr(part, name))
        assert sum(value is not None for value in vars(part).values()) == 1
        out = np.empty_like(whole)
        trace = rollout(config, policies, **{**drawn, "episodes": 1}, out={name: out}).trace
        assert getattr(trace, name) is out and np.array_equal(out, whole)


def test_results_do_not_depend_on_the_size_of_blocks(config, monkeypatch):
    policies = random_policies(config, 70)
    whole, batch = rollout(config, policies, trace=True), flotilla.collect(config, policies, episodes=5, jitter=1.0)
    monkeypatch.setattr(flotilla._play, "FIRST_BLOCK", 1)
    parts, other = rollout(config, policies, trace=True), flotilla.collect(config, policies, episodes=5, jitter=1.0)
    for name, value in vars(whole.trace).items():
        assert np.array_equal(value, getattr(parts.trace, name)), name
    assert np.array_equal(whole.g, parts.g) and np.array_equal(whole.df, parts.df)
    for name, value in vars(batch).items():
        assert np.array_equal(value, getattr(other, name)), name


def test_invalid_records_and_outputs_raise(config):
    policies = random_policies(config, 5)
    with pytest.raises(ValueError, match="record 'place'"):
        rollout(config, policies, record=("place",))
    for given in ({"record": ("place",)}, {"out": {"place": np.empty(1)}}):
        with pytest.raises(ValueError, match="record 'place'"):
            rollout(config, policies, trace=True, **given)
    for wrong in (np.empty((5, 26, 12, 1), np.float32), np.empty((5, 26, 12, 2)), [1, 2]):
        with pytest.raises(ValueError, match="positions"):
            rollout(config, policies, out={"positions": wrong})
    with pytest.raises(KeyError, match="Dt: no such score; did you mean D"):
        rollout(config, policies)["Dt"]


def test_episodes_without_jitter_warn_in_the_caller_s_file(config):
    with pytest.warns(UserWarning, match="without jitter") as warned:
        rollout(config, random_policies(config, 2), episodes=3)
    assert warned[0].filename == __file__


@pytest.mark.parametrize("drawn", [{}, {"episodes": 2, "seed": 3, "jitter": 1.0, "poi_jitter": 2.0}])
@pytest.mark.parametrize("seed", range(4))
def test_distances_are_those_between_positions(seed, drawn):
    config = random_config(seed)
    policies = random_policies(config, 7, seed)
    fields = ("positions", "poi_distances", "agent_distances")
    trace = rollout(config, policies, record=fields, **drawn).trace
    (agents, pois, steps), at = config._native.sizes, trace.positions[:, 1:]
    # The kernels round the POIs of a config to a grid of about a millionth of the map.
    places, close = np.asarray(config["world.pois"], np.float32), 1e-5
    if drawn:
        close, places = 0, flotilla._native.starts(config._native, 3, 1.0, 2.0, 0, 1)[0, agents:]
    apart = at[:, :, None] - places[:, None]
    assert trace.poi_distances.shape == (7, steps, pois, agents)
    between = np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1])
    assert np.abs(trace.poi_distances - between).max() <= close
    apart = at[:, :, None] - at[:, :, :, None]
    between = np.sqrt(apart[..., 0] * apart[..., 0] + apart[..., 1] * apart[..., 1])
    between[..., np.arange(agents), np.arange(agents)] = np.inf
    assert np.array_equal(trace.agent_distances, between.min(-1))
    # They need no positions that are returned.
    alone = rollout(config, policies, record=fields[1:], **drawn).trace
    assert alone.positions is None and np.array_equal(alone.poi_distances, trace.poi_distances)


def test_spread_gives_each_episode_and_the_program_s_interval(config, program):
    run = train(config, out="run")
    scores = rollout(config, run.policies[0], episodes=40, seed=5, jitter=2, spread=True)
    assert scores.episodes.shape == (40, 20) and np.allclose(scores.episodes.mean(0), scores.g, atol=1e-12)
    assert np.allclose(scores.episodes.std(0, ddof=1), scores.deviation, atol=1e-12)
    arguments = ("run/config.toml", "--policies", "run/policies.safetensors", "--json")
    best = json.loads(program("rollout", *arguments, "--episodes", "40", "--seed", "5", "--start-jitter", "2"))["best"]
    assert np.allclose(scores.interval[best["team"]] * 4, best["interval_95"], atol=1e-12)
    # A rollout of one episode gives the G of the first of 40.
    first = rollout(config, run.policies[0], episodes=1, seed=5, jitter=2)
    assert np.array_equal(first.g, scores.episodes[0])


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
@pytest.mark.parametrize("call", ["rollout(c, p, episodes=1_000_000, jitter=1)", "rollout(c, p, record=('speeds',))"])
def test_ctrl_c_stops_a_rollout_within_seconds(call):
    code = f"""
import numpy as np, os, signal, threading, time
from flotilla import Config, rollout
c = Config.paper().replace(world={{"steps": 2000}})
p = np.zeros((1, 20_000, c.parameters), np.float32)
rollout(c, p[:, :1])
def stop():
    global asked
    time.sleep(2)
    asked = time.perf_counter()
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=stop, daemon=True).start()
try:
    {call}
    print(-1)
except KeyboardInterrupt:
    print(time.perf_counter() - asked)
"""
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    seconds = float(finished.stdout)
    # It takes a second on an idle machine. A busy one gets five.
    assert 0 <= seconds < 5, finished


@pytest.mark.parametrize("reward", flotilla._native.FITNESSES)
@pytest.mark.parametrize("seed", range(4))
def test_collect_equals_the_steps_of_an_environment(reward, seed):
    config = random_config(seed)
    policies = random_policies(config, 5, seed)
    batch = flotilla.collect(config, policies, noise=0.5, seed=3, episodes=2, jitter=1.0, poi_jitter=1.0, reward=reward)
    by_row = np.tile(policies.transpose(1, 0, 2), (2, 1, 1))[:, None]
    assert np.array_equal(batch.means, forward(by_row, batch.observations, config))
    starts = flotilla._native.starts(config._native, 3, 1.0, 1.0, 0, 2)
    env = flotilla.VectorEnv(config, 10, reward, autoreset="disabled")
    env.reset()
    env._teams.stepper.reset(None, np.repeat(starts, 5, axis=0))
    observations = env._teams.inputs()
    for step in range(config["world.steps"]):
        assert np.array_equal(observations, batch.observations[:, step])
        observations, rewards, *_ = env.step(batch.actions[:, step])
        assert np.array_equal(rewards, batch.rewards[:, step])
    assert np.array_equal(env.observed.mean(1), batch.g)
    assert batch.masks.sum() == 10 * (config["world.steps"] - 1) and not batch.masks[:, -1].any()


def test_noise_is_normal_and_drawn_from_the_seed():
    config = Config.paper()
    policies = random_policies(config, 1)
    batch = flotilla.collect(config, policies, noise=[0.5, 0.0], seed=1, episodes=2000)
    noise = batch.actions - batch.means
    assert not noise[..., 1].any()
    drawn = noise[..., 0].ravel() / 0.5
    assert abs(drawn.mean()) < 0.01 and abs(drawn.std() - 1) < 0.01
    assert abs((np.abs(drawn) < 1).mean() - 0.6827) < 0.005
    # Neighbours along each axis are uncorrelated.
    for axis in range(3):
        turns = np.swapaxes(noise[..., 0], 0, axis)
        assert abs(np.corrcoef(turns[1:].ravel(), turns[:-1].ravel())[0, 1]) < 0.01
    again = flotilla.collect(config, policies, noise=[0.5, 0.0], seed=1, episodes=300)
    assert np.array_equal(again.actions, batch.actions[:300])
    other = flotilla.collect(config, policies, noise=[0.5, 0.0], seed=2, episodes=300)
    assert not np.array_equal(other.actions, again.actions)
    for wrong in (-1, np.nan, [1, 2, 3], np.ones((3, 2))):
        with pytest.raises(ValueError, match="noise"):
            flotilla.collect(config, policies, noise=wrong)


def test_forward_agrees_with_numpy():
    rng = np.random.default_rng(1)
    policy, inputs = rng.normal(size=112), rng.normal(size=8)
    hidden = np.tanh([*inputs, 1] @ policy[:90].reshape(9, 10))
    assert np.allclose(forward(policy, inputs), np.tanh([*hidden, 1] @ policy[90:].reshape(11, 2)), atol=1e-7)
    assert forward(np.zeros((3, 1, 18)), np.zeros((5, 8))).shape == (3, 5, 2)
    with pytest.raises(ValueError, match="pass config="):
        forward(np.zeros(113), inputs)
    with pytest.raises(ValueError, match=r"inputs have the shape \(7,\)"):
        forward(policy, inputs[:7])


def test_an_onnx_export_gives_the_same_answers(tmp_path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    config = Config.paper().replace(policy={"hidden": [7, 5]})
    policy = random_policies(config, 1)[0, 0]
    flotilla.to_onnx(policy, "policy.onnx", config)
    inputs = np.random.default_rng(2).random((50, 8), np.float32)
    answers = runtime.InferenceSession("policy.onnx").run(None, {"inputs": inputs})[0]
    assert np.abs(answers - forward(policy, inputs, config)).max() < 5e-6
