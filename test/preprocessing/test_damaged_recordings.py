"""
A damaged recording costs what is damaged.

Calibrate still writes a result, counts the loss, and ends with 3.
"""

import numpy as np
import pytest
import yaml

from imu_calibration.api.resources import config_file
from imu_calibration.cli.main import main
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session
from msg_adapters.write import write_session

TABLE_FILE = config_file('table_simulated.yaml')
TABLE = Table.from_mapping(yaml.safe_load(TABLE_FILE.read_text(encoding='utf-8')))
MODEL = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=tuple(TABLE.joint_names)
)
VALUES = random_values(MODEL, 'industrial', 6)
STORAGES = ('sqlite3', 'mcap')


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """The same session as a bag of each kind."""
    folder = tmp_path_factory.mktemp('bags')
    imu, joints, _ = simulate_session(
        MODEL,
        VALUES,
        TABLE,
        profile=make_profile('quick', 6, TABLE),
        options=SimulationOptions(100.0, 50.0),
        seed=6,
    )
    for storage in STORAGES:
        write_session(folder / storage, imu, joints, storage=storage)
    return folder, len(imu)


def storage_file(bag):
    """Return the data file of a bag."""
    return next(path for path in bag.iterdir() if path.suffix in ('.db3', '.mcap'))


def calibrate(bag, output):
    """Return (exit code, calibration document)."""
    arguments = ['calibrate', str(bag), '--table', str(TABLE_FILE), '--output', str(output)]
    code = main([*arguments, '--no-report', '--model-as-asked'])
    return code, yaml.safe_load((output / 'calibration.yaml').read_text())


def used(document):
    """Return how many samples came through."""
    return sum(document['statistics']['samples_used'].values()) + sum(
        count
        for reason, count in document['statistics']['stream'].items()
        if reason in ('settling', 'not quiet', 'too short', 'rest too short', 'edge of joints')
    )


def errors(document):
    """Return the errors of bias and matrix in reported standard deviations."""
    found = []
    for sensor in ('accelerometer', 'gyroscope'):
        for effect in ('bias', 'matrix'):
            entry = document[sensor][effect]
            found.append(
                (np.ravel(entry['value']) - VALUES[MODEL.slices[sensor, effect]])
                / np.ravel(entry['sd'])
            )
    return np.abs(np.concatenate(found))


@pytest.mark.parametrize('storage', STORAGES)
def test_a_truncated_recording_loses_its_end(bags, tmp_path, storage):
    """
    Three quarters of the file give about three quarters of the samples, and values that are right.
    """
    folder, n_samples = bags
    bag = tmp_path / storage
    bag.mkdir()
    data = storage_file(folder / storage).read_bytes()
    (bag / storage_file(folder / storage).name).write_bytes(data[: len(data) * 3 // 4])
    code, document = calibrate(bag, tmp_path / 'out')
    assert code == 3
    assert document['statistics']['dropped']
    assert 0.6 * n_samples < used(document) < 0.8 * n_samples
    assert errors(document).max() < 4.5


@pytest.mark.parametrize('storage', STORAGES)
def test_a_hole_costs_the_hole(bags, tmp_path, storage):
    """Four thousand bytes overwritten in the middle: a count, and all the rest is used."""
    folder, n_samples = bags
    bag = tmp_path / storage
    bag.mkdir()
    data = bytearray(storage_file(folder / storage).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4000] = b'\xa5' * 4000
    (bag / storage_file(folder / storage).name).write_bytes(data)
    code, document = calibrate(bag, tmp_path / 'out')
    # The rows of a damaged page are counted, and are less than 1 %; the extent of a damaged chunk
    # is not known.
    assert code == (0 if storage == 'sqlite3' else 3)
    assert any(storage_file(bag).name in reason for reason in document['statistics']['dropped'])
    assert used(document) > 0.7 * n_samples
    assert errors(document).max() < 4.5
