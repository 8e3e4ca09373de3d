"""
Errors of a calibration on a table by cause, after section V of Avrutov 2017.

The paper sums errors of the reference and of the outputs as if they were independent, with sign.
Noise gives the covariance of the solution; a wrong reference that changes the predicted output by
``dA c`` moves the parameters by ``G^+ dA c``, where errors of the rows are common when the table is
not level and independent when an encoder is read in every pose.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from imu_calibration.calibration.result import GRAVITY_SD, ErrorBudget
from imu_calibration.core.units import ARCMIN
from imu_calibration.effects.base import Role
from imu_calibration.effects.forward_equations import (
    References,
    coefficient_jacobian,
    columns,
    sensor_output,
)
from imu_calibration.estimation.prior import fixed_parameters, make_prior
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.chain import tilt
from imu_calibration.kinematics.joint_motion import JointMotion, rest_at
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.noise_model import NoiseModel, noise_of_windows
from imu_calibration.references.turntable.session_data import SessionData

LEVELLING_SD = 2 * ARCMIN
"""
Levelling of the table in each of two directions, rad; counts when table_tilt is not estimated.
"""
JOINT_POSITION_SD = 10 * ARCMIN / 60
"""Position of each joint, independent in every window, rad."""
TABLE_RATE_SD = 1e-4
"""Relative error of the table rate (its clock), common to all windows."""
MOVING_SAMPLES = 20_000
"""Most samples of moving windows that are used; they are subsampled evenly beyond it."""


def error_budget(table: Table, gathered: SessionData, solution: Solution) -> ErrorBudget:
    """
    Return the ErrorBudget of a calibration on a table.

    The shifts of the parameters by each error of the reference are of first order, with the weights
    of the solver (`parameter_shifts`). All windows at rest are used, and the moving windows with
    kept samples.

    Parameters
    ----------
    table : Table
    gathered : SessionData
        The windows.
    solution : Solution

    """
    gravity_sd = table.gravity_sd_value
    if table.gravity is not None and table.gravity_sd is None:
        gravity_sd = GRAVITY_SD
    errors = _errors_of_reference(table, solution, gravity_sd)
    changes: list[ReferenceChange] = []
    for error in errors:
        changes += error.changes
    shifts = parameter_shifts(table, gathered, solution, changes=changes)

    # `shifts` has the changes of all errors, one after the other.
    causes = {'noise': solution.sd}
    texts = {'noise': 'noise and wander of the sensors, as this recording shows them'}
    start = 0
    for error in errors:
        shifts_of_error = shifts[start : start + len(error.changes)]
        start += len(error.changes)
        # Squares of independent shifts are summed over windows, common shifts before squaring.
        if not error.scattered:
            shifts_of_error = shifts_of_error.sum(axis=1, keepdims=True)
        causes[error.name] = np.sqrt((shifts_of_error**2).sum(axis=(0, 1)))
        texts[error.name] = error.text
    return ErrorBudget(tuple(solution.param_names), causes, texts)


ReferenceChange = Callable[[Table, JointMotion], tuple[Table, JointMotion]]
"""Maps table and motion to those with an error of one standard deviation."""


@dataclass(frozen=True)
class _ReferenceError:
    """One cause of error of the reference."""

    name: str
    """Cause."""
    text: str
    """Description with its size."""
    changes: tuple[ReferenceChange, ...]
    """One for each independent direction of the error."""
    scattered: bool = False
    """Whether it is independent in every window, or common to all."""


def _errors_of_reference(
    table: Table, solution: Solution, gravity_sd: float
) -> list[_ReferenceError]:
    """Return the errors of the reference that the solution does not estimate."""
    tilts = LEVELLING_SD * np.eye(2)
    levelling = _ReferenceError(
        'levelling',
        f'levelling {LEVELLING_SD / ARCMIN:.2g} arcmin in each direction, not estimated',
        tuple(partial(_tilted, angles) for angles in tilts),
    )
    arcsec = JOINT_POSITION_SD / ARCMIN * 60
    turns = JOINT_POSITION_SD * np.eye(len(table.joints))
    joint_position = _ReferenceError(
        'joint position',
        f'joint positions {arcsec:.2g} arcsec, independent in every window',
        tuple(partial(_turned, angles) for angles in turns),
        scattered=True,
    )
    table_rate = _ReferenceError(
        'table rate',
        f'rate wrong by {TABLE_RATE_SD:.2g} of itself in all windows',
        (partial(_faster, 1 + TABLE_RATE_SD),),
    )
    gravity = _ReferenceError(
        'gravity', f'gravity known to {gravity_sd:.2g} m/s²', (partial(_heavier, gravity_sd),)
    )
    errors = [joint_position, table_rate, gravity]
    if solution.model.find('reference', Role.TILT) is None:
        errors.insert(0, levelling)
    return errors


def _tilted(angles: np.ndarray, table: Table, motion: JointMotion) -> tuple[Table, JointMotion]:
    """Return the table tilted by two angles, rad, and the motion."""
    return tilt(table, angles), motion


def _turned(angles: np.ndarray, table: Table, motion: JointMotion) -> tuple[Table, JointMotion]:
    """Return the table and the motion with the joints turned by angles, rad."""
    return table, replace(motion, position=motion.position + angles)


def _faster(factor: float, table: Table, motion: JointMotion) -> tuple[Table, JointMotion]:
    """Return the table and the motion with a time that is shorter by a factor."""
    return table, replace(
        motion, rate=factor * motion.rate, acceleration=factor**2 * motion.acceleration
    )


def _heavier(change: float, table: Table, motion: JointMotion) -> tuple[Table, JointMotion]:
    """Return the table with gravity larger by a change, m/s^2, and the motion."""
    return replace(table, gravity=table.gravity_value + change), motion


def parameter_shifts(
    table: Table,
    gathered: SessionData,
    solution: Solution,
    *,
    changes: Sequence[ReferenceChange],
) -> np.ndarray:
    """
    Return the shift of the parameters by each change of the reference in each window.

    Shape (n_changes, n_windows, n_params). With the design A, the covariance V of the rows and the
    change d of their outputs in one window, it is ``(A' V^-1 A)^-1 A' V^-1 d``: estimate minus
    truth. The sum over windows is the shift when the change is common to all.
    """
    sources = list(_sources(gathered))
    # Of each window: sensor -> columns and changes of the output.
    outputs = [_outputs(table, solution, source, changes=changes) for source in sources]

    # Normal equations of the solver: A' V^-1 A, and A' V^-1 d of each window and change. The rows
    # of a window are its mean, and its samples about the mean.
    prior = make_prior(solution.model)
    normal = prior.root.T @ prior.root
    right = np.zeros((len(changes), len(sources), len(solution.values)))
    for sensor, noise in noise_of_windows(solution).items():
        # Means of the design of each window. The designs of all windows at once need much memory.
        slope = coefficient_jacobian(solution.model, sensor, solution.values)
        means = np.array(
            [_design(of_window[sensor].columns, slope).mean(axis=0) for of_window in outputs]
        )
        weighted_means = _weighted_means(means, sources, noise)
        normal = normal + np.tensordot(weighted_means, means, ([0, 1], [0, 1]))
        for k, (source, of_window) in enumerate(zip(sources, outputs)):
            # Each sample stands for `stride` samples. Sums over samples and axes.
            centred = _design(of_window[sensor].columns, slope) - means[k]
            weighted = centred / (noise.row_variance(source.kind) / source.stride)[:, None]
            normal += np.tensordot(weighted, centred, ([0, 1], [0, 1]))
            output_changes = of_window[sensor].changes  # (n_changes, n_samples, 3)
            right[:, k] += output_changes.mean(axis=1) @ weighted_means[k]
            right[:, k] += np.tensordot(output_changes, weighted, ([1, 2], [0, 1]))

    # Fixed and held parameters do not shift.
    index = np.flatnonzero(~fixed_parameters(solution.model) & ~solution.held)
    shifts = np.zeros_like(right)
    shifts[:, :, index] = right[:, :, index] @ inverse_normal(normal[np.ix_(index, index)])
    return shifts


def _design(columns: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """
    Return the derivative of the output by the parameters, shape (n_samples, 3, n_params).

    From the columns, (n_samples, q), and the slopes of their coefficients, (q, 3, n_params).
    """
    return np.einsum('nq,qap->nap', columns, slope)


def _weighted_means(
    means: np.ndarray, sources: Sequence['_Source'], noise: NoiseModel
) -> np.ndarray:
    """
    Return ``V^-1 A`` of the means of n windows, shape (n, 3, n_params).

    `means` is their design A, of the same shape; bias processes correlate the windows of `sources`.
    """
    counts = np.array([source.samples for source in sources])
    variance = noise.mean_variance([source.kind for source in sources], counts)
    rows = Rows(
        equations=means,
        variance=variance + noise.offset_sd**2,
        processes=noise.bias_processes,
        time=np.array([source.time for source in sources]),
        session=np.array([source.session for source in sources]),
    )
    whitening = rows.whitening()
    return whitening.adjoint(whitening(means))


class _Source(NamedTuple):
    """The motion of a window at rest, or of a moving window with kept samples."""

    kind: str
    """'static', 'spin' or 'dynamic'."""
    time: float
    """Middle of the window, s."""
    session: int
    """Recording of the window."""
    samples: float
    """Number of its samples."""
    stride: int
    """Every how many samples are in `motion`."""
    motion: JointMotion
    """Motion of the joints; one row at rest."""
    temperature_c: np.ndarray | None
    """Temperature at the samples of `motion`, degrees Celsius; None: unknown."""


def _sources(gathered: SessionData) -> Iterator[_Source]:
    """Yield the windows at rest, and the moving ones that were kept."""
    counts = {}  # (recording, middle) -> samples of a window at rest
    for row in gathered.accumulator.rows:
        if row.kind == 'static':
            counts[(row.session, row.time)] = row.count
    # A window that was joined with its neighbour has no row with its time.
    typical = float(np.median(list(counts.values()))) if counts else 1.0
    for time, session, position in gathered.poses:
        motion = replace(rest_at(np.asarray(position)[None]), time=np.array([time]))
        count = counts.get((session, time), typical)
        yield _Source(
            kind='static',
            time=time,
            session=session,
            samples=count,
            stride=1,
            motion=motion,
            temperature_c=None,
        )
    stride = max(1, int(np.ceil(sum(len(w) for w in gathered.kept) / MOVING_SAMPLES)))
    for window, session in zip(gathered.kept, gathered.sessions_of_kept, strict=True):
        used = slice(None, None, stride)
        yield _Source(
            kind=window.kind,
            time=float(window.time.mean()),
            session=session,
            samples=len(window),
            stride=stride,
            motion=window.motion.select(used),
            temperature_c=None if window.temperature_c is None else window.temperature_c[used],
        )


class _Outputs(NamedTuple):
    """Samples of one sensor in one window."""

    columns: np.ndarray
    """Columns of the model, shape (n, n_columns)."""
    changes: np.ndarray
    """Changes of the output by each error, shape (n_changes, n, 3)."""


def _outputs(
    table: Table, solution: Solution, source: _Source, *, changes: Sequence[ReferenceChange]
) -> dict[str, _Outputs]:
    """Return sensor -> its columns and changes of the output at the samples of a window."""
    model = solution.model
    temperature = source.temperature_c
    if model.needs_temperature and temperature is None:  # the mean at rest is not kept
        temperature = np.full(len(source.motion), model.temperature_ref_c)
    # The reference itself, then with each change.
    references = [References(model, table, source.motion, temperature_c=temperature)]
    for change in changes:
        changed, motion = change(table, source.motion)
        references.append(References(model, changed, motion, temperature_c=temperature))
    outputs_of = {}
    for sensor in solution.noise:
        outputs = []
        for reference in references:
            ref = reference.at(sensor)
            outputs.append(sensor_output(model, sensor, solution.values, ref=ref))
        # Also without any change, shape (0, n, 3).
        moved = np.array(outputs[1:]).reshape(-1, *outputs[0].shape) - outputs[0]
        outputs_of[sensor] = _Outputs(columns(references[0], sensor), moved)
    return outputs_of
