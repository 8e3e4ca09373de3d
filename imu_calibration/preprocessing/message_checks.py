"""Checks of the other fields of messages: frame, covariances, orientation, and age of the stamps at arrival."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.preprocessing.recording_evidence import GOOD, NOTE, WARNING, CheckFinding

OLD = 0.5
"""s; transforms and filters drop older messages, and the delay of a driver is much smaller."""
ABSENT = -1.0
"""First element of a covariance: the message does not have that quantity (sensor_msgs/Imu)."""
QUANTITIES = ('specific force', 'angular rate', 'orientation')
SYMMETRY = 1e-6
"""Share of the largest variance; rounding errors are much smaller."""


@dataclass(frozen=True, eq=False)
class MessageEvidence:
    """Contents of the messages of one topic other than readings."""

    frame_ids: dict[str, int] = field(default_factory=dict)
    """frame_id -> messages."""
    covariances: dict[str, np.ndarray] = field(default_factory=dict)
    """'specific force', 'angular rate', 'orientation' -> covariance of the last message, shape (3, 3), SI."""
    orientation: np.ndarray | None = None
    """Quaternion x, y, z, w of the last message, shape (4,)."""
    age: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Arrival minus stamp by the clock of this computer, s, shape (n,); messages without a stamp are left out."""


def check_messages(evidence: MessageEvidence) -> tuple[CheckFinding, ...]:
    """Return the findings in `MessageEvidence`; empty without messages."""
    if not evidence.frame_ids:
        return ()
    return tuple(finding for check in (frame, covariance, orientation, age) for finding in check(evidence))


def frame(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """Every message names its frame, the same one."""
    names = sorted(evidence.frame_ids)
    if '' in names:
        yield CheckFinding('frame', WARNING, 'messages must name their frame, '
                           f'{evidence.frame_ids[""]} of {sum(evidence.frame_ids.values())} have an '
                           "empty frame_id: they cannot be transformed; set the driver's frame_id, usually imu_link")
    if len(names) > 1:
        yield CheckFinding('frame', WARNING, 'messages of one topic must be of one sensor, frame_ids are '
                           + ', '.join(f"'{name}'" for name in names) + '; give each sensor a topic of its own')
    elif names[0]:
        yield CheckFinding('frame', GOOD, f"frame_id '{names[0]}'")


def covariance(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """Covariances are unknown (zeros), absent (-1) or covariances: finite, symmetric, not negative."""
    for name, matrix in evidence.covariances.items():
        if matrix[0, 0] == ABSENT:
            if name != 'orientation':
                yield CheckFinding('covariance', NOTE, f'the covariance marks the {name} in these messages as absent (-1)')
            continue
        if not np.isfinite(matrix).all() or (np.diag(matrix) < 0).any():
            yield CheckFinding('covariance', WARNING, f'variances of the {name} must be finite and not negative, they are '
                               f'{_numbers(np.diag(matrix))}; filters that believe them diverge: correct the driver, '
                               'or fill them with compensator_node')
        elif not matrix.any():
            if name != 'orientation':
                yield CheckFinding('covariance', NOTE, f'the covariance of the {name} is unknown (zeros): estimators need it; '
                                   'compensator_node fills it')
        elif not np.allclose(matrix, matrix.T, rtol=0, atol=SYMMETRY * np.abs(matrix).max()):
            yield CheckFinding('covariance', WARNING, f'the covariance of the {name} must be symmetric, it is not; correct the driver')
        elif not np.diag(matrix).all():
            yield CheckFinding('covariance', WARNING, f'variances of the {name} must be greater than zero, '
                               f'they are {_numbers(np.diag(matrix))}: a filter would treat these axes as exact; correct the driver')
        else:
            yield CheckFinding('covariance', GOOD, f'standard deviations of the {name}: {_numbers(np.sqrt(np.diag(matrix)))}')


def orientation(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """An orientation is a unit quaternion, or marked as absent."""
    given = evidence.covariances.get('orientation')
    if evidence.orientation is None or given is None or given[0, 0] == ABSENT:
        return
    size = float(np.linalg.norm(evidence.orientation))
    if not abs(size - 1) < 0.01:
        yield CheckFinding('orientation', WARNING, f'an orientation must be a unit quaternion, its length is {size:.3g}: set '
                           'orientation_covariance[0] to -1 where the sensor gives none (REP 145)')
    elif not given.any() and np.array_equal(np.abs(evidence.orientation), [0, 0, 0, 1]):
        yield CheckFinding('orientation', NOTE, 'the orientation is the identity with an unknown covariance: '
                           'set orientation_covariance[0] to -1 where the sensor gives none (REP 145)')


def age(evidence: MessageEvidence) -> Iterator[CheckFinding]:
    """Stamps are close to this computer's clock."""
    if not len(evidence.age):
        return
    median = float(np.median(evidence.age))
    if abs(median) > OLD:
        yield CheckFinding('age', WARNING, f'stamps must agree with the clock of this computer within {OLD} s, '
                           f'they are {abs(median):.3g} s '
                           f'{"behind" if median > 0 else "ahead of"} it: transforms and filters drop such messages; '
                           'synchronise the clocks, or for a recording play /clock and set use_sim_time')
    else:
        yield CheckFinding('age', GOOD, f'stamps are {1e3 * median:.1f} ms old when messages are received')


def _numbers(values):
    return ', '.join(f'{value:.3g}' for value in values)
