"""Times that the user excludes: forms, names of recordings, and counts."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.inspect import inspect_imus
from imu_calibration.api.noise import identify_recording
from imu_calibration.api.references import inputs_of
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.preprocessing.exclusion import (
    EXCLUDED,
    Exclusion,
    WithoutExcluded,
    exclusions_by_recording,
    exclusions_of_units,
    parse_exclusions,
)

from worlds.hand_sessions import GRAVITY
from worlds.physics_hand import hold_and_turn


def samples(n=400, rate=50.0):
    stamp_ns = 10**18 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
    return ImuSamples(stamp_ns, np.tile([0.0, 0.0, 9.8], (n, 1)), np.zeros((n, 3)), 'imu')


def test_forms():
    assert parse_exclusions('1.5:3, bag.mcap=0:20') == (
        Exclusion(1.5, 3.0),
        Exclusion(0.0, 20.0, 'bag.mcap'),
    )


@pytest.mark.parametrize('text', ['', '4', '5:4', '3:3', '-1:4', 'a:b', '1:nan', 'x=1'])
def test_other_forms_are_refused(text):
    with refused(InputError, 'exclude_form', text) as caught:
        parse_exclusions(text)
    assert caught.value.key == 'exclude'


def test_a_time_belongs_to_one_recording():
    times = parse_exclusions('a=1:2,b=3:4,a=5:6')
    assert exclusions_by_recording(times, ['a', 'b']) == [[times[0], times[2]], [times[1]]]
    assert exclusions_by_recording([Exclusion(1.0, 2.0)], ['a'])[0]
    for text in ('c=1:2', '1:2'):
        with refused(InputError, 'exclude_recording', text):
            exclusions_by_recording(parse_exclusions(text), ['a', 'b'])


def test_a_time_of_a_fleet_belongs_to_all_units_a_unit_or_a_recording():
    units = {'a': ['day.mcap', 'night.mcap'], 'b': ['day.mcap']}
    everywhere, of_unit, of_recording = times = parse_exclusions('0:5,b=7:9,night.mcap=1:2')
    assert exclusions_of_units(times, units) == {
        'a': [[everywhere], [everywhere, of_recording]],
        'b': [[everywhere, of_unit]],
    }
    with refused(InputError, 'exclude_recording', 'c=1:2') as caught:
        exclusions_of_units(parse_exclusions('c=1:2'), units)
    assert caught.value.key == 'exclude'


@pytest.mark.parametrize('cut', [400, 37])
def test_samples_are_left_out_and_counted(cut):
    imu = samples()
    blocks = [SampleBlock(imu.select(slice(a, a + cut))) for a in range(0, len(imu), cut)]
    found = list(WithoutExcluded(blocks, parse_exclusions('2:3,6:6.5')))
    stamps = np.concatenate([block.imu.stamp_ns for block in found if block.imu is not None])
    time = (stamps - imu.stamp_ns[0]) * 1e-9
    assert len(time) == 400 - 50 - 25
    assert not ((time >= 2) & (time < 3) | (time >= 6) & (time < 6.5)).any()
    assert sum((block.dropped or {}).get(EXCLUDED, 0) for block in found) == 75


def test_a_time_outside_of_the_recording_is_refused():
    with refused(InputError, 'exclude_outside', '9:12', 8.0):
        list(WithoutExcluded([SampleBlock(samples())], parse_exclusions('9:12')))


def test_the_functions_for_files_leave_it_out():
    imu = hold_and_turn(17, n_poses=14, rate_hz=80.0)[0]
    shaken = imu.force_s.copy()
    time = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    part = (time > 20) & (time < 29)
    shaken[part] += np.random.default_rng(1).normal(0, 8, (np.count_nonzero(part), 3))
    block = SampleBlock(ImuSamples(imu.stamp_ns, shaken, imu.rate_s, 'imu'))
    found = calibrate_recordings([block], gravity=GRAVITY, model_as_asked=True, exclude='19.8:29.2')
    assert found.calibration.statistics['dropped'][EXCLUDED] == pytest.approx(9.4 * 80, abs=1)
    assert found.exit_code == 3
    (source,) = inputs_of([block], None, {'exclude': '1:2'}).sources
    assert sum((each.dropped or {}).get(EXCLUDED, 0) for each in source) == 80
    (look,) = inspect_imus(block, None, {'exclude': '1:2'})
    assert look.lost[EXCLUDED] == 80 and look.streams['imu'].count == len(imu) - 80
    with refused(InputError, 'exclude_outside', '70:71'):
        identify_recording(block, exclude='70:71')
