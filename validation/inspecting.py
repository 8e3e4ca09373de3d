"""What `inspect` says of every recording before anything is estimated."""

import re
from tempfile import TemporaryDirectory

from validation.command_line import ALL, options_of, run_verb
from validation.recordings import label
from validation.section import Section, text

SEVERAL = 'array_2'
"""A recording with several topics of Imu messages."""


def remarks(lines):
    """
    Return what was printed below the list of topics; checks that found all well are counted only.
    """
    below = [
        line for line in (lines[lines.index('') + 1 :] if '' in lines else lines) if line.strip()
    ]
    good = [line for line in below if line.startswith('good')]
    names = ', '.join(re.split(r'\s{2,}', line)[1] for line in good)
    return [line for line in below if line not in good] + [f'good      {names}'] * bool(good)


def indented(lines):
    """Return lines with an indentation."""
    return [f'  {line}' for line in lines]


def run(folder, plots):
    """Return the section."""
    section = Section('Pre-flight: `inspect` on every recording')
    quoted = []
    refused = 0
    with TemporaryDirectory() as work:
        for name, topic in ALL:
            options = options_of(folder, name, topic, work)
            # What the motions determine stands in the section of the shaft.
            if '--table' in options:
                at = options.index('--table')
                del options[at : at + 2]
            code, lines, error = run_verb('inspect', folder / name, options)
            shown = remarks(lines)
            if code == 1:
                refused += 1
                shown = [error]
            quoted += [f'{label(name, topic)}: exit code {code}', *indented(shown)]

    # A recording in counts without its units, and one with several IMUs of which none is chosen.
    bare_code, bare_lines, _ = run_verb('inspect', folder / 'xsens_counts', [])
    several_code, several_lines, _ = run_verb('inspect', folder / SEVERAL, [])
    quoted += [
        '',
        f'xsens_counts without --nominal: exit code {bare_code}',
        *indented(remarks(bare_lines)),
        '',
        f'{SEVERAL} without --imu-topic: exit code {several_code}',
        *indented(remarks(several_lines)),
    ]
    section.claim(
        'every recording is read',
        f'{len(ALL)} of {len(ALL)}',
        f'{len(ALL) - refused} of {len(ALL)}',
        refused == 0,
    )
    names_counts = any('count' in line for line in bare_lines)
    section.claim(
        'counts are noticed when nobody says so',
        'named',
        'named' if names_counts else 'not named',
        names_counts,
    )
    # Rows of the table of topics, and headings of the topics that were inspected.
    topics = [line.split()[0] for line in several_lines if line.startswith('/imu') and ' ' in line]
    looked_at = [line for line in several_lines if line in topics]
    section.claim(
        'several topics, none chosen: every one is looked at',
        f'{len(topics)} of {len(topics)}, exit code 3: their gyroscopes clip',
        f'{len(looked_at)} of {len(topics)}, exit code {several_code}',
        looked_at == topics and several_code == 3,
    )
    section.say(text('inspecting'))
    section.quote(quoted)
    return section
