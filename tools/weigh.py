#!/usr/bin/env python3
"""
Print tokens, statements, files and import cycles of imu_calibration and msg_adapters.

Fail if there is a cycle.

Usage: `weigh.py [ROOT] [--packages]`. Tokens and statements are counted without comments and
docstrings (strings under fields and constants count as docstrings); lines do not count, because a
limit on them rewards packing. A cycle is a set of modules that import each other by any import
statement at any depth, under TYPE_CHECKING too.
"""

import argparse
import ast
import collections
import io
import pathlib
import sys
import tokenize

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
}


def documented(tree):
    """Return the lines of docstrings and of bare strings in module and class bodies."""
    lines = set()
    for node in ast.walk(tree):
        body = getattr(node, 'body', None)
        if not isinstance(body, list):
            continue
        texts = body if isinstance(node, (ast.Module, ast.ClassDef)) else body[:1]
        for each in texts:
            if (
                isinstance(each, ast.Expr)
                and isinstance(each.value, ast.Constant)
                and isinstance(each.value.value, str)
            ):
                lines.update(range(each.lineno, (each.end_lineno or each.lineno) + 1))
    return lines


def weigh(path):
    """Return (tokens, statements) of a file."""
    text = path.read_text()
    tree = ast.parse(text)
    skip = documented(tree)
    tokens = sum(
        token.type not in LAYOUT and token.start[0] not in skip
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
    )
    statements = sum(
        isinstance(node, ast.stmt) and node.lineno not in skip for node in ast.walk(tree)
    )
    return tokens, statements


def imports(root, files):
    """Return module -> modules of the product that it imports."""
    names = {
        '.'.join(p.relative_to(root).with_suffix('').parts).removesuffix('.__init__'): p
        for p in files
    }
    graph = {}
    for name, path in names.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.update(
                    {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
                )
        graph[name] = {
            each
            for each in found
            if each in names and each != name and names[each].name != '__init__.py'
        }
    return graph


def cycles(graph):
    """Return the sets of more than one module that import each other, directly or not."""
    modules = sorted(graph)
    adjacency = np.array([[other in graph[module] for other in modules] for module in modules])
    _, labels = connected_components(csr_array(adjacency), connection='strong')
    components = collections.defaultdict(list)
    for module, label in zip(modules, labels):
        components[label].append(module)
    return [component for component in components.values() if len(component) > 1]


def main():
    """Print the figures; exit code 1 with a line for each cycle."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('root', nargs='?', default='.', type=pathlib.Path)
    parser.add_argument('--packages', action='store_true', help='print each package')
    options = parser.parse_args()
    root = options.root.resolve()
    files = sorted(
        p for package in ('imu_calibration', 'msg_adapters') for p in (root / package).rglob('*.py')
    )
    packages = collections.defaultdict(lambda: [0, 0, 0])
    for path in files:
        *folders, _ = path.relative_to(root).parts
        tokens, statements = weigh(path)
        package = packages['/'.join(folders[:2])]
        package[0] += 1
        package[1] += tokens
        package[2] += statements
    loops = cycles(imports(root, files))
    if options.packages:
        for name, (count, tokens, statements) in sorted(
            packages.items(), key=lambda each: -each[1][1]
        ):
            print(f'  {name:34s} {count:4d} files {tokens:7d} tokens {statements:6d} statements')
    count, tokens, statements = map(sum, zip(*packages.values()))
    print(f'tokens {tokens}, statements {statements}, files {count}, cycles {len(loops)}')
    if loops:
        sys.exit(
            '\n'.join(
                'modules must not import each other, these do: ' + ', '.join(loop) for loop in loops
            )
        )


if __name__ == '__main__':
    main()
