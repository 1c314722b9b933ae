"""Tests `Config`: files, errors with line numbers, changed keys, and its behaviour as a value."""

import copy
import pickle

import numpy as np
import pytest
from conftest import ROOT

import flotilla
from flotilla import Config, ConfigError


def test_a_file_is_read_and_written():
    config = Config.load(ROOT / "configs/chaotic.toml")
    assert Config.parse(config.to_toml()) == config == Config.paper("chaotic")
    assert config["world.steps"] == 50 and config["world"]["steps"] == 50
    assert (config.num_learners, config.parameters) == (4, 112)
    for wrong, hint in (("world.step", "world.steps"), ("population", "learning.population"), ("learnin", "learning")):
        with pytest.raises(KeyError, match=f"{wrong}: no such key; did you mean {hint}"):
            config[wrong]


def test_all_problems_are_reported_with_their_lines():
    text = "[world]\nleaders = [[1, 1]]\npois = [[2, 2]]\nsteps = 0\n[learning]\nfitness = 'E'\n"
    with pytest.raises(ConfigError) as error:
        Config.parse(text, "my.toml")
    problems = [(problem.line, problem.key) for problem in error.value.problems]
    assert problems == [(4, "world.steps"), (6, "learning.fitness")]
    assert "my.toml:4: world.steps" in str(error.value) and isinstance(error.value, ValueError)
    again = pickle.loads(pickle.dumps(error.value))
    assert (str(again), again.problems) == (str(error.value), error.value.problems)
    with pytest.raises(ConfigError, match="nowhere.toml: cannot be read"):
        Config.load("nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        Config.load("-")


def test_keys_are_replaced_and_checked():
    config = Config.paper("chaotic")
    learning, world = {"fitness": "D", "generations": np.int64(50)}, {"pois": np.float32([[1, 2], [3, 4]])}
    other = config.replace(learning=learning, world=world)
    assert (other["learning.fitness"], other["learning.generations"]) == ("D", 50)
    assert other["world.pois"] == [[1, 2], [3, 4]] and config["learning.fitness"] == "Df"
    assert other.replace() == other
    with pytest.raises(ConfigError) as error:
        config.replace(learning={"fitness": "E", "seed": -1}, wrold={"steps": 1})
    assert {problem.key for problem in error.value.problems} >= {"learning.fitness", "learning.seed"}
    assert "wrold" in str(error.value)
    with pytest.raises(TypeError, match="world.steps: found object"):
        config.replace(world={"steps": object()})
    with pytest.raises(TypeError, match="63 bits"):
        config.replace(learning={"seed": 2**63})


def test_a_config_is_made_from_python_values():
    config = Config(world={"leaders": ((5, 5),), "pois": np.array([[5.0, 15]])}, learning={"trials": 1})
    assert config == Config.parse("[world]\nleaders = [[5, 5]]\npois = [[5, 15]]\n[learning]\ntrials = 1")
    with pytest.raises(ConfigError, match="world.leaders"):
        Config()


def test_the_reference_has_every_key():
    names = {key.name for key in Config.reference()}
    sections = Config.paper().to_dict()
    assert {f"{section}.{key}" for section in sections for key in sections[section]} == names
    assert len(names) >= 40
    assert all(key.meaning and key.range for key in Config.reference() if key.kind != "true or false")


def test_equal_configs_are_interchangeable():
    config = Config.paper()
    for other in (pickle.loads(pickle.dumps(config)), copy.copy(config), copy.deepcopy(config), Config.paper()):
        assert other == config and hash(other) == hash(config)
    assert config != config.replace(learning={"seed": 1}) and config != 3
    assert repr(config) == (
        "<flotilla.Config: 4 leaders, 8 followers, 4 POIs; "
        "leader-follower by Df, 50 teams, 100 generations, 5 trials, seed 0>"
    )
    with pytest.raises(ValueError, match="allowed are generally_forward, strictly_forward, chaotic"):
        flotilla.Config.paper("sideways")
