"""Tests configs with classes of agents and groups of POIs: two classes that learn, one with a rule, and POIs with values."""

import copy
import pickle

import numpy as np
import pytest
from conftest import random_policies

import flotilla
from flotilla import Config, VectorEnv, forward, rollout

# Rovers have 8 inputs and drones 3, of which those without a POI are below 0.
TEXT = """
[world]
map = [40, 40]
steps = 30

[[agents]]
name = "rover"
at = [[10, 10], [14, 10], [18, 10]]
senses = [{ of = "pois", sectors = 4 }, { of = ["drone", "sheep"], sectors = 4, range = 15, measure = "inverse" }]
leads = "sheep"
influence_radius = 6

[[agents]]
name = "drone"
at = [[30, 12], [30, 16]]
motion = { kind = "free", max_speed = 2 }
senses = [{ of = "pois", sectors = 3, frame = "map", range = 12, measure = "closeness", combine = "closest", empty = -1 }]

[[agents]]
name = "sheep"
at = [[12, 13], [15, 13], [17, 13], [19, 12]]
control = "follow"
rule = [{ of = "sheep", to = 1, gain = -1 }, { of = "rover", to = 6, gain = 2 }]

[[pois]]
name = "pen"
at = [[13, 19], [20, 19]]
value = 2
coupling = 2
radius = 5
observers = ["rover", "sheep"]

[[pois]]
name = "tower"
at = [[31, 20], [25, 12], [5, 25]]
value = 0.5
coupling = 1
radius = 4

[policy]
hidden = [6]

[learning]
population = 8
generations = 2
trials = 2
fitness = "D"
"""
CONFIG = Config.parse(TEXT)
VALUES = np.array([2, 2, 0.5, 0.5, 0.5])


def test_a_config_with_classes_is_read_written_and_copied():
    with open("herd.toml", "w") as file:
        file.write(TEXT)
    assert Config.load("herd.toml") == CONFIG == Config.parse(CONFIG.to_toml())
    assert pickle.loads(pickle.dumps(CONFIG)) == copy.deepcopy(CONFIG) == CONFIG
    assert (CONFIG.num_inputs, CONFIG.num_learners, CONFIG.parameters) == (8, 5, 9 * 6 + 7 * 2)
    assert CONFIG.replace(world={"steps": 3})["world.steps"] == 3
    assert repr(CONFIG).startswith("<flotilla.Config: 3 × rover, 2 × drone, 4 × sheep, 5 POIs; 5 learners by D, 8 teams")
    rover = {**CONFIG["agents"][0], "count": 4, "in": {"circle": [20, 20, 5]}}
    rover.pop("at")
    drawn = CONFIG.replace(agents=[rover, *CONFIG["agents"][1:]])
    assert repr(drawn).startswith("<flotilla.Config: 4 × rover, 2 × drone")
    assert [group["value"] for group in CONFIG["pois"]] == [2, 0.5]
    # The widest class decides.
    wide = Config.parse(TEXT.replace("sectors = 3", "sectors = 11"))
    assert wide.num_inputs == 11 and VectorEnv(wide, 2).reset()[0].shape == (2, 5, 11)


def test_observations_are_those_of_each_class_and_then_zeros():
    env = VectorEnv(CONFIG, 4, jitter=2.0)
    observations, _ = env.reset(seed=1)
    assert observations.shape == (4, 5, 8) and env.agents_at_poi.shape == (4, 5, 9)
    rng, below = np.random.default_rng(2), False
    for _ in range(29):
        rovers, drones = observations[:, :3], observations[:, 3:]
        assert rovers.min() >= 0 and (rovers != 0).any()
        assert not drones[..., 3:].any() and drones[..., :3].min() >= -1 and drones[..., :3].max() <= 1
        below |= bool((drones == -1).any()) and bool((drones > 0).any())
        observations = env.step(rng.uniform(-1, 1, (4, 5, 2)))[0]
    assert below, "a drone has never had a sector with a POI and one without"


def test_a_drone_senses_its_closest_poi_by_sectors_of_the_map():
    observations, _ = VectorEnv(CONFIG, 1).reset()
    places, drone = np.array([place for group in CONFIG["pois"] for place in group["at"]]), np.array([30, 12])
    away = places - drone
    distances, sectors = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi) // (2 * np.pi / 3)
    expected = [-1.0] * 3
    for distance, sector, value in zip(distances, sectors, VALUES):
        if distance <= 12:
            expected[int(sector)] = max(expected[int(sector)], value * (1 - distance / 12))
    assert max(expected) > 0 > min(expected) and np.allclose(observations[0, 3, :3], expected, atol=1e-5)


@pytest.mark.parametrize("text, least", [(TEXT, -np.inf), (TEXT.replace("empty = -1", "empty = 1"), 0)])
def test_spaces_hold_every_observation(text, least):
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    config = Config.parse(text)
    for layout, shape in (("leaders", (3, 5, 9)), ("flat", (15, 9))):
        env = VectorEnv(config, 3, layout=layout, time_input=True)
        assert env.observation_space.shape == shape and env.single_observation_space.shape == shape[1:]
        assert (env.observation_space.low == least).all() and (env.observation_space.high == np.inf).all()
        assert (env.single_observation_space.low == least).all()
        assert env.reset()[0] in env.observation_space
    single = flotilla.team_env(config)
    assert single.reset()[0] in single.observation_space
    assert (Config.paper()._native.least_input, Config.paper().num_inputs) == (0, 8)


def test_the_parallel_environment_has_the_same_observations():
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    from pettingzoo.test import parallel_api_test

    env, many = flotilla.parallel_env(CONFIG), VectorEnv(CONFIG, 1)
    observations, _ = env.reset()
    assert np.array_equal(np.stack([observations[agent] for agent in env.agents]), many.reset()[0][0])
    for agent in env.agents:
        space = env.observation_space(agent)
        assert space.shape == (8,) and (space.low == -np.inf).all() and observations[agent] in space
    parallel_api_test(env, num_cycles=100)


# With 1020 sheep, teams are large and step one by one.
@pytest.mark.parametrize("sheep", [4, 1020])
@pytest.mark.parametrize("reward", flotilla._native.FITNESSES)
def test_steps_give_the_bits_of_a_rollout(reward, sheep):
    flock = [[12, 13], [15, 13], [17, 13], [19, 12]] + [[6 + index % 29, 14 + index // 29 % 24] for index in range(sheep - 4)]
    config = Config.parse(TEXT.replace("[[12, 13], [15, 13], [17, 13], [19, 12]]", str(flock)))
    config = config.replace(learning={"fitness": reward})
    policies = random_policies(config, 40, 3)
    scores = rollout(config, policies, trace=True)
    trace = scores.trace
    env = VectorEnv(config, 40, reward, autoreset="same_step")
    observations, _ = env.reset()
    total = np.zeros((40, 5))
    for step in range(30):
        assert np.array_equal(observations.view(np.uint32), trace.inputs[:, step].view(np.uint32)), step
        answers = forward(policies.transpose(1, 0, 2), observations, config)
        assert np.array_equal(answers.view(np.uint32), trace.outputs[:, step].view(np.uint32)), step
        observations, rewards, _, truncated, infos = env.step(answers)
        total += rewards
        if step < 29:
            assert np.array_equal(env.agents_at_poi, trace.agents_at_poi[:, step])
            assert np.array_equal(env.states[0].view(np.uint32), trace.positions[:, step + 1].view(np.uint32))
    assert truncated.all()
    observed = infos["final_info"]["observed"]
    # G is the share of the value of all POIs, and some teams observe POIs of each value.
    g = observed @ VALUES / VALUES.sum()
    assert observed[:, :2].any() and observed[:, 2:].any() and (sheep > 4 or len(set(g)) > 3)
    assert np.allclose(scores.g, g, atol=1e-12) and np.array_equal(infos["final_info"]["g"], scores.g)
    assert np.allclose(scores.observed, g * 5, atol=1e-12)
    if reward == "G":
        assert np.allclose(total, g[:, None], atol=1e-6)
    else:
        assert np.array_equal(rewards.view(np.uint32), scores[reward].view(np.uint32))


def test_held_out_starts_and_collected_episodes_weigh_pois_by_value():
    policies = random_policies(CONFIG, 6, 4)
    scores = rollout(CONFIG, policies, episodes=20, seed=3, jitter=2.0, spread=True)
    assert scores.episodes.max() <= 1 and len(np.unique(scores.episodes)) > 3
    assert np.allclose(scores.episodes.mean(0), scores.g, atol=1e-12)
    assert np.allclose(scores.episodes.std(0, ddof=1), scores.deviation, atol=1e-12)
    batch = flotilla.collect(CONFIG, policies, noise=0.0, seed=3, episodes=20, jitter=2.0)
    assert batch.observations.shape == (120, 30, 5, 8) and not batch.observations[:, :, 3:, 3:].any()
    assert np.array_equal(batch.g.reshape(20, 6), scores.episodes)
    assert np.allclose(batch.rewards[..., 0].sum(1), batch.g, atol=1e-6)


def test_two_generations_are_trained_and_their_champion_replayed():
    run = flotilla.train(CONFIG, seed=5)
    assert run.metrics["best_g"].shape == (2, 3) and 0 < run.metrics["best_g"].max() <= 1
    assert flotilla.train(CONFIG, seed=5).digest == run.digest
    coevolution = flotilla.Coevolution(CONFIG, seed=5)
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
    assert coevolution.run.digest == run.digest
    for trial in range(2):
        scores = rollout(run.config, run.policies[trial])
        assert scores.g[0] == run.metrics["champion_g"][trial, -1]
    [episode] = run.replay(trial=1).episodes
    assert episode.best_g == run.metrics["champion_g"][1, -1]
    flotilla.replay(CONFIG, random_policies(CONFIG, 2), 1).save("herd.gif", width=200)
    assert VectorEnv(CONFIG, 2, render_mode="rgb_array").render()[0].shape == (480, 480, 3)


def test_inputs_of_another_width_are_refused():
    wide = Config.parse(TEXT.replace("sectors = 3", "sectors = 11"))
    policy = random_policies(wide, 1)[0, 0]
    assert forward(policy, np.zeros((7, 11)), wide).shape == (7, 2)
    with pytest.raises(ValueError, match=r"inputs have the shape \(7, 8\), allowed is \[..., 11\]"):
        forward(policy, np.zeros((7, 8)), wide)
    with pytest.raises(ValueError, match="out is .*allowed is"):
        VectorEnv(wide, 2)._teams.inputs(np.zeros((2, 5, 8), np.float32))


LED = """
[world]
map = [20, 20]
steps = 2
start_counts = true

[[agents]]
name = "rover"
at = [[10, 10]]
senses = [{ of = "uav", range = 5 }]

[[agents]]
name = "uav"
at = [[10, 11]]
senses = [{ of = "pois" }]
observes = false
leads = "rover"
influence_radius = 3
fitness = "Dt"

[[pois]]
name = "poi"
at = [[10, 15], [3, 3]]
value = 3
coupling = 1
radius = 4
score = "closeness"

[learning]
fitness = "D"
trials = 2
generations = 2
population = 4

[credit]
led_by = "alone"
"""


def test_paths_are_scored_by_distance():
    config = Config.parse(LED)
    # The rover comes within 2 of the first POI, while the UAV is near; or while it is far away.
    near = [[[10, 10], [10, 11]], [[10, 12], [10, 12]], [[10, 13], [10, 12]]]
    far = [[[10, 10], [10, 11]], [[10, 12], [1, 1]], [[10, 13], [1, 1]]]
    scores = flotilla.score(config, [near, far])
    assert scores.value.tolist() == [1.5, 1.5] and scores.g.tolist() == [0.25, 0.25]
    assert scores.d.tolist() == [[0.25, 0], [0.25, 0]] and scores["Dt"].tolist() == [[0.25, 0.25], [0.25, 0]]
    assert scores.fitness.tolist() == scores.dt.tolist()
    added = flotilla.score(config.replace(credit={"add_g": True}), [near]).fitness
    assert added.tolist() == [[0.5, 0.5]]
    with pytest.raises(ValueError, match=r"positions are \[2, 2, 2, 2\], allowed is .* = \['1 or more', 3, 2, 2\]"):
        flotilla.score(config, np.zeros((2, 2, 2, 2)))
    with pytest.raises(ValueError, match="agent 1 of team 0 is at inf after step 2"):
        flotilla.score(config, np.where(np.arange(12).reshape(1, 3, 2, 2) == 10, np.inf, 1.0))


def test_environments_reward_closeness_at_the_end():
    config = Config.parse(LED)
    env = VectorEnv(config, 3)
    env.reset(seed=0)
    rewards = [env.step(np.ones((3, 2, 2), np.float32))[1] for _ in range(2)]
    assert not rewards[0].any() and np.allclose(rewards[1], env._teams.g[:, None])
    policies = random_policies(config, 3)
    trace = rollout(config, policies, record=("positions",))
    assert np.array_equal(trace.g, flotilla.score(config, trace.trace.positions).g)
    assert flotilla.train(config).metrics["best_g"].shape == (2, 3)


def test_starts_and_pois_in_regions_are_drawn_for_every_episode():
    text = TEXT.replace("at = [[30, 12], [30, 16]]", "count = 2\nin = { disc = [30, 14, 6] }")
    text = text.replace("at = [[31, 20], [25, 12], [5, 25]]", "count = 3\nin = { circle = [20, 20, 15] }")
    config = Config.parse(text).replace(learning={"test_episodes": 3})
    assert config["agents"][1]["in"] == {"disc": [30, 14, 6]} and config.num_learners == 5
    env = VectorEnv(config, 4)
    first, second, again = env.reset(seed=1)[0], env.reset()[0], env.reset(seed=1)[0]
    assert np.array_equal(first, again) and not np.array_equal(first, second)
    # The teams of one environment start apart, too.
    assert not np.array_equal(first[0], first[1])
    policies = random_policies(config, 6)
    assert np.array_equal(rollout(config, policies).g, rollout(config, policies, episodes=1).g)
    assert rollout(config, policies, episodes=9, spread=True).episodes.shape == (9, 6)
    run = flotilla.train(config, seed=5)
    assert run.metrics["test_g"].shape == (2, 3) and (run.metrics["test_g"] <= 1).all()
    run.save("run")
    assert np.array_equal(flotilla.Run.open("run").metrics["test_g"], run.metrics["test_g"])
    assert "test_g" not in flotilla.train(CONFIG).metrics


@pytest.mark.parametrize("reward", ["Dt", "G"])
def test_rewards_do_not_depend_on_the_fitness_of_classes(reward):
    own = TEXT.replace('name = "rover"', 'name = "rover"\nfitness = "D"').replace('name = "drone"', 'name = "drone"\nfitness = "Df"')
    plain, own = Config.parse(TEXT), Config.parse(own)
    policies = random_policies(plain, 3)
    expected, found = (flotilla.collect(config, policies, noise=0.1, episodes=2, reward=reward) for config in (plain, own))
    assert np.array_equal(expected.rewards, found.rewards) and np.isfinite(found.rewards).all()
    env = VectorEnv(own, 2, reward=reward)
    env.reset(seed=0)
    for _ in range(30):
        rewards = env.step(np.ones(env.action_space.shape, np.float32))[1]
    assert np.isfinite(rewards).all()
