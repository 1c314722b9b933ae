"""Compares the speed of two versions of the Python package, and prints tables in Markdown.

    python benches/python.py OLD_PYTHON NEW_PYTHON [ROUNDS]

The arguments are interpreters of two environments, each with one version of the package. Both processes stay alive and
measure each case in alternating rounds. Times are processor times of all threads, so that other programs disturb less.
"""

import statistics
import subprocess
import sys
import time

TEAMS = (1, 64, 4096, 65_536)
# Minimum seconds per measurement.
MIN_SECONDS = 0.2


def case(name: str):
    """Returns a function to time, and how many steps or generations one call has.

    Returns None if the version does not have the feature.
    """
    import numpy as np

    import flotilla

    config = flotilla.Config.paper("generally_forward")
    kind, count = name.split()[:2]
    teams, rng = int(count), np.random.default_rng(0)
    if kind == "step":
        reward, options = name.split()[2], {"copy": False} if name.endswith("reused") else {}
        try:
            env = flotilla.VectorEnv(config, teams, reward=reward, **options)
        except TypeError:
            return None
        actions = rng.uniform(-1, 1, (teams, 4, 2)).astype(np.float32)
        env.reset()

        def episode():
            for _ in range(25):
                env.step(actions)

        return episode, 25
    if kind in ("train", "callback", "own", "asked"):
        config = config.replace(learning={"generations": 50})
        if kind == "train":
            return lambda: flotilla.train(config, backend="cpu"), 51
        if kind == "callback":
            return lambda: flotilla.train(config, backend="cpu", callback=lambda generation: None), 51
        if not hasattr(flotilla, "Coevolution"):
            return None

        def coevolve():
            coevolution = flotilla.Coevolution(config, backend="cpu")
            while not coevolution.done:
                if kind == "asked":
                    coevolution.ask()
                coevolution.tell(coevolution.play().fitness)
            return coevolution.run

        return coevolve, 51
    policies = rng.normal(size=(4, teams, config.parameters)).astype(np.float32)
    arguments = {
        "rollout": {},
        "trace": {"trace": True},
        "positions": {"record": ("positions",)},
        "written": {"out": {"positions": np.empty((teams, 26, 12, 2), np.float32)}},
    }
    call = flotilla.rollout
    if kind == "collect":
        call, arguments["collect"] = getattr(flotilla, "collect", None), {}
    else:
        arguments[kind]["backend"] = "cpu"
    try:
        call(config, policies[:, :1], **{**arguments[kind], "out": None} if kind == "written" else arguments[kind])
    except TypeError:
        return None
    return lambda: call(config, policies, **arguments[kind]), 1


def work() -> None:
    """Reads names of cases, one per line, and prints the microseconds of each. Prints nan if a version lacks one."""
    cases = {}
    for line in sys.stdin:
        name = line.strip()
        if name not in cases:
            cases[name] = case(name)
            if cases[name]:
                # Warm up.
                cases[name][0]()
        spent = float("nan")
        if cases[name]:
            call, parts = cases[name]
            calls, start, began = 0, time.process_time(), time.perf_counter()
            while not calls or time.perf_counter() - began < MIN_SECONDS:
                call()
                calls += 1
            spent = (time.process_time() - start) / calls / parts * 1e6
        print(spent, flush=True)


def main(old: str, new: str, rounds: int = 7) -> None:
    workers = [
        subprocess.Popen([python, __file__, "--work"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for python in (old, new)
    ]

    def ask(worker: subprocess.Popen, name: str) -> float:
        worker.stdin.write(name + "\n")
        worker.stdin.flush()
        return float(worker.stdout.readline())

    def ratio(a: list[float], b: list[float]) -> str:
        ratios = [x / y for x, y in zip(a, b)]
        # nan is not equal to itself.
        return "" if ratios[0] != ratios[0] else f"{statistics.median(ratios):.2f}"

    def number(values: list[float]) -> str:
        return "" if values[0] != values[0] else f"{statistics.median(values):,.1f}"

    steps = [f"step {teams} {reward}" for teams in TEAMS for reward in ("G", "Df")]
    print("| µs | before | now | now / before | `copy=False` / before |\n|---|---|---|---|---|")
    for name in [*steps, *(f"rollout {teams}" for teams in TEAMS)]:
        kinds = [(0, name), (1, name), *([(1, f"{name} reused")] if name.startswith("step") else [])]
        turns = [[ask(workers[which], kind) for which, kind in kinds] for _ in range(rounds)]
        before, now, *reused = map(list, zip(*turns))
        reused_ratio = ratio(*reused, before) if reused else ""
        print(f"| {name} | {number(before)} | {number(now)} | {ratio(now, before)} | {reused_ratio} |")
    print("\n| | before | now |\n|---|---|---|")
    kinds = ("trace", "positions", "written", "collect")
    pairs = [(f"{kind} {teams}", f"rollout {teams}") for teams in (64, 4096) for kind in kinds]
    for kind, base in [*pairs, *((f"{kind} 50", "train 50") for kind in ("callback", "own", "asked"))]:
        cells = []
        for worker in workers:
            turns = [[ask(worker, name) for name in (kind, base)] for _ in range(rounds)]
            cells.append(ratio(*map(list, zip(*turns))))
        print(f"| {kind} / {base} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--work":
        work()
    else:
        main(*sys.argv[1:3], *map(int, sys.argv[3:]))
