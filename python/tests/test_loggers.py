"""Each generation's numbers, logged where they can be read again."""

import os
import pathlib

import pytest

import flotilla
from flotilla import loggers, train


def test_event_files_are_written(config):
    pytest.importorskip("tensorboardX", reason="tensorboardX is not installed")
    train(config, callback=loggers.tensorboard("events"))
    (file,) = pathlib.Path("events").iterdir()
    content = file.read_bytes()
    assert all(content.count(name) == 7 for name in (b"best_g", b"mean_g", b"champion_g"))


def test_weights_and_biases_offline(config, monkeypatch):
    pytest.importorskip("wandb", reason="wandb is not installed")
    monkeypatch.setenv("WANDB_SILENT", "true")
    train(config, callback=loggers.wandb(config, mode="offline", project="teams"))
    assert any(name.startswith("offline-run") for name in os.listdir("wandb"))


def test_mlflow_in_a_folder(config):
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    mlflow.set_tracking_uri(pathlib.Path("runs.db").absolute().as_uri().replace("file:", "sqlite:"))
    run = train(config, callback=loggers.mlflow(config))
    (found,) = mlflow.search_runs(output_format="list")
    assert found.data.metrics["best_g"] == pytest.approx(run.metrics["best_g"][:, -1].mean())


def test_means_over_trials_are_told(config):
    told = []
    run = train(config, callback=lambda generation: told.append(loggers.scalars(generation)))
    assert [row["mean_g"] for row in told] == pytest.approx(run.metrics["mean_g"].mean(axis=0))
