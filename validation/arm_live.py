"""
Prediction of the readings of another IMU on the same board by compensator_node with a known arm.

Live, over real DDS.
"""

import importlib.util
import os
import time
from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from examples.processes import NodeProcesses, local_environment
from imu_calibration.between_imus.arm import RelativeArm, estimate_arm
from imu_calibration.between_imus.pair import clipped
from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.compensation.compensate import Transfer, compensated_samples
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.references.gravity.gravity_reference import GravityReference
from msg_adapters.bag import open_recording
from msg_adapters.imu import FIELDS
from msg_adapters.write import encode_imu
from validation.figures import new_figure
from validation.imu_messages import parse_imu
from validation.recordings import load
from validation.section import Section, text

NAMES = ('array_2', 'array_5')
DOMAIN = 87
PAIR = (1, 7)
"""Across the board: 27 mm."""
STRETCH_S = 120.0
"""The last so many seconds are twisting."""
SPEED = 4.0
"""Seconds of the recording per second: 250 messages per second."""
MOVING = 2.0
"""rad/s; slower samples count as resting."""
RATES = (2, 10, 20, 30, 60)
"""rad/s; limits of the stretches with separate figures."""
GUARD = 4
"""Samples after a clipped one that the causal derivative still contains."""


@dataclass(frozen=True, eq=False)
class Case:
    """Two IMUs of one board with the inputs of the node and of the comparison."""

    imu_a: ImuSamples
    """The stretch of A."""
    force_b: np.ndarray
    """Calibrated specific force of B at A's stamps, m/s^2, shape (n, 3)."""
    usable: np.ndarray
    """Moving, and neither clipped nor just after clipping, shape (n,)."""
    calibration: str
    """calibration.yaml of A."""
    arm: RelativeArm
    """From A to B."""

    @property
    def pose_of_a(self):
        """(xyz, rpy) of A in B's frame, the node's target_xyz and target_rpy."""
        mat_ba = self.arm.mat_ab.T
        return tuple((-mat_ba @ self.arm.arm).tolist()), tuple(
            Rotation.from_matrix(mat_ba).as_euler('xyz').tolist()
        )


def prepare(folder, name, arm_from, *, seconds, pair=PAIR):
    """
    Return the Case of the last `seconds` of a recording.

    Calibrations from its poses, the arm from the recording `arm_from`.
    """
    topic_a, topic_b = (f'/imu_{k}/data_raw' for k in pair)
    a = load(folder, name, topic_a)
    b = load(folder, name, topic_b)
    calibration_a = _calibrated(folder / name, topic_a).calibration
    applied_b = _calibrated(folder / name, topic_b).applied
    arm = estimate_arm(load(folder, arm_from, topic_a), load(folder, arm_from, topic_b))

    # The calibrated force of B at the stamps of A.
    stretch = a.select(a.stamp_ns > a.stamp_ns[-1] - int(seconds * 1e9))
    time_a = 1e-9 * (stretch.stamp_ns - a.stamp_ns[0])
    time_b = 1e-9 * (b.stamp_ns - a.stamp_ns[0])
    force_b, _ = applied_b.compensate(b.force_s, b.rate_s)
    force_b = np.stack([np.interp(time_a, time_b, force_b[:, k]) for k in range(3)], axis=1)

    # Moving, and neither IMU clipped.
    bad_a = _after(clipped(a.force_s) | clipped(a.rate_s))[-len(stretch) :]
    bad_b = _after(clipped(b.force_s) | clipped(b.rate_s))
    bad = bad_a | (np.interp(time_a, time_b, bad_b.astype(float)) > 0)
    is_fast = np.linalg.norm(stretch.rate_s, axis=1) > MOVING
    return Case(stretch, force_b, is_fast & ~bad, calibration_to_text(calibration_a), arm)


def _calibrated(bag, topic):
    """Return the result of a calibration by hand from one topic of a bag."""
    with open_recording(bag, topic, want_joints=False) as recording:
        poses = GravityReference().gather([recording.blocks()], CalibrationOptions())
        return calibrate_by_evidence(poses)


def _after(bad):
    """Return the flags stretched by GUARD samples to later ones and by one to earlier ones."""
    return (
        np.convolve(np.concatenate([bad[1:], [False]]), np.ones(GUARD + 2), 'full')[: len(bad)] > 0
    )


def play(case, speed=SPEED, domain_id=DOMAIN):
    """
    Send A's messages to two compensator nodes and return their published messages.

    One has the rotation to B's frame, and the other one has the arm to B too; the messages of each
    are returned.

    Returns
    -------
    dict
        {'turned': {stamp_ns: force}, 'moved': {stamp_ns: force}}.

    """
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = local_environment(domain_id)[
        'ROS_AUTOMATIC_DISCOVERY_RANGE'
    ]
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain_id)
    try:
        with TemporaryDirectory() as folder, NodeProcesses(domain_id) as processes:
            path = os.path.join(folder, 'calibration.yaml')
            with open(path, 'w') as file:
                file.write(case.calibration)
            xyz, rpy = case.pose_of_a
            common = {'calibration_file': path, 'target_frame': 'imu_b', 'target_rpy': list(rpy)}
            processes.start('compensator_node', common, namespace='/turned')
            processes.start(
                'compensator_node', common | {'target_xyz': list(xyz)}, namespace='/moved'
            )
            return _exchange(rclpy, context, case, speed)
    finally:
        context.try_shutdown()


def _exchange(rclpy, context, case, speed):
    """Publish at a constant rate, store the received messages, and wait for the last one."""
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Imu

    from imu_calibration.nodes.inputs import input_qos, output_qos

    node = rclpy.create_node('validation', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    received = {'turned': [], 'moved': []}
    publishers = {}
    for name, store in received.items():
        publishers[name] = node.create_publisher(Imu, f'/{name}/imu/data_raw', output_qos())
        node.create_subscription(
            Imu, f'/{name}/imu/data_corrected', store.append, input_qos(reliable=True), raw=True
        )

    def have_subscribed():
        return all(publisher.get_subscription_count() for publisher in publishers.values())

    def do_publish():
        return all(node.count_publishers(f'/{name}/imu/data_corrected') for name in received)

    _spin_until(executor, have_subscribed, 60.0, 'both nodes')
    _spin_until(executor, do_publish, 60.0, 'their outputs')
    _spin_until(executor, lambda: False, 1.0)  # the nodes may find this one later

    # Each message at its time, then the wait for the last ones.
    messages = [row.tobytes() for row in encode_imu(case.imu_a)]
    due = time.monotonic() + 1e-9 * (case.imu_a.stamp_ns - case.imu_a.stamp_ns[0]) / speed
    for data, moment in zip(messages, due, strict=True):
        while time.monotonic() < moment:
            executor.spin_once(timeout_sec=max(moment - time.monotonic(), 0.0))
        for publisher in publishers.values():
            publisher.publish(data)

    # Nodes hold back the first messages of violent motion, so the last one is not known by number.
    def have_last():
        last = case.imu_a.stamp_ns[-1]
        return all(store and parse_imu(store[-1]).stamp_ns == last for store in received.values())

    _spin_until(executor, have_last, 30.0)
    executor.shutdown(timeout_sec=1.0)
    node.destroy_node()
    parsed = {name: map(parse_imu, store) for name, store in received.items()}
    return {
        name: {message.stamp_ns: message.doubles[FIELDS['force_s']] for message in messages}
        for name, messages in parsed.items()
    }


def _spin_until(executor, condition, seconds, what=None):
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            if what:
                raise TimeoutError(f'{what} did not connect within {seconds} s')
            return
        executor.spin_once(timeout_sec=0.05)


def residuals(case, came):
    """
    Return {'turned', 'moved': force differences}, and the numbers of messages.

    A difference is B's force minus the published force, for usable samples, shape (m, 3).
    """
    stamps = case.imu_a.stamp_ns.tolist()
    both = np.array([all(stamp in messages for messages in came.values()) for stamp in stamps])
    keep = case.usable & both
    chosen = [stamp for stamp, kept in zip(stamps, keep) if kept]
    found = {
        name: case.force_b[keep] - np.array([messages[stamp] for stamp in chosen])
        for name, messages in came.items()
    }
    return found, {name: len(messages) for name, messages in came.items()}


def rms(values):
    """Return the rms of the components."""
    return float(np.sqrt(np.mean(np.square(values))))


def looking_ahead(case):
    """
    Return the residuals of two predictions with future samples, (m, 3) each.

    A live node does not have these samples, and the residuals are on the usable samples.

    'central': the angular acceleration from the samples before and after. 'filter': from nine
    samples, with the weights that fit B's readings in this stretch best; its residual is not
    determined by the samples of the rate.
    """
    calibration, (xyz, rpy), imu = (
        calibration_from_text(case.calibration),
        case.pose_of_a,
        case.imu_a,
    )
    slope = np.gradient(imu.rate_s, 1e-9 * (imu.stamp_ns - imu.stamp_ns[0]), axis=0)
    slope = slope @ np.linalg.inv(calibration.value('gyroscope', 'matrix')).T
    transfer = Transfer.from_pose('imu_b', xyz, rpy)
    central = compensated_samples(
        calibration, imu.force_s, imu.rate_s, alpha_s=slope, transfer=transfer
    )
    still = compensated_samples(
        calibration, imu.force_s, imu.rate_s, alpha_s=np.zeros_like(slope), transfer=transfer
    )
    lags = range(-4, 5)
    columns = np.stack(
        [np.cross(np.roll(still.rate, lag, axis=0), -transfer.arm_t) for lag in lags], axis=2
    )
    keep = case.usable & (np.arange(len(imu)) >= 4) & (np.arange(len(imu)) < len(imu) - 4)
    wanted, columns = (case.force_b - still.force)[keep], columns[keep]
    weights = np.linalg.lstsq(columns.reshape(-1, len(lags)), wanted.ravel(), rcond=None)[0]
    return {
        'central': (case.force_b - central.force)[case.usable],
        'filter': wanted - columns @ weights,
    }


def run(folder, plots):
    """Return the section."""
    section = Section('One IMU predicts another, live over DDS (array_2, array_5)')
    if importlib.util.find_spec('rclpy') is None:
        section.say('Skipped: rclpy is not installed.')
        return section
    rows = []
    bins = []
    for name in NAMES:
        # The arm of one recording, the readings of the other one.
        arm_from = NAMES[1 - NAMES.index(name)]
        case = prepare(folder, name, arm_from, seconds=STRETCH_S)
        found, count = residuals(case, play(case))
        before = rms(found['turned'])
        after = rms(found['moved'])
        lost = 2 * len(case.imu_a) - sum(count.values())
        section.claim(
            f"{name}: one IMU predicts another's accelerometer live, rms without and with the arm",
            'falls',
            f'{before:.2f} → {after:.2f} m/s² ({100 * (1 - after / before):.0f} % less)',
            after < before,
        )
        section.claim(
            f'{name}: messages lost between player, nodes and listener',
            '0',
            f'{lost} of {2 * len(case.imu_a)}',
            lost == 0,
        )

        # Without and with the arm by axis and by length, then predictions that look ahead.
        per_axis = []
        lengths = []
        for which in ('turned', 'moved'):
            per_axis += [f'{rms(column):.2f}' for column in found[which].T]
            lengths.append(f'{typical(found[which]):.1f}')
        ahead = [f'{rms(residual):.2f}' for residual in looking_ahead(case).values()]
        n_samples = str(len(found['moved']))
        rows.append((name, n_samples, *per_axis, *lengths, f'{after:.2f}', *ahead))
        bins.append((name, *by_rate(case, found)))
    section.table(
        (
            'recording',
            'samples',
            *(f'before {axis}' for axis in 'xyz'),
            *(f'after {axis}' for axis in 'xyz'),
            'before, median length',
            'after, median length',
            'after, all',
            'central difference',
            'best filter',
        ),
        rows,
    )
    section.say('Before → after by the rate of turning, rms of components, m/s²:')
    section.table(
        ('recording', *(f'{low} to {high} rad/s' for low, high in zip(RATES, RATES[1:]))), bins
    )
    section.say(
        text(
            'arm_live',
            a=PAIR[0],
            b=PAIR[1],
            seconds=STRETCH_S,
            speed=SPEED,
            moving=MOVING,
            guard=GUARD,
        )
    )
    _draw(section, plots, case, found)  # of the last recording
    return section


def typical(values):
    """Return the median length of vectors."""
    return float(np.median(np.linalg.norm(values, axis=1)))


def by_rate(case, found):
    """Return 'before → after (samples)' for each stretch of RATES."""
    rate = np.linalg.norm(case.imu_a.rate_s[case.usable][: len(found['moved'])], axis=1)
    parts = [(rate >= low) & (rate < high) for low, high in zip(RATES, RATES[1:])]
    return [
        f'{rms(found["turned"][part]):.1f} → {rms(found["moved"][part]):.1f} ({part.sum()})'
        for part in parts
    ]


def _draw(section, plots, case, found):
    stamps = case.imu_a.stamp_ns[case.usable]
    time_s = 1e-9 * (stamps[: len(found['moved'])] - case.imu_a.stamp_ns[0])
    figure, axes = new_figure(3, 1, (9, 6))
    for axis, panel in enumerate(axes):
        for name, colour, label in (
            ('turned', 'tab:orange', 'without the arm'),
            ('moved', 'tab:blue', 'with the arm'),
        ):
            panel.plot(time_s, found[name][:, axis], '.', markersize=2, color=colour, label=label)
        panel.set_ylabel(f'{"xyz"[axis]}, m/s²')
    axes[0].legend()
    axes[-1].set_xlabel(f'time in the stretch of {NAMES[-1]}, s')
    section.plot(
        plots,
        'arm_live.png',
        figure,
        "B's accelerometer minus the node's prediction from A, moving and unclipped samples.",
    )
