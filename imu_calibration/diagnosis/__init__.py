"""What the model gets wrong: the cause, by evidence on windows that were held out, and what stays unexplained."""

from imu_calibration.diagnosis.diagnose import diagnose
from imu_calibration.diagnosis.document import to_mapping
from imu_calibration.diagnosis.result import Candidate, Diagnosis, Finding

__all__ = ['Candidate', 'Diagnosis', 'Finding', 'diagnose', 'to_mapping']
