"""One policy that all leaders share, by CMA-ES: any optimiser that asks and tells can drive flotilla.

    pip install cma
    python cma_shared.py [GENERATIONS]

Every candidate is a team whose leaders all play it: policies of shape [1, candidates, parameters]. What is told is the G of
the team, and a little of its leaders' D++, which tells apart teams that observe nothing.
"""

import pathlib
import sys
import time

import cma
import numpy as np

import flotilla


def main(generations: int = 60) -> None:
    # Four groups that have to meet, a task that no constant speed solves.
    config = flotilla.Config.load(pathlib.Path(__file__).parents[2] / "configs/tasks/merge.toml")
    strategy = cma.CMAEvolutionStrategy(config.parameters * [0.0], 1.0, {"seed": 1, "popsize": 64, "verbose": -9})
    start, best = time.perf_counter(), 0.0
    for generation in range(generations):
        candidates = strategy.ask()
        scores = flotilla.rollout(config, np.asarray(candidates)[None], backend="cpu")
        strategy.tell(candidates, list(-scores.g - 0.05 * scores.dpp.mean(axis=1)))
        best = max(best, float(scores.g.max()))
        if generation % 10 == 0 or generation == generations - 1:
            print(f"generation {generation:3}: G {scores.g.max():.2f} of the best, mean {scores.g.mean():.2f}")
    print(f"best G {best:.2f} after {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
