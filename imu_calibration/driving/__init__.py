"""
Driving joints through motions, safely.

In: motions that a planner asks for, what the joints really did. Out: what to send, when to measure, when and why to stop.
Read `driver` first.
"""
