"""Compares a run's event files, as TensorBoard's own reader returns them, with its metrics.csv.

    python3 tests/event_files.py RUN

RUN is a run trained with --tensorboard. Needs the package tensorboard.
"""

import csv
import pathlib
import sys

from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.util import tensor_util

TAGS = ["best_g", "mean_g", "champion_g"]


def main():
    run = pathlib.Path(sys.argv[1])
    with open(run / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    expected = {(int(row["trial"]), int(row["generation"])): [float(row[tag]) for tag in TAGS] for row in rows}
    assert expected, "metrics.csv has no rows"

    events = EventMultiplexer(tensor_size_guidance={"scalars": 0}).AddRunsFromDirectory(str(run / "tensorboard"))
    events.Reload()
    logged = {}
    for name, tags in events.Runs().items():
        trial = int(name.removeprefix("trial-"))
        assert sorted(tags["tensors"]) == sorted(TAGS), tags
        for index, tag in enumerate(TAGS):
            assert events.SummaryMetadata(name, tag).plugin_data.plugin_name == "scalars"
            for event in events.Tensors(name, tag):
                values = logged.setdefault((trial, event.step), [None] * len(TAGS))
                assert values[index] is None, f"{name} has {tag} of generation {event.step} twice"
                values[index] = tensor_util.make_ndarray(event.tensor_proto).item()
    assert logged == expected, "the event files and metrics.csv differ"
    print(f"{len(logged)} rows of {len(events.Runs())} trials are the same in TensorBoard as in metrics.csv")


main()
