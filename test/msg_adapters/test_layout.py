"""CDR layouts against rosbags, for any strings, sizes and byte order."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refused
from rosbags.typesys import Stores, get_typestore
from test_bag import make_session

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import JointSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.decode import Decoder, JointDecoder
from msg_adapters.definitions import deserializer, is_standard, standard_definition
from msg_adapters.imu import FIELDS, IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.joint_state import (
    JOINT_STATE_TYPE,
    JOINT_TRAJECTORY_TYPE,
    MISSING_JOINT,
    NO_NAMES,
    NO_POSITION,
    encode_trajectory,
    trajectory_from_message,
)
from msg_adapters.layout import LONGEST_NAME, MAX_LAYOUTS, MessageError, Packed, clean_name
from msg_adapters.live import LiveGatherer
from msg_adapters.write import encode_imu, encode_joints, encode_temperature
from validation.imu_messages import parse_imu, patch_imu

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
GENERAL = {
    message_type: deserializer(message_type, {}) for message_type in (IMU_TYPE, JOINT_STATE_TYPE)
}

frames = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=20)
doubles = st.floats(allow_nan=True, width=64)
stamps = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
orders = st.booleans()


def header(stamp, frame):
    return TYPES['std_msgs/msg/Header'](TYPES['builtin_interfaces/msg/Time'](*stamp), frame)


def imu_message(stamp, frame, numbers):
    numbers = np.array(numbers, dtype=float)
    vector, turn = TYPES['geometry_msgs/msg/Vector3'], TYPES['geometry_msgs/msg/Quaternion']
    return TYPES[IMU_TYPE](
        header(stamp, frame),
        turn(*numbers[:4]),
        numbers[4:13],
        vector(*numbers[13:16]),
        numbers[16:25],
        vector(*numbers[25:28]),
        numbers[28:37],
    )


def joint_message(stamp, frame, names, position, velocity=(), effort=()):
    return TYPES[JOINT_STATE_TYPE](
        header(stamp, frame),
        list(names),
        *(np.array(v, dtype=float) for v in (position, velocity, effort)),
    )


def serialize(message, little=True):
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little))


imu_messages = st.builds(imu_message, stamps, frames, st.lists(doubles, min_size=37, max_size=37))


@given(imu_messages, orders)
def test_imu_fields_are_those_of_rosbags(message, little):
    data = serialize(message, little)
    parsed = parse_imu(data)
    assert parsed.stamp_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    assert parsed.frame_id == clean_name(message.header.frame_id)
    np.testing.assert_array_equal(
        parsed.doubles[FIELDS['orientation']],
        [
            message.orientation.x,
            message.orientation.y,
            message.orientation.z,
            message.orientation.w,
        ],
    )
    np.testing.assert_array_equal(
        parsed.doubles[FIELDS['rate_cov']], message.angular_velocity_covariance
    )
    np.testing.assert_array_equal(
        parsed.doubles[FIELDS['force_cov']], message.linear_acceleration_covariance
    )


@given(st.text() | st.binary(max_size=400))
def test_a_name_is_one_short_line_whatever_a_recording_contains(name):
    clean = clean_name(name)
    assert (
        clean.isprintable() and len(clean.encode()) <= LONGEST_NAME and clean_name(clean) == clean
    )
    assert (
        clean_name('imu_größe/左 1') == 'imu_größe/左 1'
        and len(clean_name('x' * 5000)) == LONGEST_NAME
    )
    assert clean_name('imu\n1,\x1b[2J\u202e') == 'imu?1,?[2J?'


@given(imu_messages, orders, frames, st.lists(doubles, min_size=3, max_size=3))
def test_a_patched_imu_is_what_rosbags_would_write(message, little, frame, force):
    patched = patch_imu(serialize(message, little), frame_id=frame, force_s=force)
    message.header.frame_id = frame
    message.linear_acceleration = TYPES['geometry_msgs/msg/Vector3'](*force)
    assert patched == serialize(message, little)


@given(st.lists(st.tuples(imu_messages, orders), min_size=1, max_size=30))
def test_any_mixture_of_layouts_gives_the_general_path_s_samples(messages):
    packed = Packed.join([serialize(*pair) for pair in messages])
    fast, general = Decoder(IMU_TYPE), Decoder(IMU_TYPE, GENERAL[IMU_TYPE])
    for name in ('stamp_ns', 'force_s', 'rate_s', 'frame_id'):
        np.testing.assert_array_equal(
            getattr(fast.decode(packed), name), getattr(general.decode(packed), name)
        )


@st.composite
def joint_messages(draw, table):
    names = draw(
        st.permutations(
            table
            + draw(st.lists(st.sampled_from(['extra', 'é', 'finger_1']), unique=True, max_size=2))
        )
    )
    count = len(names)
    values = st.lists(doubles, min_size=count, max_size=count)
    return joint_message(
        draw(stamps),
        draw(frames),
        names,
        draw(values),
        draw(st.one_of(values, st.just([]))),
        draw(st.one_of(values, st.just([]))),
    )


@given(
    st.lists(st.tuples(joint_messages(['outer', 'middle', 'i']), orders), min_size=1, max_size=12)
)
def test_joints_in_any_order_give_the_general_path_s_samples(messages):
    packed = Packed.join([serialize(*pair) for pair in messages])
    table = ('i', 'outer', 'middle')
    fast, general = JointDecoder(table), JointDecoder(table, GENERAL[JOINT_STATE_TYPE])
    for name in ('stamp_ns', 'position', 'velocity', 'names'):
        np.testing.assert_array_equal(
            getattr(fast.decode(packed), name), getattr(general.decode(packed), name)
        )
    first = messages[0][0]
    expected = [first.position[first.name.index(name)] for name in table]
    np.testing.assert_array_equal(JointDecoder(table).decode(packed).position[0], expected)


def test_messages_without_names_do_not_choose_the_joints():
    stamps = np.arange(2)
    nothing = JointSamples(stamps, np.zeros((2, 0)), np.zeros((2, 0)))
    named = JointSamples.of_angles(stamps, {'yaw': np.array([0.1, 0.2])})
    messages = [row.tobytes() for part in (nothing, named) for row in encode_joints(part)]
    decoder = JointDecoder()
    samples = decoder.decode(Packed.join(messages))
    assert samples.names == ('yaw',) and samples.position[:, 0].tolist() == [0.1, 0.2]
    assert decoder.dropped == {NO_NAMES: 2}


@given(st.binary(max_size=400), imu_messages, st.integers(0, 400))
def test_broken_bytes_are_counted_and_never_raise(noise, message, cut):
    whole = serialize(message)
    packed = Packed.join([noise, whole, whole[: min(cut, len(whole) - 1)], whole])
    for message_type in (IMU_TYPE, TEMPERATURE_TYPE):
        decoder = Decoder(message_type)
        samples = decoder.decode(packed)
        assert (len(samples) if samples is not None else 0) + sum(decoder.dropped.values()) == 4
    joints = JointDecoder(('a',))
    assert joints.decode(packed) is None and sum(joints.dropped.values()) == 4


def test_messages_of_any_sizes_are_copied_to_their_places():
    whole = [b'abc', b'', b'defgh', b'ijk']
    packed = Packed.chain(
        [Packed.join(whole), Packed.of_rows(np.arange(6, dtype=np.uint8).reshape(2, 3))]
    ).select(np.array([5, 2, 1, 0, 4, 3]))
    wanted = [b'\3\4\5', b'defgh', b'', b'abc', b'\0\1\2', b'ijk']
    assert packed.views() == wanted
    target = np.zeros(packed.size.sum() + 6, np.uint8)
    packed.copy_to(target, np.cumsum(packed.size) - packed.size + np.arange(6))
    assert target.tobytes() == b''.join(message + b'\0' for message in wanted)


def test_more_layouts_than_are_worth_grouping():
    imu, _, _ = make_session(4 * MAX_LAYOUTS)
    data = [
        encode_imu(replace(imu.select(slice(k, k + 1)), frame_id='f' * (k % (2 * MAX_LAYOUTS))))[
            0
        ].tobytes()
        for k in range(len(imu))
    ]
    np.testing.assert_array_equal(Decoder(IMU_TYPE).decode(Packed.join(data)).force_s, imu.force_s)


@pytest.mark.parametrize('encapsulation', [b'\0\2', b'\0\3', b'\0\7', b'\0\x0b', b'\1\1'])
def test_other_representations_than_plain_cdr_are_dropped(encapsulation):
    data = encapsulation + encode_imu(make_session(1)[0])[0].tobytes()[2:]
    with pytest.raises(MessageError, match=f'0x{encapsulation.hex()}'):
        parse_imu(data)
    decoder = Decoder(IMU_TYPE)
    assert decoder.decode(Packed.join([data])) is None
    assert decoder.dropped == {'Imu message that cannot be decoded': 1}


def test_different_padding_is_the_same_layout():
    """Some middleware leaves padding bytes as they were in memory."""
    data = [bytearray(row.tobytes()) for row in encode_joints(make_session(20)[1])]
    joints = make_session(20)[1]
    position = bytes(data[0]).index(np.float64(joints.position[0, 0]).tobytes())
    data[1][position - 4 : position] = (
        b'junk'  # after the count of positions, in front of the first double
    )
    decoded = JointDecoder(joints.names).decode(Packed.join([bytes(message) for message in data]))
    np.testing.assert_array_equal(decoded.position, joints.position)


def test_absent_readings_come_as_nan():
    imu, _, _ = make_session(5)
    absent = (-1.0,) + (0.0,) * 8
    packed = Packed.join([row.tobytes() for row in encode_imu(imu, rate_cov=absent)])
    for decoder in (Decoder(IMU_TYPE), Decoder(IMU_TYPE, GENERAL[IMU_TYPE])):
        samples = decoder.decode(packed)
        np.testing.assert_array_equal(samples.force_s, imu.force_s)
        assert np.isnan(samples.rate_s).all()


def test_joint_states_that_do_not_fit_are_counted_by_reason():
    messages = [
        joint_message((1, 0), '', ['a', 'b'], [1, 2]),
        joint_message((2, 0), '', ['a'], [1]),
        joint_message((3, 0), '', ['b', 'a'], []),
    ]
    for deserialize in (None, GENERAL[JOINT_STATE_TYPE]):
        decoder = JointDecoder(('b', 'a'), deserialize)
        samples = decoder.decode(Packed.join([serialize(message) for message in messages]))
        np.testing.assert_array_equal(samples.position, [[2.0, 1.0]])
        assert np.isnan(samples.velocity).all()
        assert decoder.dropped == {MISSING_JOINT: 1, NO_POSITION: 1}
        decoder.check()


def test_names_that_never_match_are_refused_with_what_came():
    decoder = JointDecoder(('outer', 'inner'))
    decoder.decode(Packed.join([serialize(joint_message((1, 0), '', ['pan', 'tilt'], [1, 2]))]))
    with refused(InputError, 'joint_names', 'outer, inner', 'pan, tilt'):
        decoder.check()
    with pytest.raises(InputError):
        decoder.decode(
            Packed.join([serialize(joint_message((1, 0), '', ['pan', 'tilt'], [1, 2]))] * 1000)
        )


@pytest.mark.parametrize(
    'message_type', [IMU_TYPE, JOINT_STATE_TYPE, TEMPERATURE_TYPE, JOINT_TRAJECTORY_TYPE]
)
def test_the_written_definitions_are_the_standard_ones(message_type):
    definition = standard_definition(message_type)
    assert definition.text.strip() == STORE.generate_msgdef(message_type, ros_version=2)[0].strip()
    assert definition.digest == STORE.hash_rihs01(message_type)
    assert is_standard(message_type, 'ros2msg', definition.text)


def test_a_trajectory_is_written_whatever_the_order_of_its_arrays_in_memory():
    """
    Arrays with the instants along the last axis were refused by the serializer.

    The planner could not move.
    """
    values = np.random.default_rng(1).normal(size=(3, 5, 2))
    values[1, -1] = 0.0  # at rest at the end
    transposed = [np.asfortranarray(each) for each in values]
    assert not transposed[0][1].flags.c_contiguous
    time = np.arange(1.0, 6.0)
    assert encode_trajectory(TrajectoryPoints(('a', 'b'), time, *transposed)) == encode_trajectory(
        TrajectoryPoints(('a', 'b'), time, *values)
    )


@given(st.lists(frames, max_size=4, unique=True), st.integers(0, 5), st.integers(0, 2), frames)
def test_a_trajectory_is_written_as_rosbags_reads_it_and_comes_back(
    names, n_points, n_derivatives, frame
):
    rng = np.random.default_rng(n_points)
    values = rng.normal(size=(3, n_points, len(names)))
    time = np.cumsum(rng.integers(1, 10**9, n_points)) * 1e-9
    values[1, -1:] = 0.0  # at rest at the end
    points = TrajectoryPoints(tuple(names), time, *values[: 1 + n_derivatives])
    message = STORE.deserialize_cdr(encode_trajectory(points), JOINT_TRAJECTORY_TYPE)
    assert encode_trajectory(points) == bytes(STORE.serialize_cdr(message, JOINT_TRAJECTORY_TYPE))
    back = trajectory_from_message(message)
    assert back.joint_names == points.joint_names
    np.testing.assert_allclose(back.time, time, atol=1e-9)
    for name, wanted in points.columns().items() if n_points and names else ():
        np.testing.assert_array_equal(back.columns()[name], wanted)
    assert len(back.columns()) == 1 + n_derivatives or not n_points or not names


def test_a_trajectory_whose_points_say_different_things_gives_what_all_say():
    points = TrajectoryPoints(('a', 'b'), np.array([1.0, 2.0]), np.ones((2, 2)), np.zeros((2, 2)))
    message = STORE.deserialize_cdr(encode_trajectory(points), JOINT_TRAJECTORY_TYPE)
    message.points[1].velocities = np.zeros(1)
    assert trajectory_from_message(message).rate is None
    message.points[0].positions = np.zeros(0)
    with refused(InputError, 'position_count', 2):
        trajectory_from_message(message)


def test_definitions_with_comments_are_standard_and_others_are_not():
    text = standard_definition(IMU_TYPE).text
    noisy = '# A comment = with a sign\r\n\n' + text
    for plain, other in (
        ('string frame_id', 'string frame_id  # where'),
        ('MSG: std_msgs/Header', 'MSG: std_msgs/msg/Header'),
        ('float64 w', 'float64 w 1'),
        ('\nint32 sec', '\nint32 K=5\nint32 sec'),
    ):
        noisy = noisy.replace(plain, other)
    assert is_standard(IMU_TYPE, 'ros2msg', noisy) and is_standard(IMU_TYPE, '', '')
    assert not is_standard(
        IMU_TYPE, 'ros2msg', text.replace('float64[9] angular', 'float32[9] angular')
    )
    assert not is_standard(
        IMU_TYPE, 'ros2msg', text.replace('string frame_id\n', 'string frame_id\nuint32 seq\n')
    )
    assert not is_standard(IMU_TYPE, 'ros2msg', 'std_msgs/Header header\n') and not is_standard(
        IMU_TYPE, 'ros2idl', 'module x {};'
    )


def test_live_messages_give_the_samples_of_a_bag():
    imu, joints, temperature = make_session(40)
    gatherer = LiveGatherer(joints.names, max_messages=30)
    for add, table in (
        (gatherer.add_imu, encode_imu(imu)),
        (gatherer.add_joints, encode_joints(joints)),
        (gatherer.add_temperature, encode_temperature(temperature)),
    ):
        for row in table:
            add(row.tobytes())
    assert len(gatherer) == 30 + 8 + 1
    block = gatherer.flush()
    np.testing.assert_array_equal(block.imu.force_s, imu.force_s[10:])
    np.testing.assert_array_equal(block.joints.velocity, joints.velocity)
    np.testing.assert_array_equal(block.temperature.temperature_c, temperature.temperature_c)
    assert block.dropped == {'Imu message that was dropped because the queue was full': 10}
    empty = gatherer.flush()
    assert empty.imu is None and empty.joints is None and empty.dropped is None
