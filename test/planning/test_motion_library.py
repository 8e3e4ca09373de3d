"""
Motions that a planner asks for.

Within every limit, from rest to rest, and such as a joint trajectory can say.
"""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.motion_limits import limits_of
from imu_calibration.planning.motion_library import MotionKind, MotionLibrary, rest_at, up_at
from imu_calibration.simulation.table_controller import limit_excess, trajectory_from

from worlds.random_tables import random_table


@settings(max_examples=6, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 4), ends=st.sampled_from([0.0, 0.5, 1.0]))
@example(seed=10, count=1, ends=1.0)  # a swing that reaches an end of its joint
@example(seed=0, count=1, ends=0.5)  # a move to where the joint is
def test_no_trajectory_leaves_the_limits_of_any_joint(seed, count, ends):
    rng = np.random.default_rng(seed)
    table = random_table(rng, count, ends)
    limits = limits_of(table)
    motions = MotionLibrary(table, limits).motions
    position = np.clip(np.zeros(count), limits.lower, limits.upper)
    for number in rng.permutation(len(motions))[:12]:
        points = motions[number].points(position)
        if len(points):
            beyond, speed, acceleration = limit_excess(
                trajectory_from(rest_at(position[None]), points), limits
            )
            assert beyond <= 1e-9 and speed <= 1.0 and acceleration <= 1.0, motions[number].words
            position = points.position[-1]


def test_every_kind_of_motion_ends_at_its_own_place_for_the_next_one_to_start_from():
    library = MotionLibrary(
        random_table(np.random.default_rng(1), 3, 0.5),
        limits_of(random_table(np.random.default_rng(1), 3, 0.5)),
    )
    for motion in library.motions:
        if motion.segments:
            away = motion.segments[-1].end - motion.place
            turns = np.where(library.limits.endless, np.round(away / (2 * np.pi)), 0.0)
            np.testing.assert_allclose(away, 2 * np.pi * turns, atol=1e-9, err_msg=motion.words)


def test_spins_come_in_both_senses_and_rests_in_many_attitudes():
    table = random_table(np.random.default_rng(2), 3)
    library = MotionLibrary(table, limits_of(table))
    spins = [motion for motion in library.motions if motion.kind is MotionKind.SPIN]
    rates = [spin.segments[1].rate_from for spin in spins]
    senses = {
        (int(np.argmax(np.abs(rate))), float(np.sign(rate[np.argmax(np.abs(rate))])))
        for rate in rates
    }
    assert senses == {(joint, sense) for joint in range(3) for sense in (1.0, -1.0)}
    assert (
        len({tuple(motion.place) for motion in library.motions if motion.kind is MotionKind.POSE})
        >= 20
    )


def test_what_points_up_at_a_place_is_what_the_accelerometer_feels_there():
    table = random_table(np.random.default_rng(3), 3)
    for place in np.random.default_rng(4).uniform(-3, 3, (5, 3)):
        force = reference_motion(table, rest_at(place[None])).force_s[0]
        np.testing.assert_allclose(up_at(table, place), force / np.linalg.norm(force), atol=1e-12)
