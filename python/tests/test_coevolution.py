"""Tests `Coevolution`, the initial policies of `train`, and callbacks."""

import gc
import json
import os
import pickle
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import random_config, random_policies

import flotilla
from flotilla import Coevolution, Config, rollout, train


@pytest.mark.parametrize("seed", range(8))
def test_with_the_configs_fitness_it_gives_the_bits_of_train(seed):
    config = random_config(seed)
    coevolution = Coevolution(config)
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
    run = train(config)
    assert coevolution.run.digest == run.digest
    assert np.array_equal(coevolution.run.metrics["mean_g"], run.metrics["mean_g"])


def test_rollouts_of_the_asked_teams_give_the_scores_of_play(config):
    coevolution = Coevolution(config, seed=3)
    asked, played = coevolution.ask(), coevolution.play()
    for trial in range(2):
        teams = np.stack([asked.policies[trial, leader, asked.teams[trial, :, leader]] for leader in range(4)])
        scores = rollout(config, teams)
        assert np.array_equal(scores.g, played.g[trial]) and np.array_equal(scores["Df"], played.fitness[trial])
    # A fitness computed from these rollouts gives the run of train.
    while not coevolution.done:
        asked = coevolution.ask()
        fitness = [
            rollout(config, np.stack([policies[leader][teams[:, leader]] for leader in range(4)]))["Df"]
            for policies, teams in zip(asked.policies, asked.teams)
        ]
        coevolution.tell(np.stack(fitness))
    assert coevolution.run.digest == train(config, seed=3).digest


@pytest.mark.parametrize("episodes", [1, 2])
@pytest.mark.parametrize("leniency", ["mean", "max"])
def test_policies_play_with_several_partners(config, leniency, episodes):
    learning = {"partners": 3, "leniency": leniency, "episodes_per_team": episodes, "start_jitter": 1.0}
    config = config.replace(learning={**learning, "fitness": "D++"})
    coevolution = Coevolution(config, seed=3)
    asked, played = coevolution.ask(), coevolution.play()
    # Each policy plays once per round, and each round has other teams.
    rounds = asked.teams.reshape(2, 3, 20, 4)
    assert np.array_equal(np.sort(rounds, axis=2), np.broadcast_to(np.arange(20)[:, None], rounds.shape))
    assert not np.array_equal(rounds[:, 0], rounds[:, 1]) and not np.array_equal(rounds[:, 1], rounds[:, 2])
    assert played.g.shape == (2, 60) and played.fitness.shape == (2, 60, 4)
    # The champion is the policy with the best mean score, or with the best single score.
    fitness = np.random.default_rng(1).random(played.fitness.shape).astype(np.float32)
    other = pickle.loads(pickle.dumps(coevolution))
    other.tell(fitness)
    for trial in range(2):
        for leader in range(4):
            scores = np.empty((3, 20))
            for number, teams in enumerate(rounds[trial]):
                scores[number, teams[:, leader]] = fitness[trial].reshape(3, 20, 4)[number, :, leader]
            combined = scores.mean(0) if leniency == "mean" else scores.max(0)
            assert np.array_equal(other.best[trial, leader], asked.policies[trial, leader, combined.argmax()])
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
        coevolution = pickle.loads(pickle.dumps(coevolution))
    assert coevolution.run.digest == train(config, seed=3).digest


def test_another_fitness_gives_another_run(config):
    coevolution = Coevolution(config, seed=3)
    while not coevolution.done:
        coevolution.tell(np.random.default_rng(0).random(coevolution.play().fitness.shape))
    assert coevolution.run.digest != train(config, seed=3).digest


def test_a_run_says_that_its_fitness_is_not_the_config_s(config, program):
    theirs = Coevolution(config, seed=3)
    while not theirs.done:
        theirs.tell(theirs.play().fitness)
    assert not theirs.own_fitness and not theirs.run.own_fitness
    theirs.run.save("theirs")
    assert "own_fitness" not in json.loads(Path("theirs/run.json").read_text())
    ours = Coevolution(config, seed=3)
    while not ours.done:
        played = ours.play()
        # Only one fitness differs, and a copy knows it.
        ours.tell(-played.fitness if ours.generation == 2 else played.fitness)
        ours = pickle.loads(pickle.dumps(ours))
    ours.run.save("ours")
    run = flotilla.Run.open("ours")
    assert ours.own_fitness and run.own_fitness and "by a fitness that is not the config's" in repr(run)
    run.save("again")
    for folder in ("ours", "again"):
        assert json.loads(Path(folder, "run.json").read_text())["own_fitness"] is True
    arms = flotilla.compare(["ours", "theirs"])["comparisons"][0]["arms"]
    assert [arm["name"] for arm in arms] == ["fitness own", "fitness Df"]
    assert "fitness own" in flotilla.plot(["ours", "theirs"]).svg()
    for generation, team in ((0, "best"), (6, "champion")):
        page = run.replay(generation=generation, team=team).page()
        assert '"fitness":"own"' in page and '"fitness":"Df"' not in page
    with pytest.raises(flotilla.Error, match="fitness that is not the config's, so generation 6 cannot be trained again"):
        run.replay(team="best")
    with pytest.raises(flotilla.Error, match="cannot be extended"):
        train(config.replace(learning={"seed": 3, "generations": 8}), out="ours", resume=True)
    error = program("train", "ours/config.toml", "--out", "ours", "--resume", "--generations", "8", status=1)
    assert "its fitness is not the config's" in error
    assert train(run.config, out="ours", resume=True).own_fitness


def test_a_run_from_given_policies_says_so(config):
    initial = random_policies(config, 20)
    coevolution = Coevolution(config, init=initial)
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
    pickle.loads(pickle.dumps(coevolution)).run.save("kept")
    train(config, init=initial, out="trained")
    kept, trained = (json.loads(Path(folder, "run.json").read_text()) for folder in ("kept", "trained"))
    assert kept["init"] == trained["init"] and kept["digest"] == trained["digest"]
    with pytest.raises(flotilla.Error, match="started from given policies"):
        flotilla.Run.open("kept").replay(team="best")


def test_pickles_and_states_resume_with_the_same_bits(config):
    coevolution, expected = Coevolution(config, seed=1), train(config, seed=1).digest
    states = []
    while not coevolution.done:
        states.append(coevolution.state)
        coevolution = pickle.loads(pickle.dumps(coevolution))
        coevolution.tell(coevolution.play().fitness)
    states.append(coevolution.state)
    assert pickle.loads(pickle.dumps(coevolution)).run.digest == expected
    for state in states:
        other = Coevolution(config, seed=1)
        other.state = state
        while not other.done:
            other.tell(other.play().fitness)
        assert other.run.digest == expected
    with pytest.raises(ValueError, match="state is of another config"):
        Coevolution(config.replace(learning={"trials": 3})).state = states[2]
    with pytest.raises(ValueError, match="state is of another config"):
        Coevolution(config).state = {**states[2], "policies": states[2]["policies"] * np.nan}


def test_an_invalid_fitness_is_rejected_and_changes_nothing(config):
    coevolution = Coevolution(config)
    valid = coevolution.play().fitness
    for wrong in (valid[:1], valid[..., :2], valid * np.nan, np.full_like(valid, np.inf)):
        with pytest.raises(ValueError, match="fitness"):
            coevolution.tell(wrong)
    with pytest.raises(TypeError):
        coevolution.tell(valid > 0)
    with pytest.raises(ValueError, match=r"allowed are 3 axes: \[trials, teams, leaders\]"):
        coevolution.tell(valid[0])
    assert coevolution.generation == 0
    with pytest.raises(ValueError, match="no generation has a fitness yet"):
        coevolution.best
    with pytest.raises(ValueError, match="has no fitness yet"):
        coevolution.run
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
    with pytest.raises(ValueError, match="all generations"):
        coevolution.tell(valid)


def test_initial_policies_may_be_arrays(config):
    initial = random_policies(config, 12)
    coevolution = Coevolution(config, init=initial)
    assert np.array_equal(coevolution.ask().policies[1][:, :12], initial)
    while not coevolution.done:
        coevolution.tell(coevolution.play().fitness)
    run = train(config, init=initial)
    assert coevolution.run.digest == run.digest
    in_a_directory = train(config, init=[initial, initial], out="kept")
    assert in_a_directory.digest == run.digest
    assert train(config, init=in_a_directory).digest != run.digest
    for wrong in (initial[:3], initial[:, :1], [initial] * 3, initial[..., 1:]):
        with pytest.raises(ValueError, match="init"):
            train(config, init=wrong)
    for wrong in (7, object(), [1, 2], initial > 0):
        with pytest.raises((TypeError, ValueError), match="init"):
            train(config, init=wrong)
    run.save("saved")
    saved = flotilla.Run.open("saved")
    assert saved.digest == run.digest
    assert saved.replay(generation=0).episodes[0].observed == run.replay(generation=0).episodes[0].observed


def test_callbacks_get_champions(config):
    seen, seen_too = [], []
    run = train(config, callback=[seen.append, seen_too.append], champions=True)
    assert run.digest == train(config).digest and seen == seen_too
    assert [generation.generation for generation in seen] == list(range(7))
    assert np.array_equal(seen[-1].champions, np.stack([policies[:, 0] for policies in run.policies]))
    for generation in seen:
        for trial, champion in enumerate(generation.champions):
            assert rollout(config, champion[:, None]).g[0] == generation.champion_g[trial]
    seen.clear()
    stopped = train(config, callback=[lambda g: g.generation == 2, seen.append], champions=True)
    assert stopped.digest == train(config.replace(learning={"generations": 4})).digest == train(
        config, callback=[lambda generation: generation.generation == 2, seen.append]
    ).digest
    train(config, callback=seen.append)
    assert seen[-1].champions is None
    with pytest.raises(TypeError, match="callback"):
        train(config, callback=[7])


def test_loggers_close_when_training_stops_early(config):
    closed = []
    logger = flotilla.loggers.Logger(lambda generation: None, lambda: closed.append(1))
    train(config, callback=[logger, lambda generation: True])
    assert closed == [1]

    def fails(generation):
        raise RuntimeError("no more")

    other = flotilla.loggers.Logger(fails, lambda: closed.append(2))
    with pytest.raises(RuntimeError, match="no more"):
        train(config, callback=other)
    assert closed == [1, 2]


def test_a_deleted_run_causes_no_resource_warning(config):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = train(config)
        folder = run.folder
        del run
        gc.collect()
    assert not os.path.exists(folder)


def test_a_state_of_another_config_is_refused(config):
    coevolution = flotilla.Coevolution(config)
    coevolution.tell(coevolution.play().fitness)
    for other in ({"seed": 9}, {"fitness": "G"}):
        with pytest.raises(ValueError, match="another config"):
            flotilla.Coevolution(config.replace(learning=other)).state = coevolution.state


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no timers")
def test_an_interrupt_of_the_first_episodes_is_no_panic():
    script = """if True:
        import signal, flotilla
        config = flotilla.Config.paper().replace(learning={"population": 60_000, "trials": 1}, world={"steps": 400})
        coevolution = flotilla.Coevolution(config, backend="cpu")
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        try:
            coevolution.play()
            while True:
                pass
        except KeyboardInterrupt:
            print("interrupted")
    """
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert (found.stdout, found.returncode) == ("interrupted\n", 0), found.stderr
