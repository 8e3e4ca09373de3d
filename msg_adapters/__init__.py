"""
Turning ROS messages into arrays and back: the only place that knows message layouts.

``stamps``, ``layout``, ``imu``, ``joint_state`` and ``temperature`` know the layouts; ``bag`` reads recordings, ``write`` makes
them, ``correct`` copies one with a corrected topic beside the others, and ``live`` gathers what arrives on topics. There is no
node in here. Bags are read through rosbags, which is imported only when a bag is opened.
"""
