"""Local names of the inputs and programs that errors of the core request: parameters, topics and services of each node."""

_ARM = {'allow_xacro': "parameter 'allow_xacro'", 'urdf': "parameter 'urdf_file'", 'imu_link': "parameter 'imu_link'"}
HINTS = {
    'calibration_node': {'frame_id': "parameter 'frame_id'", 'gravity': "parameter 'gravity'", 'table': "parameter 'table_file'",
                         **_ARM, 'imu_topic': 'remap imu/data_raw', 'joint_topic': 'remap joint_states',
                         'temperature_topic': 'remap imu/temperature',
                         'inspect': "record a bag and run 'imu_calibration inspect BAG' to {}",
                         'diagnose': "call ~/diagnose, by hand record a bag and run 'imu_calibration diagnose BAG', to {}"},
    'compensator_node': {'anyway': "parameter 'anyway'", 'calibration': "parameter 'calibration_file'", 'imu_topic': 'remap imu/data_raw',
                         'target_frame': "parameter 'target_frame'", 'temperature_topic': 'remap imu/temperature'},
    'planner_node': {**_ARM, 'table': "parameter 'table_file'", 'joint_topic': 'remap joint_states'},
    'simulator_node': {**_ARM, 'calibration': "parameter 'calibration_file'", 'table': "parameter 'table_file'"},
}
"""Node -> {key of `errors.KEYS`: its name in the node}; a node without an entry receives no such error."""
