"""Leaders' policies by PPO, in one file, and where it stands beside coevolution of the same networks.

    pip install torch
    python ppo.py [ITERATIONS] [LAYOUT] [PARADIGM] [SEED]

Every leader has a network of its own, the config's, so that what PPO learns is played by `flotilla.rollout` like any team.
It gives the mean of a normal distribution that actions are drawn from; one critic sees what all leaders sense, and the time.
The reward is the share of POIs that the team observes for the first time at a step.
"""

import sys
import time

import numpy as np
import torch

import flotilla

TEAMS, EPOCHS, MINIBATCHES = 128, 4, 8
RATE, CLIP, LAMBDA, ENTROPY, VALUE = 1e-2, 0.2, 0.95, 0.003, 0.5


class Leaders(torch.nn.Module):
    """The leaders' networks, their weights laid out as `flotilla.rollout` takes them, and a critic of the team."""

    def __init__(self, config: flotilla.Config) -> None:
        super().__init__()
        self.widths = [8, *config["policy.hidden"], 2]
        # The starts that evolution has, only less far from zero.
        self.weights = torch.nn.Parameter(0.5 * torch.randn(config.num_learners, config.parameters))
        self.spread = torch.nn.Parameter(torch.full((config.num_learners, 2), -0.7))
        inputs = config.num_learners * 8 + 1
        layers = [torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()]
        self.critic = torch.nn.Sequential(*layers, torch.nn.Linear(64, 1))

    def actions(self, seen: torch.Tensor) -> torch.distributions.Normal:
        """Of `[teams, leaders, 8]`, distributions over `[teams, leaders, 2]`."""
        at, values = 0, seen.transpose(0, 1)
        for before, after in zip(self.widths, self.widths[1:]):
            layer = self.weights[:, at : at + (before + 1) * after].view(-1, before + 1, after)
            values = torch.tanh(torch.baddbmm(layer[:, -1:], values, layer[:, :-1]))
            at += (before + 1) * after
        return torch.distributions.Normal(values.transpose(0, 1), self.spread.exp())

    def worth(self, seen: torch.Tensor, age: torch.Tensor) -> torch.Tensor:
        return self.critic(torch.cat([seen.flatten(-2), age[..., None]], -1))[..., 0]


def learn(config: flotilla.Config, iterations: int, seed: int) -> np.ndarray:
    """Policies `[leaders, 1, parameters]` after so many iterations of one episode of every team."""
    torch.manual_seed(seed)
    steps, leaders = config["world.steps"], Leaders(config)
    optimizer = torch.optim.Adam(leaders.parameters(), RATE, eps=1e-5)
    env = flotilla.VectorEnv(config, TEAMS, reward="G", autoreset="same_step")
    ages = (torch.arange(steps) / steps)[:, None].expand(steps, TEAMS)
    now, _ = env.reset(seed=seed)
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = RATE * (1 - iteration / iterations)
        seen, done, chances, rewards = [], [], [], []
        with torch.no_grad():
            for _ in range(steps):
                seen.append(torch.from_numpy(now))
                distribution = leaders.actions(seen[-1])
                done.append(distribution.sample())
                chances.append(distribution.log_prob(done[-1]).sum(-1))
                now, reward, _, _, _ = env.step(done[-1].numpy())
                rewards.append(torch.from_numpy(reward[:, 0].copy()))
            seen, done, chances, rewards = map(torch.stack, (seen, done, chances, rewards))
            worth = torch.cat([leaders.worth(seen, ages), torch.zeros(1, TEAMS)])
            # Episodes are as long as a batch: after the last step there is nothing to come.
            gains, gain = torch.empty(steps, TEAMS), torch.zeros(TEAMS)
            for step in reversed(range(steps)):
                gain = rewards[step] + worth[step + 1] - worth[step] + LAMBDA * gain
                gains[step] = gain
            returns = gains + worth[:-1]
            flat = [part.flatten(0, 1) for part in (seen, done, chances, gains, returns, ages)]
        for _ in range(EPOCHS):
            for chosen in torch.randperm(steps * TEAMS).chunk(MINIBATCHES):
                saw, did, chance, gain, worth, age = (part[chosen] for part in flat)
                distribution = leaders.actions(saw)
                ratio = (distribution.log_prob(did).sum(-1) - chance).exp()
                gain = ((gain - gain.mean()) / (gain.std() + 1e-8))[:, None]
                policy = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                value = (leaders.worth(saw, age) - worth).square().mean()
                loss = policy + VALUE * value - ENTROPY * distribution.entropy().sum(-1).mean()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(leaders.parameters(), 0.5)
                optimizer.step()
        if iteration % max(iterations // 10, 1) == 0 or iteration == iterations - 1:
            played = flotilla.rollout(config, leaders.weights.detach().numpy()[:, None], backend="cpu")
            print(f"iteration {iteration:3}: G {played.g[0]:.2f} of the means, {rewards.sum(0).mean():.2f} as they explore")
    return leaders.weights.detach().numpy()[:, None]


def main(iterations: int = 300, layout: str = "generally_forward", paradigm: str = "leader-follower", seed: int = 1) -> None:
    # Networks this small are not worth a second thread.
    torch.set_num_threads(1)
    config = flotilla.Config.paper(layout, paradigm=paradigm)
    start = time.process_time()
    policies = learn(config, iterations, seed)
    found = flotilla.rollout(config, policies, backend="cpu").observed[0]
    print(f"PPO: {found:.0f} POIs after {iterations * TEAMS} episodes in {time.process_time() - start:.1f} s of processor time")
    # As the paper does, and by as many episodes as PPO had.
    population = config["learning.population"]
    for generations in (config["learning.generations"], max(iterations * TEAMS // population - 1, 0)):
        start = time.process_time()
        run = flotilla.train(config.replace(learning={"generations": generations}), seed, backend="cpu", progress=False)
        took = (time.process_time() - start) / len(run.policies)
        found = run.metrics["champion_g"][:, -1] * len(config["world.pois"])
        each = ", ".join(f"{pois:.0f}" for pois in found)
        print(f"coevolution: {each} POIs by trial, each after {population * (generations + 1)} episodes in {took:.2f} s")


if __name__ == "__main__":
    words = sys.argv[1:]
    main(*map(int, words[:1]), *words[1:3], *map(int, words[3:]))
