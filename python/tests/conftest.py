"""Fixtures and helpers. The tests run against the installed package, not against the source tree."""

import os
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

import flotilla

ROOT = pathlib.Path(os.environ.get("FLOTILLA_ROOT") or pathlib.Path(__file__).parents[2])
SOURCE = pathlib.Path(__file__).parents[1] / "flotilla"


def pytest_sessionstart() -> None:
    imported = pathlib.Path(flotilla.__file__).parent
    if imported == SOURCE and os.environ.get("FLOTILLA_IN_PLACE") != "1":
        pytest.exit(f"flotilla was imported from the source tree, {imported}; install the package to test it", 3)


@pytest.fixture
def config() -> flotilla.Config:
    learning = {"trials": 2, "generations": 6, "population": 20}
    return flotilla.Config.paper("generally_forward").replace(learning=learning)


@pytest.fixture
def program():
    """Returns a function that runs the program and returns its output, or its error output if `status` is not 0."""

    def run(*words, status=0, cwd=None) -> str:
        command = [sys.executable, "-m", "flotilla", *map(os.fspath, words)]
        finished = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
        assert finished.returncode == status, finished.stderr
        return finished.stdout if status == 0 else finished.stderr

    return run


@pytest.fixture(autouse=True)
def _in_a_temporary_directory(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


def random_policies(config: flotilla.Config, teams: int, seed: int = 0, leaders: int | None = None) -> np.ndarray:
    shape = (leaders or config.num_learners, teams, config.parameters)
    return np.random.default_rng(seed).normal(0, 1.5, shape).astype(np.float32)


def random_config(seed: int) -> flotilla.Config:
    """Returns a small random config."""
    rng = np.random.default_rng(seed)
    leaders, followers, pois = rng.integers(1, 5), rng.integers(0, 9), rng.integers(1, 6)
    world = {
        "leaders": rng.uniform(0, 50, (leaders, 2)),
        "followers": rng.uniform(0, 50, (followers, 2)),
        "pois": rng.uniform(0, 50, (pois, 2)),
        "coupling": int(rng.integers(1, leaders + followers + 1)),
        "steps": int(rng.integers(1, 40)),
        "observation_radius": float(rng.uniform(2, 15)),
    }
    learning = {
        "fitness": str(rng.choice(flotilla._native.FITNESSES)),
        "paradigm": str(rng.choice(["leader-follower", "all-leaders"])),
        "population": int(rng.integers(2, 30)),
        "generations": int(rng.integers(0, 5)),
        "trials": int(rng.integers(1, 4)),
        "seed": int(rng.integers(0, 1 << 40)),
        "start_jitter": float(rng.choice([0, 1.5])),
        "poi_jitter": float(rng.choice([0, 1.0])),
        "sharing": str(rng.choice(["none", "all"])),
        "episodes_per_team": int(rng.integers(1, 3)),
    }
    hidden = [int(units) for units in rng.integers(1, 12, rng.integers(0, 3))]
    policy = {"hidden": hidden, "actions": str(rng.choice(["direct", "behaviours"]))}
    first = min(2, learning["generations"])
    if learning["sharing"] == "none":
        learning["partners"] = int(rng.integers(1, 4))
        learning["leniency"] = str(rng.choice(["mean", "max"]))
    stages = [{"from": first, "set": {"world.coupling": 1}}] if rng.random() < 0.3 else []
    return flotilla.Config(world=world, learning=learning, policy=policy, stages=stages)
