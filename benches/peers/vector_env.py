"""Steps of `flotilla.VectorEnv` beside the core's own, and beside VMAS's `discovery`, in one run, by turns.

    python benches/peers/vector_env.py [--teams 4096] [--rounds 5] [--vmas]

Prints agent-steps a second, and what is the same and what is not stands in README.md. VMAS needs `vmas` and a CPU `torch`.
`cargo bench --bench stepping` has the core's stepping by itself; here it is the same `Stepper`, called without the
environment's rewards and resets, and whole rollouts from Python beside those of `flotilla bench`.
"""

import argparse
import json
import statistics
import time

import numpy as np

import flotilla


def rate(act, agent_steps: int, least: float = 0.5) -> float:
    """Agent-steps a second of some calls."""
    start, calls = time.perf_counter(), 0
    while calls == 0 or time.perf_counter() - start < least:
        act()
        calls += 1
    return agent_steps * calls / (time.perf_counter() - start)


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

    agent_steps = teams * agents * steps
    yield f"VectorEnv, {agents} agents", environment, agent_steps
    yield f"its stepper alone, {agents} agents", stepping, agent_steps
    yield f"rollout, {agents} agents", rollout, agent_steps


def vmas(teams: int):
    import torch
    from vmas import make_env

    torch.set_num_threads(torch.get_num_threads())
    env = make_env(scenario="discovery", num_envs=teams, device="cpu", continuous_actions=True, n_agents=12, seed=0)
    actions = [torch.rand(teams, 2) * 2 - 1 for _ in env.agents]
    yield "VMAS discovery, 12 agents", lambda: env.step(actions), teams * 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--vmas", action="store_true", help="also VMAS")
    given = parser.parse_args()
    runs = [*flotillas(given.teams), *(vmas(given.teams) if given.vmas else ())]
    rates: dict[str, list[float]] = {name: [] for name, _, _ in runs}
    for _ in range(given.rounds):
        for name, act, agent_steps in runs:
            rates[name].append(rate(act, agent_steps))
    medians = {name: statistics.median(found) for name, found in rates.items()}
    for name, median in medians.items():
        print(f"{name:<36} {median:>12.3e} agent-steps/s  ({min(rates[name]):.2e} to {max(rates[name]):.2e})")
    print(json.dumps({"teams": given.teams, "rounds": given.rounds, "agent_steps_per_s": medians}))


if __name__ == "__main__":
    main()
