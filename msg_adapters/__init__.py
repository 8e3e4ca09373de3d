"""
Conversion between ROS messages and arrays: the only package that defines message layouts.

In: recordings, messages that arrive on topics, arrays of samples. Out: blocks of samples; bags, new
or with a corrected topic. Read `bag` first: it reads recordings. `stamps`, `layout`, `imu`,
`joint_state` and `temperature` define the layouts, `storages` lists the storages of rosbag2,
`write` makes bags, `copying` copies one and adds a corrected topic, `live` collects received
messages. There is no node in here, and rosbags is imported only where a message definition or a ROS
1 bag needs it.
"""
