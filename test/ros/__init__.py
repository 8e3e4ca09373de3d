"""
Helpers of the tests that run nodes.

Stations that publish and listen over DDS, and the endurance test.
"""
