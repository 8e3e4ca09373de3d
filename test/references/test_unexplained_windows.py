"""
A rest that is significant has a size, and is gone with an effect that has a name.

It has a size also where biases may wander by more than it.
"""

from types import SimpleNamespace

import numpy as np

from imu_calibration.references.turntable.residuals import unexplained_windows


def test_what_differs_from_neighbour_to_neighbour_below_a_wander_has_a_size(monkeypatch):
    """
    Plain squares of the means are less than noise and wander allow.

    Whitened ones are not: "0 deg/s, significant" was told.
    """
    monkeypatch.setattr(unexplained_windows, 'correlate', lambda *_, fitted: ('time', 0.5))
    monkeypatch.setattr(unexplained_windows, '_explanations', lambda recording: {})
    n = 40
    noise = SimpleNamespace(
        bias_variance=1e-2,
    )
    explained = SimpleNamespace(
        floor=SimpleNamespace(noise={'gyroscope': noise}),
        numbers={'gyroscope': np.array([3 * n, 1])},
        sigma=lambda sensor, excess: (20.0, 0.0),
    )
    problem = SimpleNamespace(
        explained=explained,
        space=SimpleNamespace(
            mean={'gyroscope': [np.full((n, 1), 0.01)] * 3}, places=lambda sensor, axis: [0]
        ),
        recording=SimpleNamespace(mean_variance=lambda noise: np.full((n, 3), 4e-6)),
    )
    rest = unexplained_windows._unexplained(
        problem, 'gyroscope', np.outer([9.0 * 3 * n, 0.0], np.full(3, 1 / 3)), np.ones(1)
    )
    assert rest.significant
    np.testing.assert_allclose(rest.rms, 3 * 2e-3)


def test_a_joint_goes_by_its_name():
    n = 60
    describe = {
        'time': np.arange(n, dtype=float),
        'temperature': np.full(n, np.nan),
        'rate': np.zeros(n),
        'specific force': np.full(n, 9.8),
        'angle0': np.linspace(0, 9, n),
        'span0': np.zeros(n),
        'angle1': np.linspace(1, 5, n)[::-1],
        'span1': np.zeros(n),
    }
    recording = SimpleNamespace(
        describe=describe,
        kind=np.zeros(n),
        moving=np.zeros(n, bool),
        model=SimpleNamespace(joint_names=('pan', 'tilt')),
    )
    rest = np.random.default_rng(3).normal(size=(n, 3)) + 4 * np.cos(describe['angle1'])[:, None]
    assert (
        unexplained_windows.correlate(
            unexplained_windows._explanations(recording), rest, np.ones(rest.shape)
        )[0]
        == 'angle of tilt'
    )
