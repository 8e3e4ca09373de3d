"""Fixtures of the tests of nodes."""

import pytest


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
    monkeypatch.setattr(pytest.importorskip('imu_calibration.nodes.relay_loop'), 'available', lambda: False)
