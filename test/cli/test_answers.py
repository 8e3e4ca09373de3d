"""The pages in docs/answers: their commands run, and what they print is still what stands there."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'examples'))

import answers  # noqa: E402


def masked(text):
    """Return a text without the figures, which differ in their last digits from machine to machine, and without runs of blanks."""
    lines = (re.sub(r'[-−]+ ', ' ', re.sub(r'\s+', ' ', re.sub(r'[-+]?\d[\d.]*(e[-+]?\d+)?', '#', line))).strip() for line in text.splitlines())
    return '\n'.join(lines)


def test_the_mask_hides_figures_and_nothing_else():
    assert masked('a  1.5e-3 [-2, 3] determined') == masked('a 22 [4.1,  -3] determined')
    assert masked('a 1 determined') != masked('a 1 weak')


def test_there_is_a_page_and_a_picture_for_each_of_ten_questions():
    index = (ROOT / 'docs/answers/README.md').read_text()
    assert len(answers.pages()) == 10
    for page in answers.pages():
        picture = re.search(r'!\[[^]]+\]\(([^)]+)\)', page.read_text()).group(1)
        assert (page.parent / picture).stat().st_size > 1000 and f'({page.name})' in index
        assert answers.commands(page.read_text()), page.name


@pytest.mark.live
def test_a_page_is_written_with_what_its_commands_print(tmp_path):
    text = 'Say\n\n```console\n$ printf "a 1\\nb 2\\n"\n$ printf "c\\n" | grep -c c\nold\n```\n\nand go on'
    with answers.inside(tmp_path):
        written = answers.worked_through(text)
    assert written == 'Say\n\n```console\n$ printf "a 1\\nb 2\\n"\na 1\nb 2\n$ printf "c\\n" | grep -c c\n1\n```\n\nand go on'
    with pytest.raises(ValueError, match='must be one of'):
        answers.run('rm -r /')


@pytest.mark.long
@pytest.mark.live
def test_the_commands_still_print_what_the_pages_say(tmp_path):
    """`make answers` writes the pages anew."""
    with answers.inside(tmp_path):
        for page in answers.pages():
            text = page.read_text()
            assert masked(answers.worked_through(text)) == masked(text), page.name
