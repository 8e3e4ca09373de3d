"""Helpers of the tests that run nodes: stations that publish and listen over DDS, and the endurance test."""
