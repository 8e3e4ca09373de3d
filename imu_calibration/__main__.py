"""``python -m imu_calibration VERB``."""

from imu_calibration.cli.main import main

if __name__ == '__main__':
    raise SystemExit(main())
