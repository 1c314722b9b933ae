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


def by_policies(env, trace, step):
    """What the policies answered at a step."""
    return np.ascontiguousarray(trace.outputs[:, step])


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("reward", ["G", "D", "Df", "D++", "Dt"])
def test_fed_with_a_policy_s_answers_it_gives_the_bits_of_a_rollout(seed, reward):
    config = random_config(seed).replace(learning={"start_jitter": 0.0, "poi_jitter": 0.0, "fitness": reward})
    policies = random_policies(config, 11, seed)
    scores = rollout(config, policies, trace=True)
    trace, steps = scores.trace, config["world.steps"]
    env = VectorEnv(config, 11, reward, autoreset="disabled")
    inputs, infos = env.reset()
    total = np.zeros((11, config.num_learners))
    for step in range(steps):
        assert np.array_equal(inputs.view(np.uint32), trace.inputs[:, step].view(np.uint32)), step
        inputs, rewards, terminated, truncated, infos = env.step(by_policies(env, trace, step))
        positions, headings, speeds = env.states()
        assert np.array_equal(positions.view(np.uint32), trace.positions[:, step + 1].view(np.uint32))
        assert np.array_equal(headings.view(np.uint32), trace.headings[:, step + 1].view(np.uint32))
        assert np.array_equal(speeds.view(np.uint32), trace.speeds[:, step + 1].view(np.uint32))
        assert np.array_equal(env.agents_at_poi(), trace.agents_at_poi[:, step])
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


# The arrays of one team share blocks, those of 70 teams only in part.
@pytest.mark.parametrize("teams", [1, 70])
def test_a_buffer_that_keeps_references_keeps_every_step(teams):
    config = Config.paper()
    env, other = VectorEnv(config, teams), VectorEnv(config, teams)
    rng = np.random.default_rng(1)
    kept, expected = [env.reset()[0]], [other.reset()[0].copy()]
    for _ in range(1000):
        actions = rng.uniform(-1, 1, (teams, 4, 2)).astype(np.float32)
        kept.extend(env.step(actions)[:2])
        expected.extend(array.copy() for array in other.step(actions)[:2])
    assert len({array.__array_interface__["data"][0] for array in kept}) == len(kept)
    for found, copied in zip(kept, expected):
        assert np.array_equal(found, copied)


@pytest.mark.parametrize("layout", ["leaders", "team", "flat"])
@pytest.mark.parametrize("time_input", [False, True])
def test_arrays_are_aligned_writable_and_reused_on_request(layout, time_input):
    shaped = {"layout": layout, "time_input": time_input}
    env, reusing = VectorEnv(Config.paper(), 7, **shaped), VectorEnv(Config.paper(), 7, copy=False, **shaped)
    addresses, actions = set(), np.ones(env.action_space.shape, np.float32)
    env.reset(), reusing.reset()
    for _ in range(30):
        found, reused = env.step(actions), reusing.step(actions)
        for array, same in zip(found[:2], reused[:2]):
            assert np.array_equal(array, same)
            for each in (array, same):
                assert each.flags.writeable and each.flags.c_contiguous and each.ctypes.data % 64 == 0
        addresses.add((reused[0].ctypes.data, reused[1].ctypes.data))
    assert len(addresses) == 1


def test_observations_outlive_the_environment():
    env = VectorEnv(Config.paper(), 3, copy=False)
    seen, expected = env.reset()[0], env.reset()[0].copy()
    del env
    assert np.array_equal(seen, expected)


@pytest.mark.parametrize("library", ["torch", "jax"])
@pytest.mark.parametrize("teams", [1, 70])
def test_other_libraries_take_every_row_without_a_copy_of_ours(library, teams):
    # PyTorch takes gigabytes: only the long form of the tests installs it.
    why = "by request: FLOTILLA_LONG=1" if library == "torch" else "jax is not installed"
    module = pytest.importorskip(library, reason=why)
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
    for found, copied in zip(kept, expected):
        assert np.array_equal(np.asarray(found), copied)


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
    # It can still be used.
    assert np.array_equal(env.reset()[0], VectorEnv(Config.paper(), 20_000).reset()[0])


def test_layouts_give_the_same_episode():
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
        seen, rewards, ended, _, infos = leaders.step(actions)
        found = team.step(actions)
        assert np.array_equal(found[0], seen) and np.array_equal(found[1], rewards.mean(axis=1))
        found = flat.step(actions.reshape(-1, 2))
        assert np.array_equal(found[0], seen.reshape(-1, 8)) and np.array_equal(found[1], rewards.reshape(-1))
        assert np.array_equal(found[2], np.repeat(ended, 4)) and not found[3].any()
        assert ended.all() == (step % 25 == 24)
        if ended.any():
            last = infos["final_info"]
            assert np.array_equal(last["g"], last["observed"].mean(axis=1)) and last["state"].shape == (teams, 64)
            assert np.array_equal(found[4]["final_info"]["g"], np.repeat(last["g"], 4))
            assert np.array_equal(found[4]["final_obs"], infos["final_obs"].reshape(-1, 8))
            assert not leaders.observed.any()


def test_time_is_the_played_share():
    env = VectorEnv(Config.paper(), 3, time_input=True, autoreset="disabled")
    seen, _ = env.reset()
    plain = VectorEnv(Config.paper(), 3, autoreset="disabled")
    assert np.array_equal(seen[..., :8], plain.reset()[0]) and env.observation_space.shape == (3, 4, 9)
    for step in range(25):
        assert (seen[..., 8] == np.float32(step / 25)).all()
        seen = env.step(np.ones((3, 4, 2)))[0]


def test_spaces_keep_their_seed():
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    env = VectorEnv(Config.paper(), 2)
    assert env.action_space is env.action_space
    env.action_space.seed(0)
    first = env.action_space.sample()
    env.action_space.seed(0)
    assert np.array_equal(env.action_space.sample(), first)


def test_without_a_seed_workers_differ():
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
# What else a wrapper needs, which only the long form of the tests installs.
NEEDS = {"NumpyToTorch": "torch", "RecordVideo": "moviepy", "HumanRendering": "pygame"}
# Wrappers for spaces that these environments do not have.
OTHERS = {
    "FilterObservation": "observations are dictionaries",
    "GrayscaleObservation": "observations are pictures",
    "ResizeObservation": "observations are pictures",
    "RescaleObservation": "observations are bounded",
    "JaxToNumpy": "the environment returns JAX arrays",
    "JaxToTorch": "the environment returns JAX arrays",
}


def test_no_vector_wrapper_is_left_out():
    wrappers = pytest.importorskip("gymnasium.wrappers.vector", reason="gymnasium is not installed")
    assert set(wrappers.__all__) <= {*WRAPPERS, *OTHERS}


@pytest.mark.parametrize("layout", ["team", "flat"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_gymnasium_s_vector_wrappers_take_it(layout, name, monkeypatch):
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason="by request: FLOTILLA_LONG=1")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    words = dict(WRAPPERS[name])
    if "wrapper" in words:
        words["wrapper"] = getattr(gymnasium.wrappers, words["wrapper"])
    if name == "ReshapeObservation":
        words["shape"] = (8, 4) if layout == "team" else (2, 4)
    if name == "ArrayConversion":
        pytest.importorskip("array_api_compat", reason="array-api-compat is not installed")
        words = {"env_xp": np, "target_xp": pytest.importorskip("jax.numpy", reason="jax is not installed")}
    pictured = "rgb_array" if name in ("RecordVideo", "HumanRendering") else None
    inner = VectorEnv(Config.paper(), 5, layout=layout, autoreset="next_step", render_mode=pictured)
    assert isinstance(inner, gymnasium.vector.VectorEnv)
    env = getattr(gymnasium.wrappers.vector, name)(inner, **words)
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
        assert [film.endswith(".mp4") for film in os.listdir("films")] == [True]
    env.close()


@pytest.mark.filterwarnings("error", "ignore:.*maximum value is infinity")
@pytest.mark.parametrize("words", [{}, {"horizon": "terminated"}, {"jitter": 2.0, "reward": "Df", "time_input": True}])
def test_gymnasium_s_checker_finds_nothing(words):
    checker = pytest.importorskip("gymnasium.utils.env_checker", reason="gymnasium is not installed")
    # A picture is asked for before the first reset, too.
    checker.check_env(flotilla.team_env(Config.paper(), render_mode="rgb_array", **words), skip_render_check=True)


@pytest.mark.parametrize("reward", ["G", "Df"])
def test_one_team_is_the_first_of_many_for_gymnasium(reward):
    pytest.importorskip("gymnasium", reason="gymnasium is not installed")
    words = {"reward": reward, "jitter": 2.0, "horizon": "terminated", "time_input": True}
    one = flotilla.team_env(Config.paper(), **words)
    many = VectorEnv(Config.paper(), 1, layout="team", autoreset="disabled", **words)
    rng = np.random.default_rng(1)
    for seed in (3, None):
        assert np.array_equal(one.reset(seed=seed)[0], many.reset(seed=seed)[0][0])
        ended = False
        while not ended:
            action = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
            seen, reward, ended, truncated, infos = one.step(action)
            expected = many.step(action[None])
            assert np.array_equal(seen, expected[0][0]) and (reward, ended, truncated) == tuple(e[0] for e in expected[1:4])
            assert infos == ({"g": many.observed.mean()} if ended else {})


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
    assert "\n" not in str(found.value) and np.array_equal(env._teams.inputs(), before)


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


def test_metadata_and_spaces_are_gymnasium_s():
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
    first, _ = env.render()
    env.step(np.ones((2, 4, 2), np.float32))
    second, other = env.render()
    assert np.array_equal(second, other)
    flat = VectorEnv(Config.paper(), 2, layout="flat", render_mode="rgb_array")
    assert [picture.shape for picture in flat.render()] == [(480, 480, 3)] * 8
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8
    assert (first != second).any() and first.std() > 5
    assert VectorEnv(Config.paper(), 2).render() is None


def test_pettingzoo_s_own_tests_pass():
    tests = pytest.importorskip("pettingzoo.test", reason="pettingzoo is not installed")
    tests.parallel_api_test(flotilla.parallel_env(Config.paper()), num_cycles=200)
    jittered = Config.paper().replace(learning={"start_jitter": 2.0})
    for config in (Config.paper(), jittered):
        tests.parallel_seed_test(lambda: flotilla.parallel_env(config))
        # As one agent after the other.
        convert = pytest.importorskip("pettingzoo.utils.conversions").parallel_to_aec
        tests.api_test(convert(flotilla.parallel_env(config)), num_cycles=200)
        tests.seed_test(lambda: convert(flotilla.parallel_env(config)), num_cycles=100)
    # Renders as it says.
    env = flotilla.parallel_env(Config.paper(), render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (480, 480, 3)


def test_one_team_is_the_first_of_many():
    pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")
    config = random_config(3).replace(learning={"start_jitter": 0.0, "poi_jitter": 0.0})
    for reward in ("G", "Df"):
        one, many = flotilla.parallel_env(config, reward=reward), VectorEnv(config, 3, reward, autoreset="disabled")
        seen, _ = one.reset(seed=1)
        inputs, _ = many.reset()
        rng = np.random.default_rng(1)
        while one.agents:
            assert one.agents == [f"leader_{leader}" for leader in range(config.num_learners)]
            assert np.array_equal(np.stack(list(seen.values())), inputs[0])
            assert one.state().shape == one.state_space.shape
            actions = rng.uniform(-1, 1, (3, config.num_learners, 2)).astype(np.float32)
            seen, rewards, terminated, truncated, _ = one.step(dict(zip(one.agents, actions[0])))
            inputs, expected, _, over, _ = many.step(actions)
            assert list(rewards.values()) == [float(reward) for reward in expected[0]]
            assert set(truncated.values()) == {bool(over[0])} and not any(terminated.values())
        with pytest.raises(ValueError, match="no action for leader_0"):
            one.reset()
            one.step({})


@pytest.mark.parametrize("layout", ["leaders", "team", "flat"])
@pytest.mark.parametrize("reward", ["G", "Df", "Dt"])
def test_a_copy_continues_with_the_same_bits(layout, reward):
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
            found = other.step(actions)
            assert all(np.array_equal(a, b) for a, b in zip(found[:4], expected[:4]))
            assert found[0].ctypes.data % 64 == 0
            assert np.array_equal(other.states()[0], env.states()[0])
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
            found, expected = other.step(actions), first.step(actions)
            assert found[1] == expected[1] and all(np.array_equal(found[0][a], expected[0][a]) for a in found[0])
        assert not other.agents


def test_pois_of_each_team_move():
    config, seed = Config.paper("chaotic"), 5
    env = VectorEnv(config, 6, jitter=1.0, poi_jitter=4.0)
    still = VectorEnv(config, 6, jitter=1.0)
    seen, other = env.reset(seed=seed)[0], still.reset(seed=seed)[0]
    # Agents start alike, but what they sense of POIs differs.
    assert np.array_equal(env.states()[0], still.states()[0])
    assert (seen[..., :4] != other[..., :4]).any(axis=(1, 2)).all() and np.array_equal(seen[..., 4:], other[..., 4:])
    # Episode i of a rollout has the starts of team i.
    policies = random_policies(config, 1, 1)
    batch = flotilla.collect(config, policies, noise=0, seed=seed, episodes=6, jitter=1.0, poi_jitter=4.0)
    assert np.array_equal(batch.observations[:, 0], seen)
    for step in range(config["world.steps"]):
        assert np.array_equal(seen, batch.observations[:, step])
        seen, rewards, *_ = env.step(batch.actions[:, step])
        assert np.array_equal(rewards, batch.rewards[:, step])


def test_old_names_warn():
    env = VectorEnv(Config.paper(), 2)
    with pytest.warns(DeprecationWarning, match="num_learners"):
        assert env.leaders == env.num_learners == 4
    with pytest.warns(DeprecationWarning, match="agents_at_poi"):
        assert np.array_equal(env.near(), env.agents_at_poi())
    with pytest.warns(DeprecationWarning, match="Config.num_learners"):
        assert Config.paper().leaders == 4
    with pytest.warns(DeprecationWarning, match="Config.reference"):
        assert Config.keys() == Config.reference()
    with pytest.warns(DeprecationWarning, match="Trace.agents_at_poi"):
        assert rollout(Config.paper(), np.zeros((1, 1, 112)), trace=True).trace.near.shape == (1, 25, 4, 12)


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
