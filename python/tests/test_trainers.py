"""Trainers that others wrote, or that are written as others write them, learn something. Some take gigabytes: by request."""

import doctest
import importlib
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import flotilla
from flotilla import Config, VectorEnv


def example(name, *words):
    """What an example prints."""
    command = [sys.executable, ROOT / f"python/examples/{name}.py", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=900).stdout


def test_cma_es_learns_a_task_of_the_suite():
    pytest.importorskip("cma", reason="cma is not installed")
    said = example("cma_shared", "20")
    found = [float(mean) for mean in re.findall(r"^generation +\d+: G .* mean (\d\.\d+)", said, re.M)]
    assert found[-1] > found[0] + 0.05, said


def test_sb3_s_ppo_learns():
    pytest.importorskip("stable_baselines3", reason="by request: FLOTILLA_LONG=1")
    said = example("ppo_sb3", "200")
    before, after = map(float, re.findall(r"G (\d\.\d+) before, (\d\.\d+) after", said)[0])
    assert after > before + 0.1, said


def test_sb3_s_own_checker_finds_nothing():
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="by request: FLOTILLA_LONG=1")
    checker.check_env(flotilla.team_env(Config.paper()), warn=False)


def test_the_adapter_s_example_does_what_it_says():
    pytest.importorskip("stable_baselines3", reason="by request: FLOTILLA_LONG=1")
    adapter = importlib.import_module("flotilla.sb3")
    failed, tried = doctest.testmod(adapter, extraglobs={"flotilla": flotilla})
    assert tried and not failed


def test_a_ppo_written_for_gymnasium_learns():
    """As CleanRL's single files do it: gymnasium's wrappers, spaces and masks, and nothing of flotilla's own."""
    torch = pytest.importorskip("torch", reason="by request: FLOTILLA_LONG=1")
    wrappers = pytest.importorskip("gymnasium.wrappers.vector", reason="gymnasium is not installed")
    torch.manual_seed(1)
    torch.set_num_threads(1)
    # Two leaders alone, with POIs at their sides.
    world = {"leaders": [[22, 30], [28, 30]], "pois": [[14, 30], [36, 30]], "coupling": 1, "steps": 20}
    config = Config(world=world)
    env = VectorEnv(config, 64, "D", layout="flat", autoreset="same_step", time_input=True, horizon="terminated", jitter=1.0)
    env = wrappers.NormalizeReward(wrappers.ClipAction(wrappers.RecordEpisodeStatistics(env)), gamma=1.0)
    inputs, outputs = int(np.prod(env.single_observation_space.shape)), int(np.prod(env.single_action_space.shape))

    def network(out):
        return torch.nn.Sequential(torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, out))

    actor, critic, spread = network(outputs), network(1), torch.nn.Parameter(torch.zeros(outputs))
    parameters = [*actor.parameters(), *critic.parameters(), spread]
    optimizer = torch.optim.Adam(parameters, 3e-3)
    steps, returns = 40, []
    now, ended = torch.from_numpy(env.reset(seed=1)[0]), torch.zeros(env.num_envs)
    for _ in range(40):
        kept = []
        for _ in range(steps):
            with torch.no_grad():
                policy = torch.distributions.Normal(actor(now), spread.exp())
                action = policy.sample()
                chance, worth = policy.log_prob(action).sum(-1), critic(now)[:, 0]
            seen, reward, terminated, truncated, infos = env.step(action.numpy())
            kept.append((now, action, chance, worth, torch.from_numpy(reward).float(), ended))
            now, ended = torch.from_numpy(seen), torch.from_numpy(terminated | truncated).float()
            if "episode" in infos:
                returns.append(float(infos["episode"]["r"][infos["_episode"]].mean()))
        now_worth, gain, gains = critic(now)[:, 0].detach(), torch.zeros(env.num_envs), []
        for step in reversed(range(steps)):
            over, after = (ended, now_worth) if step == steps - 1 else (kept[step + 1][5], kept[step + 1][3])
            gain = kept[step][4] + after * (1 - over) - kept[step][3] + 0.95 * (1 - over) * gain
            gains.insert(0, gain)
        observations, actions, chances, worths = (torch.cat([row[part] for row in kept]) for part in range(4))
        gains = torch.cat(gains)
        for _ in range(4):
            for chosen in torch.randperm(len(gains)).chunk(4):
                policy = torch.distributions.Normal(actor(observations[chosen]), spread.exp())
                ratio = (policy.log_prob(actions[chosen]).sum(-1) - chances[chosen]).exp()
                scaled = (gains[chosen] - gains[chosen].mean()) / (gains[chosen].std() + 1e-8)
                loss = -torch.min(ratio * scaled, ratio.clamp(0.8, 1.2) * scaled).mean()
                target = gains[chosen] + worths[chosen]
                loss = loss + 0.5 * (critic(observations[chosen])[:, 0] - target).square().mean()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    # Mean D per leader; both POIs observed by different leaders would be 0.5 each.
    assert np.mean(returns[-5:]) > np.mean(returns[:5]) + 0.1, returns
