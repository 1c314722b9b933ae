"""Steps of `flotilla.VectorEnv` beside the core's own, and beside VMAS's `discovery`, in one run, by turns.

    python benches/peers/vector_env.py [--teams 4096] [--rounds 5] [--vmas] [--processor]

Prints agent-steps a second, and shares; what is the same and what is not stands in README.md. VMAS needs `vmas` and `torch`.
The core's own are its `Stepper`, without the environment's rewards and resets, and its rollout, both called as the package
calls them. `--processor` counts the processor's time, of all threads, instead of the clock's: where others share the cores.
"""

import argparse
import json
import statistics
import time

import numpy as np

import flotilla


def rate(act, agent_steps: int, clock, least: float = 0.5) -> float:
    """Agent-steps a second of some calls."""
    start, calls = clock(), 0
    while calls == 0 or clock() - start < least:
        act()
        calls += 1
    return agent_steps * calls / (clock() - start)


def flotillas(teams: int):
    config = flotilla.Config.paper("generally_forward")
    agents = len(config["world.leaders"]) + len(config["world.followers"])
    steps = config["world.steps"]
    actions = np.random.default_rng(0).uniform(-1, 1, (teams, config.leaders, 2)).astype(np.float32)
    env = flotilla.VectorEnv(config, teams, autoreset="same_step")
    env.reset(seed=0)

    def environment():
        for _ in range(steps):
            env.step(actions)

    stepper = flotilla._native.Stepper(config._native, teams, False)

    def stepping():
        stepper.reset(None, None)
        for _ in range(steps):
            stepper.step(actions, None)

    policies = np.random.default_rng(1).normal(size=(config.leaders, teams, config.parameters)).astype(np.float32)

    def rollout():
        flotilla.rollout(config, policies, backend="cpu")

    def core_rollout():
        flotilla._native.rollout(config._native, policies, None, "cpu")

    agent_steps = teams * agents * steps
    yield "VectorEnv", environment, agent_steps
    yield "the core's stepper", stepping, agent_steps
    yield "rollout", rollout, agent_steps
    yield "the core's rollout", core_rollout, agent_steps


def vmas(teams: int):
    import torch
    from vmas import make_env

    # As many agents and POIs as generally forward has, three to observe one.
    world = {"n_agents": 12, "n_targets": 4, "agents_per_target": 3}
    env = make_env(scenario="discovery", num_envs=teams, device="cpu", continuous_actions=True, seed=0, **world)
    actions = [torch.rand(teams, 2) * 2 - 1 for _ in env.agents]
    yield "VMAS discovery", lambda: env.step(actions), teams * 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--vmas", action="store_true", help="also VMAS")
    parser.add_argument("--processor", action="store_true", help="by the processor's time")
    given = parser.parse_args()
    clock = time.process_time if given.processor else time.perf_counter
    runs = [*flotillas(given.teams), *(vmas(given.teams) if given.vmas else ())]
    rates: dict[str, list[float]] = {name: [] for name, _, _ in runs}
    for _ in range(given.rounds):
        for name, act, agent_steps in runs:
            rates[name].append(rate(act, agent_steps, clock))
    medians = {name: statistics.median(found) for name, found in rates.items()}
    for name, median in medians.items():
        print(f"{name:<20} {median:>12.3e} agent-steps/s  ({min(rates[name]):.2e} to {max(rates[name]):.2e})")
    for ours, theirs in (("VectorEnv", "the core's stepper"), ("rollout", "the core's rollout"), ("VectorEnv", "VMAS discovery")):
        if theirs in rates:
            share = statistics.median(one / other for one, other in zip(rates[ours], rates[theirs]))
            print(f"{ours} is {share:.3g} times {theirs}")
    print(json.dumps({"teams": given.teams, "rounds": given.rounds, "agent_steps_per_s": medians}))


if __name__ == "__main__":
    main()
