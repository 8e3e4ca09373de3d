"""
The pages in docs/answers: their commands run, and print the numbers and names of the pages.

Sentences may change.
"""

import re
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'examples'))

import answer_pictures
import answers
from without_search import candidates_in_scripts

from worlds.no_reports import without_reports

SEARCHED = (
    'accel_size_effect+gyro_bias_drift+gyro_bias_trend+gyro_g_sensitivity+gyro_thermal_bias'
    '+time_offset'
)
"""Effects that the pages name, and others."""
KEY = re.compile(r'[A-Za-z]\w*(?:[./]\w+)+|[A-Za-z]+_\w+')
"""Names of parameters, effects, files, topics and units."""
NUMBER = re.compile(r'[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?')
LAST_DIGITS = {'rel': 0.05, 'abs': 1e-3}
"""
Printed numbers have three significant digits, of which the last differ from machine to machine; a
chance below 1e-3 has none.
"""


def same(found, wanted):
    """Return whether two texts have the same names, in any order, and the same numbers."""
    numbers = [
        [float(number) for number in NUMBER.findall(KEY.sub(' ', text.replace('−', '-')))]
        for text in (found, wanted)
    ]
    return Counter(KEY.findall(found)) == Counter(KEY.findall(wanted)) and numbers[
        0
    ] == pytest.approx(numbers[1], **LAST_DIGITS)


def test_pages_differ_by_their_names_and_numbers_only():
    text = 'gyroscope.bias.z is determined, its sd is 0.240 of its tolerance (calibration.yaml)'
    assert same('calibration.yaml: sd / tolerance 0.241 for gyroscope.bias.z', text)
    for other in (
        text.replace('0.240', '0.270'),
        text.replace('bias.z', 'bias.y'),
        text + ' 2',
        text.replace('calibration.yaml', 'file'),
    ):
        assert not same(other, text)


def test_there_is_a_page_and_a_picture_for_each_of_ten_questions():
    index = (ROOT / 'docs/answers/README.md').read_text()
    assert len(answers.pages()) == 10
    for page in answers.pages():
        picture = re.search(r'!\[[^]]+\]\(([^)]+)\)', page.read_text()).group(1)
        assert (page.parent / picture).stat().st_size > 1000 and f'({page.name})' in index
        assert answers.commands(page.read_text()), page.name


@pytest.mark.live
def test_a_page_is_written_with_what_its_commands_print(tmp_path):
    text = (
        'Say\n\n```console\n$ printf "a 1\\nb 2\\n"\n$ printf "c\\n" | grep -c c\nold\n```\n\nand'
        ' go on'
    )
    with answers.inside(tmp_path):
        written = answers.worked_through(text)
    assert (
        written == 'Say\n\n```console\n$ printf "a 1\\nb 2\\n"\na 1\nb 2\n$ printf "c\\n" | grep -c'
        ' c\n1\n```\n\nand go on'
    )
    with pytest.raises(ValueError, match='rm'):
        answers.run('rm -r /')


@pytest.mark.long
@pytest.mark.live
def test_the_commands_still_print_what_the_pages_say(tmp_path):
    """`make answers` writes the pages anew."""
    with answers.inside(tmp_path), candidates_in_scripts(SEARCHED), without_reports():
        for page in answers.pages():
            text = page.read_text()
            assert same(answers.worked_through(text), text), page.name
        # The picture with the loss of every target; before, two of them refused without axes.
        answer_pictures.after_calibration(tmp_path / 'loss.png')
        assert (tmp_path / 'loss.png').stat().st_size > 10_000
