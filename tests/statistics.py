"""Prints statistics.json: scipy's intervals and p-values for samples like the results of trials.

    python3 statistics.py > statistics.json

Holm's correction, which scipy lacks, comes from statsmodels. Tests compare flotilla's statistics with this file.
"""

import json

import numpy as np
import scipy
from scipy import stats
from statsmodels.stats.multitest import multipletests

random = np.random.default_rng(7)
shares = []
for of in (1, 2, 5, 30, 50, 1000):
    for count in sorted({0, 1, of // 3, of - 1, of}):
        interval = stats.binomtest(count, of).proportion_ci(0.95, "exact")
        shares.append({"count": count, "of": of, "low": interval.low, "high": interval.high})
spreads = []
for n in (3, 5, 30, 50):
    one, other = random.integers(0, 5, size=n), random.integers(2, 5, size=n)
    far = [np.abs(x - np.median(x)) for x in (one, other)]
    # Two more pairs, as below.
    less = np.append(far[0] - far[1], [-4 * np.sqrt(0.5), 4 * np.sqrt(0.5)])
    spreads.append({"one": one.tolist(), "other": other.tolist(), "p": stats.ttest_1samp(less, 0).pvalue,
                    "difference": np.mean(far[0]) - np.mean(far[1])})


def listed(values):
    return [float(x) for x in values]


# Three kinds of pairs of samples for the rank test. `tied` has few values and many ties, as G has, and is small enough
# for all permutations. `apart` has no ties. `many` is too large for the exact test.
tied = [([1, 1, 0.75, 1, 1], [0.5, 0.75, 0.5, 0.5, 0.25]), ([1, 1], [0, 0.5, 1, 0.5]), ([0.5] * 4, [0.5] * 3),
        ([0, 0.25, 0, 0.5, 1, 0.25], [0.25, 0.25, 0.75, 0, 1, 0.5])]
apart = [(listed(random.normal(0, 1, size=n)), listed(random.normal(0.8, 2, size=m)))
         for n, m in ((3, 2), (8, 8), (25, 40))]
many = [(listed(random.integers(0, 5, size=n) / 4), listed(random.integers(0, 4, size=m) / 4))
        for n, m in ((60, 60), (30, 150))]
ranks = []
for cases, method in ((tied, None), (apart, "exact"), (many, "asymptotic")):
    for one, other in cases:
        test = stats.mannwhitneyu(one, other, method=method or "asymptotic")
        p = test.pvalue if method else stats.permutation_test(
            (one, other), lambda x, y: stats.mannwhitneyu(x, y, method="asymptotic").statistic,
            permutation_type="independent", n_resamples=np.inf).pvalue
        ranks.append({"one": one, "other": other, "a": test.statistic / len(one) / len(other), "p": p})
signs = []
for size, grain, method in ((5, 1, None), (10, 2, None), (12, 4, None), (20, 0, "exact"), (60, 0, "exact"),
                            (150, 4, "asymptotic")):
    less = random.normal(0.4, 1, size=size)
    less = np.round(less * grain) / grain if grain else less
    # Pairs without a difference are dropped first, because their signs change nothing.
    p = stats.wilcoxon(less, correction=True, method=method).pvalue if method else stats.permutation_test(
        (less[less != 0],), lambda x: stats.rankdata(np.abs(x))[x > 0].sum(), vectorized=False,
        permutation_type="samples", n_resamples=np.inf).pvalue
    signs.append({"less": listed(less), "p": p})


def interval(mean, low, high, most):
    return [float(mean), float(max(low, -most)), float(min(high, most))]


# Intervals with two more values: the smallest and the largest. A pair of values gets half a pair of each combination.
intervals = []
for n, least in ((3, 4), (5, 0), (5, 3), (10, 0), (10, 4), (30, 3)):
    one, other = random.integers(least, 5, size=n) / 4, random.integers(0, 5, size=n) / 4
    more, others = np.append(one, [0, 1]), np.append(other, [0, 1])
    t = stats.t.interval(0.95, n + 1, more.mean(), stats.sem(more))
    normal = stats.norm.interval(0.95, more.mean() - others.mean(), np.hypot(stats.sem(more), stats.sem(others)))
    less = np.append(one - other, [-np.sqrt(0.5), np.sqrt(0.5)])
    pairs = stats.t.interval(0.95, n + 1, less.mean(), stats.sem(less))
    intervals.append({"one": one.tolist(), "other": other.tolist(),
                      "mean": [float(one.mean()), float(max(t[0], 0)), float(min(t[1], 1))],
                      "difference": interval((one - other).mean(), *normal, 1),
                      "paired": interval((one - other).mean(), *pairs, 1)})
medians = []
for n in (1, 5, 6, 9, 25, 200):
    values = random.integers(0, 100, size=n).astype(float)
    found = stats.quantile_test(values, q=0, p=0.5).confidence_interval(0.95)
    low, high = (None if not np.isfinite(end) else float(end) for end in found)
    medians.append({"values": values.tolist(), "median": [float(np.median(values)), low, high]})
several = [[0.01, 0.04, 0.03], [0.5, 0.2, 0.9, 0.001, 0.02, 0.02], [0.4]]
corrected = [{"p": p, "holm": multipletests(p, method="holm")[1].tolist()} for p in several]
print(json.dumps({"scipy": scipy.__version__, "shares": shares, "spreads": spreads, "ranks": ranks,
                  "signs": signs, "intervals": intervals, "medians": medians, "corrected": corrected}, indent=1))
