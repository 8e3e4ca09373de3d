"""Named models, default models, and parsing of models written by users."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from imu_calibration.effects.base import Role
from imu_calibration.effects.catalogue import CATALOGUE, JOINTS, Catalogue
from imu_calibration.errors import InputError
from imu_calibration.reference.table import Table

if TYPE_CHECKING:
    from imu_calibration.effects.sensor_model import SensorModel

BASE = ('bias', 'matrix')
"""Effects that every sensor has."""
NAMED_MODELS = {
    'axial': BASE,
    'pendulous': (*BASE, 'accel_cross_product'),
    'size_effect': (*BASE, 'accel_size_effect'),
    'rate': BASE,
    'extended_rate': (*BASE, 'gyro_rate_product'),
}
"""Models with a name: Avrutov 2017 eq. 1, eq. 4; Zhang 2017 eq. 11-17; Avrutov 2017 eq. 7, eq. 10."""
G_SENSITIVE = (*BASE, 'gyro_g_sensitivity')
"""Gyroscope model by hand when the poses require it."""
BARE = 'axial'
"""Name of the model from which a diagnosis starts; further effects need evidence."""
DEFAULT = {'accelerometer': 'size_effect', 'gyroscope': 'rate'}
"""Default model of a recording on a table."""


def parse_effects(sensor: str, text: str, joint_names: Sequence[str] = JOINTS, *, catalogue: Catalogue = CATALOGUE) -> tuple[str, ...]:
    """
    Return effect names from a named model or names joined by '+'.

    Raises
    ------
    InputError
        When a name is unknown or the model lacks bias or matrix.

    """
    names = NAMED_MODELS.get(text) or tuple(part.strip() for part in text.split('+'))
    for name in names:
        catalogue.find(sensor, name, joint_names, models=NAMED_MODELS if name == text else ())
    if not set(BASE) <= set(names):
        raise InputError(f"the {sensor} model must contain bias and matrix, got '{text}'; write bias+matrix+...")
    return names


def parse_reference(text: str | None, table: Table) -> tuple[str, ...]:
    """
    Return effect names of table and clock from names joined by '+' or 'none'.

    None: the tilt, the Earth's rate unless the table defines it, and errors of the joints where the table has their tolerances.
    """
    if text is not None:
        return tuple(name for name in text.split('+') if name not in ('', 'none'))
    names = table.joint_names
    said = {'axis_non_orthogonality': names.angle_sd and names.angles, 'encoder_zero': names.angle_sd and names.zeros,
            'axis_offset': names.place_sd and names.places}
    return tuple(name for name in ('table_tilt', *said, 'earth_rate') if said.get(name, True) and not _is_moot(name, table))


def _is_moot(name: str, table: Table) -> bool:
    moot = CATALOGUE.find('reference', name).moot
    return moot is not None and moot(table) is not None


def with_common_arm(model: 'SensorModel') -> 'SensorModel':
    """Return the model with a common lever arm beside the arms of the size effect; without a size effect unchanged."""
    lacks = model.find('accelerometer', Role.ARMS) and not model.find('accelerometer', Role.ARM)
    return model.with_effect('accelerometer', 'lever_arm') if lacks else model
