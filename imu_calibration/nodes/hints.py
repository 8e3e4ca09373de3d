"""What the nodes call the things that errors of the core ask for: parameters and topics."""

_ARM = {'allow_xacro': "parameter 'allow_xacro'", 'urdf': "parameter 'urdf_file'", 'imu_link': "parameter 'imu_link'"}
HINTS = {
    'calibration_node': {'gravity': "parameter 'gravity'", 'table': "parameter 'table_file'", **_ARM, 'imu_topic': 'remap imu/data_raw',
                         'joint_topic': 'remap joint_states', 'temperature_topic': 'remap imu/temperature'},
    'compensator_node': {'calibration': "parameter 'calibration_file'", 'imu_topic': 'remap imu/data_raw',
                         'target_frame': "parameter 'target_frame'", 'temperature_topic': 'remap imu/temperature'},
    'planner_node': {**_ARM, 'table': "parameter 'table_file'", 'joint_topic': 'remap joint_states'},
    'simulator_node': {**_ARM, 'calibration': "parameter 'calibration_file'", 'table': "parameter 'table_file'"},
}
"""Node -> {key of `errors.KEYS`: what it is called there}, of what the node has; none for a node that no such error reaches."""
