"""Draws docs/pictures/scale.svg: G of champions at coupling 6, by the number of teams played.

    pip install matplotlib
    python3 docs/scale_figure.py                 # from docs/results/scale/coupling6-curves.csv
    python3 docs/scale_figure.py SWEEP...        # writes that file first, from equal-* of docs/results/scale.md
"""

import csv
import io
import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
CURVES = HERE / "results/scale/coupling6-curves.csv"
FITNESS = "Df"
TITLE = "G of the champion at coupling 6, by the number of teams played"
DESCRIPTION = (
    "On a logarithmic axis, for 50, 500, 5000 and 50 000 policies that play equally many teams: leader-follower "
    "champions end between 0.7 and 1, the higher the larger the population; all-leaders champions rise late, to "
    "0.45 with 500 policies and to between 0.1 and 0.28 with the others."
)


def read(sweeps):
    """Returns rows (paradigm, population, teams, mean, standard error) of the champion's G, thinned out."""
    rows = []
    for point in sorted(point for sweep in sweeps for point in Path(sweep).glob("points/*")):
        learning = tomllib.loads((point / "config.toml").read_text())["learning"]
        if learning["fitness"] != FITNESS:
            continue
        by_generation = {}
        with open(point / "metrics.csv", newline="") as file:
            for row in csv.DictReader(file):
                by_generation.setdefault(int(row["generation"]), []).append(float(row["champion_g"]))
        shown = 0
        for generation, values in sorted(by_generation.items()):
            # About 47 points per factor of ten. The last generation is always shown.
            if generation + 1 < shown * 1.05 and generation != max(by_generation):
                continue
            shown = generation + 1
            mean = sum(values) / len(values)
            variance = sum((value - mean) ** 2 for value in values) / max(len(values) - 1, 1)
            teams = learning["population"] * (generation + 1)
            error = (variance / len(values)) ** 0.5
            rows.append([learning["paradigm"], learning["population"], teams, f"{mean:.4f}", f"{error:.4f}"])
    return rows


def draw():
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "flotilla", "font.size": 11})
    import matplotlib.pyplot as plt

    curves = {}
    with open(CURVES, newline="") as file:
        for row in csv.DictReader(file):
            curve = curves.setdefault((row["paradigm"], int(row["population"])), [])
            curve.append([float(row[key]) for key in ("teams", "champion_g", "standard_error")])
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    styles = {50: ":", 500: "--", 5000: "-.", 50000: "-"}
    for (paradigm, population), curve in sorted(curves.items(), key=lambda item: (item[0][0], item[0][1])):
        colour = "#0072b2" if paradigm == "leader-follower" else "#d55e00"
        teams, mean, error = zip(*curve)
        label = f"{paradigm}, {population} policies".replace("50000", "50 000")
        axes.plot(teams, mean, styles[population], color=colour, label=label)
        low = [m - e for m, e in zip(mean, error)]
        high = [m + e for m, e in zip(mean, error)]
        axes.fill_between(teams, low, high, color=colour, alpha=0.12, linewidth=0)
    axes.set(xlabel="teams played", ylabel="G of the champion, mean over trials", xscale="log", ylim=(-0.02, 1.02))
    axes.legend(loc="upper left", frameon=False, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    # Matplotlib writes no title and description, which screen readers need.
    head, rest = text.getvalue().split("<svg ", 1)
    attributes, body = rest.split(">\n <metadata>", 1)
    described = (
        f'{head}<svg role="img" aria-labelledby="title description" {attributes}>\n<title id="title">{TITLE}</title>\n'
        f'<desc id="description">{DESCRIPTION}</desc>\n<metadata>{body}'
    )
    (HERE / "pictures/scale.svg").write_text(described)


if sys.argv[1:]:
    with open(CURVES, "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["paradigm", "population", "teams", "champion_g", "standard_error"])
        table.writerows(read(sys.argv[1:]))
draw()
