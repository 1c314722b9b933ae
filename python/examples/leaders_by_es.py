"""Trains leaders with an evolution strategy of a few lines: one strategy per leader, each with that leader's credit.

    python leaders_by_es.py [GENERATIONS]

Each leader draws candidates around its own mean policy. Team t consists of candidate t of every leader. The strategy of
a leader maximises that leader's Df. Df measures the leader's own contribution, while G also depends on its partners.
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
        # Mirrored sampling: each draw is used with both signs.
        half = rng.normal(size=(config.num_learners, CANDIDATES // 2, config.parameters))
        noise = np.concatenate([half, -half], axis=1)
        scores = flotilla.rollout(config, means + SIGMA * noise, backend="cpu")
        # Credits become ranks from -0.5 to 0.5. A leader whose candidates have equal credits is not changed.
        ranks = scores.df.T.argsort(axis=1).argsort(axis=1) / (CANDIDATES - 1) - 0.5
        ranks[scores.df.T.std(axis=1) == 0] = 0
        means += RATE / SIGMA * np.einsum("lc,lcp->lp", ranks, noise)[:, None] / CANDIDATES
        if generation % 10 == 0 or generation == generations - 1:
            g = flotilla.rollout(config, means, backend="cpu").g[0]
            print(f"generation {generation:3}: G {g:.2f} of the means, {scores.g.mean():.2f} of the candidates")
    print(f"{time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
