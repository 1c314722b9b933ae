import numpy as np
import pytest
from conftest import random_config, random_policies

import flotilla
from flotilla import Config, VectorEnv, rollout


def by_policies(env, trace, step):
    """What the policies answered at a step."""
    return np.ascontiguousarray(trace.outputs[:, step])


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("reward", ["G", "D", "Df", "D++", "Dt"])
def test_fed_with_a_policy_s_answers_it_gives_the_bits_of_a_rollout(seed, reward):
    config = random_config(seed).replace(learning={"start_jitter": 0.0, "fitness": reward})
    policies = random_policies(config, 11, seed)
    scores = rollout(config, policies, trace=True)
    trace, steps = scores.trace, config["world.steps"]
    env = VectorEnv(config, 11, reward, autoreset="disabled")
    inputs, infos = env.reset()
    total = np.zeros((11, config.leaders))
    for step in range(steps):
        assert np.array_equal(inputs.view(np.uint32), trace.inputs[:, step].view(np.uint32)), step
        inputs, rewards, terminated, truncated, infos = env.step(by_policies(env, trace, step))
        positions, headings, speeds = env.states()
        assert np.array_equal(positions.view(np.uint32), trace.positions[:, step + 1].view(np.uint32))
        assert np.array_equal(headings.view(np.uint32), trace.headings[:, step + 1].view(np.uint32))
        assert np.array_equal(speeds.view(np.uint32), trace.speeds[:, step + 1].view(np.uint32))
        assert np.array_equal(env.near(), trace.near[:, step])
        total += rewards
        assert truncated.all() == (step == steps - 1) and not terminated.any() and infos == {}
        if reward != "G" and step < steps - 1:
            assert not rewards.any()
    if reward == "G":
        assert np.allclose(total, scores.g[:, None], atol=1e-6)
    else:
        expected = {"D": scores.d, "Df": scores.df, "D++": scores.dpp, "Dt": scores.dt}[reward]
        assert np.array_equal(rewards.view(np.uint32), expected.view(np.uint32))
    assert np.array_equal(env.observed.sum(1), scores.observed)


def test_arrays_are_reused_or_copied():
    config = Config.paper()
    for copy in (False, True):
        env = VectorEnv(config, 70, copy=copy)
        first, _ = env.reset()
        addresses = {first.__array_interface__["data"][0]}
        kept, rewards = first.copy(), []
        for _ in range(60):
            found = env.step(np.ones((70, 4, 2), np.float32))
            addresses.add(found[0].__array_interface__["data"][0])
            rewards.append(found[1])
        assert (len(addresses) == 1) != copy
        assert np.array_equal(first, kept) == copy
        assert (rewards[0] is rewards[1]) != copy
    # What is shown outlives whoever shows it, and is not to be written to.
    env = VectorEnv(config, 3)
    seen, expected = env.reset()[0], env.reset()[0].copy()
    del env
    assert np.array_equal(seen, expected)
    with pytest.raises(ValueError):
        seen[0] = 1


def test_what_is_handed_out_may_be_written_to():
    env, still = VectorEnv(Config.paper(), 3, "Df", autoreset="disabled"), np.zeros((3, 4, 2))
    env.reset()
    for step in range(28):
        _, rewards, terminated, truncated, _ = env.step(still)
        assert not terminated.any() and truncated.all() == (step >= 24)
        # A team has its reward once, however often it is stepped after its end.
        assert rewards.any() == (step == 24)
        terminated |= truncated
    env = VectorEnv(Config.paper(), 3)
    first = env.reset()[0].copy()
    for _ in range(25):
        _, _, _, truncated, _ = env.step(still)
    truncated[:] = False
    assert np.array_equal(env.step(still)[0], first)


def test_autoreset_at_the_next_step():
    config = Config.paper().replace(world={"steps": 3})
    env, actions = VectorEnv(config, 5), np.ones((5, 4, 2), np.float32)
    start = env.reset()[0].copy()
    for episode in range(3):
        for step in range(3):
            inputs, rewards, _, truncated, _ = env.step(actions)
            assert truncated.all() == (step == 2) and not np.array_equal(inputs, start)
        inputs, rewards, _, truncated, _ = env.step(actions)
        assert np.array_equal(inputs, start) and not truncated.any() and not rewards.any()


def test_autoreset_at_the_same_step():
    config = Config.paper().replace(world={"steps": 3})
    env, other = VectorEnv(config, 5, autoreset="same_step"), VectorEnv(config, 5, autoreset="disabled")
    actions, start = np.ones((5, 4, 2), np.float32), env.reset()[0].copy()
    for _ in range(3):
        other.reset()
        for step in range(3):
            inputs, rewards, _, truncated, infos = env.step(actions)
            expected, worth, *_ = other.step(actions)
            assert np.array_equal(rewards, worth)
            if step == 2:
                assert truncated.all() and np.array_equal(infos["final_obs"], expected) and infos["_final_obs"].all()
                assert np.array_equal(inputs, start)
            else:
                assert np.array_equal(inputs, expected) and infos == {}


def test_some_teams_are_started_anew():
    config = Config.paper().replace(world={"steps": 4})
    actions = np.ones((6, 4, 2), np.float32)
    mask = np.array([True, False, False, True, False, True])
    for mode in ("disabled", "next_step", "same_step"):
        env, plain = VectorEnv(config, 6, autoreset=mode), VectorEnv(config, 6, autoreset="disabled")
        start = env.reset()[0].copy()
        seen = [start, *(plain.step(actions)[0].copy() for _ in range(4))]
        env.step(actions)
        env.step(actions)
        inputs, _ = env.reset(options={"reset_mask": mask})
        assert np.array_equal(inputs[mask], seen[0][mask]) and np.array_equal(inputs[~mask], seen[2][~mask])
        ages, over_before = np.where(mask, 0, 2), np.zeros(6, bool)
        for _ in range(9):
            inputs, rewards, _, truncated, _ = env.step(actions)
            if mode == "next_step":
                ages = np.where(over_before, 0, ages + 1)
            elif mode == "disabled":
                ages = np.minimum(ages + 1, 4)
            else:
                ages = ages + 1
            expected_over = ages == 4
            if mode == "same_step":
                ages = np.where(expected_over, 0, ages)
            assert np.array_equal(truncated, expected_over), (mode, ages)
            for team, age in enumerate(ages):
                assert np.array_equal(inputs[team], seen[age][team]), (mode, team, age)
            over_before = expected_over
    with pytest.raises(ValueError, match="reset_mask is float64"):
        VectorEnv(config, 6).reset(options={"reset_mask": mask * 1.0})


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("reward", ["G", "Df"])
def test_the_next_episode_starts_elsewhere_where_starts_are_drawn(mode, reward):
    config = Config.paper().replace(world={"steps": 3}, learning={"start_jitter": 3.0})
    env, by_hand = VectorEnv(config, 4, reward, autoreset=mode), VectorEnv(config, 4, autoreset="disabled")
    env.reset(seed=2)
    starts = [by_hand.reset(seed=2)[0].copy(), by_hand.reset()[0].copy(), by_hand.reset()[0].copy()]
    actions, seen = np.ones((4, 4, 2), np.float32), []
    for _ in range(8):
        inputs, rewards, _, truncated, _ = env.step(actions)
        seen.append(inputs.copy())
    places = [3, 7] if mode == "next_step" else [2, 5]
    for place, start in zip(places, starts[1:]):
        assert np.array_equal(seen[place], start)
    if mode == "next_step":
        assert not rewards.any() and not truncated.any()


def test_starts_are_drawn_from_the_seed():
    config = Config.paper().replace(learning={"start_jitter": 2.0})
    env = VectorEnv(config, 8, autoreset="disabled")
    one, two = env.reset(seed=3)[0].copy(), env.reset()[0].copy()
    assert not np.array_equal(one, two) and not np.array_equal(one[0], one[1])
    assert np.array_equal(env.reset(seed=3)[0], one) and np.array_equal(env.reset()[0], two)
    assert not np.array_equal(env.reset(seed=4)[0], one)
    still = VectorEnv(Config.paper(), 8)
    assert np.array_equal(still.reset(seed=3)[0].copy(), still.reset(seed=4)[0])


@pytest.mark.parametrize(
    "actions, error, says",
    [
        (np.zeros((5, 4, 3)), ValueError, r"actions are \[5, 4, 3\], allowed is \[teams, leaders, 2\] = \[5, 4, 2\]"),
        (np.zeros((4, 4, 2)), ValueError, r"actions are \[4, 4, 2\]"),
        (np.zeros((5, 8)), ValueError, "3 axes"),
        (np.full((5, 4, 2), np.nan), ValueError, "the turn of leader 0 in team 0 is NaN"),
        (np.full((5, 4, 2), np.inf), ValueError, "is inf"),
        (np.zeros((5, 4, 2), complex), TypeError, "complex128"),
        (None, TypeError, "object"),
        ("ahead", TypeError, "<U5"),
    ],
)
def test_wrong_actions_are_one_sentence_and_move_nobody(actions, error, says):
    env = VectorEnv(Config.paper(), 5)
    before = env.reset()[0].copy()
    with pytest.raises(error, match=says) as found:
        env.step(actions)
    assert "\n" not in str(found.value) and np.array_equal(env._teams.inputs, before)


@pytest.mark.parametrize(
    "words, says",
    [
        ({"num_envs": 0}, "the number of teams is 0, allowed is 1 to 1048576"),
        ({"num_envs": 1 << 21}, "allowed is 1 to 1048576"),
        ({"reward": "E"}, "reward 'E', allowed are G, D, Df"),
        ({"autoreset": "later"}, "autoreset 'later'"),
        ({"render_mode": "human"}, "render_mode 'human'"),
    ],
)
def test_wrong_words_are_told(words, says):
    with pytest.raises(ValueError, match=says):
        VectorEnv(Config.paper(), **{"num_envs": 2, **words})


def test_it_is_declared_as_gymnasium_asks():
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    modes = gymnasium.vector.AutoresetMode
    for word, mode in (("next_step", modes.NEXT_STEP), ("same_step", modes.SAME_STEP), ("disabled", modes.DISABLED)):
        assert VectorEnv(Config.paper(), 2, autoreset=word).metadata["autoreset_mode"] is mode
    env = VectorEnv(Config.paper(), 7)
    inputs, _ = env.reset(seed=1)
    assert env.observation_space.contains(inputs) and env.action_space.shape == (7, 4, 2)
    assert env.single_observation_space.shape == (4, 8) and env.single_action_space.shape == (4, 2)
    inputs, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(inputs)


def test_a_picture_is_drawn():
    env = VectorEnv(Config.paper(), 2, render_mode="rgb_array")
    env.reset()
    first = env.render()
    env.step(np.ones((2, 4, 2), np.float32))
    second = env.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8
    assert (first != second).any() and first.std() > 5
    assert VectorEnv(Config.paper(), 2).render() is None


def test_pettingzoo_s_own_tests_pass():
    tests = pytest.importorskip("pettingzoo.test", reason="pettingzoo is not installed")
    tests.parallel_api_test(flotilla.parallel_env(Config.paper()), num_cycles=200)
    jittered = Config.paper().replace(learning={"start_jitter": 2.0})
    for config in (Config.paper(), jittered):
        tests.parallel_seed_test(lambda: flotilla.parallel_env(config))
    # Renders as it says.
    env = flotilla.parallel_env(Config.paper(), render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 480, 3)


def test_one_team_is_the_first_of_many():
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    config = random_config(3).replace(learning={"start_jitter": 0.0})
    for reward in ("G", "Df"):
        one, many = flotilla.parallel_env(config, reward=reward), VectorEnv(config, 3, reward, autoreset="disabled")
        seen, _ = one.reset(seed=1)
        inputs, _ = many.reset()
        rng = np.random.default_rng(1)
        while one.agents:
            assert one.agents == [f"leader_{leader}" for leader in range(config.leaders)]
            assert np.array_equal(np.stack(list(seen.values())), inputs[0])
            assert one.state().shape == one.state_space.shape
            actions = rng.uniform(-1, 1, (3, config.leaders, 2)).astype(np.float32)
            seen, rewards, terminated, truncated, _ = one.step(dict(zip(one.agents, actions[0])))
            inputs, expected, _, over, _ = many.step(actions)
            assert list(rewards.values()) == [float(reward) for reward in expected[0]]
            assert set(truncated.values()) == {bool(over[0])} and not any(terminated.values())
        with pytest.raises(ValueError, match="no action for leader_0"):
            one.reset()
            one.step({})
