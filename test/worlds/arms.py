"""
Robots as URDF text.

Arms, a SCARA and a gantry of our own dimensions, with the tags around them that real descriptions
have.
"""

from textwrap import indent

LIMITS = 'lower="-2.9" upper="2.9" velocity="3.0" effort="100"'


def joint(name, parent, child, xyz='0 0 0', rpy='0 0 0', axis='0 0 1', kind='revolute', extra=''):
    """Return one joint, and the link that it moves."""
    limit = {
        'revolute': f'<limit {LIMITS}/>',
        'prismatic': '<limit lower="-0.1" upper="0.9" velocity="1.5" effort="100"/>',
    }.get(kind, '')
    moving = '' if kind == 'fixed' else f'<axis xyz="{axis}"/>{limit}{extra}'
    return (
        f'<link name="{child}"><visual><geometry><mesh'
        f' filename="package://nowhere/{child}.dae"/></geometry></visual></link>\n<joint'
        f' name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent'
        f' link="{parent}"/><child link="{child}"/>{moving}</joint>'
    )


def robot(*joints, root='base_link'):
    """
    Return the description of a robot with these joints and extras.

    The extras are a camera that nobody requests, and additions of simulators.
    """
    aside = (
        joint('camera_joint', root, 'camera_link', kind='fixed')
        + '\n'
        + joint('gripper_joint', root, 'gripper_link', axis='0 1 0')
    )
    text = '\n'.join([f'<link name="{root}"/>', *joints, aside])
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<robot name="own">\n{indent(text, "  ")}\n '
        ' <gazebo><plugin name="x" filename="y"/></gazebo>\n</robot>\n'
    )


SIX_AXES = robot(
    joint('mounted', 'base_link', 'foot', '0.05 -0.02 0.01', '0 0 0.3', kind='fixed'),
    joint('pan', 'foot', 'shoulder', '0 0 0.16'),
    joint('lift', 'shoulder', 'upper_arm', '0 0.13 0', '0 1.5707963267948966 0', '0 1 0'),
    joint('elbow', 'upper_arm', 'forearm', '0 -0.12 0.43', axis='0 1 0'),
    joint('wrist_1', 'forearm', 'wrist_1_link', '0 0 0.39', '0 1.5707963267948966 0', '0 1 0'),
    joint('wrist_2', 'wrist_1_link', 'wrist_2_link', '0 0.1 0', axis='0 0 1'),
    joint('wrist_3', 'wrist_2_link', 'tool', '0 0 0.09', axis='0 1 0', kind='continuous'),
    joint('imu_joint', 'tool', 'imu_link', '0.02 0.05 -0.01', '0.2 -0.4 1.1', kind='fixed'),
)
"""Six axes, three of them parallel."""

SEVEN_AXES = robot(
    joint('j1', 'base_link', 'l1', '0 0 0.333'),
    joint('j2', 'l1', 'l2', '0 0 0', '-1.5707963267948966 0 0'),
    joint('j3', 'l2', 'l3', '0 -0.316 0', '1.5707963267948966 0 0'),
    joint('j4', 'l3', 'l4', '0.0825 0 0', '1.5707963267948966 0 0'),
    joint('j5', 'l4', 'l5', '-0.0825 0.384 0', '-1.5707963267948966 0 0'),
    joint('j6', 'l5', 'l6', '0 0 0', '1.5707963267948966 0 0'),
    joint('j7', 'l6', 'l7', '0.088 0 0', '1.5707963267948966 0 0'),
    joint('imu_joint', 'l7', 'imu_link', '0.03 0 0.1', '0 0.7 0', kind='fixed'),
)
"""Seven axes, none parallel to the next."""

SCARA = robot(
    joint('first', 'base_link', 'inner', '0 0 0.4'),
    joint('second', 'inner', 'outer', '0.35 0 0'),
    joint('stroke', 'outer', 'quill', '0.3 0 0', '3.141592653589793 0 0', kind='prismatic'),
    joint('third', 'quill', 'flange', axis='0.0 0.0 -2.0'),
    joint('imu_joint', 'flange', 'imu_link', '0.01 0.02 0.03', '0.1 0.2 0.3', kind='fixed'),
)
"""Three vertical axes and a stroke."""

GANTRY = robot(
    joint('x', 'base_link', 'bridge', axis='1 0 0', kind='prismatic'),
    joint('y', 'bridge', 'carriage', '0 0.1 0.6', axis='0 1 0', kind='prismatic'),
    joint('z', 'carriage', 'column', '0 0 -0.1', '0 0.05 0', kind='prismatic', axis='0 0.1 -1'),
    joint('yaw', 'column', 'fork', '0 0 -0.3'),
    joint('pitch', 'fork', 'imu_link', '0 0.03 -0.1', '0 0 0.2', axis='0.1 1 0'),
)
"""Three strokes and two turns."""

FOLLOWING = robot(
    joint('drive', 'base_link', 'a', axis='0 0 1'),
    joint('parallel', 'a', 'b', '0.3 0 0', '0.3 0 0', axis='0 1 0'),
    joint(
        'back',
        'b',
        'c',
        '0 0 0.3',
        axis='0 1 0',
        extra='<mimic joint="parallel" multiplier="-0.75" offset="0.2"/>',
    ),
    joint(
        'extend',
        'c',
        'd',
        '0.1 0 0',
        axis='1 0 0',
        kind='prismatic',
        extra='<mimic joint="drive" multiplier="0.05"/>',
    ),
    joint(
        'hidden',
        'd',
        'e',
        '0 0.1 0',
        axis='1 0 0',
        extra='<mimic joint="gripper_joint" multiplier="2"/>',
    ),
    joint('end', 'e', 'imu_link', '0.05 0 0', axis='0 1 1'),
)
"""
Joints that follow others: one before them, one that turns while they slide, one that is not on the
way.
"""

ROBOTS = {
    'six_axes': SIX_AXES,
    'seven_axes': SEVEN_AXES,
    'scara': SCARA,
    'gantry': GANTRY,
    'following': FOLLOWING,
}
