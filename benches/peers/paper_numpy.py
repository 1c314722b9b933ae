"""Reproduces the paper's 18 experiments in vectorised NumPy: three layouts, both paradigms, and fitness G, D and Df.

    python paper_numpy.py [--batch all|run] [--trials 5] [--generations 100] [--fraction 0.1] [--seed 0] [--json]
    python paper_numpy.py --rollout LAYOUT --teams N [--repeats R] [--seed 0]

One process plays many teams at once: the team is the last axis of every array. With --batch all, a batch has the 250
teams of all trials of an experiment (a layout, paradigm and fitness), which about fill a core's cache. With --batch
run, it has the 50 teams of one training run. Only the credit that the fitness needs is computed. --fraction runs a part
of the generations and scales the measured time up. --rollout only times and scores random teams, like the other peers.
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


def sense(offsets, heading, pois):
    """Returns the densities [8, L, B] of POIs and agents by quadrant, for offsets [2, L, pois + agents, B]."""
    rx, ry = offsets
    hx, hy = heading[:, :, None]
    d2 = rx * rx
    d2 += ry * ry
    value = np.sqrt(d2)
    value *= np.float32(-1 / DIAGONAL)
    value += 1
    value[:, pois:] *= d2[:, pois:] <= AGENT_RANGE**2
    for leader in range(len(value)):
        value[leader, pois + leader] = 0  # oneself
    fx, fy = rx * hx, ry * hx
    fx += ry * hy
    fy -= rx * hy
    left = (fy > 0) | ((fy == 0) & (fx >= 0))
    front = (fx > 0) | ((fx == 0) & (fy <= 0))
    quadrants = np.empty((4, *value.shape), np.float32)
    back_right, front_right, front_left, back_left = quadrants
    np.multiply(value, front, out=front_right)
    np.subtract(value, front_right, out=back_right)
    np.multiply(front_right, left, out=front_left)
    np.multiply(back_right, left, out=back_left)
    front_right -= front_left
    back_right -= back_left
    sums = quadrants[:, :, :pois].sum(2), quadrants[:, :, pois:].sum(2)
    return np.concatenate([sums[0] / np.float32(pois), sums[1] / np.float32(value.shape[1] - pois)])


def policy(first, second, inputs):
    """Returns the outputs [L, 2, B] of networks with the layers first [L, 9, 10, B] and second [L, 11, 2, B]."""
    hidden = np.einsum("klb,lkhb->lhb", inputs, first[:, :-1])
    hidden += first[:, -1]
    np.tanh(hidden, out=hidden)
    outputs = np.einsum("lhb,lhob->lob", hidden, second[:, :-1])
    outputs += second[:, -1]
    return np.tanh(outputs, out=outputs)


def rollout(world, weights, wanted_scores):
    """Plays teams with weights [L, WEIGHTS, B]. Returns G [B], D [L, B] and Df [L, B]; D and Df if wanted, or None."""
    L, N, F, P, B = world.leaders, world.agents, world.followers, len(world.pois), weights.shape[-1]
    first = weights[:, : (INPUTS + 1) * HIDDEN].reshape(L, INPUTS + 1, HIDDEN, B)
    second = weights[:, (INPUTS + 1) * HIDDEN :].reshape(L, HIDDEN + 1, OUTPUTS, B)
    at = np.repeat(world.starts.T[:, :, None], B, axis=2)  # [2, N, B]
    heading, speed = np.zeros((2, N, B), np.float32), np.zeros((N, B), np.float32)
    heading[1] = 1
    pois = world.pois.T[:, None, :, None]
    sensed, followed = np.empty((2, L, P + N, B), np.float32), np.empty((2, F, N, B), np.float32)
    turn, wanted = np.empty_like(speed), np.empty_like(speed)

    # Without followers, Df equals D.
    want_df = bool(F) and "Df" in wanted_scores
    want_d = "D" in wanted_scores or "Df" in wanted_scores and not want_df
    observed = np.zeros((P, B), bool)
    without = np.zeros((L, P, B), bool)  # observed with one leader taken out
    seen = np.zeros((F, L, B), np.uint16)
    sets = np.empty((world.steps if want_df else 0, N, P, B), bool)
    for step in range(world.steps):
        np.subtract(pois, at[:, :L, None], out=sensed[:, :, :P])
        np.subtract(at[:, None], at[:, :L, None], out=sensed[:, :, P:])
        outputs = policy(first, second, sense(sensed, heading[:, :L], P))
        turn[:L] = np.float32(np.pi) * outputs[:, 0]
        wanted[:L] = (outputs[:, 1] + 1) * np.float32(0.5 * MAX_SPEED)

        if F:
            np.subtract(at[:, None], at[:, L:, None], out=followed)
            d2 = followed[0] * followed[0]
            d2 += followed[1] * followed[1]
            attracted, near = d2 <= ATTRACTION_RADIUS**2, d2 <= REPULSION_RADIUS**2
            if want_df:
                seen += attracted[:, :L]
            far = attracted ^ near
            # Do not count the agent itself, at offset 0.
            near_count = near.view(np.uint8).sum(1, dtype=np.uint8) - np.uint8(1)
            far_count = far.view(np.uint8).sum(1, dtype=np.uint8)
            near_scale = np.float32(REPULSION_GAIN / REPULSION_RADIUS) / np.maximum(near_count, 1).astype(np.float32)
            far_scale = np.float32(ATTRACTION_GAIN / ATTRACTION_RADIUS) / np.maximum(far_count, 1).astype(np.float32)
            low = np.float32(REPULSION_RADIUS) - at[:, L:]
            high = at[:, L:] - np.float32(MAP - REPULSION_RADIUS)
            alone = (near_count == 0) & (far_count == 0) & ~((low >= 0) | (high >= 0)).any(0)
            force = np.float32(WALL_GAIN) * (np.maximum(low, 0) - np.maximum(high, 0))
            force += (followed * far).sum(2) * far_scale
            force -= (followed * near).sum(2) * near_scale
            (sx, sy), (hx, hy) = force, heading[:, L:]
            size = np.sqrt(sx * sx + sy * sy)
            along, across = sx * hx + sy * hy, sy * hx - sx * hy
            turn[L:] = np.where(alone | (size == 0), 0, np.arctan2(across, along))
            wanted[L:] = np.where(alone, speed[L:], np.where((along > 0) | (size == 0), size, np.float32(MIN_SPEED)))

        np.clip(turn, -MAX_TURN, MAX_TURN, out=turn)
        c, s = np.cos(turn), np.sin(turn)
        hx, hy = heading
        heading = np.stack([hx * c - hy * s, hx * s + hy * c])
        wanted -= speed
        speed += np.clip(wanted, -MAX_SPEED_CHANGE, MAX_SPEED_CHANGE, out=wanted)
        np.clip(speed, MIN_SPEED, MAX_SPEED, out=speed)
        at += speed * np.float32(DT) * heading
        np.clip(at, 0, MAP, out=at)

        px, py = pois - at[:, :, None]
        inside = px * px + py * py <= OBSERVATION_RADIUS**2  # [N, P, B]
        counts = inside.view(np.uint8).sum(0, dtype=np.uint8)
        observed |= counts >= world.coupling
        if want_d:
            without |= counts >= inside[:L] + np.uint8(world.coupling)
        if want_df:
            sets[step] = inside

    g = observed.mean(0, dtype=np.float32)
    d = g - without.mean(1, dtype=np.float32) if want_d else None
    if not want_df:
        return g, d, d
    df = np.empty((L, B), np.float32)
    owner = np.where(seen.max(1) > 0, seen.argmax(1), -1)  # [F, B]
    counts = sets.view(np.uint8).sum(1, dtype=np.uint8)
    for leader in range(L):
        taken = (sets[:, L:] & (owner == leader)[:, None]).view(np.uint8).sum(1, dtype=np.uint8)
        taken += sets[:, leader]
        df[leader] = g - (counts >= taken + np.uint8(world.coupling)).any(0).mean(0, dtype=np.float32)
    return g, d, df


def evolve(random, weights, fitness):
    """Returns the next policies [runs, L, k, WEIGHTS]: each population's best, and mutated tournament winners."""
    runs, leaders, k = fitness.shape
    a = random.integers(k, size=(runs, leaders, k - 1))
    b = random.integers(k - 1, size=a.shape)
    b += b >= a  # two distinct policies
    low, high = np.minimum(a, b), np.maximum(a, b)
    first = np.take_along_axis(fitness, low, 2) >= np.take_along_axis(fitness, high, 2)
    parents = np.concatenate([fitness.argmax(2)[..., None], np.where(first, low, high)], axis=2)
    children = chosen(weights, parents)
    mutated = random.random((runs, leaders, k - 1, WEIGHTS), np.float32) < MUTATION_PROBABILITY
    noise = random.standard_normal(np.count_nonzero(mutated), np.float32)
    children[:, :, 1:][mutated] *= 1 + np.float32(MUTATION_SIGMA) * noise
    return children


def chosen(weights, policies):
    """Returns the policies [runs, L, k, WEIGHTS] with the given indices in their populations."""
    runs, leaders = policies.shape[:2]
    return weights[np.arange(runs)[:, None, None], np.arange(leaders)[:, None], policies]


def train(world, fitness, trials, generations, policies, random):
    """Trains several trials at once. Returns the best team's POIs [trials, generations + 1]; generation 0 is random."""
    L = world.leaders
    populations = random.standard_normal((trials, L, policies, WEIGHTS), np.float32)
    best = np.empty((trials, generations + 1), np.float32)
    for generation in range(generations + 1):
        order = random.permuted(np.broadcast_to(np.arange(policies), (trials, L, policies)), axis=2)
        weights = chosen(populations, order).transpose(1, 3, 0, 2).reshape(L, WEIGHTS, -1)
        g, d, df = rollout(world, weights, [fitness])
        best[:, generation] = g.reshape(trials, policies).max(1) * len(world.pois)
        if generation == generations:
            break
        scores = np.broadcast_to({"G": g, "D": d, "Df": df}[fitness], (L, len(g)))
        ratings = np.empty((trials, L, policies), np.float32)
        np.put_along_axis(ratings, order, scores.reshape(L, trials, policies).transpose(1, 0, 2), 2)
        populations = evolve(random, populations, ratings)
    return best


def curves_of(world, fitness, arguments, generations):
    """Trains all trials, at once or one after the other. Returns the best team's POIs [trials, generations + 1]."""
    parts = arguments.trials if arguments.batch == "run" else 1
    seeds = np.random.SeedSequence((arguments.seed, FITNESSES.index(fitness))).spawn(parts)
    randoms = [np.random.default_rng(seed) for seed in seeds]
    trials, policies = arguments.trials // parts, arguments.population
    return np.concatenate([train(world, fitness, trials, generations, policies, random) for random in randoms])


def paper(arguments):
    """Runs all experiments, and prints the curves and the time."""
    generations = max(1, round(arguments.generations * arguments.fraction))
    rows, seconds = [], 0.0
    for layout in arguments.layouts:
        for paradigm in ("leader-follower", "all-leaders"):
            world = make_world(layout, paradigm == "all-leaders")
            begin = time.perf_counter()
            best = [curves_of(world, fitness, arguments, generations) for fitness in FITNESSES]
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
    # Generation 0 is played, too, so the number of episodes is generations + 1.
    estimate = seconds * (arguments.generations + 1) / (generations + 1)
    summary = {
        "peer": "numpy",
        "batch": arguments.batch,
        "trials": arguments.trials,
        "generations": generations,
        "seconds": round(seconds, 3),
        "paper_seconds": round(estimate, 2),
    }
    print(json.dumps(summary | {"rows": rows}) if arguments.json else json.dumps(summary))


def random_teams(arguments):
    """Times and scores random teams."""
    world = make_world(arguments.rollout)
    random, chunk = np.random.default_rng(arguments.seed), 512
    rates = []
    weights = random.standard_normal((arguments.teams, world.leaders, WEIGHTS), np.float32)
    chunks = [np.ascontiguousarray(weights[at : at + chunk].transpose(1, 2, 0)) for at in range(0, len(weights), chunk)]
    for _ in range(arguments.repeats):
        begin = time.perf_counter()
        scores = [rollout(world, part, FITNESSES) for part in chunks]
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
    parser.add_argument("--fraction", type=float, default=1.0, help="share of the generations to run and time")
    parser.add_argument(
        "--batch", choices=["run", "all"], default="all", help="what is played at once: a training run, or all trials"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--layouts", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--json", action="store_true", help="print one JSON object with all curves")
    parser.add_argument("--rollout", choices=NAMES, metavar="LAYOUT", help="only play random teams of this layout")
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    random_teams(arguments) if arguments.rollout else paper(arguments)


main()
