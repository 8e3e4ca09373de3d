"""
A ROS message package that no wheel has, made from its definition.

The generators and headers come with rclpy's wheels, a compiler with the system.

What `rosidl_generate_interfaces` does in CMake: C structures, the Python class, and the two type
supports that Fast DDS asks for.
"""

import json
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PREFIX = Path(sys.prefix)
SUPPORTS = ('rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c')
LIBRARIES = (
    'rosidl_runtime_c',
    'rosidl_typesupport_c',
    *SUPPORTS,
    'rosidl_typesupport_fastrtps_cpp',
    'fastcdr',
    'rcutils',
    'rmw',
)
LOADED_FIRST = """from ctypes import CDLL
from pathlib import Path

# rosidl_typesupport_c opens them by name and finds the loaded ones.
for path in Path(__file__).parent.glob('lib*.so'):
    CDLL(str(path))
"""


def why_not() -> str:
    """Return what is missing to make one, '' when nothing is."""
    compilers = [name for name in ('gcc', 'g++') if not shutil.which(name)]
    if compilers:
        return f'{compilers[0]} is not installed'
    headers = [
        path
        for path in (
            PREFIX / 'include/rosidl_runtime_c',
            Path(sysconfig.get_path('include'), 'Python.h'),
        )
        if not path.exists()
    ]
    return f'{headers[0]} is not there' if headers else ''


def make_package(
    folder: Path, package: str, messages: dict[str, str], needs: tuple[str, ...]
) -> None:
    """
    Make a package that can be imported with `folder` on the path.

    Parameters
    ----------
    folder : Path
        Empty.
    package : str
        Its name.
    messages : dict
        Name of a message -> its definition.
    needs : tuple of str
        Packages of the messages within, with wheels.

    """
    (folder / 'definitions/msg').mkdir(parents=True)
    made = folder / package
    (made / 'msg').mkdir(parents=True)
    (made / '__init__.py').write_text(LOADED_FIRST)
    for name, text in messages.items():
        (folder / f'definitions/msg/{name}.msg').write_text(text)
    _generate(folder, package, list(messages))
    sources = sorted(path for suffix in ('*.c', '*.cpp') for path in folder.rglob(suffix))
    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(lambda path: _compiled(path, folder), sources))
    own = [
        f'-l{need}__{part}'
        for need in needs
        for part in ('rosidl_generator_c', *SUPPORTS, 'rosidl_typesupport_c', 'rosidl_generator_py')
    ]
    shared = [
        'g++',
        '-shared',
        *objects,
        f'-L{PREFIX}/lib',
        f'-Wl,-rpath,{PREFIX}/lib',
        *own,
        *[f'-l{name}' for name in LIBRARIES],
    ]
    _run(
        *shared,
        '-o',
        made / f'{package}_s__rosidl_typesupport_c{sysconfig.get_config_var("EXT_SUFFIX")}',
    )
    for support in SUPPORTS:
        name = f'lib{package}__{support}.so'
        _run(*shared, f'-Wl,-soname,{name}', '-o', made / name)


def _generate(folder, package, names):
    """Write the sources."""
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_support
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    made, definitions, share = folder / package, folder / 'definitions', PREFIX / 'share'
    for name in names:
        convert_msg_to_idl(definitions, package, Path(f'msg/{name}.msg'), definitions / 'msg')

    def arguments(generator, output=made):
        path = folder / f'{generator}.json'
        path.write_text(
            json.dumps(
                {
                    'package_name': package,
                    'idl_tuples': [f'{definitions}:msg/{name}.idl' for name in names],
                    'ros_interface_dependencies': [],
                    'output_dir': str(output),
                    'template_dir': str(share / generator / 'resource'),
                    'target_dependencies': [],
                    'type_description_tuples': [
                        f'msg/{name}.idl:{made}/msg/{name}.json' for name in names
                    ],
                    'include_paths': sorted(
                        {
                            f'{path.parents[1].name}:{path.parents[1]}'
                            for path in share.glob('*/msg/*.idl')
                        }
                    ),
                }
            )
        )
        return str(path)

    generate_type_hash(arguments('rosidl_generator_type_description'))
    generate_c(arguments('rosidl_generator_c'))
    generate_typesupport_fastrtps_c(arguments(SUPPORTS[0]))
    # Its file has the name of another one.
    generate_introspection(arguments(SUPPORTS[1], folder / SUPPORTS[1] / package))
    generate_support(arguments('rosidl_typesupport_c'), list(SUPPORTS))
    generate_py(arguments('rosidl_generator_py'), ['rosidl_typesupport_c'])
    for generator in ('rosidl_generator_c', *SUPPORTS):
        template = (
            share / generator / 'resource' / f'{generator}__visibility_control.h.in'
        ).read_text()
        (made / f'msg/{generator}__visibility_control.h').write_text(
            template.replace('@PROJECT_NAME@', package).replace(
                '@PROJECT_NAME_UPPER@', package.upper()
            )
        )


def _compiled(path, folder):
    """Compile one source; return its object file."""
    import numpy

    headers = PREFIX / 'include'
    include = [
        folder,
        folder / SUPPORTS[1],
        sysconfig.get_path('include'),
        numpy.get_include(),
        headers,
        *(path for path in headers.iterdir() if path.is_dir()),
    ]
    target = path.with_suffix('.o')
    _run(
        'gcc' if path.suffix == '.c' else 'g++',
        '-O0',
        '-fPIC',
        '-w',
        '-c',
        path,
        '-o',
        target,
        *[f'-I{folder}' for folder in include],
    )
    return target


def _run(*command):
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
