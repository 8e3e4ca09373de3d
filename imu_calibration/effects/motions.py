"""Instructions of the standard motions, which effects name as the motions that show them."""

SENSOR_MOTIONS = {
    'static_poses': 'rest in six faces and twelve edge positions, at several headings',
    'static_dense': 'rest every 15 degrees on three rings',
    'spin_x': "spin about the sensor's x axis at 100 and 200 deg/s in both senses",
    'spin_y': "spin about the sensor's y axis at 100 and 200 deg/s in both senses",
    'spin_z': "spin about the sensor's z axis at 100 and 200 deg/s in both senses",
    'three_speeds': 'spin about skewed axes at 50, 100 and 200 deg/s in both senses',
    'oscillate_x': "oscillate about the sensor's x axis, 30 deg at 1 Hz",
    'oscillate_y': "oscillate about the sensor's y axis, 30 deg at 1 Hz",
    'oscillate_z': "oscillate about the sensor's z axis, 30 deg at 1 Hz",
    'two_axis': 'turn about two axes at once at 200 deg/s, for each pair of axes',
    'centrifuge': 'spin at 300 deg/s on an arm of 0.3 m, about each axis',
    'warm_up': 'rest in six faces, cold and warm',
    'warm_and_cool': (
        'rest in six faces while it warms up by ten kelvins, and again while it cools'
    ),
    'shake': 'rest in six faces, quiet and while a machine shakes the sensor along each axis',
}
"""Motions of the sensor, on a table or by hand; their gain can be predicted."""
TABLE_MOTIONS = {
    'turn_about_vertical': (
        'turn slowly through a full circle about the vertical, resting at several headings'
    ),
    'slow_turn': (
        'turn each joint slowly through full circles, with the sensor mounted at two attitudes'
    ),
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz about two axes, in both phases',
    'fast_spin': 'spin slowly up to the fastest rate in both senses',
}
"""
Motions that concern the table or the clock; their gain depends on the table and is not predicted.
"""
ALL_MOTIONS = SENSOR_MOTIONS | TABLE_MOTIONS
"""Name -> instruction."""
