"""
A reference of poses needs rows and a step only.

The rotation over blocks of a second against the poses of a motion-capture system.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from imu_calibration.estimation.row_estimate import RowSet, estimate_rows
from imu_calibration.estimation.solution import total
from imu_calibration.kinematics.strapdown import integrate_turn, small_rotation

BLOCK, GAP, STEP, MARGIN = 1.0, 0.03, 0.05, 0.1
"""
Length of a block, largest steps of the reference and of the IMU at a block, distance from the ends
of the recording, s.
"""


@dataclass(frozen=True, eq=False)
class PoseState:
    """The parameters alone."""

    values: np.ndarray


@dataclass(frozen=True, eq=False)
class PoseReference:
    """
    Rotations of blocks: ``mat_ref = exp(-[psi]) mat(values)``, three rows of psi each.

    Parameters are bias, matrix and mounting of the gyroscope and the lag of the poses, s. A
    mounting is a rotation of the matrix, so it is fixed.
    """

    time: np.ndarray
    rate: np.ndarray
    poses: Slerp

    nominal = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(4)])
    priors = np.concatenate([np.full(3, 0.2), np.full(9, 0.3), np.full(3, 0.3), [0.05]])
    fixed = np.isin(np.arange(16), (12, 13, 14))

    @cached_property
    def blocks(self):
        """(samples, rotation by the poses) of each block without a gap."""
        known, found = self.poses.times, []
        edges = np.searchsorted(
            self.time,
            np.arange(
                max(self.time[0], known[0]) + MARGIN, min(self.time[-1], known[-1]) - MARGIN, BLOCK
            ),
        )
        for block in map(slice, edges, edges[1:] + 1):
            ends = self.time[[block.start, block.stop - 1]]
            near = np.searchsorted(known, ends)
            if np.all(known[near] - known[near - 1] <= GAP) and np.all(
                np.diff(self.time[block]) <= STEP
            ):
                first, last = self.poses(ends).as_matrix()
                found.append((block, last.T @ first))
        return found

    def moved(self, state, step):
        return replace(state, values=state.values + step)

    def linearise(self, state):
        bias, matrix, lag, residual, main = (
            state.values[:3],
            state.values[3:12].reshape(3, 3),
            state.values[15],
            [],
            [],
        )
        for block, mat_ref in self.blocks:
            turn = integrate_turn(self.time[block], self.rate[block], bias=bias, matrix=matrix)
            first, last = np.linalg.solve(matrix, (self.rate[block][[0, -1]] - bias).T).T
            late = small_rotation(lag * last) @ turn.mat_ji @ small_rotation(-lag * first)
            residual.append(-Rotation.from_matrix(mat_ref @ late.T).as_rotvec())
            main.append(
                np.column_stack(
                    [
                        turn.by_bias,
                        turn.by_matrix.reshape(3, 9),
                        late - np.eye(3),
                        late @ first - last,
                    ]
                )
            )
        count = 3 * len(residual)
        block = np.repeat(np.arange(len(residual)), 3)
        return RowSet(
            np.concatenate(residual),
            np.zeros((count, 0)),
            np.concatenate(main),
            np.full(count, 1e-12),
            np.zeros(count, int),
            np.column_stack([block, block]),
        )


@pytest.fixture(scope='module')
def walking(recordings):
    with AnyReader([recordings / 'mocap_walk_raw']) as reader:
        found = {
            name: [
                reader.deserialize(raw, c.msgtype)
                for c, _, raw in reader.messages()
                if c.topic == name
            ]
            for name in ('/imu/data_raw', '/mocap/pose')
        }
    imu, pose = found.values()
    stamps = [
        np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in some])
        for some in (imu, pose)
    ]
    time, known = (1e-9 * (some - stamps[0][0]) for some in stamps)
    kept = np.append(True, np.diff(known) > 0)
    attitudes = [[getattr(m.pose.orientation, axis) for axis in 'xyzw'] for m in pose]
    rate = np.array([[getattr(m.angular_velocity, axis) for axis in 'xyz'] for m in imu])
    return PoseReference(
        time, rate, Slerp(known[kept], Rotation.from_quat(np.array(attitudes)[kept]))
    )


def test_scales_agree_with_those_of_an_independent_fit(walking):
    """
    Published with the recording, with the standard deviations of that fit; ours are of white noise.
    """
    found = estimate_rows(
        walking, PoseState(walking.nominal), fallback=np.array([np.radians(0.2) ** 2])
    )
    scales = np.array([3, 7, 11])
    values, sd = found.state.values[scales], np.sqrt(np.diag(total(found.terms)))[scales]
    print(
        f'1 over scale {1 / values} +- {sd / values**2}, attitude noise'
        f' {np.degrees(np.sqrt(found.scatter.variance[0])):.3f} deg, lag'
        f' {found.state.values[15]:.4f} s'
    )
    assert np.all(
        np.abs(1 / values - [0.9444, 1.0956, 1.0173])
        < 3 * np.hypot(sd / values**2, [0.0004, 0.0009, 0.0003])
    )
    assert sd.max() < 3e-3 and not found.held[~walking.fixed].any()
    assert np.all(np.abs(1 / values - 1) > 10 * sd)


def test_rows_are_the_derivative_of_the_residual(walking):
    """Of some blocks, at the nominal values."""
    few = replace(walking, time=walking.time[:2000], rate=walking.rate[:2000])
    rows = few.linearise(PoseState(few.nominal))
    for k in np.flatnonzero(~few.fixed):
        step = 1e-6 * np.eye(16)[k]
        ahead, behind = (
            few.linearise(PoseState(few.nominal + sign * step)).residual for sign in (1, -1)
        )
        slope = (behind - ahead) / 2e-6
        # To first order in the residual, a tenth of a radian.
        assert np.abs(rows.main[:, k] - slope).max() < 0.1 * np.abs(slope).max(), k
