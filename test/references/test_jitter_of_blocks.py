"""
Independent errors of the stamps.

Their size from the scatter of both sensors in motion, and no regime where they explain it.
"""

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.diagnosis_result import diagnosis_mapping
from imu_calibration.calibration.diagnosis.diagnosis_workflow import timing_lines
from imu_calibration.references.turntable.residuals.jitter_of_blocks import (
    jitter_ratio,
    stamp_jitter,
)

from worlds.candidates import FEW
from worlds.diagnosing import diagnose
from worlds.hiding import record

BLOCKS, FREEDOM, NOISE = 600, 13, (1e-8, 1e-10)


def blocks(jitter, seed=0):
    """
    Return (variances, mean square slopes, degrees of freedom) of blocks, a third of them at rest.

    `jitter` of each sensor, s.
    """
    rng = np.random.default_rng(seed)
    speed = np.where(np.arange(BLOCKS) % 3 == 0, 0.0, rng.uniform(0.5, 4.0, BLOCKS))[:, None]
    slope = [(size * speed * rng.uniform(0.5, 1.0, (BLOCKS, 3))) ** 2 for size in (4.0, 1.0)]
    scatter = rng.chisquare(FREEDOM, (2, BLOCKS, 3)) / FREEDOM
    rough = [
        (noise + sd**2 * steep) * part
        for noise, sd, steep, part in zip(NOISE, jitter, slope, scatter)
    ]
    return rough, slope, np.full(BLOCKS, float(FREEDOM))


@pytest.mark.parametrize('sd', [2e-5, 1e-4])
def test_the_size_of_the_errors_is_estimated_and_their_scatter_removed(sd):
    rough, slope, freedom = blocks((sd, sd))
    found = stamp_jitter(rough, slope, freedom)
    assert found.significant and found.sd == pytest.approx(sd, rel=0.05) and len(found.lines) == 1
    for own, steep, noise in zip(rough, slope, NOISE):
        assert np.median(
            (own / jitter_ratio(own, steep, found.sd))[steep[:, 0] > 0]
        ) == pytest.approx(noise, rel=0.15)


@pytest.mark.parametrize('jitter', [(1e-4, 0.0), (0.0, 1e-4), (0.0, 5e-6)])
def test_scatter_of_one_sensor_is_no_error_of_the_stamps(jitter):
    """
    The other sensor shows none; at 5 us the precise sensor would decide the mean of both alone.
    """
    rough, slope, freedom = blocks(jitter)
    found = stamp_jitter(rough, slope, freedom)
    assert not found.significant and found.sd < 0.7 * max(jitter) and not found.lines


def test_no_jitter_changes_nothing():
    rough, slope, freedom = blocks((0.0, 0.0))
    assert not stamp_jitter(rough, slope, freedom).significant
    assert np.all(jitter_ratio(rough[0], slope[0], 0.0) == 1.0)


def test_a_navigation_grade_session_with_irregular_stamps_has_no_regime():
    """Independent errors of 50 us at 1 rad/s are 0.5 mm/s^2, six times the noise of this grade."""
    recording = record(5, None, 'realistic@navigation', through_bag=False, profile='quick')
    diagnosis = diagnose(recording.windows, recording.table, recording.model, candidates=FEW)
    assert not any(rest.significant for rest in diagnosis.unexplained.values())
    assert diagnosis_mapping(diagnosis)['stamp_jitter_s'] == pytest.approx(50e-6, rel=0.1)
    assert timing_lines(diagnosis) == diagnosis.stamp_jitter.lines != []
