#!/usr/bin/env python3
"""
Count files, code lines, tokens, functions, classes and import cycles of imu_calibration and msg_adapters; fail above the limits.

Usage: `weigh.py [ROOT] [--packages]`. A code line holds at least one token that is not a comment or a docstring (strings under fields
and constants count as docstrings). Tokens are counted on the same lines, so that a packed line does not reduce the weight. A cycle is a
set of modules that import each other by any import statement at any depth, under TYPE_CHECKING too.
"""

import argparse
import ast
import collections
import io
import pathlib
import sys
import tokenize

LIMITS = {'files': 300, 'code lines': 32_300, 'tokens': 423_500, 'raw lines of the longest file': 450, 'cycles': 0}
"""Largest weights of the product; lower them when it has become lighter."""
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER, tokenize.ENCODING}


def documented(tree):
    """Return the lines of docstrings and of bare strings in module and class bodies."""
    lines = set()
    for node in ast.walk(tree):
        body = getattr(node, 'body', None)
        if not isinstance(body, list):
            continue
        texts = body if isinstance(node, (ast.Module, ast.ClassDef)) else body[:1]
        for each in texts:
            if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant) and isinstance(each.value.value, str):
                lines.update(range(each.lineno, each.end_lineno + 1))
    return lines


def weigh(path):
    """Return (code lines, tokens, functions, classes, raw lines) of a file."""
    text = path.read_text()
    tree = ast.parse(text)
    skip, lines, tokens = documented(tree), set(), 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in LAYOUT or token.start[0] in skip:
            continue
        tokens += 1
        lines.update(range(token.start[0], token.end[0] + 1))
    kinds = collections.Counter(type(node).__name__ for node in ast.walk(tree))
    return len(lines), tokens, kinds['FunctionDef'] + kinds['AsyncFunctionDef'], kinds['ClassDef'], text.count('\n')


def imports(root, files):
    """Return module -> modules of the product that it imports."""
    names = {'.'.join(p.relative_to(root).with_suffix('').parts).removesuffix('.__init__'): p for p in files}
    graph = {}
    for name, path in names.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.update({node.module, *(f'{node.module}.{alias.name}' for alias in node.names)})
        graph[name] = {each for each in found if each in names and each != name and names[each].name != '__init__.py'}
    return graph


def cycles(graph):
    """Return the strongly connected sets of more than one module (Tarjan)."""
    index, low, stack, on, found = {}, {}, [], set(), []
    sys.setrecursionlimit(10000)

    def visit(v):
        index[v] = low[v] = len(index)
        stack.append(v)
        on.add(v)
        for w in graph[v]:
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in on:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            part = []
            while True:
                w = stack.pop()
                on.discard(w)
                part.append(w)
                if w == v:
                    break
            if len(part) > 1:
                found.append(sorted(part))

    for v in graph:
        if v not in index:
            visit(v)
    return found


def weights_of(rows, loops):
    """Return the weights that have LIMITS, from the rows of `weigh` of all files and the cycles."""
    lines, tokens, _, _, raw = zip(*rows)
    return dict(zip(LIMITS, (len(rows), sum(lines), sum(tokens), max(raw), len(loops)), strict=True))


def excess(weights):
    """Return a line for each limit that is exceeded."""
    return [f'{name} must be at most {most}, got {weights[name]}; replace or generalise code'
            for name, most in LIMITS.items() if weights[name] > most]


def main():
    """Print the figures; exit code 1 with a line for each limit that is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('root', nargs='?', default='.', type=pathlib.Path)
    parser.add_argument('--packages', action='store_true', help='print each package and each cycle')
    options = parser.parse_args()
    root = options.root.resolve()
    files = sorted(p for package in ('imu_calibration', 'msg_adapters') for p in (root / package).rglob('*.py'))
    rows = {path: weigh(path) for path in files}
    packages = collections.defaultdict(lambda: [0, 0])
    for path, row in rows.items():
        *folders, _ = path.relative_to(root).parts
        package = packages['/'.join(folders[:2])]
        package[0] += 1
        package[1] += row[0]
    loops = cycles(imports(root, files))
    weights = weights_of(rows.values(), loops)
    if options.packages:
        for name, (count, lines) in sorted(packages.items(), key=lambda each: -each[1][1]):
            print(f'  {name:34s} {count:4d} files {lines:6d} code lines')
        for loop in loops:
            print('  cycle: ' + ', '.join(loop))
    functions, classes, raw = list(zip(*rows.values()))[2:]
    print(f'{", ".join(f"{name} {weight}" for name, weight in weights.items())}, functions {sum(functions)}, classes {sum(classes)}, '
          f'files above 320 raw lines {sum(n > 320 for n in raw)}, below 50 {sum(n < 50 for n in raw)}')
    if lines := excess(weights):
        sys.exit('\n'.join(lines))


if __name__ == '__main__':
    main()
