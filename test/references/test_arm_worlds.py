"""
An arm whose joints are not as described.

What of it can be known, and that the rest of the calibration does not suffer.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.estimation.solution import HELD, WEAK

from worlds.arm_worlds import deviations, in_our_axes, make_arm_world, truth
from worlds.arms import SEVEN_AXES, SIX_AXES
from worlds.calibrated import calibrated_on_table
from worlds.candidates import FEW

pytest.importorskip('pinocchio', reason='Pinocchio makes these worlds: make oracles')
OPTIONS = CalibrationOptions(catalogue=CATALOGUE.with_candidates(FEW))


@pytest.mark.parametrize('text', [SIX_AXES, SEVEN_AXES], ids=['six_axes', 'seven_axes'])
def test_tilt_angles_zeros_and_places_are_all_that_can_be_wrong_with_an_arm(text):
    """
    Frames that stand turned and shifted anyhow are explained to rounding.

    Nothing is missing from the catalogue.
    """
    world = make_arm_world(5, joint_error=1e-3, place_error=1e-3, text=text, seconds=1.0)
    *_, rest = in_our_axes(world)
    assert max(rest) < 1e-12


@pytest.fixture(scope='module')
def world():
    return make_arm_world(100, joint_error=3e-4, place_error=3e-4, rate=25.0)


@pytest.fixture(scope='module')
def calibration(world):
    return calibrated_on_table([[world.block]], world.table, OPTIONS).calibration


@pytest.mark.long
def test_an_imu_is_calibrated_on_an_arm_with_wrong_joints(world, calibration):
    errors, _ = deviations(world, calibration)
    assert (
        np.abs(list(errors.values())).max() < 4.5
        and np.mean(np.square(list(errors.values()))) < 2.0
    )
    status = dict(zip(calibration.param_names, calibration.status, strict=True))
    # Three parallel axes: their zeros are one angle, which the last of them carries.
    assert [status[f'reference.encoder_zero.{name}'] for name in ('lift', 'elbow', 'wrist_1')] == [
        HELD,
        HELD,
        WEAK,
    ]
    assert calibration.gauge['zeros_as_described'] == ['pan', 'wrist_3']
    mixed = [
        direction['parameters']
        for direction in calibration.undetermined
        if 'reference.encoder_zero.lift' in direction['parameters']
    ]
    assert any(
        {'reference.encoder_zero.lift', 'reference.encoder_zero.elbow'} <= set(parameters)
        for parameters in mixed
    )


@pytest.mark.long
def test_joints_taken_at_their_word_spoil_the_calibration(world, calibration):
    """
    The quiet counterpart.

    Without the joints' errors in the model the matrices are ten times less exact, and their
    standard deviations say so.
    """
    true = {name: value for name, value in truth(world).items() if '.matrix.' in name}
    errors = []
    at_their_word = replace(OPTIONS, reference_model='table_tilt')
    spoilt = calibrated_on_table([[world.block]], world.table, at_their_word).calibration
    for each in (calibration, spoilt):
        found = dict(
            zip(
                each.param_names,
                zip(each.values, each.sd, strict=True),
                strict=True,
            )
        )
        errors.append(
            np.array([(found[name][0] - value, found[name][1]) for name, value in true.items()])
        )
    assert np.std(errors[1][:, 0]) > 8 * np.std(errors[0][:, 0])
    assert np.mean(np.square(errors[1][:, 0] / errors[1][:, 1])) < 4
