"""Trains leaders with evosax: one strategy per leader, each with that leader's credit.

    pip install evosax
    python leaders_by_evosax.py [GENERATIONS]

As in leaders_by_es.py, team t consists of candidate t of every leader, and the strategy of a leader maximises that
leader's Df. Here the strategies are evosax's Open_ES. JAX runs those of all leaders at once with vmap.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from evosax.algorithms import Open_ES

import flotilla

CANDIDATES = 200


def main(generations: int = 60) -> None:
    config = flotilla.Config.paper("generally_forward")
    rate, schedule = optax.adam(0.05), optax.constant_schedule(0.3)
    strategy = Open_ES(CANDIDATES, jnp.zeros(config.parameters), optimizer=rate, std_schedule=schedule)
    params = strategy.default_params
    init, ask = (jax.jit(jax.vmap(call, (0, 0, None))) for call in (strategy.init, strategy.ask))
    tell = jax.jit(jax.vmap(strategy.tell, (0, 0, 0, 0, None)))
    start, key = time.perf_counter(), jax.random.key(1)

    def keys(number: int) -> jax.Array:
        return jax.random.split(jax.random.fold_in(key, number), config.num_learners)

    means = 0.5 * jax.random.normal(key, (config.num_learners, config.parameters))
    state = init(keys(0), means, params)
    for generation in range(generations):
        candidates, state = ask(keys(2 * generation + 1), state, params)
        scores = flotilla.rollout(config, np.asarray(candidates), backend="cpu")
        # evosax minimises.
        state, _ = tell(keys(2 * generation + 2), candidates, -jnp.asarray(scores.df.T), state, params)
        if generation % 10 == 0 or generation == generations - 1:
            g = flotilla.rollout(config, np.asarray(state.mean)[:, None], backend="cpu").g[0]
            print(f"generation {generation:3}: G {g:.2f} of the means, {scores.g.mean():.2f} of the candidates")
    print(f"{time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
