"""Trains one policy that all leaders share, with Stable-Baselines3's PPO and the credit D as reward.

    pip install stable-baselines3
    python ppo_sb3.py [STEPS PER LEADER]
"""

import sys

import numpy as np
from stable_baselines3 import PPO

import flotilla
from flotilla.sb3 import LeaderVecEnv

# Two leaders without followers, and one POI on each side of them.
config = flotilla.Config(
    world={"leaders": [[22, 30], [28, 30]], "pois": [[14, 30], [36, 30]], "coupling": 1, "steps": 20}
)
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 400
TEAMS = 64


def mean_g(model: PPO) -> float:
    """Returns the mean G over teams with random starts, without exploration."""
    env = flotilla.VectorEnv(config, TEAMS, layout="flat", autoreset="disabled", time_input=True, jitter=1.0)
    observations, _ = env.reset(seed=1)
    for _ in range(config["world.steps"]):
        observations, *_ = env.step(model.predict(observations, deterministic=True)[0])
    return float(env.observed.mean())


env = LeaderVecEnv(config, TEAMS, reward="D", time_input=True, horizon="terminated", jitter=1.0)
episode = config["world.steps"]
batch = episode * env.num_envs // 4
model = PPO(
    "MlpPolicy", env, n_steps=episode, batch_size=batch, gamma=1.0, learning_rate=1e-3, seed=1, device="cpu"
)
before = mean_g(model)
model.learn(steps * env.num_envs)
after = mean_g(model)
print(f"G {before:.3f} before, {after:.3f} after {steps} steps per leader")
assert np.isfinite(after)
