"""
Installation by colcon (ament_python) and by pip.

Docs/decisions/packaging.md has the places of the files.
"""

import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.develop import develop
from setuptools.command.install_scripts import install_scripts

NAME = 'imu_calibration'
REPOSITORY = 'https://github.com/imu-calibration/imu_calibration'
"""The one place of the address; package.xml repeats it, and a test compares."""
LINK = re.compile(r'(!?)\[([^\]]*)\]\(([^)#:\s]+)(#[^)]*)?\)')
"""A link of a page to a file of the repository, or an image."""
NODES = (
    'calibration_node',
    'compensator_node',
    'simulator_node',
    'bag_player_node',
    'planner_node',
)


def readme():
    """Return the README with absolute links, for a page outside the repository."""
    text = Path(__file__).with_name('README.md').read_text(encoding='utf-8')

    def absolute(link):
        image, label, path, anchor = link.groups()
        view = 'raw' if image else 'blob'
        return f'{image}[{label}]({REPOSITORY}/{view}/main/{path}{anchor or ""})'

    return LINK.sub(absolute, text)


class _OnPathToo:
    """
    Write each console script to bin/ as well.

    `ros2 run` looks in lib/PACKAGE, a shell looks on PATH.
    """

    def write_script(self, script_name, contents, *args):
        super().write_script(script_name, contents, *args)
        folder = Path(getattr(self, 'script_dir', None) or self.install_dir)
        if folder.parts[-2:] == ('lib', NAME):
            command = folder.parents[1] / 'bin' / script_name
            command.parent.mkdir(parents=True, exist_ok=True)
            command.write_text((folder / script_name).read_text())
            command.chmod(0o755)


class InstallScripts(_OnPathToo, install_scripts):
    """Used by colcon build."""


class Develop(_OnPathToo, develop):
    """Used by colcon build --symlink-install."""


setup(
    name=NAME,
    version='0.1.0',
    description=(
        'Calibration and compensation of inertial measurement units, offline and live on ROS 2'
    ),
    long_description=readme(),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    url=REPOSITORY,
    project_urls={'Changes': f'{REPOSITORY}/blob/main/CHANGELOG.rst'},
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    maintainer='imu_calibration maintainers',
    maintainer_email='imu_calibration@users.noreply.github.com',
    packages=find_packages(include=[NAME, f'{NAME}.*', 'msg_adapters', 'msg_adapters.*']),
    package_data={
        NAME: ['py.typed'],
        'msg_adapters': ['py.typed'],
        f'{NAME}.report': ['templates/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    python_requires='>=3.10',
    install_requires=[
        # The oldest versions that are tested, constraints/oldest.txt; a test compares.
        'numpy>=1.26',
        'scipy>=1.11',
        'PyYAML>=6.0.1',
        'matplotlib>=3.6',
        'Jinja2>=3.1.2',
        'tqdm>=4.66',
        'rosbags>=0.11',
        'lz4>=4.4',
        'backports.zstd>=1.8; python_version < "3.14"',
    ],
    # urdfdom-py brings lxml (12 MB), which only robot descriptions need.
    extras_require={
        'arm': ['urdfdom-py>=1.2', 'xacro>=2.1'],
        'view': ['foxglove-sdk>=0.30'],
        'dask': ['dask>=2026.8', 'distributed>=2026.8'],
    },
    zip_safe=False,
    cmdclass={'install_scripts': InstallScripts, 'develop': Develop},
    entry_points={
        'console_scripts': [
            f'{NAME} = {NAME}.__main__:main',
            *(f'{node} = {NAME}.nodes.{node}:main' for node in NODES),
        ],
        'ros2cli.command': [f'imu = {NAME}.cli.ros2:ImuCommand'],
        'ros2doctor.checks': [f'ImuCheck = {NAME}.nodes.doctor:ImuCheck'],
        'ros2doctor.report': [f'ImuReport = {NAME}.nodes.doctor:ImuReport'],
    },
)
