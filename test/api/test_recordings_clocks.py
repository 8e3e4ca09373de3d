"""Two clocks that differ are the cause; what follows from them is not reported beside it."""

from dataclasses import replace

import pytest

from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.recordings import Topics
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.table_reference import TableReference

from worlds.physics import make_session


@pytest.mark.parametrize('offset', [37.0, -20.0])
def test_joints_do_not_seem_constant_where_the_clocks_differ(offset):
    session = make_session(9425, profile='quick', imu_rate=50.0, joint_rate=50.0)
    shifted = session.imu.stamp_ns + round(offset * 1e9)
    block = SampleBlock(replace(session.imu, stamp_ns=shifted), session.joints)
    table = Table.from_mapping(session.table)
    (look,) = inspect_recording(
        block, [Topics()], TableReference(table), options=CalibrationOptions()
    )
    assert look.calibrated.code == 'on_table'
    assert f'{abs(offset):.1f} s' in str(look.calibrated)
    assert 'clocks' in [finding.check for finding in look.findings]
    assert 'frozen' not in [finding.check for finding in look.findings]
