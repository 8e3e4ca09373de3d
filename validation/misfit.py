"""
Worlds with causes outside the catalogue.

A sensor with the decision `helps` improves in a second session, and warnings name the regimes that
do not.
"""

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.document.decision import HARM, HELPS, harmed
from imu_calibration.kinematics.table import Table
from validation.section import Section, text

SEED = 31
WORLDS = slice(None)
"""Those that are run."""
ON_A_SHAFT = ('driver_lag', 'rate_dependent_lag', 'motor_ripple', 'flexible_mount')


def worlds():
    """Return (cause, name of the table, options of `make_pair`) of every world."""
    from worlds.misfit_worlds import CAUSES

    return [
        *((cause, 'three axis', {}) for cause in (None, *CAUSES)),
        *((cause, 'shaft', {'table': 'shaft', 'profile': 'sweeps'}) for cause in ON_A_SHAFT),
    ]


def outcome(cause, options):
    """
    Return ([cells of the row], [whether each sensor with `helps` improves as stated]).

    The cells are decisions, error after / before, and the largest of a motion.
    """
    from worlds.misfit_worlds import make_pair

    pair = make_pair(cause, SEED, **options)
    table = Table.from_mapping(pair.table)
    try:
        found = calibrate_recordings(pair.first.block, table)
    except ImuCalibrationError as error:
        return [f'refused: {error}', '', ''], []
    proof, decisions = (
        check_recording(pair.second.block, found.calibration, table).proof,
        found.calibration.decisions,
    )
    ratios = {sensor: entry.after / entry.before for sensor, entry in proof.items()}
    worst = {
        sensor: max(part.after / part.before for part in entry.regimes.values())
        for sensor, entry in proof.items()
    }
    cells = [' / '.join(str(decisions[sensor]) for sensor in proof)]
    cells += [' / '.join(f'{value:.2f}' for value in values.values()) for values in (ratios, worst)]
    worse = {
        sensor: {name for name, part in entry.regimes.items() if part.after > HARM * part.before}
        for sensor, entry in proof.items()
    }
    return cells, [
        ratios[sensor] < 1.0 and worse[sensor] <= harmed(found.calibration.proof[sensor]).keys()
        for sensor in proof
        if decisions[sensor] is HELPS
    ]


def run(folder, plots):
    """Return the section."""
    section = Section('Worlds with causes outside the catalogue')
    rows = []
    improved = []  # whether each sensor that is helped improves
    for cause, table, options in worlds()[WORLDS]:
        cells, helps = outcome(cause, options)
        improved += helps
        rows.append(((cause or 'none').replace('_', ' '), table, *cells))
    section.claim(
        'worlds of misfit: sensors with the decision "helps" improve in a second session; regimes'
        ' that are worse by 5 % are named',
        'all of them',
        f'{sum(improved)} of {len(improved)}',
        all(improved),
        headline=True,
    )
    section.say(text('misfit'))
    section.table(
        (
            'cause',
            'table',
            'decisions, accelerometer / gyroscope',
            'error after / before',
            'the largest of a motion',
        ),
        rows,
    )
    return section
