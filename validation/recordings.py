"""The real recordings, used in place."""

import os
from functools import cache
from pathlib import Path

import yaml

from imu_calibration.core.readings import RawReadings
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.preprocessing.sample_recording import read_recording
from msg_adapters.bag import open_recording

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = 'IMU_CALIBRATION_DATA'
BOARD = (1, 3, 5, 7)
"""Numbers of the IMUs on the boards."""
BY_HAND = (
    ('xsens_counts', None),
    ('mpu9150_0', None),
    ('mpu9150_3', None),
    *((name, f'/imu_{k}/data_raw') for name in ('array_2', 'array_5') for k in BOARD),
)
"""Recordings of many poses, with the topic where there are several."""
SHAFT = ('shaft_pitch_slow', 'shaft_yaw_medium')
"""Recordings with one joint."""


def data_folder():
    """Return the folder of the recordings, or None when it is absent."""
    folder = Path(os.environ.get(VARIABLE, ROOT.parent / 'shared' / 'data'))
    return folder if folder.is_dir() else None


def reference(folder, name):
    """Return what is known of a recording, {} when nothing is stated."""
    path = folder / name / 'reference.yaml'
    return yaml.safe_load(path.read_text()) if path.is_file() else {}


def nominal_of(folder, name):
    """Return the nominal scaling of a recording in counts, else None."""
    nominal = reference(folder, name).get('nominal')
    return RawReadings.of_scales(**nominal) if nominal else None


def gravity_of(folder, name):
    """Return the stated gravity of a recording, else the standard gravity."""
    return reference(folder, name).get('gravity') or STANDARD_GRAVITY


@cache
def load(folder, name, topic=None):
    """Return the cleaned ImuSamples of a recording, in SI; several sections use the same ones."""
    with open_recording(folder / name, topic, want_joints=False) as recording:
        imu = read_recording(recording.blocks()).imu
    nominal = nominal_of(folder, name)
    return imu if nominal is None else nominal.apply(imu)


def label(name, topic):
    """Return a short name of one IMU of a recording."""
    first = (topic or '').strip('/').partition('/')[0]
    return f'{name} {first}' if '_' in first else name
