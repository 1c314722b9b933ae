"""Compares the speed of `flotilla.train` and of training with evosax on the episode of `episode_jax.py`.

    python train_evosax.py LAYOUT TEAMS ROUNDS [SEED] [--platform cpu]

Trains five trials of 100 generations with Df, in alternating rounds. evosax has one genetic algorithm per leader and
trial, each with as many policies as there are teams. A whole training is jitted, and compiling is not timed. Needs
`evosax` and `flotilla`.
"""

import json
import statistics
import time

import jax
import jax.numpy as jnp
from episode_jax import L, P, WEIGHTS, arguments, rollout, world
from evosax.algorithms import SimpleGA

import flotilla

TRIALS, GENERATIONS = 5, 100
teams = arguments.teams
strategy = SimpleGA(teams, jnp.zeros(WEIGHTS))
params = strategy.default_params
ask_all = jax.vmap(jax.vmap(strategy.ask, (0, 0, None)), (0, 0, None))
tell_all = jax.vmap(jax.vmap(strategy.tell, (0, 0, 0, 0, None)), (0, 0, 0, 0, None))


def keys(key):
    return jax.random.split(key, (TRIALS, L))


def credits(populations):
    """Returns G [TRIALS, teams] and Df [TRIALS, L, teams] of populations [TRIALS, L, teams, WEIGHTS]."""
    g, _, df = rollout(populations.swapaxes(1, 2).reshape(TRIALS * teams, L, WEIGHTS))
    return g.reshape(TRIALS, teams), df.reshape(TRIALS, teams, L).swapaxes(1, 2)


def generation(state, key):
    ask, tell = jax.random.split(key)
    populations, state = ask_all(keys(ask), state, params)
    g, df = credits(populations)
    state, _ = tell_all(keys(tell), populations, -df, state, params)
    return state, g.max(axis=1)


@jax.jit
def training(key):
    """Returns the best team's G, [GENERATIONS, TRIALS]."""
    first, begin, rest = jax.random.split(key, 3)
    populations = jax.random.normal(first, (TRIALS, L, teams, WEIGHTS))
    start = jax.vmap(jax.vmap(strategy.init, (0, 0, 0, None)), (0, 0, 0, None))
    state = start(keys(begin), populations, -credits(populations)[1], params)
    return jax.lax.scan(generation, state, jax.random.split(rest, GENERATIONS))[1]


def timed(call):
    """Calls a function. Returns the seconds, the seconds of processor time, and its result."""
    begin, begin_processor = time.perf_counter(), time.process_time()
    result = call()
    return time.perf_counter() - begin, time.process_time() - begin_processor, result


def main():
    config = flotilla.Config.paper(arguments.layout).replace(
        learning={"fitness": "Df", "trials": TRIALS, "generations": GENERATIONS, "population": teams}
    )
    compiling, _, _ = timed(lambda: jax.block_until_ready(training(jax.random.key(0))))
    ours, theirs = [], []
    for number in range(arguments.repeats):
        seed = arguments.seed + number
        ours.append(timed(lambda: flotilla.train(config, seed, backend="cpu", progress=False).metrics["best_g"][:, -1]))
        theirs.append(timed(lambda: jax.block_until_ready(training(jax.random.key(seed)))[-1]))
    line = {"layout": arguments.layout, "teams": teams, "compile_seconds": round(compiling, 1)}
    for name, rounds in (("flotilla", ours), ("evosax", theirs)):
        line[name] = {
            "seconds": statistics.median(wall for wall, _, _ in rounds),
            "processor_seconds": statistics.median(processor for _, processor, _ in rounds),
            "pois_of_best_team": statistics.mean(float(best.mean()) * P for _, _, best in rounds),
        }
    for index, name in enumerate(("seconds", "processor_seconds")):
        line[f"times_{name}"] = statistics.median(b[index] / a[index] for a, b in zip(ours, theirs))
    print(json.dumps(line))


main()
