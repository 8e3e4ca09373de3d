"""Length and language of the pages: short enough to be read, in plain technical English."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SPEC = importlib.util.spec_from_file_location('plain', ROOT / 'tools/plain.py')
plain = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(plain)
MOST_WORDS = {'README.md': 900, 'docs/turntable.md': 900, 'docs/planning.md': 900, **{path.relative_to(ROOT).as_posix(): 250 for path in (ROOT / 'docs/decisions').glob('*.md')}}
MOST_MARKERS = 10


def marker_words(path):
    """Return (words, those that are markers) of a page, without code and tables."""
    words = [word for _, _, text in plain.texts(path) for word in re.findall(r"[A-Za-z][A-Za-z'-]*", text)]
    return words, [word for word in words if word.lower() in plain.MARKERS]


@pytest.mark.parametrize('page', MOST_WORDS)
def test_a_page_is_short(page):
    assert len((ROOT / page).read_text().split()) <= MOST_WORDS[page]


@pytest.mark.parametrize('page', MOST_WORDS)
def test_a_page_is_plain(page):
    words, found = marker_words(ROOT / page)
    assert len(found) <= max(2, MOST_MARKERS * len(words) / 1000), found   # two in a page of less than 200 words


def test_markers_are_counted(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text('Nobody knows `what` stays here.\n')
    assert marker_words(page)[1] == ['Nobody', 'knows', 'stays']
