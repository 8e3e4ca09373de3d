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
MOST_IN_ALL = 20_000
WRITTEN = re.compile(r'<!-- \w+: begin -->.*?<!-- \w+: end -->', re.S)
"""What a program writes into a page."""
WRITTEN_WHOLE = {'docs/claims.md', 'docs/validation.md', 'docs/exports.md'}
"""Pages whose tables and code a program writes; in docs/answers it is the code."""
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')))


def own_words(page):
    """Return the words of a page that no program writes."""
    text = WRITTEN.sub('', (ROOT / page).read_text())
    if page in WRITTEN_WHOLE or page.startswith('docs/answers'):
        text = re.sub(r'^```.*?^```', '', text, flags=re.S | re.M)
    if page in WRITTEN_WHOLE:
        text = re.sub(r'^\|.*', '', text, flags=re.M)
    return text.split()


def test_all_pages_together_are_short():
    words = {page: len(own_words(page)) for page in PAGES}
    assert len(words) > 40 and sum(words.values()) <= MOST_IN_ALL, words


def marker_words(path):
    """Return (words, those that are markers) of a page, without code, tables and the parts that a program writes."""
    text = plain.CODE.sub(' ', WRITTEN.sub('', path.read_text()))
    lines = [line for line in text.splitlines() if not line.lstrip().startswith('|')]
    words = re.findall(r"[A-Za-z][A-Za-z'-]*", ' '.join(lines))
    return words, [word for word in words if word.lower() in plain.MARKERS]


@pytest.mark.parametrize('page', MOST_WORDS)
def test_a_page_is_short(page):
    assert len((ROOT / page).read_text().split()) <= MOST_WORDS[page]


@pytest.mark.parametrize('page', [page for page in PAGES if not page.startswith('docs/answers')])
def test_a_page_is_plain(page):
    words, found = marker_words(ROOT / page)
    assert len(found) <= max(2, MOST_MARKERS * len(words) / 1000), found   # two in a page of less than 200 words


def test_markers_are_counted(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text('Nobody knows `what` stays here.\n')
    assert marker_words(page)[1] == ['Nobody', 'knows', 'stays']
