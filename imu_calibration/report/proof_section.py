"""The proof in numbers: errors on held-out data, by sensor and regime."""

from imu_calibration.core.units import error_text
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import harmed, ratio_text


def proof_section(calibration: Calibration) -> list[dict[str, str | bool]]:
    """Return a row for each sensor and motion: 'sensor', 'motion', 'much', 'before', 'after', 'ratio', 'bad'; empty without a proof."""
    rows = []
    for sensor, found in calibration.proof.items():
        worse = harmed(found)
        for motion, part in (('all', found), *(found.get('regimes') or {}).items()):
            before, after = (error_text(part[name], part.get('unit', found['unit'])) for name in ('before', 'after'))
            much = f'{part["seconds"]:.0f} s' if 'seconds' in part else f'{found["windows"]}'
            rows.append({'sensor': sensor, 'motion': motion, 'much': much, 'before': before, 'after': after,
                         'ratio': ratio_text(part), 'bad': motion in worse})
    return rows
