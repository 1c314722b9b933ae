import csv

import numpy as np
import pytest
from conftest import random_config, random_policies

import flotilla
from flotilla import Config, forward, rollout, train


def test_scores_are_the_program_s(config, program, tmp_path):
    run = train(config, out="run")
    program("rollout", "run/config.toml", "--policies", "run/policies.safetensors", "--scores", "scores.csv", "--trial", "1")
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


def test_drawn_starts_are_the_program_s(config, program):
    run = train(config, out="run")
    words = ("run/config.toml", "--policies", "run/policies.safetensors", "--scores", "scores.csv")
    program("rollout", *words, "--episodes", "30", "--seed", "5", "--start-jitter", "2")
    scores = rollout(config, run.policies[0], episodes=30, seed=5, jitter=2)
    with open("scores.csv") as file:
        assert [float(row["pois"]) for row in csv.DictReader(file) if row["leader"] == "0"] == list(scores.observed)
    other = rollout(config, run.policies[0], episodes=30, seed=6, jitter=2)
    assert not np.array_equal(scores.observed, other.observed)
    with pytest.raises(ValueError, match="episodes"):
        rollout(config, run.policies[0], jitter=2)


ACTIONS = ("direct", "behaviours")


@pytest.mark.parametrize("seed", range(12))
def test_a_trace_is_what_policies_answered(seed):
    config = random_config(seed).replace(policy={"hidden": [[10], [], [7, 5], [1, 2, 3]][seed % 4], "actions": ACTIONS[seed // 8]})
    policies = random_policies(config, 9, seed)
    if config["policy.actions"] == "behaviours":
        # Answers so large that tanh is 1 of several would leave open which of them is wanted most.
        policies *= np.float32(0.2)
    trace = rollout(config, policies, trace=True).trace
    agents = len(config["world.leaders"]) + len(config["world.followers"])
    steps, pois = config["world.steps"], len(config["world.pois"])
    assert trace.positions.shape == trace.headings.shape == (9, steps + 1, agents, 2)
    assert trace.speeds.shape == (9, steps + 1, agents)
    assert trace.inputs.shape == (9, steps, config.leaders, 8) and trace.outputs.shape == (9, steps, config.leaders, 2)
    assert trace.near.shape == (9, steps, pois, agents) and trace.near.dtype == np.bool_
    # [teams, 1, leaders, parameters] against [teams, steps, leaders, 8]
    answers = forward(policies.transpose(1, 0, 2)[:, None], trace.inputs, config)
    assert np.abs(answers - trace.outputs).max() < 5e-6
    assert config["policy.actions"] == "direct" or set(np.unique(answers[..., 1])) <= {-1, 1}
    # Who is near is near.
    place = np.asarray(config["world.pois"])[None, None, :, None]
    distance = np.linalg.norm(trace.positions[:, 1:, None] - place, axis=-1)
    radius = config["world.observation_radius"]
    clear = np.abs(distance - radius) > 1e-3
    assert np.array_equal((distance < radius)[clear], trace.near[clear])
    observed = (trace.near.sum(-1) >= np.asarray(config["world.coupling"])).any(1).sum(1)
    assert np.array_equal(observed, rollout(config, policies).observed)


def test_a_shared_policy_is_every_leader_s(config):
    shared = random_policies(config, 5, leaders=1)
    one, all_ = rollout(config, shared), rollout(config, np.repeat(shared, 4, axis=0))
    for name in ("observed", "g", "d", "df", "dpp"):
        assert np.array_equal(getattr(one, name), getattr(all_, name))


def test_leaders_may_share_a_policy(config, program):
    config = config.replace(learning={"sharing": "all"})
    run = train(config, out="run")
    assert [trial.shape for trial in run.policies] == [(1, 20, 112)] * 2
    assert rollout(config, run.policies[0]).g[0] == run.metrics["champion_g"][0, -1]
    train(config).save("saved")
    assert flotilla.Run.open("saved").digest == run.digest


def test_other_arrays_are_converted(config):
    policies = random_policies(config, 5)
    expected = rollout(config, policies).d
    shapes = (policies.astype(np.float64), np.asfortranarray(policies), policies.tolist(), policies.astype(">f4"))
    for other in (*shapes, np.repeat(policies, 2, axis=1)[:, ::2]):
        assert np.array_equal(rollout(config, other).d, expected)
    assert rollout(config, policies, backend="cpu").d.flags.writeable


@pytest.mark.parametrize(
    "change, error, says",
    [
        (lambda p: p[:3], ValueError, r"policies are \[3, 5, 112\], allowed is \[leaders, teams, parameters\] = \[4, "),
        (lambda p: p[:, :, 1:], ValueError, r"\[4, 5, 111\]"),
        (lambda p: p[:, :0], ValueError, r"\[4, 0, 112\]"),
        (lambda p: p[0], ValueError, "3 axes"),
        (lambda p: p * np.nan, ValueError, "weight 0 of the policy of leader 0 in team 0 is NaN"),
        (lambda p: np.where(p == p[2, 3, 4], np.inf, p), ValueError, "weight 4 of the policy of leader 2 in team 3 is inf"),
        (lambda p: p.astype(complex), TypeError, "policies are complex128"),
        (lambda p: p > 0, TypeError, "policies are bool"),
        (lambda p: p.astype(object), TypeError, "policies are object"),
        (lambda p: "policies", TypeError, "policies are <U8"),
        (lambda p: [[1], [1, 2]], ValueError, "policies are no array"),
        (lambda p: None, TypeError, "policies are object"),
    ],
)
def test_wrong_policies_are_one_sentence(config, change, error, says):
    with pytest.raises(error, match=says) as found:
        rollout(config, change(random_policies(config, 5)))
    assert "\n" not in str(found.value)


def test_the_network_in_numpy():
    rng = np.random.default_rng(1)
    policy, inputs = rng.normal(size=112), rng.normal(size=8)
    hidden = np.tanh([*inputs, 1] @ policy[:90].reshape(9, 10))
    assert np.allclose(forward(policy, inputs), np.tanh([*hidden, 1] @ policy[90:].reshape(11, 2)), atol=1e-7)
    assert forward(np.zeros((3, 1, 18)), np.zeros((5, 8))).shape == (3, 5, 2)
    with pytest.raises(ValueError, match="say by config"):
        forward(np.zeros(113), inputs)
    with pytest.raises(ValueError, match=r"inputs have the shape \(7,\)"):
        forward(policy, inputs[:7])


def test_onnx_answers_the_same(tmp_path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    config = Config.paper().replace(policy={"hidden": [7, 5]})
    policy = random_policies(config, 1)[0, 0]
    flotilla.to_onnx(policy, "policy.onnx", config)
    inputs = np.random.default_rng(2).random((50, 8), np.float32)
    answers = runtime.InferenceSession("policy.onnx").run(None, {"inputs": inputs})[0]
    assert np.abs(answers - forward(policy, inputs, config)).max() < 5e-6
