#!/usr/bin/env python3
"""
Print back-quoted names in docstrings and comments that the code does not have.

Fail if there is one.

Usage: `quoted_names.py [ROOT]`. A name in single back quotes is a module, class, function,
argument, attribute or key of imu_calibration or msg_adapters; with dots, each part is a name in the
module or package before it. Names of files and of other packages are in double back quotes.
"""

import argparse
import ast
import pathlib
import re
import sys

PACKAGES = ('imu_calibration', 'msg_adapters')
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


def absent_names(root: pathlib.Path) -> list[str]:
    """Return a line for each back-quoted name below a folder that does not exist."""
    texts = {}
    members: dict[str, set[str]] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob('*.py')):
            texts[path] = path.read_text(encoding='utf8')
            names = names_of(ast.parse(texts[path]))
            parts = path.relative_to(root).with_suffix('').parts
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
                    lines.append(f'{path.relative_to(root)}:{number}: no such name: {quoted}')
    return lines


def main():
    """Print the names."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('root', nargs='?', default='.')
    lines = absent_names(pathlib.Path(parser.parse_args().root))
    print('\n'.join(lines) if lines else 'each back-quoted name exists')
    return int(bool(lines))


if __name__ == '__main__':
    sys.exit(main())
