"""
Rows of the table `messages` of an SQLite file, many pages at once.

Written are the documented pages of a table b-tree (sqlite.org/fileformat2.html, sections 1.3 to 2.1): leaves in the order of the ids,
overflow pages of long messages, and the inner pages above them. A varint may be longer than necessary: it has the same number of bytes for
all rows of a call.
"""

from pathlib import Path

import numpy as np

from msg_adapters.layout import Packed, overlapping
from msg_adapters.sqlite_pages import INTERIOR, LEAF

PAGE_SIZE = 16384
LOCK_PAGE = (1 << 30) // PAGE_SIZE + 1
"""The page of the lock bytes remains empty."""
MOST_LOCAL, LEAST_LOCAL = PAGE_SIZE - 35, (PAGE_SIZE - 12) * 32 // 255 - 23
"""Bytes of a row inside its leaf: without, and at least with overflow pages."""
PAGE_COUNT_AT = 28
"""Place of the number of pages in the header of the file."""


class RowWriter:
    """
    Appends rows with the ids 1, 2, ... to an empty table; no other program may use the file before `close`.

    Parameters
    ----------
    path : path-like
        A file with pages of `PAGE_SIZE`.
    root : int
        Root page of the table, which is empty.

    """

    def __init__(self, path: Path, root: int):
        self._file = open(path, 'r+b')   # closed by `close`
        self._root, self._next = root, path.stat().st_size // PAGE_SIZE + 1
        self._pages, self._last_ids = [], []   # of the leaves up to now: arrays
        self._n_rows = 0
        self._rest = Packed.join([])   # cells of the last leaf, which is not full

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """Append messages: arrays of topic ids and receive times, and the messages."""
        ids = self._n_rows + 1 + np.arange(len(messages))
        self._n_rows += len(messages)
        cells = Packed.chain([self._rest, self._cells(ids, topic_ids, received_ns, messages)])
        last_id = np.arange(self._n_rows - len(cells), self._n_rows) + 1
        ends, bounds = np.cumsum(cells.size + 2), [0]
        while (stop := int(np.searchsorted(ends, PAGE_SIZE - 8 + (ends[bounds[-1] - 1] if bounds[-1] else 0), 'right'))) < len(cells):
            bounds.append(stop)
        if len(bounds) > 1:
            self._add_leaves(cells, np.array(bounds), last_id)
        self._rest = Packed.join([cells.message(k) for k in range(bounds[-1], len(cells))])

    def close(self) -> None:
        """Write the last leaf and the inner pages, and close the file."""
        rest = np.array([0, len(self._rest)])
        if not self._pages:
            self._put(np.array([self._root]), _pages(LEAF, self._rest, rest))
        else:
            self._add_leaves(self._rest, rest, np.arange(self._n_rows - len(self._rest), self._n_rows) + 1)
            self._add_inner(np.concatenate(self._pages), np.concatenate(self._last_ids))
        self._file.seek(PAGE_COUNT_AT)
        self._file.write(int(self._next - 1).to_bytes(4, 'big'))
        self.abort()

    def abort(self) -> None:
        """Close without finishing."""
        self._file.close()

    def _cells(self, ids, topic_ids, received_ns, messages):
        kind = _varint(2 * messages.size + 12)
        header = np.concatenate([np.tile(np.array([4 + kind.shape[1], 0, 4, 6], np.uint8), (len(ids), 1)), kind, _big(topic_ids, '>i4'),
                                 _big(received_ns, '>i8')], axis=1)   # types: id (as the row id), 32 bits, 64 bits, bytes
        payload = header.shape[1] + messages.size
        head = np.concatenate([_varint(payload), _varint(ids), header], axis=1)
        fits = LEAST_LOCAL + (payload - LEAST_LOCAL) % (PAGE_SIZE - 4)
        local = np.where(payload <= MOST_LOCAL, payload, np.where(fits <= MOST_LOCAL, fits, LEAST_LOCAL)) - header.shape[1]
        long = np.flatnonzero(local < messages.size)
        size = head.shape[1] + local
        size[long] += 4
        cells = Packed(np.zeros(size.sum(), np.uint8), np.cumsum(size) - size, size)
        Packed.of_rows(head).copy_to(cells.buffer, cells.start)
        Packed(messages.buffer, messages.start, local).copy_to(cells.buffer, cells.start + head.shape[1])
        for row in long:
            first = self._add_overflow(np.frombuffer(messages.message(row), np.uint8)[local[row]:])
            cells.buffer[cells.start[row] + size[row] - 4:][:4] = _big(first, '>u4')
        return cells

    def _add_overflow(self, data):
        """Write the rest of a long message and return the number of its first page."""
        numbers = self._take(-(-len(data) // (PAGE_SIZE - 4)))
        table = np.zeros((len(numbers), PAGE_SIZE), np.uint8)
        table[:, :4] = _big(np.append(numbers[1:], 0), '>u4')
        table[:, 4:] = np.pad(data, (0, len(numbers) * (PAGE_SIZE - 4) - len(data))).reshape(len(numbers), -1)
        self._put(numbers, table)
        return numbers[:1]

    def _add_leaves(self, cells, bounds, ids):
        numbers = self._take(len(bounds) - 1)
        self._put(numbers, _pages(LEAF, cells, bounds))
        self._pages.append(numbers)
        self._last_ids.append(ids[bounds[1:] - 1])

    def _add_inner(self, children, last_ids):
        """Write the levels above pages of which the largest ids are known; the topmost page is the root."""
        cells = np.concatenate([_big(children, '>u4'), _varint(last_ids)], axis=1)
        groups = np.array_split(np.arange(len(children)), -(-len(children) // ((PAGE_SIZE - 12) // (cells.shape[1] + 2))))
        ends = np.array([group[-1] for group in groups])   # its place is in the header of the page, not in a cell
        table = _pages(INTERIOR, Packed.of_rows(np.delete(cells, ends, axis=0)), np.append(0, ends - np.arange(len(ends))))
        table[:, 8:12] = _big(children[ends], '>u4')
        numbers = self._take(len(ends)) if len(ends) > 1 else np.array([self._root])
        self._put(numbers, table)
        if len(ends) > 1:
            self._add_inner(numbers, last_ids[ends])

    def _take(self, count):
        """Return the numbers of new pages."""
        numbers = np.arange(self._next, self._next + count)
        if self._next <= LOCK_PAGE:
            numbers += numbers >= LOCK_PAGE
        self._next = int(numbers[-1]) + 1
        return numbers

    def _put(self, numbers, table):
        for rows in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) != 1) + 1):
            self._file.seek((int(numbers[rows[0]]) - 1) * PAGE_SIZE)
            self._file.write(table[rows[0]:rows[-1] + 1])


def _pages(kind, cells, bounds):
    """Return pages of one kind, uint8, shape (n, PAGE_SIZE); page k has the cells from bounds[k] to bounds[k + 1], at its end."""
    counts, header = np.diff(bounds), 12 if kind == INTERIOR else 8
    page, number = np.repeat(np.arange(len(counts)), counts), np.arange(bounds[-1]) - np.repeat(bounds[:-1], counts)
    cells, before = cells.select(slice(bounds[-1])), np.append(0, np.cumsum(cells.size[:bounds[-1]]))
    start = PAGE_SIZE - np.diff(before[bounds])
    place = start[page] + before[:-1] - before[bounds[page]]
    table = np.zeros((len(counts), PAGE_SIZE), np.uint8)
    table[:, 0] = kind
    table[:, 3:5], table[:, 5:7] = _big(counts, '>u2'), _big(start, '>u2')
    overlapping(table.reshape(-1), '>u2')[page * PAGE_SIZE + header + 2 * number] = place
    cells.copy_to(table.reshape(-1), page * PAGE_SIZE + place)
    return table


def _big(values, kind):
    """Return big-endian integers as bytes, shape (n, size)."""
    return values.astype(kind).view(np.uint8).reshape(len(values), -1)


def _varint(values):
    """Return numbers as varints of one length, shape (n, length)."""
    shifts = 7 * np.arange(max(1, -(-int(values.max(initial=0)).bit_length() // 7)))[::-1]
    found = (values[:, None] >> shifts & 0x7F | 0x80).astype(np.uint8)
    found[:, -1] &= 0x7F
    return found
