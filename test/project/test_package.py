"""
The package's own papers agree.

Manifest, set-up, pinned environments, make targets, installed files.
"""

import ast
import json
import re
import shutil
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from catkin_pkg.package import parse_package
from refusal import refused

import imu_calibration
from imu_calibration.api import resources
from imu_calibration.cli.parser import VERBS
from imu_calibration.core.errors import InputError
from imu_calibration.effects.catalogue import CATALOGUE
from msg_adapters.bag import DEFAULT_TOPICS
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = {
    'imu_calibration',
    'calibration_node',
    'compensator_node',
    'simulator_node',
    'bag_player_node',
    'planner_node',
}
FOREIGN = {'ekf_node', 'ekf_filter_node'}
"""Of robot_localization, started only where that is asked for."""
ROSDEP_KEYS = {
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'yaml': 'python3-yaml',
    'jinja2': 'python3-jinja2',
    'matplotlib': 'python3-matplotlib',
    'tqdm': 'python3-tqdm',
    'urdf_parser_py': 'urdfdom_py',
    # installed with its user
    'markupsafe': 'python3-jinja2',
}
INDEX = ROOT / 'test/project/rosdep_noble.yaml'
NOBLE = {key: rule['ubuntu']['noble'][0] for key, rule in yaml.safe_load(INDEX.read_text()).items()}
"""Key -> the package of Ubuntu 24.04 or of ROS Jazzy that rosdep installs for it."""
EXTRAS = {'dask', 'foxglove'}
"""Installed by those who ask for the extra of that name; the code goes without."""
READ_SETUP = """
import json, setuptools
from distutils.core import run_setup
found = run_setup('setup.py', stop_after='init')
print(json.dumps({'name': found.get_name(), 'version': found.get_version(),
                  'packages': found.packages, 'requires': found.install_requires,
                  'scripts': found.entry_points['console_scripts'], 'data': found.data_files,
                  'oldest_python': str(found.python_requires),
                  'classifiers': found.get_classifiers(), 'url': found.get_url(),
                  'page': found.get_long_description(), 'package_data': found.package_data,
                  'extras': found.extras_require, 'license': found.get_license()}))
"""


@pytest.fixture(scope='module')
def installed():
    """What setup.py declares."""
    done = subprocess.run(
        [sys.executable, '-c', READ_SETUP],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope='module')
def manifest():
    """What package.xml declares."""
    warnings = []
    package = parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    assert warnings == []
    package.validate()
    return package


def third_party_imports(*folders):
    """Top-level names that the code in `folders` imports from elsewhere."""
    ours = {'imu_calibration', 'msg_adapters', *sys.stdlib_module_names}
    found = set()
    for path in (p for folder in folders for p in (ROOT / folder).rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module.partition('.')[0])
    return found - ours


def pinned(name):
    """
    Lines of a constraints file and of those it includes, without comments alone and blank lines.
    """
    lines = []
    for line in (ROOT / 'constraints' / name).read_text().splitlines():
        if line.startswith('-r '):
            lines += pinned(line.split()[1])
        elif line.strip() and not line.startswith('#'):
            lines.append(line)
    return lines


def distribution(requirement):
    """Normal form of the name in a requirement."""
    return re.sub(r'[-_.]+', '-', re.match(r'[A-Za-z0-9._-]+', requirement).group()).lower()


@pytest.mark.live
def test_manifest_set_up_and_module_agree(manifest, installed):
    assert manifest.name == installed['name'] == resources.PACKAGE
    assert manifest.version == installed['version'] == imu_calibration.__version__
    assert manifest.licenses[0] == installed['license'] == 'Apache-2.0'
    assert (ROOT / manifest.licenses[0].file).is_file()
    assert manifest.get_build_type() == 'ament_python'
    assert manifest.urls[0].url == installed['url']


@pytest.mark.live
def test_the_page_of_the_package_index_has_absolute_links(installed):
    targets = re.findall(r'\]\(([^)]+)\)', installed['page'])
    assert len(targets) >= 10
    assert {target.startswith(installed['url']) for target in targets} == {True}
    for target in targets:
        path = target.removeprefix(installed['url']).split('/main/')[1]
        assert (ROOT / path.partition('#')[0]).is_file()


@pytest.mark.live
def test_types_of_both_packages_are_installed_for_type_checkers(installed):
    for package in ('imu_calibration', 'msg_adapters'):
        assert 'py.typed' in installed['package_data'][package]
        assert (ROOT / package / 'py.typed').is_file()


def test_every_key_of_the_manifest_is_one_that_rosdep_knows(manifest):
    """By the table, and by rosdep itself where it is installed and has its lists."""
    keys = {
        dependency.name
        for dependency in (*manifest.exec_depends, *manifest.test_depends, *manifest.build_depends)
    }
    assert keys <= set(NOBLE), keys - set(NOBLE)
    # A Debian package depends on Debian packages; pip installs none.
    assert [key for key in keys if not NOBLE[key].startswith(('python3-', 'ros-jazzy-'))] == []
    rosdep = shutil.which('rosdep')
    known = rosdep and subprocess.run(
        [rosdep, 'resolve', 'python3-numpy', '--os=ubuntu:noble'],
        capture_output=True,
        text=True,
        timeout=120,
    )
    if not known or known.returncode:
        return
    for key in sorted(keys):
        done = subprocess.run(
            [rosdep, 'resolve', key, '--rosdistro=jazzy', '--os=ubuntu:noble'],
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0 and NOBLE[key] in done.stdout.split(), (
            key,
            done.stdout,
            done.stderr,
        )


OPTIONAL = {'dask', 'distributed', 'foxglove', 'lz4', 'rosbags', 'typing_extensions'}
"""
Extras of setup.py that only their own option needs; readers of bags that rosbag2_py replaces; a
module for type checkers only.
"""


def test_the_manifest_declares_what_the_code_imports(manifest):
    declared = {dependency.name for dependency in manifest.exec_depends}
    imported = third_party_imports('imu_calibration', 'msg_adapters', 'launch') - OPTIONAL
    assert {ROSDEP_KEYS.get(name, name) for name in imported - EXTRAS} <= declared


@pytest.mark.live
def test_console_scripts_are_those_of_the_contract_and_exist(installed):
    targets = dict(re.split(r'\s*=\s*', script) for script in installed['scripts'])
    assert set(targets) == EXECUTABLES
    for target in targets.values():
        module, function = target.split(':')
        path = ROOT.joinpath(*module.split('.'))
        path = path / '__init__.py' if path.is_dir() else path.with_suffix('.py')
        names = {
            node.name
            for node in ast.parse(path.read_text()).body
            if isinstance(node, ast.FunctionDef)
        }
        assert function in names, target


@pytest.mark.live
def test_every_python_package_and_data_file_is_installed(installed):
    folders = {
        path.parent
        for package in ('imu_calibration', 'msg_adapters')
        for path in (ROOT / package).rglob('*.py')
    }
    assert set(installed['packages']) == {
        '.'.join(folder.relative_to(ROOT).parts) for folder in folders
    }
    listed = {name for _, names in installed['data'] for name in names}
    present = {
        str(path.relative_to(ROOT))
        for pattern in ('config/*', 'launch/*.launch.py')
        for path in ROOT.glob(pattern)
    }
    assert present | {'package.xml', 'resource/imu_calibration'} == listed
    others = {
        path
        for path in (ROOT / 'imu_calibration').rglob('*')
        if path.is_file() and path.suffix not in ('.py', '.pyc') and path.name != 'py.typed'
    }
    assert {str(path.parent.relative_to(ROOT)) for path in others} <= {
        'imu_calibration/report/templates'
    }


@pytest.mark.live
@pytest.mark.parametrize('name', ['pypi.txt', 'jazzy-ubuntu2404.txt', 'oldest.txt'])
def test_every_requirement_is_pinned_once_with_a_reason(name, installed):
    lines = pinned(name)
    for line in lines:
        requirement, _, reason = line.partition('#')
        assert re.fullmatch(
            r'[\w.-]+==[\w.]+(; python_version < "3\.\d+")?', requirement.strip()
        ), line
        assert len(reason.split()) >= 2, f'why is this needed? {line}'
    names = [distribution(line) for line in lines]
    assert len(names) == len(set(names))
    assert {distribution(requirement) for requirement in installed['requires']} <= set(names)


def test_pins_are_those_that_the_advisories_require():
    """Except Fast DDS in security mode, which is named with the version that is needed."""
    versions = {}
    for line in pinned('pypi.txt'):
        versions[distribution(line)] = re.search(r'==([\w.]+)', line).group(1)
    rows = re.findall(
        r'^\| (.+?) \| ([\d.]+) \| ([\d.]+)[^|]* \| [^|]*(?:CVE-\d{4}-\d+|GHSA-)',
        (ROOT / 'SECURITY.md').read_text(),
        re.MULTILINE,
    )
    assert len(rows) >= 7
    too_old = []
    for package, needed, stated in rows:
        name = {'Fast DDS, security mode': 'ros-fastrtps'}.get(package, package)
        assert stated == versions[distribution(name)], package
        if [int(part) for part in stated.split('.')] < [int(part) for part in needed.split('.')]:
            too_old.append(package)
    assert too_old == ['Fast DDS, security mode']


@pytest.mark.live
def test_the_oldest_versions_pinned_are_those_that_set_up_allows(installed):
    oldest, newest = (
        {distribution(line): re.search(r'==([\w.]+)', line).group(1) for line in pinned(name)}
        for name in ('oldest.txt', 'pypi.txt')
    )
    extras = [
        requirement for requirements in installed['extras'].values() for requirement in requirements
    ]
    for requirement in [*installed['requires'], *extras]:
        name, least = re.match(r'([\w.-]+)>=([\d.]+)', requirement).groups()
        tested = (oldest if distribution(name) in oldest else newest)[distribution(name)]
        assert f'{tested}.'.startswith(f'{least}.'), requirement


@pytest.mark.live
def test_one_oldest_python_is_declared_linted_and_stated(installed):
    """The linter knows the syntax of that version, mypy the names of its standard library."""
    major, minor = installed['oldest_python'].removeprefix('>=').split('.')
    assert f'target-version = "py{major}{minor}"' in (ROOT / 'ruff.toml').read_text()
    assert f'python_version = {major}.{minor}\n' in (ROOT / 'mypy.ini').read_text()
    assert f'version_info < ({major}, {minor}))' in (ROOT / 'Makefile').read_text()
    assert f'Python {major}.{minor} or later' in (ROOT / 'README.md').read_text()
    versions = [name.split()[-1] for name in installed['classifiers'] if ':: 3.' in name]
    assert versions[0] == f'{major}.{minor}'


def test_no_format_needs_a_later_python_than_the_oldest():
    """Neither ruff nor mypy knows that the sign option z came with Python 3.11."""
    found = []
    for package in ('imu_calibration', 'msg_adapters', 'launch'):
        for path in (ROOT / package).rglob('*.py'):
            text = path.read_text()
            if not re.search(r'\{.*:.?[-+ ]?z', text):
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FormattedValue) and node.format_spec is not None:
                    if re.match(r"f'.?[-+ ]?z", ast.unparse(node.format_spec)):
                        found.append(f'{path.name}:{node.lineno}')
    assert found == []


def test_the_readme_has_the_equation():
    text = (ROOT / 'README.md').read_text()
    assert 'measured = bias + matrix @ (true + lever-arm terms) + further effects' in text


def test_every_file_that_a_make_target_runs_exists():
    makefile = (ROOT / 'Makefile').read_text()
    scripts = set(re.findall(r'\$\(PY\) (\w+/\w+\.py)', makefile))
    assert {'examples/demo.py', 'examples/live_demo.py', 'benchmarks/run.py'} <= scripts
    assert {script for script in scripts if not (ROOT / script).is_file()} == set()


def test_workflows_call_targets_of_the_makefile_and_every_supported_python():
    targets = set(re.findall(r'^([a-z-]+):', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    called, versions = [], []
    for path in sorted((ROOT / '.github/workflows').glob('*.yml')):
        for job in yaml.safe_load(path.read_text())['jobs'].values():
            versions += job.get('strategy', {}).get('matrix', {}).get('python', [])
            called += [step['run'] for step in job['steps'] if 'run' in step]
    assert [line for line in called if not line.startswith('make ')] == []
    goals = {goal for line in called for goal in line.split()[1:]}
    assert goals <= targets
    assert {'lint', 'test-fast', 'test-live', 'test-long', 'docs', 'readme-check'} <= goals
    declared = re.findall(r'Python :: (3\.\d+)', (ROOT / 'setup.py').read_text())
    assert versions == declared


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'launch').glob('*.launch.py')), ids=lambda path: path.name
)
def test_launch_files_name_executables_and_config_files_that_exist(path):
    text = path.read_text()
    ast.parse(text)
    nodes = set(re.findall(r'\b(\w+_node)\b', text)) - FOREIGN
    assert nodes and nodes <= EXECUTABLES
    files = set(re.findall(r"CONFIG, '(\w+\.yaml)'", text)) | (
        {f'{node}.yaml' for node in nodes} if '{name}.yaml' in text else set()
    )
    assert files and all((ROOT / 'config' / name).is_file() for name in files)


def test_node_parameter_files_hold_one_documented_set_for_any_node_name():
    for path in (ROOT / 'config').glob('*_node.yaml'):
        assert path.stem in EXECUTABLES
        ((name, group),) = yaml.safe_load(path.read_text()).items()
        assert name == '/**' and set(group) == {'ros__parameters'}
        lines = path.read_text().splitlines()
        for parameter in group['ros__parameters']:
            row = next(
                i for i, line in enumerate(lines) if line.strip().startswith(f'{parameter}:')
            )
            assert lines[row - 1].strip().startswith('#') or '#' in lines[row], (
                f'{path.name}: {parameter} has no comment'
            )


def test_the_groups_of_diagnostics_have_each_publishing_node_once():
    """A status is named NODE: SUBJECT, hence its group by the beginning of its name."""
    nodes = ROOT / 'imu_calibration' / 'nodes'
    publishing = []
    for name in sorted(EXECUTABLES - {'imu_calibration'}):
        text = (nodes / f'{name}.py').read_text()
        if re.search(r'^from imu_calibration\.nodes\.\w*diagnostics import', text, re.MULTILINE):
            publishing.append(name)
    period = re.search(
        r'^DIAGNOSTICS_SECONDS = ([\d.]+)$', (nodes / 'diagnostics.py').read_text(), re.MULTILINE
    )
    document = yaml.safe_load((ROOT / 'config/diagnostic_aggregator.yaml').read_text())
    groups = document['/**']['ros__parameters']
    assert groups.pop('path') == 'IMU'
    grouped = []
    for group in groups.values():
        assert group['type'] == 'diagnostic_aggregator/GenericAnalyzer'
        assert group['timeout'] > 2 * float(period.group(1))
        grouped += group['startswith']
    assert sorted(grouped) == publishing


IMU_FIELDS = {
    f'{sensor}/{axis}' for sensor in ('linear_acceleration', 'angular_velocity') for axis in 'xyz'
}
SHOWN = {
    'imu.plotjuggler.xml': {'/imu/data_raw', '/imu/data_corrected', '/imu/residual'},
    'coverage.foxglove.json': {'/imu/coverage', '/diagnostics', '/imu/residual'},
    'coverage.rviz': {'/imu/coverage'},
}
"""Layout -> the topics it shows."""


@pytest.mark.parametrize('layout', SHOWN)
def test_a_layout_shows_fields_of_topics_that_the_nodes_have(layout):
    """Each absolute name is a topic that a node publishes or reads; of an Imu each field."""
    types = {DEFAULT_TOPICS[IMU_TYPE]: 'Imu'}
    for path in (ROOT / 'imu_calibration/nodes').glob('*.py'):
        for kind, topic in re.findall(r"create_publisher\((\w+), '([\w/]+)'", path.read_text()):
            types['/' + topic.lstrip('/')] = kind
    for sensor in ('linear_acceleration', 'angular_velocity'):
        assert f'geometry_msgs/Vector3 {sensor}' in standard_definition(IMU_TYPE).text
    shown = {}
    text = (ROOT / 'config' / layout).read_text()
    for name in re.findall(r'(?:"|Value: )(/[\w/.]+)', text):
        topic = next((topic for topic in types if re.match(rf'{topic}\b', name)), name)
        shown.setdefault(topic, set()).add(name[len(topic) + 1 :].replace('.', '/'))
    assert shown == {
        topic: IMU_FIELDS if types[topic] == 'Imu' else {''} for topic in SHOWN[layout]
    }


def test_links_of_the_documents_lead_somewhere():
    for document in [*ROOT.glob('*.md'), *ROOT.glob('docs/**/*.md')]:
        for target in re.findall(r'\]\(([^)#:]+)\)', document.read_text()):
            assert (document.parent / target).exists(), f'{document.name}: {target}'


def test_config_files_are_found_in_the_checkout():
    assert resources.share_folder() == ROOT
    assert resources.config_file('tolerances.yaml') == ROOT / 'config' / 'tolerances.yaml'


def test_an_unknown_config_file_is_refused_with_those_there_are():
    with refused(InputError, 'config_file_unknown', 'nothing.yaml', 'tolerances.yaml'):
        resources.config_file('nothing.yaml')


@pytest.mark.parametrize(
    'layout', ['lib/python3.11/site-packages', 'local/lib/python3.12/dist-packages']
)
def test_an_installation_answers_for_itself(tmp_path, monkeypatch, layout):
    def share(prefix):
        (prefix / 'share' / resources.PACKAGE / 'config').mkdir(parents=True)
        (prefix / 'share' / resources.PACKAGE / 'package.xml').touch()
        return prefix / 'share' / resources.PACKAGE

    own, other = share(tmp_path / 'own'), share(tmp_path / 'other')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'other'))
    monkeypatch.setattr(
        resources, '__file__', str(tmp_path / 'own' / layout / resources.PACKAGE / 'resources.py')
    )
    assert resources.share_folder() == own
    monkeypatch.setattr(
        resources, '__file__', str(tmp_path / 'elsewhere' / resources.PACKAGE / 'resources.py')
    )
    assert resources.share_folder() == other


def test_the_tolerances_file_covers_the_catalogue_with_its_defaults():
    listed = yaml.safe_load((ROOT / 'config' / 'tolerances.yaml').read_text())
    flat = {
        (sensor, name): value for sensor, group in listed.items() for name, value in group.items()
    }
    declared = {
        (effect.sensor, effect.name): effect.tolerance for effect in CATALOGUE.effects().values()
    }
    assert flat == pytest.approx(declared, rel=1e-5)


def test_the_map_has_each_verb_and_functions_that_exist():
    rows = [
        line.split(' | ')
        for line in (
            (ROOT / 'CONTRIBUTING.md').read_text().split('## Map')[1].split('## ')[0].splitlines()
        )
        if line.startswith('| ')
    ]
    verbs = {verb for row in rows[2:] for verb in row[0].strip('| ').split(', ')} - {
        'table',
        'by hand',
    }
    assert verbs == set(VERBS)
    for name in re.findall(r'`([a-z_.0-9]+\.\w+)`', ''.join(row[1] for row in rows[2:])):
        module, _, function = name.rpartition('.')
        assert callable(
            getattr(
                import_module(
                    module if module.startswith('msg_adapters') else f'imu_calibration.{module}'
                ),
                function,
            )
        ), name


@pytest.mark.parametrize('folder', ['examples', 'benchmarks', 'validation', 'tools'])
def test_scripts_import_names_that_the_package_has(folder):
    """
    No lane runs every script; a name that was moved or removed would be noticed by a user first.
    """
    if find_spec('rclpy') is None:
        pytest.skip('scripts import nodes, and there is no ROS here')

    def known(module, name):
        return (
            hasattr(found := import_module(module), name)
            or hasattr(found, '__path__')
            and find_spec(f'{module}.{name}') is not None
        )

    lacking = []
    for path in sorted((ROOT / folder).rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or '').split('.')[0] in (
                'imu_calibration',
                'msg_adapters',
            ):
                lacking += [
                    f'{path.name}: {node.module}.{alias.name}'
                    for alias in node.names
                    if not known(node.module, alias.name)
                ]
    assert not lacking
