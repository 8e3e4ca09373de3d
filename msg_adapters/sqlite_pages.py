"""
Table leaves of an SQLite file, many pages at once.

Only the file format's documented table b-tree is used (sqlite.org/fileformat2.html, sections 1.3 to
2.1). Rows that do not fit into one page are read by SQL; a damaged page costs its own rows only.
"""

import os
from collections.abc import Generator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imu_calibration.core.documents import open_regular

INTERIOR, LEAF = 0x05, 0x0D
PAGES_BYTES = 4 << 20
"""Bytes of pages that are read in one stretch."""
MAX_DEPTH = 20
"""Of a b-tree by the file format's page numbers; deeper means a loop in a damaged file."""

_INTEGER_SIZE = np.array([0, 1, 2, 3, 4, 6, 8, 8, 0, 0, 0, 0], dtype=np.int64)
"""Bytes of a value by its serial type (file format, section 2.1)."""


PADDING_BYTES = 64
"""Zeros after the pages, so that six varints never exceed the buffer."""


class MessageRows(NamedTuple):
    """Rows of the table `messages`, in the order of their ids."""

    buffer: np.ndarray
    """Pages, uint8."""
    row_id: np.ndarray
    """Primary keys, int64, shape (n,)."""
    topic_id: np.ndarray
    """Topics, int64, shape (n,)."""
    start: np.ndarray
    """First byte of the data in `buffer`, int64, shape (n,)."""
    size: np.ndarray
    """Bytes of the data, int64, shape (n,)."""
    inside: np.ndarray
    """False where the data continue in overflow pages, bool, shape (n,)."""
    received_at: np.ndarray
    """First byte of the receive time in `buffer`, int64, shape (n,)."""
    received_type: np.ndarray
    """Serial type of the receive time, int64, shape (n,)."""

    def received_ns(self, index: np.ndarray) -> np.ndarray:
        """Return the receive times of some rows, int64."""
        return _integer(self.buffer, self.received_at[index], self.received_type[index])


class PageReader:
    """
    Reads the leaves below one root page in the order of the row ids.

    When inner pages are damaged or the file is truncated, all leaves of the file are read in their
    order instead: the inner page above the first rows of a table is often much later in the file.
    """

    def __init__(self, path: Path, root: int):
        self.file = open_regular(path)
        header = self.file.read(100)
        size = int.from_bytes(header[16:18], 'big')
        self.page_size = 65536 if size == 1 else size
        self.usable = self.page_size - header[20]
        self.stretch_pages = PAGES_BYTES // self.page_size
        self.n_pages = os.fstat(self.file.fileno()).st_size // self.page_size
        self.root = root
        self.damaged_pages, self.damaged_rows = 0, 0
        self.last_id: int | None = None
        for _ in self._leaves():
            pass
        self.scanning = self.damaged_pages > 0
        if self.scanning:
            self.damaged_pages = max(
                int.from_bytes(header[28:32], 'big') - self.n_pages, self.damaged_pages
            )

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def stretches(self) -> Generator[tuple[np.ndarray, np.ndarray], None, None]:
        """Yield (buffer, starts of the pages in it) over the leaves."""
        if self.scanning:
            for first in range(1, self.n_pages + 1, self.stretch_pages):
                yield self._read(
                    np.arange(first, min(first + self.stretch_pages, self.n_pages + 1))
                )
            return
        waiting = np.zeros(0, dtype=np.int64)
        for leaves in self._leaves():  # of one inner page: many where the pages are large
            waiting = np.concatenate([waiting, leaves])
            while len(waiting) >= self.stretch_pages:
                yield self._read(waiting[: self.stretch_pages])
                waiting = waiting[self.stretch_pages :]
        if len(waiting):
            yield self._read(waiting)

    def rows(self, buffer: np.ndarray, starts: np.ndarray) -> MessageRows:
        """Parse the leaves of a stretch; invalid pages and rows are counted and omitted."""
        whole = buffer[starts] == LEAF
        if not self.scanning:
            self.damaged_pages += int((~whole).sum())
        starts = starts[whole]
        word = np.ndarray((max(len(buffer) - 1, 0),), '>u2', buffer, strides=(1,))
        n_cells = word[starts + 3].astype(np.int64)
        n_cells[8 + 2 * n_cells > self.usable] = 0
        page = np.repeat(starts, n_cells)
        number = np.arange(n_cells.sum()) - np.repeat(np.cumsum(n_cells) - n_cells, n_cells)
        page_end = page + self.usable
        cell = np.minimum(page + word[page + 8 + 2 * number], page_end)
        rows, sensible = _parse_cells(buffer, cell, page_end, self.usable - 35)
        if self.scanning:
            sensible &= self._ascending(
                rows.row_id, sensible
            )  # other tables, and old copies of pages
        else:
            self.damaged_rows += int((~sensible).sum())
        return (
            rows
            if sensible.all()
            else MessageRows(buffer, *(column[sensible] for column in rows[1:]))
        )

    def _ascending(self, row_id, sensible):
        """Return where the row ids exceed the largest earlier one."""
        lowest = np.iinfo(np.int64).min
        ids = np.where(sensible, row_id, lowest)
        before = np.maximum.accumulate(
            np.concatenate([[lowest if self.last_id is None else self.last_id], ids])
        )
        self.last_id = int(before[-1])
        return ids > before[:-1]

    def _leaves(self):
        """Yield arrays of the numbers of all leaves below the root."""
        self.is_seen = np.zeros(self.n_pages + 1, dtype=bool)
        yield from self._leaf_groups(np.array([self.root]), 0)

    def _leaf_groups(self, pages, depth):
        """
        Yield arrays of leaf page numbers below `pages`, all of one level.

        A page listed several times, or by itself, counts once.
        """
        inside = pages[(pages >= 1) & (pages <= self.n_pages)]
        inside = inside[~self.is_seen[inside]]
        inside = inside[np.sort(np.unique(inside, return_index=True)[1])]
        self.is_seen[inside] = True
        self.damaged_pages += len(pages) - len(inside)
        kind = next((kind for kind in map(self._kind, inside) if kind in (INTERIOR, LEAF)), None)
        if kind == LEAF:
            yield inside
        elif kind is None or depth == MAX_DEPTH:
            self.damaged_pages += len(inside)
        else:
            for page in inside:
                children = self._children(page)
                if children is None:
                    self.damaged_pages += 1
                else:
                    yield from self._leaf_groups(children, depth + 1)

    def _kind(self, page):
        return os.pread(self.file.fileno(), 1, (int(page) - 1) * self.page_size)[0]

    def _children(self, page):
        data = np.frombuffer(
            os.pread(self.file.fileno(), self.page_size, (int(page) - 1) * self.page_size), np.uint8
        )
        n_cells = int(data[3]) << 8 | int(data[4])
        if data[0] != INTERIOR or 12 + 2 * n_cells > self.usable:
            return None
        pointers = data[12 : 12 + 2 * n_cells].view('>u2').astype(np.int64)
        if n_cells and pointers.max() + 4 > self.page_size:
            return None
        word = np.ndarray((len(data) - 3,), '>u4', data, strides=(1,))
        return word[np.append(pointers, 8)].astype(np.int64)

    def _read(self, pages):
        """Read pages: in one piece where they are close together, otherwise run by run."""
        if np.ptp(pages) < 2 * len(pages) + 16:
            runs = [(pages.min(), pages.max() + 1)]
        else:
            ordered = np.sort(pages)
            cuts = np.flatnonzero(np.diff(ordered) > 8) + 1
            runs = [(run[0], run[-1] + 1) for run in np.split(ordered, cuts)]
        buffer = np.empty(
            sum(int(last - first) for first, last in runs) * self.page_size + PADDING_BYTES,
            dtype=np.uint8,
        )
        buffer[-PADDING_BYTES:] = 0
        filled, firsts, bases = 0, [], []
        for first, last in runs:
            size = int(last - first) * self.page_size
            _read_into(
                self.file.fileno(),
                buffer[filled : filled + size],
                (int(first) - 1) * self.page_size,
            )
            firsts.append(first)
            bases.append(filled)
            filled += size
        run = np.searchsorted(firsts, pages, side='right') - 1
        return buffer, np.array(bases)[run] + (pages - np.array(firsts)[run]) * self.page_size


def _read_into(descriptor, target, offset):
    view = memoryview(target)
    while len(view):
        n_read = os.preadv(descriptor, [view], offset)
        if n_read == 0:
            view[:] = bytes(len(view))
            return
        view, offset = view[n_read:], offset + n_read


def _parse_cells(buffer, cell, page_end, largest):
    """
    Return (MessageRows, mask of the sensible ones) for the table cells at `cell`.

    The cells must end before `page_end`.
    """
    payload_size, position = _varint(buffer, cell)
    row_id, position = _varint(buffer, position)
    header_size, field = _varint(buffer, position)
    value = position + header_size
    types = []
    for _ in range(4):  # id, topic_id, timestamp, data
        serial, field = _varint(buffer, field)
        types.append(serial)
    sizes = [_INTEGER_SIZE[np.clip(serial, 0, 11)] for serial in types[:3]]
    topic_id = _integer(buffer, value + sizes[0], types[1])
    received_at = value + sizes[0] + sizes[1]
    start = received_at + sizes[2]
    size = (types[3] - 12) >> 1
    inside = payload_size <= largest
    sensible = (
        (types[3] >= 12)
        & (types[1] < 12)
        & (types[2] < 12)
        & (field == value)
        & (value <= page_end)
    )
    sensible &= (start - position + size == payload_size) & (~inside | (start + size <= page_end))
    return (
        MessageRows(buffer, row_id, topic_id, start, size, inside, received_at, types[2]),
        sensible,
    )


def _varint(buffer, position):
    """Decode SQLite varints at `position`; return (value, position after it)."""
    byte = buffer[position]
    value, position = byte.astype(np.int64), position + 1
    if byte.max(initial=0) < 0x80:
        return value, position
    value &= 0x7F
    going = np.flatnonzero(byte & 0x80)
    for count in range(2, 10):
        if not len(going):
            break
        byte = buffer[position[going]].astype(np.int64)
        value[going] = (
            (value[going] << 8 | byte) if count == 9 else (value[going] << 7 | byte & 0x7F)
        )
        position[going] += 1
        going = going[(byte & 0x80) != 0]
    return value, position


def _integer(buffer, position, serial):
    """Decode big-endian integers by their serial types."""
    value = np.where(serial == 9, 1, 0)
    for kind in range(1, 7):
        mine = np.flatnonzero(serial == kind)
        if len(mine):
            size = int(_INTEGER_SIZE[kind])
            at = np.clip(position[mine, np.newaxis] + np.arange(size), 0, len(buffer) - 1)
            padded = np.zeros((len(mine), 8), dtype=np.uint8)
            padded[:, :size] = buffer[at]
            value[mine] = padded.view('>i8')[:, 0] >> 8 * (
                8 - size
            )  # the shift brings the sign along
    return value
