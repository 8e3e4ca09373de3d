"""Fixtures of the tests of nodes."""

import fcntl
import os
from contextlib import contextmanager

import pytest


@contextmanager
def made_once(tmp_path_factory, name):
    """Yield a folder that all processes of a run share, locked: who finds it empty fills it."""
    folder = tmp_path_factory.getbasetemp()
    place = (folder.parent if 'PYTEST_XDIST_WORKER' in os.environ else folder) / name
    with open(place.with_suffix('.lock'), 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        place.mkdir(exist_ok=True)
        yield place


@pytest.fixture(scope='session')
def built(tmp_path_factory):
    """A workspace with this tree built in it, which nothing may change."""
    from ros.workspace import build

    with made_once(tmp_path_factory, 'workspace') as place:
        if not (place / 'install').is_dir():
            build(place)
    return place


@pytest.fixture(scope='session')
def with_ros2(tmp_path_factory):
    """The environment of a shell with the real `ros2`."""
    from ros.workspace import with_ros2

    with made_once(tmp_path_factory, 'ros2') as place:
        return with_ros2(place)


@pytest.fixture
def bench(monkeypatch):
    """Nodes in the process of the test."""
    pytest.importorskip('rclpy')
    from ros.one_process import OneProcess

    with OneProcess(monkeypatch) as made:
        yield made


@pytest.fixture
def executor_only(monkeypatch):
    """Messages pass through the executor of the test, not through the loop of the relay."""
    monkeypatch.setattr(
        pytest.importorskip('imu_calibration.nodes.relay_loop'), 'available', lambda: False
    )
