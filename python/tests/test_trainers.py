"""Tests that other optimisers learn with flotilla: CMA-ES, Stable-Baselines3's PPO, and a PPO in the style of CleanRL.

Those that need gigabytes of packages run only in the long form of the tests (`FLOTILLA_LONG=1`).
"""

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


def output_of_example(name, *arguments):
    command = [sys.executable, ROOT / f"python/examples/{name}.py", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=900).stdout


def test_cma_es_learns_a_task_of_the_suite():
    pytest.importorskip("cma", reason="cma is not installed")
    output = output_of_example("cma_shared", "20")
    means = [float(mean) for mean in re.findall(r"^generation +\d+: G .* mean (\d\.\d+)", output, re.M)]
    assert means[-1] > means[0] + 0.05, output


def test_sb3_s_ppo_learns():
    pytest.importorskip("stable_baselines3", reason="by request: FLOTILLA_LONG=1")
    output = output_of_example("ppo_sb3", "200")
    before, after = map(float, re.findall(r"G (\d\.\d+) before, (\d\.\d+) after", output)[0])
    assert after > before + 0.1, output


def test_sb3_s_checker_accepts_team_env():
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="by request: FLOTILLA_LONG=1")
    checker.check_env(flotilla.team_env(Config.paper()), warn=False)


def test_the_docstring_example_of_the_sb3_adapter_runs():
    pytest.importorskip("stable_baselines3", reason="by request: FLOTILLA_LONG=1")
    adapter = importlib.import_module("flotilla.sb3")
    failed, tried = doctest.testmod(adapter, extraglobs={"flotilla": flotilla})
    assert tried and not failed


def test_a_ppo_written_for_gymnasium_learns():
    # Like CleanRL's single-file PPO, it uses Gymnasium's wrappers, spaces and masks, and no functions of flotilla.
    torch = pytest.importorskip("torch", reason="by request: FLOTILLA_LONG=1")
    wrappers = pytest.importorskip("gymnasium.wrappers.vector", reason="gymnasium is not installed")
    torch.manual_seed(1)
    torch.set_num_threads(1)
    # Two leaders without followers, and one POI on each side of them.
    world = {"leaders": [[22, 30], [28, 30]], "pois": [[14, 30], [36, 30]], "coupling": 1, "steps": 20}
    config = Config(world=world)
    options = {"layout": "flat", "autoreset": "same_step", "time_input": True, "horizon": "terminated", "jitter": 1.0}
    env = VectorEnv(config, 64, "D", **options)
    env = wrappers.NormalizeReward(wrappers.ClipAction(wrappers.RecordEpisodeStatistics(env)), gamma=1.0)
    inputs, outputs = int(np.prod(env.single_observation_space.shape)), int(np.prod(env.single_action_space.shape))

    def network(out):
        return torch.nn.Sequential(torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, out))

    actor, critic, log_std = network(outputs), network(1), torch.nn.Parameter(torch.zeros(outputs))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, 3e-3)
    steps, returns = 40, []
    current, ended = torch.from_numpy(env.reset(seed=1)[0]), torch.zeros(env.num_envs)
    for _ in range(40):
        # Tuples of observation, action, log probability, value, reward, and whether the observation starts an episode.
        batch = []
        for _ in range(steps):
            with torch.no_grad():
                policy = torch.distributions.Normal(actor(current), log_std.exp())
                action = policy.sample()
                log_prob, value = policy.log_prob(action).sum(-1), critic(current)[:, 0]
            observation, reward, terminated, truncated, infos = env.step(action.numpy())
            batch.append((current, action, log_prob, value, torch.from_numpy(reward).float(), ended))
            current, ended = torch.from_numpy(observation), torch.from_numpy(terminated | truncated).float()
            if "episode" in infos:
                returns.append(float(infos["episode"]["r"][infos["_episode"]].mean()))
        last_value, advantage, advantages = critic(current)[:, 0].detach(), torch.zeros(env.num_envs), []
        for step in reversed(range(steps)):
            over, next_value = (ended, last_value) if step == steps - 1 else (batch[step + 1][5], batch[step + 1][3])
            error = batch[step][4] + next_value * (1 - over) - batch[step][3]
            advantage = error + 0.95 * (1 - over) * advantage
            advantages.insert(0, advantage)
        observations, actions, log_probs, values = (torch.cat([row[part] for row in batch]) for part in range(4))
        advantages = torch.cat(advantages)
        for _ in range(4):
            for chosen in torch.randperm(len(advantages)).chunk(4):
                policy = torch.distributions.Normal(actor(observations[chosen]), log_std.exp())
                ratio = (policy.log_prob(actions[chosen]).sum(-1) - log_probs[chosen]).exp()
                scaled = (advantages[chosen] - advantages[chosen].mean()) / (advantages[chosen].std() + 1e-8)
                loss = -torch.min(ratio * scaled, ratio.clamp(0.8, 1.2) * scaled).mean()
                target = advantages[chosen] + values[chosen]
                loss = loss + 0.5 * (critic(observations[chosen])[:, 0] - target).square().mean()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    # A return is a leader's D. If each leader observes one POI alone, D is 0.5 for both.
    assert np.mean(returns[-5:]) > np.mean(returns[:5]) + 0.1, returns
