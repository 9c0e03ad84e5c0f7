"""The command as a person runs it: in this process, and now and then in one of its own."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepsimbad.cli import run

from ..commands import CommandResult


@pytest.fixture
def deepsimbad(capfd, monkeypatch, tmp_path) -> Callable[..., CommandResult]:
    """Runs the command in this process, in an empty folder."""
    for name in os.environ:
        if name.startswith("DEEPSIMBAD_"):
            monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> CommandResult:
        capfd.readouterr()
        code = run([str(argument) for argument in arguments])
        return CommandResult(code, *capfd.readouterr())

    return call


@pytest.fixture
def process(tmp_path) -> Callable[..., subprocess.Popen[str]]:
    """Starts the command as a process, in an empty folder."""

    def start(*arguments: object, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "deepsimbad", *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


@pytest.fixture(scope="session")
def drives(tmp_path_factory) -> Path:
    """Three drives of one route as ready encodings, and elsewhere: landmarks, summer, winter."""
    folder = tmp_path_factory.mktemp("drives")
    rng = np.random.default_rng(11)
    places = rng.normal(size=(80, 16))
    np.save(folder / "landmarks.npy", rng.normal(size=(60, 16)).astype(np.float32))
    np.save(folder / "summer.npy", (places + 0.1 * rng.normal(size=places.shape)).astype(np.float32))
    np.save(folder / "winter.npy", (places + 0.5 * rng.normal(size=places.shape)).astype(np.float32))
    return folder


@pytest.fixture(scope="session")
def pictures(tmp_path_factory) -> Path:
    """A folder of thirty images, three metres apart."""
    folder = tmp_path_factory.mktemp("pictures")
    lines = ["name,position_m"]
    for place in range(30):
        coarse = np.random.default_rng(place).integers(0, 255, (6, 8, 3), np.uint8)
        image = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{place}.png"), image)
        lines.append(f"{place}.png,{3 * place}")
    (folder / "positions.csv").write_text("\n".join(lines))
    return folder


@pytest.fixture
def mapped_dir(deepsimbad, drives, tmp_path) -> Path:
    """A data directory with one mapped domain, `route`."""
    sources = ("--landmarks", drives / "landmarks.npy", "--training", drives / "summer.npy")
    ran = deepsimbad("map", "route", *sources, "--evaluator", "feature_l2:none", "--n-landmarks", 20)
    assert ran.code == 0, ran.err
    return tmp_path / "deepsimbad-data"
