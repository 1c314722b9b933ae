"""Tests the step environments: `VectorEnv`, `team_env` and `parallel_env`.

They have to play the same bits as `rollout`. Further tests cover arrays, resets, copies and rendering. Others pass the
environments to Gymnasium, PettingZoo, SuperSuit, JAX and PyTorch.
"""

import copy
import os
import pickle
import threading
import warnings

import numpy as np
import pytest
from conftest import random_config, random_policies

import flotilla
from flotilla import Config, VectorEnv, rollout


def actions_of(trace, step):
    """Returns the actions of the policies at a step, as [teams, leaders, 2]."""
    return np.ascontiguousarray(trace.outputs[:, step])


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("reward", flotilla._native.FITNESSES)
def test_steps_with_the_actions_of_policies_give_the_bits_of_a_rollout(seed, reward):
    config = random_config(seed).replace(learning={"start_jitter": 0.0, "poi_jitter": 0.0, "fitness": reward})
    policies = random_policies(config, 11, seed)
    scores = rollout(config, policies, trace=True)
    trace, steps = scores.trace, config["world.steps"]
    env = VectorEnv(config, 11, reward, autoreset="disabled")
    inputs, infos = env.reset()
    total = np.zeros((11, config.num_learners))
    for step in range(steps):
        assert np.array_equal(inputs.view(np.uint32), trace.inputs[:, step].view(np.uint32)), step
        inputs, rewards, terminated, truncated, infos = env.step(actions_of(trace, step))
        positions, headings, speeds = env.states
        assert np.array_equal(positions.view(np.uint32), trace.positions[:, step + 1].view(np.uint32))
        assert np.array_equal(headings.view(np.uint32), trace.headings[:, step + 1].view(np.uint32))
        assert np.array_equal(speeds.view(np.uint32), trace.speeds[:, step + 1].view(np.uint32))
        assert np.array_equal(env.agents_at_poi, trace.agents_at_poi[:, step])
        total += rewards
        assert truncated.all() == (step == steps - 1) and not terminated.any() and infos == {}
        if reward != "G" and step < steps - 1:
            assert not rewards.any()
    if reward == "G":
        assert np.allclose(total, scores.g[:, None], atol=1e-6)
    else:
        expected = scores[reward]
        assert np.array_equal(rewards.view(np.uint32), expected.view(np.uint32))
    assert np.array_equal(env.observed.sum(1), scores.observed)


# With one team, the arrays of many steps share a block of memory. With 70 teams, few do.
@pytest.mark.parametrize("teams", [1, 70])
def test_returned_arrays_are_never_overwritten(teams):
    config = Config.paper()
    env, other = VectorEnv(config, teams), VectorEnv(config, teams)
    rng = np.random.default_rng(1)
    kept, expected = [env.reset()[0]], [other.reset()[0].copy()]
    for _ in range(1000):
        actions = rng.uniform(-1, 1, (teams, 4, 2)).astype(np.float32)
        kept.extend(env.step(actions)[:2])
        expected.extend(array.copy() for array in other.step(actions)[:2])
    assert len({array.__array_interface__["data"][0] for array in kept}) == len(kept)
    for array, copied in zip(kept, expected):
        assert np.array_equal(array, copied)


@pytest.mark.parametrize("layout", ["leaders", "team", "flat"])
@pytest.mark.parametrize("time_input", [False, True])
def test_arrays_are_aligned_writable_and_reused_on_request(layout, time_input):
    options = {"layout": layout, "time_input": time_input}
    env, reusing = VectorEnv(Config.paper(), 7, **options), VectorEnv(Config.paper(), 7, copy=False, **options)
    addresses, actions = set(), np.ones(env.action_space.shape, np.float32)
    env.reset(), reusing.reset()
    for _ in range(30):
        fresh, reused = env.step(actions), reusing.step(actions)
        for array, other in zip(fresh[:2], reused[:2]):
            assert np.array_equal(array, other)
            for each in (array, other):
                assert each.flags.writeable and each.flags.c_contiguous and each.ctypes.data % 64 == 0
        addresses.add((reused[0].ctypes.data, reused[1].ctypes.data))
    assert len(addresses) == 1


def test_observations_outlive_the_environment():
    env = VectorEnv(Config.paper(), 3, copy=False)
    observations, expected = env.reset()[0], env.reset()[0].copy()
    del env
    assert np.array_equal(observations, expected)


@pytest.mark.parametrize("library", ["torch", "jax"])
@pytest.mark.parametrize("teams", [1, 70])
def test_jax_and_pytorch_read_every_observation_correctly(library, teams):
    # PyTorch takes gigabytes, so only the long form of the tests installs it.
    reason = "by request: FLOTILLA_LONG=1" if library == "torch" else "jax is not installed"
    module = pytest.importorskip(library, reason=reason)
    convert = module.from_numpy if library == "torch" else module.device_put
    env, other = VectorEnv(Config.paper(), teams), VectorEnv(Config.paper(), teams)
    env.reset(), other.reset()
    rng, kept, expected = np.random.default_rng(1), [], []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(1000):
            actions = rng.uniform(-1, 1, (teams, 4, 2)).astype(np.float32)
            kept.append(convert(env.step(actions)[0]))
            expected.append(other.step(actions)[0])
    for converted, array in zip(kept, expected):
        assert np.array_equal(np.asarray(converted), array)


def test_a_second_thread_gets_an_error():
    env = VectorEnv(Config.paper(), 20_000, "Df")
    actions = np.ones((20_000, 4, 2), np.float32)
    env.reset()
    errors, barrier = [], threading.Barrier(2)

    def step():
        barrier.wait()
        for _ in range(25):
            try:
                env.step(actions)
            except ValueError as error:
                errors.append(str(error))

    threads = [threading.Thread(target=step) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors and set(errors) == {"another thread is stepping this environment: make one environment per thread"}
    # The environment can still be used.
    assert np.array_equal(env.reset()[0], VectorEnv(Config.paper(), 20_000).reset()[0])


def test_all_layouts_play_the_same_episode():
    config, teams = Config.paper(), 6
    leaders, team, flat = (
        VectorEnv(config, teams, "Df", layout=layout, autoreset="same_step", horizon="terminated")
        for layout in ("leaders", "team", "flat")
    )
    rng = np.random.default_rng(3)
    assert np.array_equal(leaders.reset()[0], team.reset()[0])
    assert np.array_equal(leaders.reset()[0].reshape(-1, 8), flat.reset()[0])
    for step in range(60):
        actions = rng.uniform(-1, 1, (teams, 4, 2)).astype(np.float32)
        observations, rewards, ended, _, infos = leaders.step(actions)
        of_team = team.step(actions)
        assert np.array_equal(of_team[0], observations) and np.array_equal(of_team[1], rewards.mean(axis=1))
        of_flat = flat.step(actions.reshape(-1, 2))
        assert np.array_equal(of_flat[0], observations.reshape(-1, 8))
        assert np.array_equal(of_flat[1], rewards.reshape(-1))
        assert np.array_equal(of_flat[2], np.repeat(ended, 4)) and not of_flat[3].any()
        assert ended.all() == (step % 25 == 24)
        if ended.any():
            last = infos["final_info"]
            assert np.array_equal(last["g"], last["observed"].mean(axis=1)) and last["state"].shape == (teams, 64)
            assert np.array_equal(of_flat[4]["final_info"]["g"], np.repeat(last["g"], 4))
            assert np.array_equal(of_flat[4]["final_obs"], infos["final_obs"].reshape(-1, 8))
            assert not leaders.observed.any()


def test_time_input_is_the_share_of_steps_played():
    env = VectorEnv(Config.paper(), 3, time_input=True, autoreset="disabled")
    observations, _ = env.reset()
    without_time = VectorEnv(Config.paper(), 3, autoreset="disabled")
    assert np.array_equal(observations[..., :8], without_time.reset()[0])
    assert env.observation_space.shape == (3, 4, 9)
    for step in range(25):
        assert (observations[..., 8] == np.float32(step / 25)).all()
        observations = env.step(np.ones((3, 4, 2)))[0]


def test_seeded_spaces_give_the_same_samples():
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    env = VectorEnv(Config.paper(), 2)
    assert env.action_space is env.action_space
    env.action_space.seed(0)
    first = env.action_space.sample()
    env.action_space.seed(0)
    assert np.array_equal(env.action_space.sample(), first)


def test_environments_without_a_seed_differ():
    config = Config.paper().replace(learning={"start_jitter": 2.0})
    assert not np.array_equal(VectorEnv(config, 4).reset()[0], VectorEnv(config, 4).reset()[0])


def identity(value):
    return value


WRAPPERS = {
    "ClipReward": {"min_reward": 0.0, "max_reward": 0.5},
    "TransformReward": {"func": lambda reward: reward * 2},
    "VectorizeTransformReward": {"wrapper": "TransformReward", "func": identity},
    "NormalizeReward": {},
    "NormalizeObservation": {},
    "FlattenObservation": {},
    "ReshapeObservation": {},
    "RescaleAction": {"min_action": 0.0, "max_action": 1.0},
    "ClipAction": {},
    "TransformAction": {"func": identity},
    "VectorizeTransformAction": {"wrapper": "ClipAction"},
    "TransformObservation": {"func": identity},
    "VectorizeTransformObservation": {"wrapper": "FlattenObservation"},
    "DtypeObservation": {"dtype": np.float64},
    "RecordEpisodeStatistics": {},
    "DictInfoToList": {},
    "ArrayConversion": {},
    "NumpyToTorch": {},
    "RecordVideo": {"video_folder": "films", "video_length": 5, "disable_logger": True},
    "HumanRendering": {},
}
# Packages that wrappers need, and that only the long form of the tests installs.
NEEDS = {"NumpyToTorch": "torch", "RecordVideo": "moviepy", "HumanRendering": "pygame"}
# Wrappers that do not apply: they are for environments in which ...
NOT_APPLICABLE = {
    "FilterObservation": "observations are dictionaries",
    "GrayscaleObservation": "observations are pictures",
    "ResizeObservation": "observations are pictures",
    "RescaleObservation": "observations are bounded",
    "JaxToNumpy": "the environment returns JAX arrays",
    "JaxToTorch": "the environment returns JAX arrays",
}


def test_every_vector_wrapper_is_tested_or_not_applicable():
    wrappers = pytest.importorskip("gymnasium.wrappers.vector", reason="gymnasium is not installed")
    assert set(wrappers.__all__) <= {*WRAPPERS, *NOT_APPLICABLE}


@pytest.mark.parametrize("layout", ["team", "flat"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_gymnasium_s_vector_wrappers_work(layout, name, monkeypatch):
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason="by request: FLOTILLA_LONG=1")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    options = dict(WRAPPERS[name])
    if "wrapper" in options:
        options["wrapper"] = getattr(gymnasium.wrappers, options["wrapper"])
    if name == "ReshapeObservation":
        options["shape"] = (8, 4) if layout == "team" else (2, 4)
    if name == "ArrayConversion":
        pytest.importorskip("array_api_compat", reason="array-api-compat is not installed")
        options = {"env_xp": np, "target_xp": pytest.importorskip("jax.numpy", reason="jax is not installed")}
    render_mode = "rgb_array" if name in ("RecordVideo", "HumanRendering") else None
    inner = VectorEnv(Config.paper(), 5, layout=layout, autoreset="next_step", render_mode=render_mode)
    assert isinstance(inner, gymnasium.vector.VectorEnv)
    env = getattr(gymnasium.wrappers.vector, name)(inner, **options)
    observations, _ = env.reset(seed=1)
    for _ in range(30):
        actions = env.action_space.sample()
        if name == "NumpyToTorch":
            actions = pytest.importorskip("torch").from_numpy(actions)
        observations, rewards, terminated, truncated, infos = env.step(actions)
        assert len(observations) == env.num_envs
        assert rewards.shape == terminated.shape == truncated.shape == (env.num_envs,)
        if name == "RecordEpisodeStatistics" and truncated.all():
            assert (infos["episode"]["l"] == 25).all() and (infos["episode"]["r"] <= 1).all()
    if name == "RecordVideo":
        assert [video.endswith(".mp4") for video in os.listdir("films")] == [True]
    env.close()


@pytest.mark.filterwarnings("error", "ignore:.*maximum value is infinity")
@pytest.mark.parametrize(
    "options", [{}, {"horizon": "terminated"}, {"jitter": 2.0, "reward": "Df", "time_input": True}]
)
def test_gymnasium_s_checker_accepts_team_env(options):
    checker = pytest.importorskip("gymnasium.utils.env_checker", reason="gymnasium is not installed")
    # The render check would warn that the environment has no spec, and warnings are errors here.
    checker.check_env(flotilla.team_env(Config.paper(), render_mode="rgb_array", **options), skip_render_check=True)


@pytest.mark.parametrize("reward", ["G", "Df"])
def test_team_env_plays_like_vector_env(reward):
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    options = {"reward": reward, "jitter": 2.0, "horizon": "terminated", "time_input": True}
    one = flotilla.team_env(Config.paper(), **options)
    many = VectorEnv(Config.paper(), 1, layout="team", autoreset="disabled", **options)
    rng = np.random.default_rng(1)
    for seed in (3, None):
        assert np.array_equal(one.reset(seed=seed)[0], many.reset(seed=seed)[0][0])
        ended = False
        while not ended:
            action = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
            observation, reward, ended, truncated, infos = one.step(action)
            expected = many.step(action[None])
            assert np.array_equal(observation, expected[0][0])
            assert (reward, ended, truncated) == tuple(array[0] for array in expected[1:4])
            assert infos == ({"g": many.observed.mean()} if ended else {})


def test_writing_to_returned_arrays_changes_no_state():
    env, actions = VectorEnv(Config.paper(), 3, "Df", autoreset="disabled"), np.zeros((3, 4, 2))
    env.reset()
    for step in range(28):
        _, rewards, terminated, truncated, _ = env.step(actions)
        assert not terminated.any() and truncated.all() == (step >= 24)
        # A team gets its reward once, even if it is stepped after its end.
        assert rewards.any() == (step == 24)
        terminated |= truncated
    env = VectorEnv(Config.paper(), 3)
    first = env.reset()[0].copy()
    for _ in range(25):
        _, _, _, truncated, _ = env.step(actions)
    truncated[:] = False
    assert np.array_equal(env.step(actions)[0], first)


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
            expected, expected_rewards, *_ = other.step(actions)
            assert np.array_equal(rewards, expected_rewards)
            if step == 2:
                assert truncated.all() and np.array_equal(infos["final_obs"], expected) and infos["_final_obs"].all()
                assert np.array_equal(inputs, start)
            else:
                assert np.array_equal(inputs, expected) and infos == {}


def test_a_reset_mask_resets_only_its_teams():
    config = Config.paper().replace(world={"steps": 4})
    actions = np.ones((6, 4, 2), np.float32)
    mask = np.array([True, False, False, True, False, True])
    for mode in ("disabled", "next_step", "same_step"):
        env, plain = VectorEnv(config, 6, autoreset=mode), VectorEnv(config, 6, autoreset="disabled")
        start = env.reset()[0].copy()
        plain.reset()
        by_age = [start, *(plain.step(actions)[0].copy() for _ in range(4))]
        env.step(actions)
        env.step(actions)
        inputs, _ = env.reset(options={"reset_mask": mask})
        assert np.array_equal(inputs[mask], by_age[0][mask]) and np.array_equal(inputs[~mask], by_age[2][~mask])
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
                assert np.array_equal(inputs[team], by_age[age][team]), (mode, team, age)
            over_before = expected_over
    with pytest.raises(ValueError, match="reset_mask is float64"):
        VectorEnv(config, 6).reset(options={"reset_mask": mask * 1.0})


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("reward", ["G", "Df"])
def test_with_random_starts_the_next_episode_has_other_starts(mode, reward):
    config = Config.paper().replace(world={"steps": 3}, learning={"start_jitter": 3.0})
    env, by_hand = VectorEnv(config, 4, reward, autoreset=mode), VectorEnv(config, 4, autoreset="disabled")
    env.reset(seed=2)
    starts = [by_hand.reset(seed=2)[0].copy(), by_hand.reset()[0].copy(), by_hand.reset()[0].copy()]
    actions, seen = np.ones((4, 4, 2), np.float32), []
    for _ in range(8):
        inputs, rewards, _, truncated, _ = env.step(actions)
        seen.append(inputs.copy())
    reset_steps = [3, 7] if mode == "next_step" else [2, 5]
    for step, start in zip(reset_steps, starts[1:]):
        assert np.array_equal(seen[step], start)
    if mode == "next_step":
        assert not rewards.any() and not truncated.any()


def test_starts_are_drawn_from_the_seed():
    config = Config.paper().replace(learning={"start_jitter": 2.0})
    env = VectorEnv(config, 8, autoreset="disabled")
    one, two = env.reset(seed=3)[0].copy(), env.reset()[0].copy()
    assert not np.array_equal(one, two) and not np.array_equal(one[0], one[1])
    assert np.array_equal(env.reset(seed=3)[0], one) and np.array_equal(env.reset()[0], two)
    assert not np.array_equal(env.reset(seed=4)[0], one)
    without_jitter = VectorEnv(Config.paper(), 8)
    assert np.array_equal(without_jitter.reset(seed=3)[0].copy(), without_jitter.reset(seed=4)[0])


@pytest.mark.parametrize(
    "actions, error, message",
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
def test_invalid_actions_raise_a_one_line_error_and_move_nobody(actions, error, message):
    env = VectorEnv(Config.paper(), 5)
    before = env.reset()[0].copy()
    with pytest.raises(error, match=message) as raised:
        env.step(actions)
    assert "\n" not in str(raised.value) and np.array_equal(env._teams.inputs(), before)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"num_envs": 0}, "the number of teams is 0, allowed is 1 to 1048576"),
        ({"num_envs": 1 << 21}, "allowed is 1 to 1048576"),
        ({"reward": "E"}, "reward 'E', allowed are G, D, Df"),
        ({"autoreset": "later"}, "autoreset 'later'"),
        ({"render_mode": "human"}, "render_mode 'human'"),
    ],
)
def test_invalid_options_raise(options, message):
    with pytest.raises(ValueError, match=message):
        VectorEnv(Config.paper(), **{"num_envs": 2, **options})


def test_metadata_and_spaces_are_gymnasium_s():
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    modes = gymnasium.vector.AutoresetMode
    for name, mode in (("next_step", modes.NEXT_STEP), ("same_step", modes.SAME_STEP), ("disabled", modes.DISABLED)):
        assert VectorEnv(Config.paper(), 2, autoreset=name).metadata["autoreset_mode"] is mode
    env = VectorEnv(Config.paper(), 7)
    inputs, _ = env.reset(seed=1)
    assert env.observation_space.contains(inputs) and env.action_space.shape == (7, 4, 2)
    assert env.single_observation_space.shape == (4, 8) and env.single_action_space.shape == (4, 2)
    inputs, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(inputs)


def test_render_returns_a_picture_per_environment():
    env = VectorEnv(Config.paper(), 2, render_mode="rgb_array")
    env.reset()
    first, _ = env.render()
    env.step(np.ones((2, 4, 2), np.float32))
    second, other = env.render()
    assert np.array_equal(second, other)
    flat = VectorEnv(Config.paper(), 2, layout="flat", render_mode="rgb_array")
    assert [picture.shape for picture in flat.render()] == [(480, 480, 3)] * 8
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8
    assert (first != second).any() and first.std() > 5
    assert VectorEnv(Config.paper(), 2).render() is None


def test_pettingzoo_s_test_functions_pass():
    tests = pytest.importorskip("pettingzoo.test", reason="pettingzoo is not installed")
    tests.parallel_api_test(flotilla.parallel_env(Config.paper()), num_cycles=200)
    jittered = Config.paper().replace(learning={"start_jitter": 2.0})
    for config in (Config.paper(), jittered):
        tests.parallel_seed_test(lambda: flotilla.parallel_env(config))
        # The same as an AEC environment, in which agents act one after the other.
        convert = pytest.importorskip("pettingzoo.utils.conversions").parallel_to_aec
        tests.api_test(convert(flotilla.parallel_env(config)), num_cycles=200)
        tests.seed_test(lambda: convert(flotilla.parallel_env(config)), num_cycles=100)
    env = flotilla.parallel_env(Config.paper(), render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 480, 3)


def test_parallel_env_plays_like_the_first_team_of_vector_env():
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    config = random_config(3).replace(learning={"start_jitter": 0.0, "poi_jitter": 0.0})
    for reward in ("G", "Df"):
        one, many = flotilla.parallel_env(config, reward=reward), VectorEnv(config, 3, reward, autoreset="disabled")
        observations, _ = one.reset(seed=1)
        inputs, _ = many.reset()
        rng = np.random.default_rng(1)
        while one.agents:
            assert one.agents == [f"leader_{leader}" for leader in range(config.num_learners)]
            assert np.array_equal(np.stack(list(observations.values())), inputs[0])
            assert one.state().shape == one.state_space.shape
            actions = rng.uniform(-1, 1, (3, config.num_learners, 2)).astype(np.float32)
            observations, rewards, terminated, truncated, _ = one.step(dict(zip(one.agents, actions[0])))
            inputs, expected, _, over, _ = many.step(actions)
            assert list(rewards.values()) == [float(reward) for reward in expected[0]]
            assert set(truncated.values()) == {bool(over[0])} and not any(terminated.values())
        with pytest.raises(ValueError, match="no action for leader_0"):
            one.reset()
            one.step({})


@pytest.mark.parametrize("layout", ["leaders", "team", "flat"])
@pytest.mark.parametrize("reward", ["G", "Df", "Dt"])
def test_copies_and_pickles_continue_with_the_same_bits(layout, reward):
    learning = {"start_jitter": 1.0, "poi_jitter": 2.0}
    config = Config.paper("chaotic").replace(learning=learning)
    env = VectorEnv(config, 7, reward, layout=layout, autoreset="same_step", time_input=True, copy=False)
    env.reset(seed=4)
    rng = np.random.default_rng(2)
    shape = (28, 2) if layout == "flat" else (7, 4, 2)
    for _ in range(60):
        env.step(rng.uniform(-1, 1, shape))
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(70):
        actions = rng.uniform(-1, 1, shape)
        expected = env.step(actions)
        for other in copies:
            actual = other.step(actions)
            assert all(np.array_equal(a, b) for a, b in zip(actual[:4], expected[:4]))
            assert actual[0].ctypes.data % 64 == 0
            assert np.array_equal(other.states[0], env.states[0])
    assert env.observed.any()


def test_a_parallel_environment_can_be_copied():
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    env = flotilla.parallel_env(Config.paper(), reward="Df", jitter=1.0)
    env.reset(seed=1)
    actions = {agent: np.float32([0.3, 0.9]) for agent in env.agents}
    for _ in range(12):
        env.step(actions)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        first = copy.deepcopy(env)
        while first.agents:
            actual, expected = other.step(actions), first.step(actions)
            assert actual[1] == expected[1] and all(np.array_equal(actual[0][a], expected[0][a]) for a in actual[0])
        assert not other.agents


def test_poi_jitter_moves_the_pois_of_each_team():
    config, seed = Config.paper("chaotic"), 5
    env = VectorEnv(config, 6, jitter=1.0, poi_jitter=4.0)
    fixed = VectorEnv(config, 6, jitter=1.0)
    seen, other = env.reset(seed=seed)[0], fixed.reset(seed=seed)[0]
    # Agents have the same starts in both, but sense other POIs.
    assert np.array_equal(env.states[0], fixed.states[0])
    assert (seen[..., :4] != other[..., :4]).any(axis=(1, 2)).all()
    assert np.array_equal(seen[..., 4:], other[..., 4:])
    # Episode i of `collect` has the starts of team i.
    policies = random_policies(config, 1, 1)
    batch = flotilla.collect(config, policies, noise=0, seed=seed, episodes=6, jitter=1.0, poi_jitter=4.0)
    assert np.array_equal(batch.observations[:, 0], seen)
    for step in range(config["world.steps"]):
        assert np.array_equal(seen, batch.observations[:, step])
        seen, rewards, *_ = env.step(batch.actions[:, step])
        assert np.array_equal(rewards, batch.rewards[:, step])


def test_state_is_read_as_properties():
    env = VectorEnv(Config.paper(), 2)
    assert env.observed.shape == (2, 4) and env.agents_at_poi.shape == (2, 4, 12)
    assert [state.shape for state in env.states] == [(2, 12, 2), (2, 12, 2), (2, 12)]


def test_a_step_before_the_first_reset_raises():
    many = VectorEnv(Config.paper(), 2)
    with pytest.raises(flotilla.Error, match="step was called before the first reset; call reset"):
        many.step(np.zeros((2, 4, 2)))
    many.reset()
    many.step(np.zeros((2, 4, 2)))
    assert pickle.loads(pickle.dumps(many)).step(np.zeros((2, 4, 2)))[0].shape == (2, 4, 8)
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    with pytest.raises(flotilla.Error, match="before the first reset"):
        flotilla.team_env(Config.paper()).step(np.zeros((4, 2)))
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    with pytest.raises(flotilla.Error, match="before the first reset"):
        flotilla.parallel_env(Config.paper()).step({})


def test_actions_with_other_axes_raise_with_the_names_of_the_axes():
    with pytest.raises(ValueError, match=r"allowed are 3 axes: \[num_envs, leaders, 2\]"):
        VectorEnv(Config.paper(), 2).step(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"allowed are 2 axes: \[num_envs, 2\]"):
        VectorEnv(Config.paper(), 2, layout="flat").step(np.zeros((2, 4, 2)))


def test_supersuit_concatenates_copies():
    supersuit = pytest.importorskip("supersuit", reason="supersuit is not installed")
    env = flotilla.parallel_env(Config.paper(), jitter=1.0)
    vector = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 3, base_class="gymnasium")
    seen, _ = vector.reset(seed=1)
    assert seen.shape == (12, 8)
    first, last = seen[:4], seen[8:]
    assert not np.array_equal(first, last)
    for _ in range(60):
        seen, rewards, terminated, truncated, _ = vector.step(np.ones((12, 2), np.float32))
    assert seen.shape == (12, 8) and np.isfinite(seen).all()
