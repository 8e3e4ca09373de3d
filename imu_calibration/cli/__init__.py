"""
The command line, also as ``ros2 imu VERB``.

In: arguments and files. Out: files, a summary, an exit code.
Read `parser` first: a verb is a module.
"""
