"""Plays flotilla's episode, or whole generations of its training, in jitted JAX: vmap over teams, scan over steps.

    python episode_jax.py LAYOUT TEAMS REPEATS [SEED] [--generation] [--platform cpu|gpu]

Prints one JSON line. Compiling and drawing the first weights are not timed. JAX uses its default device unless
--platform names another.
"""

import argparse
import json
import os
import statistics
import time

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("layout", choices=["generally_forward", "strictly_forward", "chaotic"])
parser.add_argument("teams", type=int)
parser.add_argument("repeats", type=int)
parser.add_argument("seed", type=int, nargs="?", default=0)
parser.add_argument(
    "--generation", action="store_true", help="time whole generations: teams, episodes, D, selection, mutation"
)
parser.add_argument("--platform", help="the JAX platform to run on")
arguments = parser.parse_args()
if arguments.platform:
    os.environ["JAX_PLATFORMS"] = {"gpu": "cuda"}.get(arguments.platform, arguments.platform)

import jax  # noqa: E402  (the platform must be chosen first)
import jax.numpy as jnp  # noqa: E402

from layouts import (  # noqa: E402
    AGENT_RANGE, ATTRACTION_GAIN, ATTRACTION_RADIUS, DIAGONAL, DT, HIDDEN, INPUTS, MAP, MAX_SPEED, MAX_SPEED_CHANGE,
    MAX_TURN, MIN_SPEED, MUTATION_PROBABILITY, MUTATION_SIGMA, OBSERVATION_RADIUS, OUTPUTS, REPULSION_GAIN,
    REPULSION_RADIUS, WALL_GAIN, WEIGHTS, make_world,
)  # fmt: skip

world = make_world(arguments.layout)
L, N, P = world.leaders, world.agents, len(world.pois)
others = ~jnp.eye(N, dtype=bool)


def norm(v):
    return jnp.sqrt(v[..., 0] ** 2 + v[..., 1] ** 2)


def dot(a, b):
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def sense(offsets, heading, included):
    """Returns the density [L, 4] in four quadrants of the included entities at `offsets` [L, entities, 2]."""
    fx, fy = dot(heading[:, None], offsets), cross(heading[:, None], offsets)
    left = (fy > 0) | ((fy == 0) & (fx >= 0))
    front = (fx > 0) | ((fx == 0) & (fy <= 0))
    value = jnp.where(included, 1 - norm(offsets) / DIAGONAL, 0)
    quadrants = jnp.stack([~front & ~left, front & ~left, front & left, ~front & left], -1)
    return jnp.sum(value[..., None] * quadrants, axis=1)


def policy(weights, inputs):
    """Returns the outputs [L, 2] of the networks with `weights` [L, WEIGHTS]."""
    first = weights[:, : (INPUTS + 1) * HIDDEN].reshape(L, INPUTS + 1, HIDDEN)
    second = weights[:, (INPUTS + 1) * HIDDEN :].reshape(L, HIDDEN + 1, OUTPUTS)
    hidden = jnp.tanh(jnp.einsum("li,lih->lh", inputs, first[:, :-1]) + first[:, -1])
    return jnp.tanh(jnp.einsum("lh,lho->lo", hidden, second[:, :-1]) + second[:, -1])


def lead(weights, position, heading, offsets):
    """Returns the wanted turns and speeds of leaders."""
    to_pois = world.pois - position[:L, None]
    in_range = others[:L] & (norm(offsets[:L]) <= AGENT_RANGE)
    inputs = jnp.concatenate(
        [sense(to_pois, heading[:L], True) / P, sense(offsets[:L], heading[:L], in_range) / N], axis=1
    )
    outputs = policy(weights, inputs)
    return jnp.pi * outputs[:, 0], (outputs[:, 1] + 1) / 2 * MAX_SPEED


def follow(position, heading, speed, offsets):
    """Returns the wanted turns and speeds of followers, and which leaders they see."""
    distance = norm(offsets[L:])
    near = others[L:] & (distance <= REPULSION_RADIUS)
    far = others[L:] & (distance > REPULSION_RADIUS) & (distance <= ATTRACTION_RADIUS)

    def mean(which):
        return jnp.sum(offsets[L:] * which[..., None], axis=1) / jnp.maximum(which.sum(1), 1)[:, None]

    at = position[L:]
    low = jnp.where(at <= REPULSION_RADIUS, REPULSION_RADIUS - at, 0)
    high = jnp.where(MAP - at <= REPULSION_RADIUS, REPULSION_RADIUS - (MAP - at), 0)
    wall = jnp.any((at <= REPULSION_RADIUS) | (MAP - at <= REPULSION_RADIUS), axis=1)
    s = (
        ATTRACTION_GAIN / ATTRACTION_RADIUS * mean(far)
        - REPULSION_GAIN / REPULSION_RADIUS * mean(near)
        + WALL_GAIN * (low - high)
    )
    size, along = norm(s), dot(heading[L:], s)
    alone = ~jnp.any(near | far, axis=1) & ~wall
    turn = jnp.where(alone | (size == 0), 0, jnp.arctan2(cross(heading[L:], s), along))
    wanted = jnp.where(size == 0, 0, jnp.where(along > 0, size, MIN_SPEED))
    return turn, jnp.where(alone, speed[L:], wanted), (near | far)[:, :L]


def step(weights, state, _):
    """Moves a team by one step. Returns its state, and which agents are near each POI."""
    position, heading, speed, seen = state
    offsets = position[None] - position[:, None]
    leader_turn, leader_speed = lead(weights, position, heading, offsets)
    follower_turn, follower_speed, sees = follow(position, heading, speed, offsets)
    turn = jnp.clip(jnp.concatenate([leader_turn, follower_turn]), -MAX_TURN, MAX_TURN)
    c, s = jnp.cos(turn), jnp.sin(turn)
    hx, hy = heading[:, 0], heading[:, 1]
    heading = jnp.stack([hx * c - hy * s, hx * s + hy * c], axis=1)
    wanted = jnp.concatenate([leader_speed, follower_speed])
    speed = jnp.clip(speed + jnp.clip(wanted - speed, -MAX_SPEED_CHANGE, MAX_SPEED_CHANGE), MIN_SPEED, MAX_SPEED)
    position = jnp.clip(position + speed[:, None] * DT * heading, 0, MAP)
    near = norm(world.pois[:, None] - position[None]) <= OBSERVATION_RADIUS
    return (position, heading, speed, seen + sees), near


def episode(weights):
    """Returns G, D [L] and Df [L] of the team with `weights` [L, WEIGHTS]."""
    start = (
        jnp.asarray(world.starts),
        jnp.tile(jnp.array([0.0, 1.0]), (N, 1)),
        jnp.zeros(N),
        jnp.zeros((N - L, L), jnp.int32),
    )
    (_, _, _, seen), near = jax.lax.scan(lambda state, x: step(weights, state, x), start, None, world.steps)
    counts = near.sum(-1)  # [steps, P]

    def score(count):  # [steps, P, ...] -> [...]
        return jnp.mean(jnp.any(count >= world.coupling, axis=0), axis=0)

    belongs = (jnp.argmax(seen, 1)[:, None] == jnp.arange(L)) & (seen.max(1) > 0)[:, None]  # [followers, L]
    taken = jnp.einsum("tpf,fl->tpl", near[..., L:].astype(jnp.float32), belongs.astype(jnp.float32)).astype(int)
    g = score(counts)
    d = g - score(counts[..., None] - near[..., :L])
    df = g - score(counts[..., None] - near[..., :L] - taken)
    return g, d, df


rollout = jax.jit(jax.vmap(episode))


@jax.jit
def generation(key, populations):
    """Plays `populations` [L, teams, WEIGHTS] and selects with D. Returns the next populations and every team's G."""
    teams = populations.shape[1]
    keys = jax.random.split(key, 4)
    order = jax.vmap(lambda k: jax.random.permutation(k, teams))(jax.random.split(keys[0], L))  # [L, teams]
    g, d, _ = rollout(jnp.take_along_axis(populations, order[..., None], 1).swapaxes(0, 1))
    fitness = jnp.zeros((L, teams)).at[jnp.arange(L)[:, None], order].set(d.T)

    first = jax.random.randint(keys[1], (L, teams - 1), 0, teams)
    second = jax.random.randint(keys[2], (L, teams - 1), 0, teams - 1)
    second += second >= first  # two distinct policies
    low, high = jnp.minimum(first, second), jnp.maximum(first, second)
    low_wins = jnp.take_along_axis(fitness, low, 1) >= jnp.take_along_axis(fitness, high, 1)
    parents = jnp.take_along_axis(populations, jnp.where(low_wins, low, high)[..., None], 1)
    coin, noise = jax.random.split(keys[3])
    mutated = jax.random.bernoulli(coin, MUTATION_PROBABILITY, parents.shape)
    children = parents * (1 + mutated * MUTATION_SIGMA * jax.random.normal(noise, parents.shape))
    elite = jnp.take_along_axis(populations, jnp.argmax(fitness, 1)[:, None, None], 1)
    return jnp.concatenate([elite, children], axis=1), g


def timed(call):
    begin = time.perf_counter()
    result = jax.block_until_ready(call())
    return time.perf_counter() - begin, result


def main():
    teams, repeats = arguments.teams, arguments.repeats
    key = jax.random.key(arguments.seed)
    line = {"peer": "jax", "layout": arguments.layout, "teams": teams, "agents": N, "steps": world.steps}
    seconds = []
    if arguments.generation:
        populations = jax.block_until_ready(jax.random.normal(key, (L, teams, WEIGHTS)))
        compile_seconds, _ = timed(lambda: generation(key, populations))
        for repeat in range(repeats):
            elapsed, (populations, g) = timed(lambda: generation(jax.random.fold_in(key, repeat), populations))
            seconds.append(elapsed)
        line["generations_per_s"] = 1 / statistics.median(seconds)
        prefix, scores = "generation_", {"mean_g": g}
    else:
        weights = jax.block_until_ready(jax.random.normal(key, (teams, L, WEIGHTS)))
        compile_seconds, (g, d, df) = timed(lambda: rollout(weights))
        seconds = [timed(lambda: rollout(weights))[0] for _ in range(repeats)]
        prefix, scores = "", {"mean_g": g, "mean_d": d, "mean_df": df}
        line["sd_g"] = round(float(jnp.std(g)), 6)
    rates = [teams * world.steps / elapsed for elapsed in seconds]
    line[prefix + "team_steps_per_s"] = round(statistics.median(rates), 1)
    line["best_" + prefix + "team_steps_per_s"] = round(max(rates), 1)
    line |= {name: round(float(jnp.mean(score)), 6) for name, score in scores.items()}
    line |= {"compile_seconds": round(compile_seconds, 2), "device": str(jax.devices()[0]), "threads": os.cpu_count()}
    print(json.dumps(line))


if __name__ == "__main__":
    main()
