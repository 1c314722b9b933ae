import concurrent.futures
import multiprocessing
import os
import signal

import numpy as np
import pytest

import flotilla
from flotilla import Config, ConfigError, sweep, train


@pytest.fixture
def grid(config):
    text = config.replace(learning={"trials": 1}).to_toml().replace("coupling = 3", "").replace('fitness = "Df"', "")
    return text + '[grid]\n"world.coupling" = [1, 3]\n"learning.fitness" = ["G", "Df"]\n'


def digests(config):
    all_ = [(coupling, fitness) for coupling in (1, 3) for fitness in ("G", "Df")]
    configs = [config.replace(learning={"trials": 1, "fitness": fitness}, world={"coupling": coupling}) for coupling, fitness in all_]
    return [train(own).digest for own in configs]


def test_points_are_played_here(config, grid, tmp_path):
    found = sweep(grid)
    assert [point.run.digest for point in found] == digests(config)
    assert found.axes == ["world.coupling", "learning.fitness"] and len(found) == 4
    assert found.points[1].values == {"world.coupling": 1, "learning.fitness": "Df"}
    assert found.metric("champion_g").shape == (4, 1)
    (tmp_path / "grid.toml").write_text(grid)
    kept = sweep("grid.toml", out="kept")
    assert [point.run.digest for point in kept] == digests(config) and os.path.exists("kept/results.csv")
    assert found.points[0].run.replay().episodes[0].trial == 0
    assert repr(found) == "<flotilla.Sweep: 4 points over world.coupling, learning.fitness>"


@pytest.mark.parametrize("method", [m for m in multiprocessing.get_all_start_methods() if m != "forkserver"])
def test_points_are_played_by_other_processes(config, grid, method):
    """Forked ones too, whose parent has threads at work."""
    expected, told = digests(config), []
    with concurrent.futures.ProcessPoolExecutor(2, multiprocessing.get_context(method)) as executor:
        found = sweep(grid, executor, backend="cpu", progress=lambda *done: told.append(done))
    assert [point.run.digest for point in found] == expected
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        assert [point.run.digest for point in sweep(grid, executor)] == expected


class Losing(concurrent.futures.ProcessPoolExecutor):
    """Kills a worker once some points are handed out."""

    def submit(self, *arguments, **named):
        future = super().submit(*arguments, **named)
        if len(self._pending_work_items) == 2 and not getattr(self, "lost", False):
            self.lost = True
            os.kill(next(iter(self._processes)), signal.SIGKILL)
        return future


unix = pytest.mark.skipif(os.name == "nt", reason="a process cannot be killed like this there")


@unix
def test_a_lost_worker_s_points_are_played_again(config, grid):
    with Losing(2, multiprocessing.get_context("spawn")) as executor, pytest.warns(RuntimeWarning, match="no worker plays it"):
        found = sweep(grid, executor, backend="cpu")
    assert executor.lost and [point.run.digest for point in found] == digests(config)


@unix
def test_dask_plays_points(config, grid):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            lost = []

            def lose(done, points):
                if not lost:
                    lost.append(next(iter(cluster.workers.values())).pid)
                    os.kill(lost[0], signal.SIGKILL)

            found = sweep(grid, client.get_executor(), backend="cpu", progress=lose)
    assert [point.run.digest for point in found] == digests(config)


@pytest.mark.skipif(os.name == "nt", reason="submitit is for Unix")
def test_submitit_plays_points(config, grid):
    submitit = pytest.importorskip("submitit", reason="submitit is not installed")
    executor = submitit.LocalExecutor("jobs")
    executor.update_parameters(timeout_min=5)
    assert [point.run.digest for point in sweep(grid, executor, backend="cpu")] == digests(config)


def test_what_is_wrong_with_a_sweep_is_told(grid):
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


def test_a_table_of_points(grid):
    pytest.importorskip("pandas", reason="pandas is not installed")
    table = sweep(grid).to_pandas()
    assert list(table.columns) == ["point", "world.coupling", "learning.fitness", "trial", "best_g", "mean_g", "champion_g"]
    assert len(table) == 4 and np.isfinite(table["best_g"]).all()
