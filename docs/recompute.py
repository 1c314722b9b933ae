"""Compares published figures with new runs of another seed, for docs/results/recomputed.md.

    pip install numpy scipy
    python3 docs/recompute.py RUNS             # writes docs/results/recomputed.csv, from the runs of the page's commands

Means, intervals and tests use only the runs' metrics.csv and SciPy. Of a published mean, the standard deviation is derived
from its interval. A mean agrees if Welch's test of both finds no difference (p at least 0.05). A contrast agrees if it has
the same sign and is below 0.05 in both or in none, after Holm's correction if the page corrects. Counts over whole studies
use their tables.
"""

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
from scipy import stats

RESULTS = Path(__file__).resolve().parent / "results"


def last(run):
    """Returns the champions' G of the last generation, by trial."""
    if json.loads((run / "run.json").read_text())["state"] != "done":
        sys.exit(f"{run}: not finished")
    rows = list(csv.DictReader((run / "metrics.csv").open()))
    end = max(int(row["generation"]) for row in rows)
    return np.array([float(row["champion_g"]) for row in rows if int(row["generation"]) == end])


def published(file, root=RESULTS, **want):
    """Returns mean, interval and p of a row of a CSV file."""
    for row in csv.DictReader((root / file).open()):
        if all(row[key] == value for key, value in want.items()):
            names = ("value", "g", "champion_g"), ("low", "champion_g_low"), ("high", "champion_g_high"), ("p_holm", "p")
            return [next((float(row[name]) for name in some if row.get(name)), None) for some in names]
    sys.exit(f"{file}: no row with {want}")


def interval(values):
    """Returns the mean and Student's interval with 0 and 1 added."""
    more, mean = np.append(values, [0.0, 1.0]), values.mean()
    low, high = stats.t.interval(0.95, len(more) - 1, loc=more.mean(), scale=stats.sem(more))
    return mean, max(0.0, min(low, mean)), min(1.0, max(high, mean))


def deviation(mean, low, high, trials):
    """Returns the standard deviation of values with this interval."""
    size, center = trials + 2, (trials * mean + 1) / (trials + 2)
    half = max(high - center if high < 1 else 0, center - low if low > 0 else 0)
    squares = (half / stats.t.ppf(0.975, size - 1)) ** 2 * size * (size - 1) + size * center**2 - 1
    return math.sqrt(max(0.0, (squares - trials * mean**2) / (trials - 1)))


def signed_rank(differences):
    """Returns p of Wilcoxon's test, exact with ties, by counting the sums of ranks over all signs."""
    some = np.round(differences, 9)
    some = some[some != 0]
    if not len(some):
        return 1.0
    ranks = np.round(2 * stats.rankdata(np.abs(some))).astype(int)
    ways = np.zeros(ranks.sum() + 1)
    ways[0] = 1
    for rank in ranks:
        ways[rank:] += ways[: len(ways) - rank].copy()
    share, up = ways / ways.sum(), ranks[some > 0].sum()
    return min(1.0, 2 * min(share[: up + 1].sum(), share[up:].sum()))


def paired(differences):
    """Returns the mean and the interval of differences with two pairs added (Agresti and Min)."""
    size, mean = len(differences) + 2, differences.mean()
    center = differences.sum() / size
    half = stats.norm.ppf(0.975) * math.sqrt(((differences**2).sum() + 1) / size - center**2) / math.sqrt(size)
    return mean, max(-1.0, min(center - half, mean)), min(1.0, max(center + half, mean))


def claims(arm):
    """Returns the published G by trial of an experiment."""
    row = next(row for row in csv.DictReader((RESULTS / "claims/trials.csv").open()) if row["arm"] == arm)
    return np.array([int(digit) for digit in row["champion_pois"]]) / (2 if arm.startswith("strictly") else 4)


POPULATIONS = "layout,fitness,max_speed,density,what"
QUESTIONS = "where,generation,arm,other"
FEWER, FOLLOWERS = "fewer populations: one per group or per agent, no followers", "followers, at one population per group"
# The page, its file, the columns that select the row and their values, and the runs below RUNS; two make a contrast.
CELLS = [
    ("claims", None, "", ["generally forward, all-leaders, G"], ["paper/arms/generally-forward-all-leaders-G"]),
    ("claims", None, "", ["generally forward, leader-follower, Df"], ["paper/arms/generally-forward-leader-follower-Df"]),
    ("claims", None, "", ["strictly forward, all-leaders, G"], ["paper/arms/strictly-forward-all-leaders-G"]),
    ("claims", None, "", ["chaotic, all-leaders, Df"], ["paper/arms/chaotic-all-leaders-Df"]),
    ("claims", None, "", ["chaotic, leader-follower, Df"], ["paper/arms/chaotic-leader-follower-Df"]),
    ("claims", None, "", ["generally forward, leader-follower, Df", "generally forward, leader-follower, G"],
     ["paper/arms/generally-forward-leader-follower-Df", "paper/arms/generally-forward-leader-follower-G"]),
    ("claims", None, "", ["chaotic, leader-follower, Df", "chaotic, leader-follower, G"],
     ["paper/arms/chaotic-leader-follower-Df", "paper/arms/chaotic-leader-follower-G"]),
    ("populations", "cells", POPULATIONS, ["generally-forward", "G", "3", "linear", "no followers, one per group"],
     ["populations/arms/generally-forward-all-leaders-group-G-3-linear"]),
    ("populations", "pairs", POPULATIONS, ["generally-forward", "G", "3", "linear", FEWER],
     ["populations/arms/generally-forward-all-leaders-group-G-3-linear", "populations/arms/generally-forward-all-leaders-none-G-3-linear"]),
    ("populations", "pairs", POPULATIONS, ["generally-forward", "G", "3", "linear", FOLLOWERS],
     ["populations/arms/generally-forward-leader-follower-none-G-3-linear", "populations/arms/generally-forward-all-leaders-group-G-3-linear"]),
    ("populations", "pairs", POPULATIONS, ["strictly-forward", "G", "10", "linear", FOLLOWERS],
     ["populations/arms/strictly-forward-leader-follower-none-G-10-linear", "populations/arms/strictly-forward-all-leaders-group-G-10-linear"]),
    ("populations", "pairs", POPULATIONS, ["chaotic", "G", "3", "mean", FOLLOWERS],
     ["populations/arms/chaotic-leader-follower-none-G-3-mean", "populations/arms/chaotic-all-leaders-group-G-3-mean"]),
    ("populations", "pairs", POPULATIONS, ["coupling-6", "G", "3", "linear", FEWER],
     ["populations/arms/coupling-6-all-leaders-group-G-3-linear", "populations/arms/coupling-6-all-leaders-none-G-3-linear"]),
    ("questions", "groups", QUESTIONS, ["groups, leader-follower, groups 4", "100", "own policies", "one policy"],
     ["questions/groups/points/0004", "questions/groups/points/0005"]),
    ("questions", "behaviours", QUESTIONS, ["behaviours, all-leaders, each another way", "100", "behaviours", ""],
     ["questions/behaviours/points/0007"]),
    ("questions", "relay", QUESTIONS, ["relay, 30 steps", "100", "G", "Df"],
     ["questions/relay/points/0016", "questions/relay/points/0018"]),
    ("questions", "observers", QUESTIONS, ["observers, followers per leader 2", "50", "G", ""], ["questions/observers/points/0004"]),
    ("questions", "curricula", QUESTIONS, ["curricula, all-leaders, coupling 5", "100", "at once", "step by step"],
     ["questions/curricula/points/0008", "questions/curricula/points/0009"]),
    ("questions", "warm", QUESTIONS, ["warm, coupling 3", "100", "from random policies", "from ahead"],
     ["questions/warm/points/0000", "questions/warm/warm/0000-0"]),
    ("questions", "places", QUESTIONS, ["places, Df", "100", "learned on fixed POIs", ""], ["questions/places/points/0002"]),
    ("sensitivity", "points", "point", ["1"], ["sensitivity/points/0001"]),
    ("sensitivity", "points", "point", ["22"], ["sensitivity/points/0022"]),
    ("sensitivity", "points", "point", ["31"], ["sensitivity/points/0031"]),
    ("scale", "coupling6", "population,paradigm,fitness,sharing", ["50", "leader-follower", "G", "none"], ["coupling6-50/points/0001"]),
    ("scale", "coupling6", "population,paradigm,fitness,sharing", ["50", "all-leaders", "G", "all"], ["shared-50/points/0001"]),
    ("scale", "methods", "layout,population,paradigm,method", ["generally_forward", "50", "all-leaders", "openai-es"],
     ["methods-50/points/0003"]),
    ("scale", "partners", "layout,population,paradigm,partners,leniency", ["chaotic", "50", "all-leaders", "3", "mean"],
     ["partners-3/points/0001"]),
    ("tasks", "small", "task,fitness", ["return", "D++"], ["task-return"]),
    ("tasks", "small", "task,fitness", ["slalom", "G"], ["task-slalom"]),
    ("influence", "3_rovers_3_uavs", "learning.fitness", ["G"], ["influence"]),
]  # fmt: skip


def recomputed(runs, page, file, columns, values, folders):
    """Returns a row of the table."""
    new = [last(runs / folder) for folder in folders]
    is_pair = len(new) == 2
    if file is None:
        trials = [claims(arm) for arm in values]
        old = [*paired(trials[0] - trials[1]), signed_rank(trials[0] - trials[1])] if is_pair else [*interval(trials[0]), None]
        count, name, holm = 200, " less ".join(values), None
    else:
        where = dict(zip(columns.split(","), values, strict=True))
        old, count = published(f"{page}/{file}.csv", **where), {"methods": 10, "small": 10}.get(file, 30)
        name = ("point " if columns == "point" else "") + ", ".join(value for value in values if value)
        holm = published(f"{page}/{file}.csv", runs, **where)[3] if is_pair else None
    if is_pair:
        p = signed_rank(new[0] - new[1])
        test, found, decided = "Wilcoxon", paired(new[0] - new[1]), p if holm is None else holm
        agrees = (decided < 0.05) == (old[3] < 0.05) and (old[3] >= 0.05 or found[0] * old[0] > 0)
        notes = [f"{old[3]:.2g}", f"{decided:.2g}"]
    else:
        spread, found = deviation(*old[:3], count), interval(new[0])
        equal = spread < 1e-6 and np.ptp(new[0]) == 0
        p = 1.0 if equal else stats.ttest_ind_from_stats(
            old[0], spread, count, found[0], new[0].std(ddof=1), len(new[0]), equal_var=False).pvalue  # fmt: skip
        test, agrees, notes = "Welch", p >= 0.05, ["", ""]
    numbers = [f"{number:.3f}" for number in [*old[:3], *found]]
    return [page, name, *numbers, test, f"{p:.2g}", *notes, "agrees" if agrees else "differs"]


def studies(runs, page, files):
    """Prints how many champions' means of a study are within the published interval, and how many verdicts are the same."""
    means = within = contrasts = same = turned = 0
    for file in files:
        old, new = (list(csv.DictReader((root / page / file).open())) for root in (RESULTS, runs))
        for was, now in zip(old, new, strict=True):
            name = "value" if "value" in was else "g"
            keys = [key for key in was if key not in (name, *"low high p p_holm a reached trials other_trials".split())]
            assert all(was[key] == now[key] for key in keys), (file, was, now)
            if was["measure"] not in ("champion", "champion_g", "fixed_pois_g", "moved_pois_g"):
                continue
            if was.get("p_holm"):
                before, after = float(was["p_holm"]) < 0.05, float(now["p_holm"]) < 0.05
                contrasts, same = contrasts + 1, same + (before == after)
                turned += before and after and float(was[name]) * float(now[name]) < 0
            else:
                means, within = means + 1, within + (float(was["low"]) <= float(now[name]) <= float(was["high"]))
    print(f"{page}: {within} of {means} means within, {same} of {contrasts} contrasts with the same verdict, {turned} turned")


def main(runs):
    header = "page,cell,published,published_low,published_high,recomputed,low,high,test,p,published_p,decided_p,verdict"
    rows = [recomputed(runs, *cell) for cell in CELLS]
    with (RESULTS / "recomputed.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header.split(","), *rows])
    print(f"{sum(row[-1] == 'agrees' for row in rows)} of {len(rows)} cells agree")
    studies(runs, "populations", ["cells.csv", "pairs.csv"])
    files = "asymmetry behaviours curricula groups observers places relay relay_forced relay_led relay_order relay_twice warm"
    studies(runs, "questions", [f"{name}.csv" for name in files.split()])


main(Path(sys.argv[1]))
