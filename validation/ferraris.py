"""
Six faces and three full turns by hand: this project compared with imucal on the same sections.
"""

import numpy as np

from imu_calibration.estimation.solution import LACKING
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions, KnownTurn
from validation.recordings import load, reference
from validation.second_opinions import FACES, TURNS, accelerometer_of, ferraris, installed
from validation.section import Section, text

NAME, RATE_HZ, GRAVITY = 'ferraris', 102.4, 9.81
PAIRS = ((0, 1, 'xy'), (1, 2, 'yz'), (0, 2, 'xz'))


def known_turns(imu, sections, angle):
    """Return the full turns as KnownTurn, with the sign that the gyroscope shows."""
    turns = []
    for k, name in enumerate(TURNS):
        part = slice(*sections[name])
        sign = np.sign(np.sum(imu.rate_s[part, k]))
        turns.append(KnownTurn(part.start, part.stop, tuple(np.eye(3)[k]), float(sign * angle)))
    return turns


def calibrate_sections(imu, sections, angle):
    """Return our calibration from the six faces, the way between them, and the full turns."""
    faces = [slice(*sections[name]) for name in FACES]
    order = np.argsort([face.start for face in faces])
    return (
        calibrate_by_hand(
            imu,
            HandOptions(GRAVITY),
            [faces[k] for k in order],
            known_turns=known_turns(imu, sections, angle),
        ),
        order,
    )


def angles_between(matrix):
    """Return the departure from 90 deg of the angles between the sensing axes xy, yz, xz, deg."""
    axes = matrix / np.linalg.norm(matrix, axis=1, keepdims=True)
    return np.array([90 - np.degrees(np.arccos(axes[i] @ axes[j])) for i, j, _ in PAIRS])


def comparable(found, info):
    """
    Return [(parameter, unit, ours, imucal's, our sd or None)].

    The quantities that are independent of the choice of axes.
    """
    (bias_f, matrix_f), (bias_w, matrix_w, _) = found.accelerometer, found.gyroscope
    theirs_f, theirs_w = accelerometer_of(info), info.K_g @ info.R_g
    rows = []
    for k, axis in enumerate('xyz'):
        sd = found.sd_of(f'accelerometer.bias.{axis}')
        rows.append(
            _row(f'accelerometer bias {axis}', 'mm/s²', 1e3, bias_f[k], theirs_f.bias[k], sd)
        )
    rows += _matrix_rows('accelerometer', matrix_f, theirs_f.matrix, found)
    for k, axis in enumerate('xyz'):
        rows.append(
            _row(
                f'gyroscope bias {axis}',
                'deg/s',
                180 / np.pi,
                bias_w[k],
                info.b_g[k],
                found.sd_of(f'gyroscope.bias.{axis}'),
            )
        )
    return rows + _matrix_rows('gyroscope', matrix_w, theirs_w, found)


def _row(name, unit, factor, *values):
    return name, unit, *(factor * value for value in values)


def _matrix_rows(sensor, ours, theirs, found):
    rows = []
    for k, axis in enumerate('xyz'):
        lengths = [100 * (np.linalg.norm(matrix[k]) - 1) for matrix in (ours, theirs)]
        rows.append(
            (
                f'{sensor} scale factor {axis}, from 1',
                '%',
                *lengths,
                100 * found.sd_of(f'{sensor}.matrix.{axis}{axis}'),
            )
        )
    for pair, (_, _, name) in zip(
        np.array([angles_between(ours), angles_between(theirs)]).T, PAIRS
    ):
        i, j = name[0], name[1]
        sd = np.degrees(
            np.hypot(found.sd_of(f'{sensor}.matrix.{i}{j}'), found.sd_of(f'{sensor}.matrix.{j}{i}'))
        )
        rows.append((f'{sensor} angle between {i} and {j}, from 90 deg', 'deg', *pair, sd))
    return rows


def faces_as_they_lay(found, order):
    """
    Return the directions of gravity in x_p, x_a, ... as our calibration sees them.

    They are unit vectors in our axes, shape (6, 3).
    """
    return found.state.up[np.argsort(order)]


def imucal_from_ours(found, up):
    """
    Return (bias, matrix) that imucal's formulas give for our sensor with the faces as they lay.

    Without noise.
    """
    bias, matrix = found.accelerometer
    readings = bias + GRAVITY * up @ matrix.T
    plus, minus = readings[0::2].T, readings[1::2].T
    return np.diag(plus + minus) / 2, (plus - minus) / (2 * GRAVITY)


def tilts(up):
    """
    Return the angle between each face and the axis of our frame that it represents, deg.

    Shape (6,).
    """
    wanted = np.repeat(np.eye(3), 2, axis=0) * np.tile([1, -1], 3)[:, None]
    return np.degrees(np.arccos(np.clip(np.sum(up * wanted, axis=1), -1, 1)))


def run(folder, plots):
    """Return the section."""
    section = Section('Six faces and three turns: ours beside imucal (ferraris)')
    if not installed('imucal'):
        section.say('Skipped: imucal is not installed; `make validate` installs it.')
        return section

    # Both calibrations of the same faces and turns, which all have the same sense.
    imu = load(folder, NAME)
    known = reference(folder, NAME)
    sections = known['sections']
    angle = np.radians(known['turn_deg'])
    found, order = calibrate_sections(imu, sections, angle)
    signs = {np.sign(turn.angle) for turn in known_turns(imu, sections, angle)}
    info = ferraris(imu, sections, RATE_HZ, GRAVITY, angle * signs.pop())

    # Their differences, in our standard deviations.
    rows = []
    apart = []
    for name, unit, ours, theirs, sd in comparable(found, info):
        difference = theirs - ours
        numbers = (f'{ours:+.3f}', f'{sd:.3f}', f'{theirs:+.3f}', f'{difference:+.3f}')
        rows.append((name, unit, *numbers, f'{difference / sd:+.1f}'))
        apart.append(abs(difference) / sd)
    section.table(
        ('parameter', 'unit', 'ours', 'our sd', 'imucal', 'difference', 'in our sd'), rows
    )
    section.claim(
        'ferraris: all 18 parameters agree with imucal',
        'within three of our sd',
        f'largest difference {max(apart):.1f} sd',
        max(apart) < 3,
        headline=True,
    )

    # The result of imucal from our sensor, on faces that were not level.
    up = faces_as_they_lay(found, order)
    bias, matrix = imucal_from_ours(found, up)
    of_imucal = accelerometer_of(info)
    bias_error = np.max(np.abs(bias - of_imucal.bias))
    matrix_error = np.max(np.abs(matrix - of_imucal.matrix))
    section.claim(
        "differences of the accelerometer explained: imucal's formulas on our sensor and the faces"
        ' as they lay give its result',
        'bias within 1 mm/s², matrix within 0.0001',
        f'{1e3 * bias_error:.3f} mm/s², {matrix_error:.6f}',
        bias_error < 1e-3 and matrix_error < 1e-4,
    )
    sensitivity = any('g_sensitivity' in name for name in found.param_names)
    weak = [name for name, status in zip(found.param_names, found.statuses) if status in LACKING]
    section.say(
        text(
            'ferraris',
            gravity=GRAVITY,
            turn_deg=known['turn_deg'],
            tilts=', '.join(f'{t:.1f}' for t in tilts(up)),
            sensitivity=(
                'estimates it'
                if sensitivity
                else 'leaves it out, since six attitudes do not show it'
            ),
            weak=', '.join(weak) or 'nothing',
        )
    )
    return section
