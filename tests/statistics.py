"""Makes statistics.json, what scipy says of samples like those of trials: python3 statistics.py > statistics.json"""

import json

import numpy as np
import scipy
from scipy import stats

random = np.random.default_rng(7)
samples = [[float(x) for x in random.integers(0, 5, size=n)] for n in (2, 3, 5, 10, 30, 50)]
samples += [[3.0] * 4 + [4.0] * 26, [0.0] * 29 + [1.0], [float(x) for x in random.normal(-2, 3, size=200)]]
means = []
for values in samples:
    low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
    means.append({"values": values, "mean": np.mean(values), "low": low, "high": high,
                  "p": stats.ttest_1samp(values, 0).pvalue})
shares = []
for of in (1, 2, 5, 30, 50, 1000):
    for count in sorted({0, 1, of // 3, of - 1, of}):
        interval = stats.binomtest(count, of).proportion_ci(0.95, "exact")
        shares.append({"count": count, "of": of, "low": interval.low, "high": interval.high})
spreads = []
for n in (3, 5, 30, 50):
    one, other = random.integers(0, 5, size=n), random.integers(2, 5, size=n)
    far = [np.abs(x - np.median(x)) for x in (one, other)]
    spreads.append({"one": one.tolist(), "other": other.tolist(), "p": stats.ttest_rel(*far).pvalue,
                    "difference": np.mean(far[0]) - np.mean(far[1])})
print(json.dumps({"scipy": scipy.__version__, "means": means, "shares": shares, "spreads": spreads}, indent=1))
