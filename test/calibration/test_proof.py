"""A calibration is proven on windows that took no part, before it is handed over."""

import re
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.document.decision import HELPS, decide, reason_of, worse_regimes
from imu_calibration.document.proof_entry import RegimeErrors
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import applied_values
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.session_data import TABLE_FOLDS, HeldOut
from imu_calibration.references.turntable.window_statistics import Regime, moving_pieces

from worlds.misfit_worlds import make_pair

SENSORS = ('accelerometer', 'gyroscope')


def calibrated(pair, **choices):
    return calibrate_recordings(
        pair.first.block, Table.from_mapping(pair.table), model_as_asked=True, **choices
    )


@pytest.fixture(scope='module')
def clean():
    return calibrated(make_pair(None, 1, imu_rate=50.0, joint_rate=50.0))


@pytest.fixture(scope='module')
def late():
    return calibrated(
        make_pair('driver_lag', 1, table='shaft', profile='sweeps', imu_rate=50.0, joint_rate=50.0),
        reference_model='table_tilt',
    )


def test_both_sides_are_compared_with_the_same_table():
    """
    What belongs to the table and the clock stays where compensation would undo nothing.

    A mount that bends went from one side alone.
    """
    names = [effect.name for effect in CATALOGUE.effects().values() if effect.sensor == 'reference']
    model = SensorModel(reference=tuple(names))
    values = np.arange(1.0, 1.0 + len(model.prior()[0]))
    kept = applied_values(model, values)
    assert names and all(
        (kept[model.slices[effect.key]] == values[model.slices[effect.key]]).all()
        for effect in model.effects
        if effect.sensor == 'reference'
    )


def test_a_good_calibration_is_proven_in_every_motion(clean):
    found = clean.calibration.proof
    assert set(found) == set(SENSORS) and clean.verdict.word is HELPS
    for entry in found.values():
        assert entry.windows == sum(clean.calibration.statistics['windows'].values())
        assert set(entry.regimes) >= {Regime.REST, Regime.FAST, Regime.ACCELERATING}
        for part in (entry, *entry.regimes.values()):
            assert part.ci95[0] <= part.after / part.before <= part.ci95[1] < 0.6


def test_a_gain_that_a_lag_has_spoiled_is_no_help_and_the_cause_is_named(late, tmp_path):
    true = (
        make_pair('driver_lag', 1, table='shaft', profile='sweeps', imu_rate=50.0, joint_rate=50.0)
        .first.truth['gyroscope']
        .matrix[0, 0]
    )
    gain = late.calibration.value('gyroscope', 'matrix')[0, 0]
    assert abs(gain - true) > 2 * abs(1.0 - true)  # what has to be noticed
    assert late.verdict.decisions['gyroscope'] is not HELPS and late.exit_code == 3
    assert late.calibration.proof['gyroscope'].delay_s == pytest.approx(0.012, abs=2e-3)
    line = reason_of(late.calibration.proof['gyroscope'])
    assert (
        re.search(r'\b1\d(\.\d+)? ms\b', line)
        and '\n' not in line
        and line == late.calibration.decision_reasons['gyroscope']
    )
    # Its residuals are large, and it helps in every motion.
    assert late.verdict.decisions['accelerometer'] is HELPS
    late.save(tmp_path, report=False)
    assert 'proof:' in (tmp_path / 'calibration.yaml').read_text()


def test_a_fold_is_left_out_as_if_it_had_not_been_recorded(clean):
    result = clean.result
    dealt = result.gathered.held_out.restricted(result.data.model, result.model)
    without = dealt.values_without(result.solution)
    rest = Accumulator()
    for k, block in enumerate(dealt.blocks):
        if k % TABLE_FOLDS != 2:
            rest.merge(block.accumulator)
    assert not rest.blocks  # memory that nobody needs
    again = solve(rest, result.model, noise=result.solution.noise)
    free = ~(result.solution.held | again.held)
    step, wanted = (
        (values - result.solution.values)[free] / result.solution.sd[free]
        for values in (without[2], again.values)
    )
    # biases wander from window to window: what is dealt out apart is whitened apart
    assert np.corrcoef(step, wanted)[0, 1] > 0.95 and np.abs(step - wanted).max() < 0.3


def test_every_window_is_dealt_to_one_block(clean):
    gathered = clean.result.gathered
    blocks = gathered.held_out.blocks
    for kind, count in gathered.accumulator.windows.items():
        each = [block.accumulator.windows.get(kind, 0) for block in blocks]
        assert sum(each) == count and max(each) - min(each) <= 1


def test_memory_does_not_grow_with_the_session(clean):
    twice = HeldOut()
    for _ in range(3):
        twice.merge(clean.result.gathered.held_out)
    sizes = [factor.shape for block in twice.blocks for factor in block.pieces.values()]
    assert twice.n_windows == 3 * clean.result.gathered.held_out.n_windows and max(
        rows for rows, _ in sizes
    ) <= max(width for _, width in sizes)


def test_a_regime_that_gets_worse_is_named(clean):
    entry = clean.calibration.proof['gyroscope']
    worse = RegimeErrors(1.0, 1.2, (1.1, 1.3), seconds=10.0, unit='rad/s')
    lines = worse_regimes(replace(entry, regimes={**entry.regimes, Regime.FAST: worse}))
    assert len(lines) == 1 and Regime.FAST in lines[0]
    # The decision excepts it.
    partly = replace(entry, regimes={**entry.regimes, Regime.FAST: worse})
    assert decide(partly) is HELPS and Regime.FAST not in reason_of(entry)
    assert reason_of(partly).endswith(f'regime {Regime.FAST}')
    doubtful = replace(worse, ci95=(0.9, 1.5))
    assert not worse_regimes(replace(entry, regimes={Regime.FAST: doubtful}))


def test_a_piece_knows_its_mean_and_how_the_input_changed():
    time = np.arange(0.0, 5.0, 0.01)
    rate = np.stack([2.5 * np.sin(time), np.zeros_like(time), np.zeros_like(time)], axis=1)
    rows = np.concatenate([np.ones((len(time), 1)), rate], axis=1)
    pieces = moving_pieces(rows, time, rate, rate_s=rate)
    assert set(pieces) == {Regime.MEDIUM, Regime.FAST, Regime.ACCELERATING}
    total = np.concatenate(list(pieces.values()))
    assert len(total) == 19 and np.all(total[:, 0] == 1.0)
    middle = np.arcsin(np.clip(total[:, 4] / 2.5, -1, 1))
    np.testing.assert_allclose(np.abs(total[:, 1]), np.abs(2.5 * np.cos(middle)), atol=0.15)
    assert np.all(np.abs(pieces[Regime.ACCELERATING][:, 1]) > 90 * np.pi / 180)
