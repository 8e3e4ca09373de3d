"""Two IMUs on one topic, separated by frame_id."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.compensate import compensate_recording
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from msg_adapters.bag import open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.decode import OTHER_FRAME, FrameChoice
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu

from worlds.physics_hand import hold_and_turn


@pytest.fixture(scope='module')
def two(tmp_path_factory):
    """
    Return a bag with the frames 'front' and 'rear' on one topic, alternating.

    Rear reads 1 m/s^2 more along x.
    """
    imu = hold_and_turn(3)[0]
    path = tmp_path_factory.mktemp('frames') / 'bag'
    with BagWriter(path) as bag:
        topic = bag.add_topic('/imus', standard_definition(IMU_TYPE))
        messages = [
            Packed.of_rows(
                encode_imu(ImuSamples(imu.stamp_ns, imu.force_s + [shift, 0, 0], imu.rate_s, frame))
            ).views()
            for frame, shift in (('front', 0.0), ('rear', 1.0))
        ]
        bag.write(
            np.full(2 * len(imu), topic),
            np.repeat(imu.stamp_ns, 2),
            Packed.join([each for pair in zip(*messages) for each in pair]),
        )
    return path, imu


def read(path, **choice):
    with open_recording(path, want_joints=False, **choice) as recording:
        return ImuSamples.concatenate(
            [block.imu for block in recording.blocks() if block.imu is not None]
        )


@pytest.mark.parametrize(('frame', 'shift'), [('front', 0.0), ('rear', 1.0)])
def test_the_messages_of_the_chosen_frame_are_read(two, frame, shift):
    path, imu = two
    found = read(path, frame_id=frame)
    assert found.frame_id == frame and np.array_equal(found.stamp_ns, imu.stamp_ns)
    assert np.allclose(found.force_s - imu.force_s, [shift, 0, 0], atol=1e-12)


def test_several_frames_without_a_choice_are_refused_with_their_names(two):
    with refused(InputError, 'frame_ambiguous', '/imus', "'front'", "'rear'"):
        read(two[0])


def test_a_frame_that_no_message_has_is_refused_with_those_of_the_topic(two):
    with refused(InputError, 'frame_unknown', "'left'", "'front'", "'rear'"):
        read(two[0], frame_id='left')


def test_a_few_messages_of_another_frame_are_damage():
    choice = FrameChoice('/imu')
    assert choice.wants('imu', 1000) and choice.wants('imx', OTHER_FRAME - 1)
    with refused(InputError, 'frame_ambiguous', "'imx'"):
        choice.wants('imx')


def test_the_option_selects_the_frame_and_its_absence_is_one_line(capsys, two, tmp_path):
    out = tmp_path / 'out'
    assert main(['calibrate', str(two[0]), '--output', str(out), '--no-report']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert '--frame-id' in line and not out.exists()
    assert main(
        ['calibrate', str(two[0]), '--frame-id', 'rear', '--output', str(out), '--no-report']
    ) in (0, 3)
    assert 'frame_id: rear' in (out / 'calibration.yaml').read_text()
    with refused(InputError, 'frame_ambiguous'):
        compensate_recording(
            two[0], out / 'calibration.yaml', output=tmp_path / 'refused', anyway=True
        )
    assert not (tmp_path / 'refused').exists()
    found = compensate_recording(
        two[0],
        out / 'calibration.yaml',
        output=tmp_path / 'corrected',
        frame_id='rear',
        anyway=True,
    )
    corrected = read(tmp_path / 'corrected', imu_topic='/imu/data_corrected')
    assert found.count == len(corrected) == len(two[1]) and corrected.frame_id == 'rear'


def test_inspect_lists_both(capsys, two):
    main(['inspect', str(two[0])])
    printed = capsys.readouterr().out
    assert '/imus (front)' in printed and '/imus (rear)' in printed
    main(['inspect', str(two[0]), '--frame-id', 'rear'])
    assert '(front)' not in capsys.readouterr().out


def test_arm_refuses_one_imu_twice(capsys, two):
    for words in ([], ['--frame-id', 'rear', '--frame-id', 'rear'], ['--frame-id', 'rear']):
        assert (
            main(['arm', str(two[0]), '--imu-topic', '/imus', '--imu-topic', '/imus', *words]) == 1
        )
        (line,) = capsys.readouterr().err.splitlines()
        assert 'twice' in line
    assert main(
        [
            'arm',
            str(two[0]),
            '--imu-topic',
            '/imus',
            '--imu-topic',
            '/imus',
            '--frame-id',
            'front',
            '--frame-id',
            'rear',
        ]
    ) in (0, 1, 3)
    assert 'twice' not in capsys.readouterr().err
