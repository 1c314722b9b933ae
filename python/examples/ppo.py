"""Trains leaders with PPO, and compares the result with coevolution of the same networks.

    pip install torch
    python ppo.py [ITERATIONS] [LAYOUT] [PARADIGM] [SEED]

Each leader has its own network, with the architecture of the config, so that `flotilla.rollout` can play what PPO
learns. For training, the network gives the mean of a normal distribution, from which actions are drawn. One critic gets
the inputs of all leaders and the time. The reward of a step is the share of POIs that the team observes for the first
time.
"""

import sys
import time

import numpy as np
import torch

import flotilla

TEAMS, EPOCHS, MINIBATCHES = 128, 4, 8
RATE, CLIP, LAMBDA, ENTROPY, VALUE = 1e-2, 0.2, 0.95, 0.003, 0.5


class Leaders(torch.nn.Module):
    """The leaders' networks, with weights in the layout of `flotilla.rollout`, and the critic of the team."""

    def __init__(self, config: flotilla.Config) -> None:
        super().__init__()
        self.widths = [config.num_inputs, *config["policy.hidden"], 2]
        # Half the standard deviation of evolution's initial weights.
        self.weights = torch.nn.Parameter(0.5 * torch.randn(config.num_learners, config.parameters))
        self.log_std = torch.nn.Parameter(torch.full((config.num_learners, 2), -0.7))
        inputs = config.num_learners * config.num_inputs + 1
        layers = [torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()]
        self.critic = torch.nn.Sequential(*layers, torch.nn.Linear(64, 1))

    def distribution(self, observations: torch.Tensor) -> torch.distributions.Normal:
        """Returns the distribution of actions, [teams, leaders, 2], for observations, [teams, leaders, inputs]."""
        at, values = 0, observations.transpose(0, 1)
        for before, after in zip(self.widths, self.widths[1:]):
            layer = self.weights[:, at : at + (before + 1) * after].view(-1, before + 1, after)
            values = torch.tanh(torch.baddbmm(layer[:, -1:], values, layer[:, :-1]))
            at += (before + 1) * after
        return torch.distributions.Normal(values.transpose(0, 1), self.log_std.exp())

    def value(self, observations: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        """Returns the critic's estimate of the rewards until the end of the episode."""
        return self.critic(torch.cat([observations.flatten(-2), times[..., None]], -1))[..., 0]


def learn(config: flotilla.Config, iterations: int, seed: int) -> np.ndarray:
    """Returns policies, [leaders, 1, parameters]. In each iteration, every team plays one episode."""
    torch.manual_seed(seed)
    steps, leaders = config["world.steps"], Leaders(config)
    optimizer = torch.optim.Adam(leaders.parameters(), RATE, eps=1e-5)
    env = flotilla.VectorEnv(config, TEAMS, reward="G", autoreset="same_step")
    times = (torch.arange(steps) / steps)[:, None].expand(steps, TEAMS)
    current, _ = env.reset(seed=seed)
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = RATE * (1 - iteration / iterations)
        observations, actions, log_probs, rewards = [], [], [], []
        with torch.no_grad():
            for _ in range(steps):
                observations.append(torch.from_numpy(current))
                distribution = leaders.distribution(observations[-1])
                actions.append(distribution.sample())
                log_probs.append(distribution.log_prob(actions[-1]).sum(-1))
                current, reward, _, _, _ = env.step(actions[-1].numpy())
                rewards.append(torch.from_numpy(reward[:, 0].copy()))
            observations, actions, log_probs, rewards = map(torch.stack, (observations, actions, log_probs, rewards))
            # A batch is one whole episode, so the value after the last step is 0.
            values = torch.cat([leaders.value(observations, times), torch.zeros(1, TEAMS)])
            advantages, advantage = torch.empty(steps, TEAMS), torch.zeros(TEAMS)
            for step in reversed(range(steps)):
                advantage = rewards[step] + values[step + 1] - values[step] + LAMBDA * advantage
                advantages[step] = advantage
            returns = advantages + values[:-1]
            batch = [part.flatten(0, 1) for part in (observations, actions, log_probs, advantages, returns, times)]
        for _ in range(EPOCHS):
            for chosen in torch.randperm(steps * TEAMS).chunk(MINIBATCHES):
                observed, action, old_log_prob, advantage, target, when = (part[chosen] for part in batch)
                distribution = leaders.distribution(observed)
                ratio = (distribution.log_prob(action).sum(-1) - old_log_prob).exp()
                advantage = ((advantage - advantage.mean()) / (advantage.std() + 1e-8))[:, None]
                policy_loss = -torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
                value_loss = (leaders.value(observed, when) - target).square().mean()
                loss = policy_loss + VALUE * value_loss - ENTROPY * distribution.entropy().sum(-1).mean()
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(leaders.parameters(), 0.5)
                optimizer.step()
        if iteration % max(iterations // 10, 1) == 0 or iteration == iterations - 1:
            g = flotilla.rollout(config, leaders.weights.detach().numpy()[:, None], backend="cpu").g[0]
            print(f"iteration {iteration:3}: G {g:.2f} of the means, {rewards.sum(0).mean():.2f} with exploration")
    return leaders.weights.detach().numpy()[:, None]


def main(
    iterations: int = 300, layout: str = "generally_forward", paradigm: str = "leader-follower", seed: int = 1
) -> None:
    # Networks this small run fastest on one thread.
    torch.set_num_threads(1)
    config = flotilla.Config.paper(layout, paradigm=paradigm)
    start = time.process_time()
    policies = learn(config, iterations, seed)
    observed = flotilla.rollout(config, policies, backend="cpu").observed[0]
    seconds = time.process_time() - start
    print(f"PPO: {observed:.0f} POIs after {iterations * TEAMS} episodes in {seconds:.1f} s of processor time")
    # Coevolution with the paper's number of generations, and with as many episodes as PPO.
    population = config["learning.population"]
    for generations in (config["learning.generations"], max(iterations * TEAMS // population - 1, 0)):
        start = time.process_time()
        run = flotilla.train(config.replace(learning={"generations": generations}), seed, backend="cpu", progress=False)
        seconds = (time.process_time() - start) / len(run.policies)
        observed = run.metrics["champion_g"][:, -1] * len(config["world.pois"])
        by_trial = ", ".join(f"{pois:.0f}" for pois in observed)
        episodes = population * (generations + 1)
        print(f"coevolution: {by_trial} POIs by trial, each after {episodes} episodes in {seconds:.2f} s")


if __name__ == "__main__":
    words = sys.argv[1:]
    main(*map(int, words[:1]), *words[1:3], *map(int, words[3:]))
