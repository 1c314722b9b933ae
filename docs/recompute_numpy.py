"""Trains champions with a second simulator, the peer in NumPy, for docs/results/recomputed.md.

    python3 docs/recompute_numpy.py LAYOUT ARM [TRIALS]      # ARM: agent, group or followers; G, 50 policies, 100 generations

The simulator is benches/peers/paper_numpy.py. Learning is written anew here: tournaments of two, ties to the first drawn, one
elite, ties at random. With `group`, the agents of a group share a population without followers.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benches/peers"))
arguments, sys.argv[1:] = sys.argv[1:], ["--rollout", "generally_forward", "--teams", "512"]
import paper_numpy as peer  # It plays these 512 teams when it is imported.

GENERATIONS, POLICIES = 100, 50


def champions(layout, arm, trials, seed=31337):
    """Returns the G of each trial's champion."""
    random, world = np.random.default_rng(seed), peer.make_world(layout, arm != "followers")
    groups, leaders = len(world.pois), world.leaders
    # The population of each learner. In an all-leaders team, the former leaders come first.
    owner = np.arange(leaders)
    if arm == "group":
        owner[groups:] = np.repeat(np.arange(groups), leaders // groups - 1)
    count = owner.max() + 1
    policies = random.standard_normal((trials, count, POLICIES, peer.WEIGHTS), np.float32)

    def played(weights):
        """Returns G of teams of policies [trials, populations, teams, WEIGHTS]."""
        weights = weights[:, owner].transpose(1, 3, 0, 2).reshape(leaders, peer.WEIGHTS, -1)
        return peer.rollout(world, np.ascontiguousarray(weights), ["G"])[0].reshape(trials, -1)

    def best_of(score):
        """Returns the best policy of each population, ties at random."""
        return (score + 1e-6 * random.random(score.shape, np.float32)).argmax(2)[..., None]

    for generation in range(GENERATIONS + 1):
        order = random.permuted(np.broadcast_to(np.arange(POLICIES), (trials, count, POLICIES)), axis=2)
        score = np.empty((trials, count, POLICIES), np.float32)
        teams = played(peer.chosen(policies, order))[:, None]
        np.put_along_axis(score, order, np.broadcast_to(teams, score.shape), 2)
        if generation == GENERATIONS:
            return played(peer.chosen(policies, best_of(score)))[:, 0]
        first = random.integers(POLICIES, size=(trials, count, POLICIES - 1))
        second = random.integers(POLICIES - 1, size=first.shape)
        second += second >= first
        wins = np.take_along_axis(score, first, 2) >= np.take_along_axis(score, second, 2)
        policies = peer.chosen(policies, np.concatenate([best_of(score), np.where(wins, first, second)], axis=2))
        mutated = random.random((trials, count, POLICIES - 1, peer.WEIGHTS), np.float32) < peer.MUTATION_PROBABILITY
        noise = random.standard_normal(np.count_nonzero(mutated), np.float32)
        policies[:, :, 1:][mutated] *= 1 + np.float32(peer.MUTATION_SIGMA) * noise


layout, arm, *trials = arguments
g = champions(layout, arm, int(trials[0]) if trials else 30)
print(f"{layout}, {arm}: G {g.mean():.3f} ± {g.std(ddof=1) / len(g) ** 0.5:.3f} (standard error), {len(g)} trials")
