"""Trains one policy that all leaders share, with CMA-ES.

    pip install cma
    python cma_shared.py [GENERATIONS]

Any optimiser with an ask-and-tell interface can drive flotilla like this. Each candidate is one team, in which every
leader uses the same policy. The array of policies therefore has the shape [1, candidates, parameters].

The fitness is G of the team plus 0.05 times the mean D++ of its leaders. D++ ranks the teams that observe no POI, whose
G is 0.
"""

import pathlib
import sys
import time

import cma
import numpy as np

import flotilla


def main(generations: int = 60) -> None:
    # Four groups have to meet. No baseline solves this task (docs/results/tasks.md).
    config = flotilla.Config.load(pathlib.Path(__file__).parents[2] / "configs/tasks/merge.toml")
    strategy = cma.CMAEvolutionStrategy(config.parameters * [0.0], 1.0, {"seed": 1, "popsize": 64, "verbose": -9})
    start, best = time.perf_counter(), 0.0
    for generation in range(generations):
        candidates = strategy.ask()
        scores = flotilla.rollout(config, np.asarray(candidates)[None], backend="cpu")
        # CMA-ES minimises.
        strategy.tell(candidates, list(-scores.g - 0.05 * scores.dpp.mean(axis=1)))
        best = max(best, float(scores.g.max()))
        if generation % 10 == 0 or generation == generations - 1:
            print(f"generation {generation:3}: G {scores.g.max():.2f} of the best, mean {scores.g.mean():.2f}")
    print(f"best G {best:.2f} after {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
