"""Compares the speed of `flotilla.VectorEnv` with that of the Rust core and of VMAS's `discovery`.

    python benches/peers/vector_env.py [--teams 4096] [--rounds 5] [--vmas] [--processor]

Prints agent-steps per second and ratios, measured in alternating rounds. README.md lists the differences to VMAS, which
needs `vmas` and `torch`. The core's functions are its `Stepper`, without the environment's rewards and resets, and its
rollout. They are called as the package calls them. `--processor` measures the processor time of all threads, for
machines whose cores other programs share.
"""

import argparse
import json
import statistics
import time

import numpy as np

import flotilla


def rate(call, agent_steps: int, clock, min_seconds: float = 0.5) -> float:
    """Returns the agent-steps per second of repeated calls."""
    start, calls = clock(), 0
    while calls == 0 or clock() - start < min_seconds:
        call()
        calls += 1
    return agent_steps * calls / (clock() - start)


def flotilla_calls(teams: int):
    """Yields names, functions to time, and the agent-steps of a call."""
    config = flotilla.Config.paper("generally_forward")
    agents = len(config["world.leaders"]) + len(config["world.followers"])
    steps = config["world.steps"]
    actions = np.random.default_rng(0).uniform(-1, 1, (teams, config.num_learners, 2)).astype(np.float32)
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

    policies = np.random.default_rng(1).normal(size=(config.num_learners, teams, config.parameters)).astype(np.float32)

    def rollout():
        flotilla.rollout(config, policies, backend="cpu")

    def core_rollout():
        flotilla._native.rollout(config._native, policies, None, "cpu")

    agent_steps = teams * agents * steps
    yield "VectorEnv", environment, agent_steps
    yield "the core's stepper", stepping, agent_steps
    yield "rollout", rollout, agent_steps
    yield "the core's rollout", core_rollout, agent_steps


def vmas_calls(teams: int):
    """Yields the same for VMAS."""
    import torch
    from vmas import make_env

    # As in the layout generally_forward: 12 agents, 4 POIs, and three agents to observe one.
    world = {"n_agents": 12, "n_targets": 4, "agents_per_target": 3}
    env = make_env(scenario="discovery", num_envs=teams, device="cpu", continuous_actions=True, seed=0, **world)
    actions = [torch.rand(teams, 2) * 2 - 1 for _ in env.agents]
    yield "VMAS discovery", lambda: env.step(actions), teams * 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--vmas", action="store_true", help="measure VMAS, too")
    parser.add_argument("--processor", action="store_true", help="measure processor time instead of elapsed time")
    options = parser.parse_args()
    clock = time.process_time if options.processor else time.perf_counter
    calls = [*flotilla_calls(options.teams), *(vmas_calls(options.teams) if options.vmas else ())]
    rates: dict[str, list[float]] = {name: [] for name, _, _ in calls}
    for _ in range(options.rounds):
        for name, call, agent_steps in calls:
            rates[name].append(rate(call, agent_steps, clock))
    medians = {name: statistics.median(values) for name, values in rates.items()}
    for name, median in medians.items():
        print(f"{name:<20} {median:>12.3e} agent-steps/s  ({min(rates[name]):.2e} to {max(rates[name]):.2e})")
    pairs = ("VectorEnv", "the core's stepper"), ("rollout", "the core's rollout"), ("VectorEnv", "VMAS discovery")
    for ours, theirs in pairs:
        if theirs in rates:
            ratio = statistics.median(a / b for a, b in zip(rates[ours], rates[theirs]))
            print(f"{ours} is {ratio:.3g} times as fast as {theirs}")
    print(json.dumps({"teams": options.teams, "rounds": options.rounds, "agent_steps_per_s": medians}))


if __name__ == "__main__":
    main()
