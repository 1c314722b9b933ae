"""Tests `sweep`: its points equal single runs, in this process, in other processes, and with Dask and submitit."""

import concurrent.futures
import multiprocessing
import os
import signal

import numpy as np
import pytest
from conftest import ROOT

import flotilla
from flotilla import Config, ConfigError, sweep, train


@pytest.fixture
def grid(config):
    text = config.replace(learning={"trials": 1}).to_toml().replace("coupling = 3", "").replace('fitness = "Df"', "")
    return text + '[grid]\n"world.coupling" = [1, 3]\n"learning.fitness" = ["G", "Df"]\n'


def expected_digests(config):
    """Trains each point of the grid by itself."""
    points = [(coupling, fitness) for coupling in (1, 3) for fitness in ("G", "Df")]
    return [
        train(config.replace(learning={"trials": 1, "fitness": fitness}, world={"coupling": coupling})).digest
        for coupling, fitness in points
    ]


def digests(points):
    return [point.run.digest for point in points]


def test_points_equal_single_runs(config, grid, tmp_path):
    points = sweep(grid)
    assert digests(points) == expected_digests(config)
    assert points.axes == ["world.coupling", "learning.fitness"] and len(points) == 4
    assert points.points[1].values == {"world.coupling": 1, "learning.fitness": "Df"}
    assert points.metric("champion_g").shape == (4, 1)
    (tmp_path / "grid.toml").write_text(grid)
    saved = sweep("grid.toml", out="kept")
    assert digests(saved) == expected_digests(config) and os.path.exists("kept/results.csv")
    assert points.points[0].run.replay().episodes[0].trial == 0
    assert repr(points) == "<flotilla.Sweep: 4 points over world.coupling, learning.fitness>"


@pytest.mark.parametrize("method", [m for m in multiprocessing.get_all_start_methods() if m != "forkserver"])
def test_points_are_played_in_other_processes_and_threads(config, grid, method):
    # `expected_digests` starts the thread pool of this process, so forked processes have a parent with threads.
    expected, progress = expected_digests(config), []
    with concurrent.futures.ProcessPoolExecutor(2, multiprocessing.get_context(method)) as executor:
        points = sweep(grid, executor, backend="cpu", progress=lambda *done: progress.append(done))
    assert digests(points) == expected
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        assert digests(sweep(grid, executor)) == expected


class KillingExecutor(concurrent.futures.ProcessPoolExecutor):
    """Kills one worker after the second point is submitted."""

    def submit(self, *arguments, **named):
        future = super().submit(*arguments, **named)
        if len(self._pending_work_items) == 2 and not getattr(self, "killed", False):
            self.killed = True
            os.kill(next(iter(self._processes)), signal.SIGKILL)
        return future


unix = pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")


@unix
def test_points_of_a_killed_worker_are_played_again(config, grid):
    executor = KillingExecutor(2, multiprocessing.get_context("spawn"))
    with executor, pytest.warns(RuntimeWarning, match="no worker plays it"):
        points = sweep(grid, executor, backend="cpu")
    assert executor.killed and digests(points) == expected_digests(config)


@unix
def test_dask_plays_points_and_survives_a_killed_worker(config, grid):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            killed = []

            def kill_once(done, total):
                if not killed:
                    killed.append(next(iter(cluster.workers.values())).pid)
                    os.kill(killed[0], signal.SIGKILL)

            points = sweep(grid, client.get_executor(), backend="cpu", progress=kill_once)
    assert digests(points) == expected_digests(config)


@pytest.mark.skipif(os.name == "nt", reason="submitit is for Unix")
def test_submitit_plays_points(config, grid):
    submitit = pytest.importorskip("submitit", reason="submitit is not installed")
    executor = submitit.LocalExecutor("jobs")
    executor.update_parameters(timeout_min=5)
    assert digests(sweep(grid, executor, backend="cpu")) == expected_digests(config)


def test_invalid_sweeps_raise(grid):
    with pytest.raises(ConfigError) as error:
        sweep(grid.replace("[1, 3]", "[1, 300]"))
    assert "world.coupling" in str(error.value) and error.value.problems[0].line is not None
    sizes = "\n".join(line for line in grid.splitlines() if not line.startswith(("population", "elites", '"')))
    sizes += '\n"learning.population" = [2, 20]\n"learning.elites" = [1, 5]\n'
    with pytest.raises(ConfigError, match="1 of 4 points"):
        sweep(sizes)
    assert [point.number for point in sweep(sizes, skip_impossible=True)] == [0, 2, 3]
    with pytest.raises(flotilla.Error, match="nowhere.toml: cannot be read"):
        sweep("nowhere.toml")
    with pytest.raises(ConfigError, match="grid"):
        sweep(Config.paper().to_toml())


def test_points_convert_to_a_pandas_table(grid):
    pytest.importorskip("pandas", reason="pandas is not installed")
    table = sweep(grid).to_pandas()
    axes, measures = ["world.coupling", "learning.fitness"], ["best_g", "mean_g", "champion_g"]
    assert list(table.columns) == ["point", *axes, "trial", *measures]
    assert len(table) == 4 and np.isfinite(table["best_g"]).all()


def test_a_grid_may_name_keys_of_groups_and_values_that_fit_only_together(config):
    text = config.to_toml()
    herd = flotilla.Config.parse((ROOT / "configs/herd.toml").read_text()).replace(
        learning={"population": 4, "generations": 0, "trials": 1}, world={"steps": 5}
    )
    found = sweep(herd, grid={"pois.pen.radius": [1.5, 2.5]}, backend="cpu")
    assert [point.values for point in found] == [{"pois.pen.radius": 1.5}, {"pois.pen.radius": 2.5}]
    small = flotilla.Config.parse(text).replace(learning={"elites": 5, "generations": 0, "trials": 1})
    found = sweep(small, grid={"learning.population": [2, 20], "learning.elites": [1, 2]}, backend="cpu")
    assert [point.run.policies[0].shape[1] for point in found] == [2, 2, 20, 20]
    with pytest.raises(TypeError, match="world.steps"):
        sweep(config, grid={"world.steps": [object()]})
