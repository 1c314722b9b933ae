"""Leaders' policies by an evolution strategy of a few lines, each leader's by its own credit.

    python leaders_by_es.py [GENERATIONS]

Every leader has a mean of its own, and asks for as many candidates; team t is made of every leader's candidate t. What a
leader's strategy is told is that leader's Df, so that it learns from what it was worth, not from the luck of its team.
"""

import sys
import time

import numpy as np

import flotilla

CANDIDATES, SIGMA, RATE = 200, 0.3, 0.3


def main(generations: int = 60) -> None:
    config = flotilla.Config.paper("generally_forward")
    rng = np.random.default_rng(1)
    means = rng.normal(0, 0.5, (config.num_learners, 1, config.parameters))
    start = time.perf_counter()
    for generation in range(generations):
        # Every draw and its mirror.
        half = rng.normal(size=(config.num_learners, CANDIDATES // 2, config.parameters))
        noise = np.concatenate([half, -half], axis=1)
        scores = flotilla.rollout(config, means + SIGMA * noise, backend="cpu")
        ranks = scores.df.T.argsort(axis=1).argsort(axis=1) / (CANDIDATES - 1) - 0.5
        ranks[scores.df.T.std(axis=1) == 0] = 0
        means += RATE / SIGMA * np.einsum("lc,lcp->lp", ranks, noise)[:, None] / CANDIDATES
        if generation % 10 == 0 or generation == generations - 1:
            alone = flotilla.rollout(config, means, backend="cpu")
            print(f"generation {generation:3}: G {alone.g[0]:.2f} of the means, of their candidates {scores.g.mean():.2f}")
    print(f"{time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
