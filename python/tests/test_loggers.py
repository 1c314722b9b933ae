"""Tests that the loggers pass each generation's numbers to TensorBoard, Weights & Biases and MLflow."""

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


def test_weights_and_biases_writes_an_offline_run(config, monkeypatch):
    pytest.importorskip("wandb", reason="wandb is not installed")
    monkeypatch.setenv("WANDB_SILENT", "true")
    train(config, callback=loggers.wandb(config, mode="offline", project="teams"))
    assert any(name.startswith("offline-run") for name in os.listdir("wandb"))


def test_mlflow_stores_the_last_generation(config):
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    mlflow.set_tracking_uri(pathlib.Path("runs.db").absolute().as_uri().replace("file:", "sqlite:"))
    run = train(config, callback=loggers.mlflow(config))
    (logged,) = mlflow.search_runs(output_format="list")
    assert logged.data.metrics["best_g"] == pytest.approx(run.metrics["best_g"][:, -1].mean())


def test_scalars_are_means_over_trials(config):
    rows = []
    run = train(config, callback=lambda generation: rows.append(loggers.scalars(generation)))
    assert [row["mean_g"] for row in rows] == pytest.approx(run.metrics["mean_g"].mean(axis=0))
