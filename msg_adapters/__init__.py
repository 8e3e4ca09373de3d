"""
Turning ROS messages into arrays and back: the only place that knows message layouts.

In: recordings, messages that arrive on topics, arrays of samples. Out: blocks of samples; bags, new or with a corrected topic.
Read `bag` first: it reads recordings. `stamps`, `layout`, `imu`, `joint_state` and `temperature` know the layouts, `storages` lists the
storages of rosbag2, `write` makes bags, `copying` copies one with a corrected topic beside the others, `live` gathers what arrives. There
is no node in here, and rosbags is imported only where a message definition or a ROS 1 bag asks for it.
"""
