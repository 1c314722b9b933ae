"""Runs standard optimisers on the tasks in `configs/tasks/`, at equal numbers of episodes.

    pip install ./python cma numpy scipy
    python benches/peers/tasks.py --episodes 5050 --trials 10 --csv peers.csv
    python benches/peers/tasks.py --episodes 5050 --trials 5 --csv peers.csv --optimisers ppo-shared
    python benches/peers/tasks.py --csv peers.csv --episodes 0       # only prints the table

PPO needs the package stable-baselines3.

All optimisers maximise G of the whole team, and start with policies drawn from N(0, 1):

- `cma`: CMA-ES of the package `cma`. One shared policy has a full covariance matrix. Own policies have a diagonal one
  (separable CMA-ES), because the full matrix of four policies takes most of the time. The stopping rules are off: they
  mistake the few values of G for convergence.
- `openai-es`: flotilla's own evolution strategy with default keys, in 100 generations.
- `tournament`: flotilla's coevolution with 10 % elites, in 100 generations.
- `ppo`: PPO of Stable-Baselines3, with the same network and one shared policy. Its reward is the share of POIs that the
  team newly observes at each step. It starts from Stable-Baselines3's own small weights. Teams play in batches of the
  same size as populations.

`found` is the largest G of any team that was played. Starts are fixed, so this team reaches it again (with PPO only with
the same noise on its actions). `end` is G at the end: of a strategy's mean, of the team of champions, or of PPO's policy
without noise. `seconds` is the processor's time per trial. Rows that the file already has are not run again.
"""

import argparse
import csv
import os
import time
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # Small matrices: more threads only wait for each other.

import numpy as np
from scipy import stats

import flotilla

# 0.003 was no better in three tasks, with other seeds.
PPO_RATE = 0.001
TASKS = Path(__file__).resolve().parents[2] / "configs/tasks"
OPTIMISERS = [f"{name}-{policies}" for name in ("cma", "openai-es", "tournament") for policies in ("shared", "own")]
OPTIMISERS.append("ppo-shared")
GENERATIONS = 100
FIELDS = ["task", "optimiser", "episodes", "trial", "found", "end", "seconds"]


def cma_es(config: flotilla.Config, shared: bool, episodes: int, size: int, seed: int) -> tuple[float, float]:
    """Runs CMA-ES once. Returns the largest G and that of the last mean."""
    import cma

    warnings.filterwarnings("ignore", module="cma")
    policies = 1 if shared else config.num_learners
    options = {"seed": seed, "popsize": size, "CMA_diagonal": not shared, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(policies * config.parameters * [0.0], 1.0, options)

    def play(candidates) -> np.ndarray:
        teams = np.asarray(candidates, dtype=np.float32).reshape(len(candidates), policies, config.parameters)
        return flotilla.rollout(config, np.ascontiguousarray(teams.transpose(1, 0, 2)), backend="cpu").g

    found = 0.0
    for _ in range(episodes // size):
        candidates = strategy.ask()
        g = play(candidates)
        found = max(found, float(g.max()))
        strategy.tell(candidates, (-g).tolist())
    return found, float(play([strategy.result.xfavorite])[0])


def ppo(config: flotilla.Config, episodes: int, size: int, seed: int) -> tuple[float, float]:
    """Runs PPO once, with one policy that all leaders share. Returns the largest G and that of the last policy."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from flotilla.sb3 import LeaderVecEnv

    class Largest(BaseCallback):
        g = 0.0

        def _on_step(self) -> bool:
            self.g = max(self.g, *(info.get("g", 0.0) for info in self.locals["infos"]))
            return True

    torch.set_num_threads(1)
    steps, largest = config["world.steps"], Largest()
    env = LeaderVecEnv(config, size, reward="G", horizon="terminated")
    network = {"net_arch": {"pi": config["policy.hidden"], "vf": [64, 64]}, "activation_fn": torch.nn.Tanh}
    batch = steps * env.num_envs // 4
    model = PPO("MlpPolicy", env, PPO_RATE, steps, batch, gamma=1.0, policy_kwargs=network, seed=seed, device="cpu")
    model.learn(episodes // size * steps * env.num_envs, largest)
    last = flotilla.VectorEnv(config, 1, layout="flat", autoreset="disabled")
    seen, g = last.reset()[0], 0.0
    for _ in range(steps):
        seen, rewards, *_ = last.step(model.predict(seen, deterministic=True)[0])
        g += float(rewards[0])
    return largest.g, g


def trained(config: flotilla.Config, method: str, shared: bool, episodes: int, trials: int) -> list[tuple[float, float]]:
    """Trains with flotilla's own methods. Returns the same two values for each trial."""
    learning = {"method": method, "sharing": "all" if shared else "none", "elites": "10%", "fitness": "G", "trials": trials,
                "generations": GENERATIONS, "population": episodes // (GENERATIONS + 1)}
    metrics = flotilla.train(config.replace(learning=learning), seed=777, backend="cpu", progress=False).metrics
    found = np.maximum(metrics["best_g"], metrics["champion_g"]).max(axis=1)
    return list(zip(found.tolist(), metrics["champion_g"][:, -1].tolist(), strict=True))


def read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def run(arguments: argparse.Namespace) -> None:
    there = {tuple(row[field] for field in FIELDS[:4]) for row in read(arguments.csv)}
    new = not arguments.csv.exists()
    with arguments.csv.open("a", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        if new:
            table.writerow(FIELDS)
        for optimiser in arguments.optimisers.split(","):
            method, policies = optimiser.rsplit("-", 1)
            for task in arguments.tasks.split(","):
                config, start = flotilla.Config.load(TASKS / f"{task}.toml"), time.perf_counter()
                if policies == "own" and config.num_learners == 1:
                    continue  # One leader has one policy.
                trials = range(1, arguments.trials + 1)
                missing = [n for n in trials if (task, optimiser, str(arguments.episodes), str(n)) not in there]
                size = arguments.popsize or (50 if arguments.episodes < 100_000 else 500)
                rows, begin = None, time.process_time()
                if method in ("openai-es", "tournament") and missing:
                    rows = trained(config, method, policies == "shared", arguments.episodes, arguments.trials)
                    seconds = (time.process_time() - begin) / arguments.trials
                for n in missing:
                    if rows:
                        row = rows[n - 1]
                    else:
                        begin = time.process_time()
                        if method == "ppo":
                            row = ppo(config, arguments.episodes, size, n)
                        else:
                            row = cma_es(config, policies == "shared", arguments.episodes, size, n)
                        seconds = time.process_time() - begin
                    table.writerow([task, optimiser, arguments.episodes, n, *(f"{g:.4f}" for g in row), f"{seconds:.2f}"])
                    file.flush()
                print(f"{task} {optimiser}: {time.perf_counter() - start:.0f} s", flush=True)


def cell(values: list[float]) -> str:
    """Returns the mean with the 95 % interval of `flotilla compare`, and the number of trials that reach 0.9."""
    more = [*values, 0.0, 1.0]
    low, high = np.clip(stats.t.interval(0.95, len(more) - 1, np.mean(more), stats.sem(more)), 0, 1)
    solved = sum(value >= 0.9 for value in values)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}] ({solved} of {len(values)})"


def show(rows: list[dict[str, str]], field: str) -> None:
    columns = sorted({(int(row["episodes"]), OPTIMISERS.index(row["optimiser"])) for row in rows})
    print(f"\n{field}:\n\n| task |", *(f"{OPTIMISERS[optimiser]}, {episodes} |" for episodes, optimiser in columns))
    print("|---" * (len(columns) + 1) + "|")
    for task in sorted({row["task"] for row in rows}):
        print(f"| {task} |", end="")
        for episodes, optimiser in columns:
            at = (task, OPTIMISERS[optimiser], str(episodes))
            values = [float(row[field]) for row in rows if (row["task"], row["optimiser"], row["episodes"]) == at]
            print(f" {cell(values) if values else '–'} |", end="")
        print()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", default=",".join(sorted(path.stem for path in TASKS.glob("*.toml"))))
    parser.add_argument("--optimisers", default=",".join(OPTIMISERS[:-1]), help="[default: all but ppo-shared]")
    parser.add_argument("--episodes", type=int, default=5050, help="episodes per trial; 0 runs nothing")
    parser.add_argument("--trials", type=int, default=10)
    size = "candidates per generation of CMA-ES, or teams per batch of PPO [default: 50, or 500 from 100 000 episodes]"
    parser.add_argument("--popsize", type=int, help=size)
    parser.add_argument("--csv", type=Path, default=Path("peers.csv"))
    arguments = parser.parse_args()
    if arguments.episodes:
        run(arguments)
    rows = read(arguments.csv)
    show(rows, "found")
    show(rows, "end")


main()
