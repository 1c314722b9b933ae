"""Draws docs/pictures/coupling.svg: how many teams are played at each coupling until one solves the task.

    pip install matplotlib
    python3 docs/coupling_figure.py

The input is docs/results/scale/scale_coupling-5000.csv.
"""

import csv
import io
from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams.update({"svg.hashsalt": "flotilla", "font.size": 11})
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
POPULATION = 5000
LIMIT = 101 * POPULATION
TITLE = "Teams played until one has G of 0.75, by coupling"
DESCRIPTION = (
    "On a logarithmic axis: all-leaders teams need more from coupling 3 to 4 and never succeed later; leader-follower"
    " teams need more from coupling 3 to 6 and never succeed later. Dashed lines show how the numbers would grow if "
    "each further agent multiplied them by the same factor."
)


def teams(paradigm):
    """Returns {coupling: [mean, low, high] in teams}, and the couplings at which no trial solves the task."""
    found, never = {}, []
    with open(HERE / "results/scale/scale_coupling-5000.csv", newline="") as file:
        for row in csv.DictReader(file):
            if row["measure"] != "generations_to_reach" or row["arm"] != f"paradigm {paradigm}" or row["other"]:
                continue
            coupling = int(row["where"].removeprefix("coupling "))
            if int(row["reached"]) == 0:
                never.append(coupling)
            else:
                # A trial that reaches G in generation n plays n + 1 generations, because generation 0 counts.
                found[coupling] = [POPULATION * (1 + float(row[key])) for key in ("value", "low", "high")]
    return found, never


figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
for paradigm, colour, fitted in [("leader-follower", "#0072b2", (4, 5)), ("all-leaders", "#d55e00", (3, 4))]:
    found, never = teams(paradigm)
    couplings = sorted(found)
    mean, low, high = ([found[coupling][at] for coupling in couplings] for at in range(3))
    spread = [[m - l for m, l in zip(mean, low)], [h - m for m, h in zip(mean, high)]]
    axes.errorbar(couplings, mean, spread, marker="o", capsize=3, color=colour, label=paradigm)
    shift = -0.06 if paradigm == "all-leaders" else 0.06
    axes.scatter([coupling + shift for coupling in never], [LIMIT] * len(never), marker="^", s=50, color=colour)
    first, second = (found[coupling][0] for coupling in fitted)
    later = range(fitted[0], 9)
    axes.plot(later, [first * (second / first) ** (coupling - fitted[0]) for coupling in later], "--", color=colour,
              linewidth=1, label=f"{paradigm}, if each further agent costs {second / first:.1f} times as much")
axes.axhline(LIMIT, color="#888888", linewidth=0.8)
axes.text(3, LIMIT * 1.12, "triangles: never solved", color="#555555", fontsize=9)
axes.set(xlabel="coupling: agents that a POI needs at once", ylabel="teams played until one has G of 0.75",
         yscale="log", ylim=(4000, 3e7), xticks=range(3, 9))
axes.legend(loc="upper left", frameon=False, fontsize=10)
axes.spines[["top", "right"]].set_visible(False)
text = io.StringIO()
figure.savefig(text, format="svg", metadata={"Date": None})
# Matplotlib writes no title and description, which screen readers need.
described = '''<svg role="img" aria-labelledby="title description" ''', f'''>
<title id="title">{TITLE}</title>
<desc id="description">{DESCRIPTION}</desc>
<metadata>'''
head, rest = text.getvalue().split("<svg ", 1)
attributes, body = rest.split(">\n <metadata>", 1)
(HERE / "pictures/coupling.svg").write_text(head + described[0] + attributes + described[1] + body)
