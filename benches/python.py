"""Times the Python package against an earlier version, by turns, and prints tables in Markdown.

    python benches/python.py OLD_PYTHON NEW_PYTHON [ROUNDS]

The arguments are interpreters of two environments, each with one version of the package. Both processes stay alive and
measure each case in turn. Times are of the processor, of all threads, so that other programs disturb less.
"""

import statistics
import subprocess
import sys
import time

TEAMS = (1, 64, 4096, 65_536)
# Seconds that one measurement takes at least.
LEAST = 0.2


def case(name: str):
    """Returns a function to time, and how many steps or generations one call has, or None if the version lacks it."""
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
    if kind in ("train", "own", "asked"):
        config = config.replace(learning={"generations": 50})
        if kind == "train":
            return lambda: flotilla.train(config, backend="cpu"), 51
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
    words = {
        "rollout": {},
        "trace": {"trace": True},
        "positions": {"record": ("positions",)},
        "written": {"out": {"positions": np.empty((teams, 26, 12, 2), np.float32)}},
    }
    call = flotilla.rollout
    if kind == "collect":
        call, words["collect"] = getattr(flotilla, "collect", None), {}
    else:
        words[kind]["backend"] = "cpu"
    try:
        call(config, policies[:, :1], **{**words[kind], "out": None} if kind == "written" else words[kind])
    except TypeError:
        return None
    return lambda: call(config, policies, **words[kind]), 1


def work() -> None:
    """Measures the cases that come in, one per line. Prints microseconds, or nan for what this version lacks."""
    made = {}
    for line in sys.stdin:
        name = line.strip()
        if name not in made:
            made[name] = case(name)
            if made[name]:
                made[name][0]()
        spent = float("nan")
        if made[name]:
            call, parts = made[name]
            calls, start, began = 0, time.process_time(), time.perf_counter()
            while not calls or time.perf_counter() - began < LEAST:
                call()
                calls += 1
            spent = (time.process_time() - start) / calls / parts * 1e6
        print(spent, flush=True)


def main(old: str, new: str, rounds: int = 7) -> None:
    words = [sys.executable, __file__, "--work"]
    workers = [
        subprocess.Popen([python, *words[1:]], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for python in (old, new)
    ]

    def ask(worker: subprocess.Popen, name: str) -> float:
        worker.stdin.write(name + "\n")
        worker.stdin.flush()
        return float(worker.stdout.readline())

    def ratio(a: list[float], b: list[float]) -> str:
        found = [one / other for one, other in zip(a, b)]
        return "" if found[0] != found[0] else f"{statistics.median(found):.2f}"

    def number(values: list[float]) -> str:
        return "" if values[0] != values[0] else f"{statistics.median(values):,.1f}"

    steps = [f"step {teams} {reward}" for teams in TEAMS for reward in ("G", "Df")]
    print("| µs | before | now | now / before | `copy=False` / before |\n|---|---|---|---|---|")
    for name in [*steps, *(f"rollout {teams}" for teams in TEAMS)]:
        kinds = [(0, name), (1, name), *([(1, f"{name} reused")] if name.startswith("step") else [])]
        turns = [[ask(workers[which], kind) for which, kind in kinds] for _ in range(rounds)]
        before, now, *reused = map(list, zip(*turns))
        print(f"| {name} | {number(before)} | {number(now)} | {ratio(now, before)} | {ratio(*reused, before) if reused else ''} |")
    print("\n| | before | now |\n|---|---|---|")
    pairs = [(f"{kind} {teams}", f"rollout {teams}") for teams in (64, 4096) for kind in ("trace", "positions", "written", "collect")]
    for kind, base in [*pairs, ("own 50", "train 50"), ("asked 50", "train 50")]:
        found = []
        for worker in workers:
            turns = [[ask(worker, name) for name in (kind, base)] for _ in range(rounds)]
            found.append(ratio(*map(list, zip(*turns))))
        print(f"| {kind} / {base} | {' | '.join(found)} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--work":
        work()
    else:
        main(*sys.argv[1:3], *map(int, sys.argv[3:]))
