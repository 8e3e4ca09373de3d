"""Every command of docs/units-axes-files.md runs as printed."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np

from imu_calibration.cli.main import main
from imu_calibration.core.readings import RawReadings
from msg_adapters.write import write_session

from worlds.hand_sessions import simulate
from worlds.no_reports import without_reports

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'units-axes-files.md'


def test_the_commands_of_the_page_run_in_its_order(tmp_path, monkeypatch):
    imu = simulate(3, n_poses=20, still=3.0, force_sd=0.004, rate_sd=4e-4)[0]
    raw = replace(imu, force_s=imu.force_s / 9.80665, rate_s=np.degrees(imu.rate_s))
    write_session(tmp_path / 'session_si', imu)
    write_session(tmp_path / 'session_g', raw)
    seconds = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    header = 't (s),ax (g),ay (g),az (g),gx (deg/s),gy (deg/s),gz (deg/s)'
    columns = np.column_stack([seconds, raw.force_s, raw.rate_s])
    np.savetxt(tmp_path / 'log.csv', columns, delimiter=',', header=header, comments='')
    for name, used in (('accelerometer', [0, 1, 2, 3]), ('gyroscope', [0, 4, 5, 6])):
        names = ','.join(np.array(header.split(','))[used])
        np.savetxt(
            tmp_path / f'{name}.csv', columns[:, used], delimiter=',', header=names, comments=''
        )
    monkeypatch.chdir(tmp_path)
    parts = re.split(r'^```\w*\n?', PAGE.read_text(), flags=re.MULTILINE)
    lines = [line for block in parts[1::2] for line in block.splitlines()]
    lines = [line for line in lines if line.startswith('imu_calibration ')]
    assert len(lines) == 6
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == 'imu_calibration'
        with without_reports():
            assert main(arguments) in (0, 3), line
    for name in ('corrected', 'corrected_si', 'corrected.csv', 'flu.params', 'joined'):
        assert (tmp_path / name).exists()


def test_the_page_names_each_option_of_the_readings():
    options = ('accelerometer-unit', 'gyroscope-unit', 'increments', 'nominal', 'axes', 'where')
    text = PAGE.read_text()
    for option in (*options, 'exclude', 'gyroscope-topic', 'columns'):
        assert f'--{option}' in text


def test_the_file_on_the_page_is_valid():
    import yaml

    (text,) = re.findall(r'^```yaml\n(.*?)^```$', PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert RawReadings.from_mapping(yaml.safe_load(text)).axes == 'frd'
