#!/usr/bin/env python3
"""
Print back-quoted names that the code does not have, and public names with two meanings.

Fail if there is one.

Usage: `quoted_names.py [ROOT]`. A name in single back quotes is a module, class, function,
argument, attribute or key of imu_calibration or msg_adapters; with dots, each part is a name in the
module or package before it. Names of files and of other packages are in double back quotes. A
public function, class or constant is defined in one module.
"""

import argparse
import ast
import pathlib
import re
import sys

PACKAGES = ('imu_calibration', 'msg_adapters')
SAME_ROLE = {
    'main': 'entry of a program',
    'EXAMPLES': 'command lines in the help of a verb',
    'add_arguments': 'options of a verb',
    'run': 'action of a verb, or of a motion',
    'TARGETS': 'exports that a module adds to the registry',
    'diagnose': 'a function of `api`, and the same in a notebook',
    'simulate': 'a function of `api`, and the same in a notebook',
}
"""Public names that several modules define -> their one meaning."""
QUOTED = re.compile(r'(?<!`)`([A-Za-z_][\w.]*)`(?!`)')


def names_of(tree: ast.AST) -> set[str]:
    """Return the names and the keys that are names in a module."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.alias):
            found.update((node.asname or node.name).split('.'))
        elif isinstance(node, ast.keyword) and node.arg:
            found.add(node.arg)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if node.value.isidentifier():
                found.add(node.value)
    return found


def absent_names(
    texts: dict[pathlib.Path, str], trees: dict[pathlib.Path, ast.Module]
) -> list[str]:
    """Return a line for each back-quoted name in the texts that the trees do not have."""
    members: dict[str, set[str]] = {}
    for path, tree in trees.items():
        names = names_of(tree)
        parts = path.with_suffix('').parts
        # A name belongs to its module and to each package above it.
        for part in parts:
            members.setdefault(part, set()).update(names, parts)
    known = set().union(*members.values())
    lines = []
    for path, text in texts.items():
        for number, line in enumerate(text.splitlines(), 1):
            for quoted in QUOTED.findall(line):
                parts = quoted.split('.')
                exists = all(part in known for part in parts)
                for home, part in zip(parts, parts[1:]):
                    exists = exists and part in members.get(home, known)
                if not exists:
                    lines.append(f'{path}:{number}: no such name: {quoted}')
    return lines


def defined_in(tree: ast.Module) -> set[str]:
    """Return the public functions, classes and constants that a module defines."""
    found = set()
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found.update(target.id for target in targets if isinstance(target, ast.Name))
    return {name for name in found if not name.startswith('_')}


def ambiguous_names(trees: dict[pathlib.Path, ast.Module]) -> list[str]:
    """Return a line for each public name that two modules define, unless its role is the same."""
    homes: dict[str, list[pathlib.Path]] = {}
    for path, tree in trees.items():
        for name in defined_in(tree) - set(SAME_ROLE):
            homes.setdefault(name, []).append(path)
    lines = []
    for name, paths in sorted(homes.items()):
        if len(paths) > 1:
            lines.append(f'{paths[1]}: must not define {name}, which {paths[0]} defines')
    return lines


def main():
    """Print the names."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('root', nargs='?', default='.')
    root = pathlib.Path(parser.parse_args().root)
    texts = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob('*.py')):
            texts[path.relative_to(root)] = path.read_text(encoding='utf8')
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lines = [*absent_names(texts, trees), *ambiguous_names(trees)]
    fine = 'each back-quoted name exists, and each public name is defined once'
    print('\n'.join(lines) if lines else fine)
    return int(bool(lines))


if __name__ == '__main__':
    sys.exit(main())
