"""
Axes that sag and wobble: the same as joints across them, and as what a table cannot tell from them.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.chain import (
    WOBBLES,
    reference_motion,
    with_axis_angles,
    with_sag,
    with_wobble,
    wobble_at,
)
from imu_calibration.kinematics.joint import Joint
from imu_calibration.kinematics.joint_motion import JointMotion, with_encoder_harmonics
from imu_calibration.kinematics.table import Table, axis_error_directions

FIELDS = ('force_s', 'rate_s', 'alpha_s', 'mat_sn')
TIME = np.linspace(0.0, 7.0, 141)


def motion(n_joints):
    """Return sines with their exact derivatives."""
    frequency, phase = np.arange(1, n_joints + 1) * 0.6, np.arange(n_joints)
    turn = np.exp(1j * (TIME[:, None] * frequency + phase))
    return JointMotion(TIME, *((turn * (1j * frequency) ** order).imag for order in range(4)))


def change(table, moves, other_table, other_moves):
    """Return what one reference has more than another, by field."""
    one, other = reference_motion(table, moves), reference_motion(other_table, other_moves)
    return {name: getattr(one, name) - getattr(other, name) for name in FIELDS}


@pytest.mark.parametrize('axis', [(0, 0, 1), (0, 0, -1), (1, 2, -1), (-1, 0, 0)])
def test_wobble_is_two_joints_across_the_axis(axis):
    first, last = (
        Joint('first', (0, 1, 0)),
        Joint('last', axis, xyz=(0.1, 0.0, 0.2), rpy_deg=(10.0, 20.0, 30.0)),
    )
    table, moves = Table((first, last), gravity=9.8, mount_xyz=(0.1, 0.2, 0.3)), motion(2)
    amplitudes = 1e-6 * np.arange(1, 9.0).reshape(2, 2, 2) * [[[0.0]], [[1.0]]]
    lean = wobble_at(
        tuple(zip(WOBBLES, amplitudes[1] @ [1, 1j])),
        moves.position[:, 1],
        moves.rate[:, 1],
        acceleration=moves.acceleration[:, 1],
    )
    across = [
        replace(last, name=name, axis=tuple(direction))
        for name, direction in zip('uv', axis_error_directions(np.array(last.axis)))
    ]
    across[1] = replace(across[1], xyz=(0, 0, 0), rpy_deg=(0, 0, 0))
    grown = replace(table, joints=(first, *across, replace(last, xyz=(0, 0, 0), rpy_deg=(0, 0, 0))))
    columns = [
        np.stack([of_first, one.real, one.imag, of_last], axis=1)
        for of_first, one, of_last in zip(
            *(
                np.stack([moves.position, moves.rate, moves.acceleration])[:, :, k]
                if k >= 0
                else lean
                for k in (0, -1, 1)
            )
        )
    ]
    wanted = change(grown, JointMotion(TIME, *columns, np.zeros((len(TIME), 4))), table, moves)
    got = change(with_wobble(table, amplitudes.ravel()), moves, table, moves)
    for name in FIELDS:
        # two small turns in another order differ by the square of the angle
        np.testing.assert_allclose(got[name], wanted[name], atol=3e-5 * np.abs(wanted[name]).max())


def test_sag_of_a_gimbal_is_an_angle_between_axes_and_an_encoder_that_reads_wrong():
    joints = [
        Joint(name, axis)
        for name, axis in zip(('outer', 'middle', 'inner'), ((0, 0, 1), (0, 1, 0), (1, 0, 0)))
    ]
    table, moves, sag = Table(tuple(joints), gravity=9.8), motion(3), 1e-6
    # What is behind the shaft goes along with it: the zero of the inner joint.
    mounted = replace(moves, position=moves.position - [0.0, 0.0, sag])
    for of_joint, alike in (
        ([sag, 0.0], (with_axis_angles(table, np.array([sag, 0.0])), mounted)),
        (
            [0.0, sag],
            (
                table,
                with_encoder_harmonics(
                    moves, 1, np.array([0.0, sag, 0.0]), sin_amplitude=np.zeros(3)
                ),
            ),
        ),
    ):
        got, wanted = (
            change(with_sag(table, np.array(of_joint)), moves, table, moves),
            change(*alike, table, moves),
        )
        for name in FIELDS:
            np.testing.assert_allclose(
                got[name], wanted[name], atol=3e-5 * np.abs(wanted[name]).max()
            )


def test_a_shaft_that_sags_points_down():
    table, moves = (
        Table((Joint('base', (0, 0, 1)), Joint('shaft', (1, 0, 0))), gravity=9.8),
        motion(2),
    )
    hanging = reference_motion(with_sag(table, np.array([0.01])), moves)
    # The shaft's direction, seen from above.
    np.testing.assert_allclose(hanging.mat_sn[:, 0, 2], -0.01, atol=1e-6)


def test_what_stands_straight_is_left_as_it_is():
    table, moves = (
        Table((Joint('base', (0, 0, 1)), Joint('shaft', (1, 0, 0))), gravity=9.8),
        motion(2),
    )
    same = change(with_wobble(with_sag(table, np.zeros(1)), np.zeros(8)), moves, table, moves)
    assert not any(values.any() for values in same.values())
    assert with_sag(table, np.zeros(1)) == table


def test_lags_between_axes_are_moot_on_a_shaft():
    effect = CATALOGUE.find('gyroscope', 'gyro_cross_axis_lag')
    shaft = Table((Joint('shaft', (1, 0, 0)),), gravity=9.8)
    assert (
        'one axis' in effect.moot(shaft)[0]
        and effect.moot(Table((Joint('base', (0, 0, 1)), *shaft.joints), gravity=9.8)) is None
    )
