"""Random changes of bytes, of text and of the members of a zip archive."""

import io
import math
import re
import struct
import zipfile
from datetime import date

import yaml

NUMBERS = [
    0,
    1,
    2,
    3,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0xFFFF,
    1 << 24,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    1 << 45,
    (1 << 63) - 1,
    (1 << 64) - 1,
]
TOKENS = [
    'nan',
    '.nan',
    'inf',
    '-.inf',
    '1e400',
    '-1',
    '0',
    '9' * 400,
    '1' * 5000,
    '1:59:59',
    '0x10',
    'null',
    '~',
    'true',
    '[]',
    '{}',
    '[[]]',
    '{a: 1}',
    '""',
    "'",
    '"',
    '&a ',
    '*a',
    '<<: ',
    '!!python/object:os.system ',
    '!!binary x',
    '---\n',
    '\n',
    '\r',
    '\t',
    '\0',
    '\x1b[2J',
    '\ufeff',
    '\u2028',
    '\ud800',
    '%',
    '#',
    ': ',
    '- ',
    ',',
    ';',
    '[' * 50,
    '{' * 50,
    '<a>',
    '</',
    '<!--',
    '&amp;',
    '&x;',
    '<![CDATA[',
    '=cmd|x',
    '../../x',
    '/',
    'x' * 3000,
    '2000-99-99',
    '1e308',
    '-1e-320',
    'NaN',
    'Infinity',
    'imu_link',
    'outer',
]
TOKEN = re.compile(r'[^\W_][\w.+-]*|[^\w\s]')


def mutated(data, others, rng, text=False):
    """Return the data with one to four random changes; pieces of the `others` are spliced in."""
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        data = (
            _changed_text(data, others, rng)
            if text and rng.random() < 0.75
            else _changed_bytes(data, others, rng)
        )
    return data


WRONG = (
    *(None, True, '', 'text', '1e-3', -1, 0, 7, 10**40, 1e308, -1e308, math.inf, math.nan),
    *([], [1.0], [None] * 3, [math.nan] * 3, [[1.0] * 3] * 3, ['a'] * 3, {}, {'a': 1}, {1: {}}),
    *(' =1+1', date(2026, 1, 1), b'bytes', 'x' * 4000),
)
"""What a node of a document is replaced by."""


def mutated_document(data, others, rng, text=True):
    """
    Return a YAML document with one to three nodes replaced by values of other kinds.

    One of three times as any text.
    """
    if rng.random() < 0.3:
        return mutated(data, others, rng, text)
    # libyaml, where it is there, is ten times as fast.
    document = yaml.load(data, getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
    for _ in range(rng.choice((1, 1, 2, 3))):
        part, key = None, None
        inner = document
        while isinstance(inner, (dict, list)) and inner and (part is None or rng.random() < 0.8):
            part = inner
            key = rng.choice(list(part)) if isinstance(part, dict) else rng.randrange(len(part))
            inner = part[key]
        if part is None:
            break
        if rng.random() < 0.1:
            del part[key]
        else:
            part[key] = rng.choice(WRONG)
    dumper = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
    return yaml.dump(document, Dumper=dumper, default_flow_style=None, width=10**6).encode()


def mutated_archive(data, others, rng):
    """
    Return a zip archive with a change in the content of a member, so that its checksum is right.

    One of five times as any bytes.
    """
    if rng.random() < 0.2:
        return mutated(data, others, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, kind = rng.choice(sorted(members)), rng.random()
    if kind < 0.1:
        del members[name]
    elif kind < 0.2:
        members[name] = members[rng.choice(sorted(members))]
    else:  # headers are text behind the first 128 bytes
        head, body = members[name][:128], members[name][128:]
        members[name] = (
            mutated(head, [head], rng) + body
            if rng.random() < 0.3
            else head + mutated(body, [body], rng, name == 'header.npy')
        )
    target = io.BytesIO()
    with zipfile.ZipFile(target, 'w') as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return target.getvalue()


def _changed_bytes(data, others, rng):
    at, kind = rng.randrange(len(data) + 1), rng.randrange(7)
    if kind == 0 and data:
        at = min(at, len(data) - 1)
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if kind == 1:
        number = struct.pack(rng.choice('<>') + 'Q', rng.choice(NUMBERS))
        size = rng.choice((1, 2, 4, 8))
        number = number[:size] if rng.random() < 0.5 else number[-size:]
        return data[:at] + number + data[at + size :]
    length = rng.choice((1, 4, 16, 256, 4096, len(data)))
    if kind == 2:
        return data[:at] + data[at + length :]
    if kind == 3:
        return data[: at + length] + data[at:]
    if kind == 4:
        return data[:at] + rng.randbytes(min(length, 64)) + data[at + rng.choice((0, length)) :]
    other = rng.choice(others)
    start = rng.randrange(len(other) + 1)
    if kind == 5:
        return data[:at] + other[start : start + length] + data[at + rng.choice((0, length)) :]
    return data[:at]


def _changed_text(data, others, rng):
    text = data.decode(errors='replace')
    lines = text.splitlines(keepends=True)
    if rng.random() < 0.3 and lines:
        at, other = (
            rng.randrange(len(lines)),
            rng.choice(others).decode(errors='replace').splitlines(keepends=True),
        )
        lines[at : at + rng.randrange(3)] = rng.choice(
            ([], [lines[at]] * 2, [rng.choice(lines)], [rng.choice(other)] if other else [])
        )
        text = ''.join(lines)
    else:
        places = [found.span() for found in TOKEN.finditer(text)]
        start, end = rng.choice(places) if places else (0, 0)
        words = [text[slice(*rng.choice(places))]] if places else ['']
        text = (
            text[:start]
            + rng.choice((rng.choice(TOKENS), rng.choice(TOKENS), words[0], ''))
            + text[rng.choice((start, end, end, end)) :]
        )
    return text.encode(errors='surrogatepass')
