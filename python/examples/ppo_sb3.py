"""Stable-Baselines3's PPO: one policy that all leaders share, learnt from the credit D.

Usage: python ppo_sb3.py [steps per leader]
"""

import sys

import numpy as np
from stable_baselines3 import PPO

import flotilla
from flotilla.sb3 import LeaderVecEnv

# Two leaders alone, with POIs at their sides.
config = flotilla.Config(world={"leaders": [[22, 30], [28, 30]], "pois": [[14, 30], [36, 30]], "coupling": 1, "steps": 20})
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 400
TEAMS = 64


def mean_g(model: PPO) -> float:
    """G of the policy's mean actions, over 64 teams with starts of their own."""
    env = flotilla.VectorEnv(config, TEAMS, layout="flat", autoreset="disabled", time_input=True, jitter=1.0)
    seen, _ = env.reset(seed=1)
    for _ in range(config["world.steps"]):
        seen, *_ = env.step(model.predict(seen, deterministic=True)[0])
    return float(env.observed.mean())


env = LeaderVecEnv(config, TEAMS, reward="D", time_input=True, horizon="terminated", jitter=1.0)
episode = config["world.steps"]
model = PPO("MlpPolicy", env, n_steps=episode, batch_size=episode * env.num_envs // 4, gamma=1.0, learning_rate=1e-3, seed=1, device="cpu")
before = mean_g(model)
model.learn(steps * env.num_envs)
after = mean_g(model)
print(f"G {before:.3f} before, {after:.3f} after {steps} steps per leader")
assert np.isfinite(after)
