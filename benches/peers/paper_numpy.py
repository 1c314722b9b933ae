"""The complete paper in vectorised NumPy: both paradigms, three layouts, fitness G, D and Df, trials, generations.

    python paper_numpy.py [--trials 5] [--generations 100] [--fraction 0.1] [--seed 0] [--layouts ...] [--json]
    python paper_numpy.py --rollout LAYOUT --teams N [--repeats R] [--seed 0]

One process. All teams of a generation, of all trials and fitnesses of one layout and paradigm, play side by side: the
team is the last axis of every array. --fraction runs that part of the generations and scales the measured time up to
all of them. --rollout times and scores random teams only, as the other peers do.
"""

import argparse
import json
import statistics
import time

import numpy as np

from layouts import (
    AGENT_RANGE, ATTRACTION_GAIN, ATTRACTION_RADIUS, DIAGONAL, DT, HIDDEN, INPUTS, MAP, MAX_SPEED, MAX_SPEED_CHANGE,
    MAX_TURN, MIN_SPEED, MUTATION_PROBABILITY, MUTATION_SIGMA, NAMES, OBSERVATION_RADIUS, OUTPUTS, REPULSION_GAIN,
    REPULSION_RADIUS, WALL_GAIN, WEIGHTS, make_world,
)  # fmt: skip

FITNESSES = ["G", "D", "Df"]


def sense(rx, ry, d, hx, hy, included):
    """Summed value [4, L, B] by quadrant of the included entities at offsets [L, entities, B]."""
    fx, fy = rx * hx[:, None] + ry * hy[:, None], ry * hx[:, None] - rx * hy[:, None]
    left = (fy > 0) | ((fy == 0) & (fx >= 0))
    front = (fx > 0) | ((fx == 0) & (fy <= 0))
    value = 1 - d / np.float32(DIAGONAL)
    if included is not None:
        value *= included
    front_value = value * front
    back_value = value - front_value
    front_left, back_left = front_value * left, back_value * left
    quadrants = [back_value - back_left, front_value - front_left, front_left, back_left]
    return np.stack([quadrant.sum(1) for quadrant in quadrants])


def policy(first, second, inputs):
    """Outputs [L, 2, B] of the nets with weights first [L, 9, 10, B] and second [L, 11, 2, B] on inputs [8, L, B]."""
    hidden = first[:, -1].copy()
    for k in range(INPUTS):
        hidden += inputs[k][:, None] * first[:, k]
    np.tanh(hidden, out=hidden)
    outputs = second[:, -1].copy()
    for k in range(HIDDEN):
        outputs += hidden[:, k, None] * second[:, k]
    return np.tanh(outputs, out=outputs)


def rollout(world, weights):
    """G [B], D [L, B] and Df [L, B] of teams with weights [L, WEIGHTS, B]."""
    L, N, F, P, B = world.leaders, world.agents, world.followers, len(world.pois), weights.shape[-1]
    first = weights[:, : (INPUTS + 1) * HIDDEN].reshape(L, INPUTS + 1, HIDDEN, B)
    second = weights[:, (INPUTS + 1) * HIDDEN :].reshape(L, HIDDEN + 1, OUTPUTS, B)
    x, y = (np.repeat(world.starts[:, axis, None], B, axis=1) for axis in (0, 1))
    hx, hy, speed = np.zeros((N, B), np.float32), np.ones((N, B), np.float32), np.zeros((N, B), np.float32)
    poi_x, poi_y = world.pois[:, 0, None], world.pois[:, 1, None]
    others = ~np.eye(N, dtype=bool)[:, :, None]
    seen = np.zeros((F, L, B), np.int32)
    turn, wanted = np.empty_like(x), np.empty_like(x)

    observed = np.zeros((P, B), bool)
    without = np.zeros((L, P, B), bool)  # observed with one leader taken out
    sets = np.empty((world.steps, N, P, B), bool)
    for step in range(world.steps):
        rx, ry = x[None] - x[:, None], y[None] - y[:, None]
        d = np.sqrt(rx * rx + ry * ry)

        px, py = poi_x - x[:L, None], poi_y - y[:L, None]
        pois = sense(px, py, np.sqrt(px * px + py * py), hx[:L], hy[:L], None) / np.float32(P)
        agents = sense(rx[:L], ry[:L], d[:L], hx[:L], hy[:L], (d[:L] <= AGENT_RANGE) & others[:L]) / np.float32(N)
        outputs = policy(first, second, np.concatenate([pois, agents]))
        turn[:L] = np.float32(np.pi) * outputs[:, 0]
        wanted[:L] = (outputs[:, 1] + 1) * np.float32(0.5 * MAX_SPEED)

        if F:
            attracted = (d[L:] <= ATTRACTION_RADIUS) & others[L:]
            near = (d[L:] <= REPULSION_RADIUS) & others[L:]
            seen += attracted[:, :L]
            near_count, count = near.sum(1), attracted.sum(1)
            near_scale = np.float32(REPULSION_GAIN / REPULSION_RADIUS) / np.maximum(near_count, 1).astype(np.float32)
            far_scale = np.float32(ATTRACTION_GAIN / ATTRACTION_RADIUS) / np.maximum(count - near_count, 1).astype(
                np.float32
            )
            far = attracted & ~near
            forces, walls = [], []
            for r, at in ((rx, x), (ry, y)):
                low, high = REPULSION_RADIUS - at[L:], REPULSION_RADIUS - (np.float32(MAP) - at[L:])
                walls.append((low >= 0) | (high >= 0))
                push = np.float32(WALL_GAIN) * (np.maximum(low, 0) - np.maximum(high, 0))
                forces.append(push + (r[L:] * far).sum(1) * far_scale - (r[L:] * near).sum(1) * near_scale)
            sx, sy = forces
            size = np.sqrt(sx * sx + sy * sy)
            along, across = sx * hx[L:] + sy * hy[L:], sy * hx[L:] - sx * hy[L:]
            alone = (count == 0) & ~walls[0] & ~walls[1]
            turn[L:] = np.where(alone | (size == 0), 0, np.arctan2(across, along))
            wanted[L:] = np.where(alone, speed[L:], np.where((along > 0) | (size == 0), size, np.float32(MIN_SPEED)))

        np.clip(turn, -MAX_TURN, MAX_TURN, out=turn)
        c, s = np.cos(turn), np.sin(turn)
        hx, hy = hx * c - hy * s, hx * s + hy * c
        speed += np.clip(wanted - speed, -MAX_SPEED_CHANGE, MAX_SPEED_CHANGE)
        np.clip(speed, MIN_SPEED, MAX_SPEED, out=speed)
        x = np.clip(x + speed * np.float32(DT) * hx, 0, MAP)
        y = np.clip(y + speed * np.float32(DT) * hy, 0, MAP)

        px, py = poi_x - x[:, None], poi_y - y[:, None]
        sets[step] = px * px + py * py <= OBSERVATION_RADIUS**2
        counts = sets[step].sum(0, dtype=np.int8)
        observed |= counts >= world.coupling
        without |= counts - sets[step, :L] >= world.coupling

    g = observed.mean(0, dtype=np.float32)
    d = g - without.mean(1, dtype=np.float32)
    if not F:
        return g, d, d
    owner = np.where(seen.max(1) > 0, seen.argmax(1), -1)  # [F, B]
    counts = sets.sum(1, dtype=np.int8)
    df = np.empty_like(d)
    for leader in range(L):
        taken = (sets[:, L:] & (owner == leader)[:, None]).sum(1, dtype=np.int8) + sets[:, leader]
        df[leader] = g - (counts - taken >= world.coupling).any(0).mean(0, dtype=np.float32)
    return g, d, df


def evolve(random, weights, fitness):
    """The next policies [k, WEIGHTS] of a population: the best one, and mutated winners of binary tournaments."""
    k = len(weights)
    one = random.integers(k, size=k - 1)
    other = random.integers(k - 1, size=k - 1)
    other += other >= one  # two distinct policies
    low, high = np.minimum(one, other), np.maximum(one, other)
    children = weights[np.where(fitness[low] >= fitness[high], low, high)]
    mutated = random.random(children.shape, np.float32) < MUTATION_PROBABILITY
    children *= 1 + mutated * (np.float32(MUTATION_SIGMA) * random.standard_normal(children.shape, np.float32))
    return np.concatenate([weights[np.argmax(fitness)][None], children])


def train(world, trials, generations, policies, seed):
    """Best team's G in POIs [fitnesses, trials, generations + 1]; generation 0 is the random start."""
    random = np.random.default_rng(seed)
    L, runs = world.leaders, len(FITNESSES) * trials
    populations = random.standard_normal((runs, L, policies, WEIGHTS), np.float32)
    best = np.empty((runs, generations + 1), np.float32)
    for generation in range(generations + 1):
        order = random.permuted(np.broadcast_to(np.arange(policies), (runs, L, policies)), axis=2)
        teams = np.take_along_axis(populations, order[..., None], 2)  # [runs, L, policies, WEIGHTS]
        g, d, df = rollout(world, np.ascontiguousarray(teams.transpose(1, 3, 0, 2)).reshape(L, WEIGHTS, -1))
        best[:, generation] = g.reshape(runs, policies).max(1) * len(world.pois)
        if generation == generations:
            break
        scores = [score.reshape(L, runs, policies) for score in (np.broadcast_to(g, d.shape), d, df)]
        for run in range(runs):
            for leader in range(L):
                fitness = np.empty(policies, np.float32)
                fitness[order[run, leader]] = scores[run // trials][leader, run]
                populations[run, leader] = evolve(random, populations[run, leader], fitness)
    return best.reshape(len(FITNESSES), trials, generations + 1)


def paper(arguments):
    generations = max(1, round(arguments.generations * arguments.fraction))
    rows, seconds = [], 0.0
    for layout in arguments.layouts:
        for paradigm in ("leader-follower", "all-leaders"):
            world = make_world(layout, paradigm == "all-leaders")
            begin = time.perf_counter()
            best = train(world, arguments.trials, generations, arguments.population, arguments.seed)
            elapsed = time.perf_counter() - begin
            seconds += elapsed
            for fitness, curves in zip(FITNESSES, best):
                row = {"layout": layout, "paradigm": paradigm, "fitness": fitness, "pois": len(world.pois)}
                row["mean_curve"] = [round(float(value), 4) for value in curves.mean(0)]
                row["sd_curve"] = [round(float(value), 4) for value in curves.std(0)]
                rows.append(row)
                shown = sorted({g for g in (0, 5, 10, 20, 30, 40) if g <= generations} | {generations})
                marks = " ".join(f"{g}: {curves[:, g].mean():.2f}±{curves[:, g].std():.2f}" for g in shown)
                if not arguments.json:
                    print(
                        f"{layout:18} {paradigm:15} {fitness:2}  best team, POIs of {len(world.pois)}: {marks}",
                        flush=True,
                    )
            if not arguments.json:
                print(f"{layout:18} {paradigm:15} {elapsed:.2f} s", flush=True)
    # Generation 0 only plays, every later one also selects first: generations + 1 episodes.
    estimate = seconds * (arguments.generations + 1) / (generations + 1)
    summary = {
        "peer": "numpy",
        "trials": arguments.trials,
        "generations": generations,
        "seconds": round(seconds, 3),
        "paper_seconds": round(estimate, 2),
    }
    print(json.dumps(summary | {"rows": rows}) if arguments.json else json.dumps(summary))


def random_teams(arguments):
    world = make_world(arguments.rollout)
    random, chunk = np.random.default_rng(arguments.seed), 512
    rates = []
    weights = random.standard_normal((arguments.teams, world.leaders, WEIGHTS), np.float32)
    chunks = [np.ascontiguousarray(weights[at : at + chunk].transpose(1, 2, 0)) for at in range(0, len(weights), chunk)]
    for _ in range(arguments.repeats):
        begin = time.perf_counter()
        scores = [rollout(world, part) for part in chunks]
        rates.append(arguments.teams * world.steps / (time.perf_counter() - begin))
    g, d, df = (np.concatenate(score, axis=-1) for score in zip(*scores))
    line = {
        "peer": "numpy",
        "layout": arguments.rollout,
        "teams": arguments.teams,
        "agents": world.agents,
        "steps": world.steps,
    }
    line |= {"team_steps_per_s": round(statistics.median(rates), 1), "best_team_steps_per_s": round(max(rates), 1)}
    figures = {"mean_g": g.mean(), "sd_g": g.std(), "mean_d": d.mean(), "mean_df": df.mean()}
    line |= {name: round(float(figure), 6) for name, figure in figures.items()}
    print(json.dumps(line | {"threads": 1}))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--population", type=int, default=50)
    parser.add_argument("--fraction", type=float, default=1.0, help="part of the generations to run and time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--layouts", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--json", action="store_true", help="one JSON object with every curve")
    parser.add_argument("--rollout", choices=NAMES, metavar="LAYOUT", help="only play random teams of this layout")
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    random_teams(arguments) if arguments.rollout else paper(arguments)


main()
