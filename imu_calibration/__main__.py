"""``python -m imu_calibration VERB``."""

from imu_calibration.cli import main

if __name__ == '__main__':
    raise SystemExit(main())
