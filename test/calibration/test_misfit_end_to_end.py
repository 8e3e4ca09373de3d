"""
In worlds with uncatalogued causes a calibration helps, or states that it does not.

The causes are in no catalogue; the calibration helps in another session and harms in no motion, or
a sentence states that it does not.
"""

import pytest

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.document.decision import HELPS
from imu_calibration.kinematics.table import Table

from worlds.candidates import FEW
from worlds.misfit_coverage import COARSE
from worlds.misfit_worlds import make_pair

WORSE = 1.05
"""No kind of motion may get worse by more."""


@pytest.mark.long
@pytest.mark.parametrize(
    ('cause', 'world'),
    [
        ('driver_lag', {'table': 'shaft', 'profile': 'sweeps'}),
        ('motor_ripple', {'table': 'shaft', 'profile': 'sweeps'}),
        ('backlash', {'profile': 'six_faces', **COARSE}),
    ],
    ids=lambda value: value if isinstance(value, str) else value.get('table', 'gimbals'),
)
def test_what_is_handed_over_helps_in_another_session(cause, world):
    pair = make_pair(cause, 21, **world)
    table = Table.from_mapping(pair.table)
    try:
        found = calibrate_recordings(pair.first.block, table, candidates=FEW)
    except ImuCalibrationError as refused:
        assert '\n' not in str(refused)
        return
    proof = check_recording(pair.second.block, found.calibration, table).proof
    for sensor, entry in proof.items():
        if found.verdict.decisions[sensor] is not HELPS:
            assert found.exit_code == 3
            continue
        worst = max(part.after / part.before for part in entry.regimes.values())
        print(
            f'{cause}, {sensor}: error after / before {entry.after / entry.before:.3f} wanted'
            f' below 1, worst motion {worst:.3f} wanted at most {WORSE}'
        )
        assert entry.after < entry.before and worst <= WORSE
