"""
Find a syntax-tree node by function and pattern, wherever the function is, and replace it.

A place is the qualified name of a function (`Class.method`, `outer.inner`) or of a constant of a
module or class. A pattern is source text that matches one expression or statement there: `_1`,
`_2`, ... stand for local variables, equal numbers for the same one; `...` stands for any
expression, or as the only statement of a block for any block. The replacement uses the same
placeholders; its n-th `...` is the n-th of the pattern. All other names, attributes and numbers
must be equal. `self` and `cls` are written as they are.
"""

import ast
import copy
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

PACKAGES = ('imu_calibration', 'msg_adapters')
PLACEHOLDER = re.compile(r'_\d+$')
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


class NotFound(Exception):
    """A place or a pattern is there never, or more than once."""


@lru_cache(maxsize=None)
def places(root):
    """
    Return {qualified name: [Place, ...]} of functions and constants.

    They are defined in the packages below `root`.
    """
    known = {}
    for package in PACKAGES:
        for file in sorted(Path(root, package).rglob('*.py')):
            tree = ast.parse(file.read_text())
            for name, node, scope in _named(tree, ''):
                known.setdefault(name, []).append(Place(file, tree, node, scope))
    return known


@dataclass(frozen=True)
class Place:
    """A function or a constant."""

    file: Path
    tree: ast.Module
    node: ast.AST
    """Definition of the function, or value of the constant."""
    scope: ast.AST | None
    """Outermost function around it, itself included."""


def _named(node, prefix, scope=None):
    """
    Yield (qualified name, node, outermost function) of each definition.

    The definitions are in a module, class or function.
    """
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield from _named(child, f'{prefix}{child.name}.', scope)
        elif isinstance(child, FUNCTION):
            yield prefix + child.name, child, scope or child
            yield from _named(child, f'{prefix}{child.name}.', scope or child)
        elif isinstance(child, ast.stmt):
            if isinstance(child, (ast.Assign, ast.AnnAssign)) and isinstance(
                node, (ast.Module, ast.ClassDef)
            ):
                yield from ((prefix + name, value, None) for name, value in _constants(child))
            yield from _named(child, prefix, scope)


def _constants(assignment):
    """Yield (name, value) of an assignment."""
    for target in assignment.targets if isinstance(assignment, ast.Assign) else [assignment.target]:
        if isinstance(target, ast.Name) and assignment.value:
            yield target.id, assignment.value
        elif isinstance(target, ast.Tuple) and isinstance(assignment.value, ast.Tuple):
            yield from (
                (each.id, value)
                for each, value in zip(target.elts, assignment.value.elts)
                if isinstance(each, ast.Name)
            )


def local_names(function):
    """Return the names of arguments and variables of a function and of the functions inside it."""
    nodes = list(ast.walk(function))
    names = {node.arg for node in nodes if isinstance(node, ast.arg)}
    names |= {
        node.id
        for node in nodes
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)
    }
    shared = {
        name
        for node in nodes
        if isinstance(node, (ast.Global, ast.Nonlocal))
        for name in node.names
    }
    return names - shared - {'self', 'cls'}


def parsed(*texts):
    """
    Return the trees of some texts.

    Expressions if all of them are expressions, otherwise statements.
    """
    try:
        return [ast.parse(text, mode='eval').body for text in texts]
    except SyntaxError:
        bodies = [ast.parse(text).body for text in texts]
    if any(len(body) != 1 for body in bodies):
        raise ValueError(
            'a pattern and its replacement must be one expression or one statement each, got'
            f' {texts}'
        )
    return [body[0] for body in bodies]


def _is_any(node):
    return isinstance(node, ast.Constant) and node.value is ...


def _is_any_block(nodes):
    return len(nodes) == 1 and isinstance(nodes[0], ast.Expr) and _is_any(nodes[0].value)


class _Match:
    """Names and nodes that the placeholders of a pattern stand for."""

    def __init__(self, names):
        self.locals, self.names, self.any = names, {}, []

    def equal(self, pattern, node):
        """Return whether a node fits; fills `names` and `any`."""
        if isinstance(pattern, list):
            if (
                isinstance(node, list)
                and _is_any_block(pattern)
                and node
                and isinstance(node[0], ast.stmt)
            ):
                self.any.append(node)
                return True
            return (
                isinstance(node, list)
                and len(pattern) == len(node)
                and all(map(self.equal, pattern, node))
            )
        if not isinstance(pattern, ast.AST):
            return type(pattern) is type(node) and pattern == node
        if _is_any(pattern) and isinstance(node, ast.expr):
            self.any.append(node)
            return True
        if type(pattern) is not type(node):
            return False
        name = {ast.Name: 'id', ast.arg: 'arg'}.get(type(pattern))
        if name and PLACEHOLDER.match(getattr(pattern, name)):
            known = self.names.setdefault(getattr(pattern, name), getattr(node, name))
            return (
                known == getattr(node, name)
                and known in self.locals
                and len(set(self.names.values())) == len(self.names)
            )
        return all(
            self.equal(getattr(pattern, field), getattr(node, field))
            for field in pattern._fields
            if field not in ('ctx', 'type_comment')
        )


class _Fill(ast.NodeTransformer):
    """Put into a replacement what the placeholders stand for."""

    def __init__(self, match):
        self.names, self.any = match.names, iter(match.any)

    def visit(self, node):
        if isinstance(node, ast.Constant) and _is_any(node):
            return copy.deepcopy(next(self.any))
        for name in ('id', 'arg'):
            if isinstance(node, (ast.Name, ast.arg)) and PLACEHOLDER.match(
                getattr(node, name, None) or ''
            ):
                setattr(node, name, self.names[getattr(node, name)])
        for name, value in ast.iter_fields(node):
            if isinstance(value, list) and _is_any_block(value):
                setattr(node, name, copy.deepcopy(next(self.any)))
        return self.generic_visit(node)


def matches(root, place, pattern, replacement):
    """
    Return [(Place, node, replacement of the node), ...] of all nodes that match.

    They are in places of a name that fit a pattern.
    """
    old, new = parsed(pattern, replacement)
    fitting = []
    for each in places(root).get(place, ()):
        if each.scope:
            names, nodes = (
                local_names(each.scope),
                [node for node in ast.walk(each.node) if node is not each.node],
            )
        else:
            names, nodes = set(), [each.node] if pattern == '...' else list(ast.walk(each.node))
        for node in nodes:
            match = _Match(names)
            if match.equal(old, node):
                fitting.append((each, node, _Fill(match).visit(copy.deepcopy(new))))
    return fitting


class _Replace(ast.NodeTransformer):
    def __init__(self, old, new):
        self.old, self.new = old, new

    def visit(self, node):
        return self.new if node is self.old else self.generic_visit(node)


def mutated(root, place, pattern, replacement):
    """
    Return (file, its text with one node replaced); comments are lost.

    Raises
    ------
    NotFound
        When the pattern does not fit exactly one node, or the replacement changes nothing.

    """
    fitting = matches(root, place, pattern, replacement)
    if len(fitting) != 1:
        raise NotFound(
            f'{place} is defined {len(places(root).get(place, ()))} times, and {pattern!r} fits'
            f' {len(fitting)} nodes there'
        )
    ((where, node, new),) = fitting
    if ast.dump(node) == ast.dump(new):
        raise NotFound(f'{place}: {pattern!r} is already {replacement!r}')
    copies = {}
    tree = copy.deepcopy(where.tree, copies)
    return where.file, ast.unparse(_Replace(copies[id(node)], new).visit(tree)) + '\n'


def path_of_test(root, name):
    """
    Return the path below `root` of a test file, or of one of its tests, from FILE or FILE::TEST.

    The folder does not matter.
    """
    file, separator, test = name.partition('::')
    files = list(Path(root, 'test').rglob(file))
    if len(files) != 1 or test and f'def {test.partition("[")[0]}(' not in files[0].read_text():
        raise NotFound(f'{name} is there {len(files)} times, or has no such test')
    return f'{files[0].relative_to(root)}{separator}{test}'
