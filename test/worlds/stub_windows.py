"""Windows of which a test states what it needs."""

from imu_calibration.references.turntable.estimation.window_means import WindowMeans


class StubWindows(WindowMeans):
    """Properties of windows as arrays, given instead of read from windows."""

    def __init__(self, **properties):
        vars(self).update(properties)
