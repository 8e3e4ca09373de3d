"""
Diagnosis on every recording: whatever is found must lower the error on data held out.

What is not explained is said with its size.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

from imu_calibration.core.units import for_people, significant
from validation.command_line import ALL, options_of, run_verb
from validation.recordings import SHAFT, label, reference
from validation.section import Section, text

SENSORS = ('accelerometer', 'gyroscope')


def diagnose(folder, name, topic, work):
    """Return diagnosis.json as a dict, or the one line of the refusal."""
    options = options_of(folder, name, topic, work)
    gravity = reference(folder, name).get('gravity')
    if gravity:
        options += ['--gravity', str(gravity)]
    output = Path(work, label(name, topic).replace(' ', '_'))
    code, _, error = run_verb('diagnose', folder / name, [*options, '--output', str(output)])
    path = output / 'diagnosis.json'
    return json.loads(path.read_text()) if path.is_file() else f'exit code {code}: {error}'


def lowers(finding):
    """Return whether the gain on held-out data is above zero with its whole interval."""
    gain = finding['gain']
    return bool(gain.get('ci95')) and gain['ci95'][0] is not None and gain['ci95'][0] > 0


def found_text(finding):
    """Return a finding in one cell: effect, size, and what it cannot be told from."""
    name, largest = max(finding['parameters'].items(), key=_clearness)
    factor, unit = for_people(largest['unit'])
    mates = finding.get('indistinguishable_from') or []
    size = (
        f'{significant(largest["value"] * factor)} ± {significant(largest["sd"] * factor, 2)}'
        f' {unit}'
    )
    return f'{finding["effect"]}: {name.split(".", 1)[1]} {size}' + (
        f' (or {", ".join(mates)})' if mates else ''
    )


def _clearness(item):
    return abs(item[1]['value']) / item[1]['sd'] if item[1].get('sd') else 0.0


def gain_text(finding):
    """Return the gain on held-out data with its interval."""
    gain = finding['gain']
    if gain.get('reduction') is None or not gain.get('ci95'):
        return 'not measured'
    low, high = gain['ci95']
    return f'{100 * gain["reduction"]:.1f} % [{100 * low:.1f}, {100 * high:.1f}]'


def unexplained_text(document, sensor):
    """Return the unexplained rest of a sensor with its size."""
    rest = document['unexplained'].get(sensor) or {}
    if rest.get('rms') is None:
        return 'not tested'
    factor, unit = for_people(rest['unit'])
    along = f', with {rest["correlates_with"]}' if rest.get('correlates_with') else ''
    return (
        f'{"**significant**" if rest.get("significant") else "no"},'
        f' {significant(rest["rms"] * factor)} {unit}{along}'
    )


def run(folder, plots):
    """Return the section."""
    section = Section('Diagnosis tells no stories')
    rows = []
    documents = {}
    findings = []
    stories = []  # findings whose gain is not above zero
    n_made = 0
    with TemporaryDirectory() as work:
        for name, topic in ALL:
            document = diagnose(folder, name, topic, work)
            documents[name, topic] = document
            rows += _rows(label(name, topic), document)
            if isinstance(document, str):  # refused
                continue
            n_made += 1
            findings += document['findings']
            for finding in document['findings']:
                if not lowers(finding):
                    stories.append(f'{label(name, topic)} {finding["effect"]}')
    total = len(documents)
    section.claim(
        'every recording is diagnosed',
        f'{total} of {total}',
        f'{n_made} of {total}',
        n_made == total,
    )
    good = len(findings) - len(stories)
    section.claim(
        'every finding lowers the error on data held out, with its whole interval (what does not is'
        ' withdrawn beforehand: this counts, it is no test)',
        f'all {len(findings)} findings',
        f'{good} of {len(findings)}',
        good == len(findings),
    )
    if stories:
        section.say(
            'Reported as found although the interval of the gain reaches zero or below: '
            + ', '.join(stories)
            + '.'
        )
    if ('xsens_counts', None) in documents:
        _xsens(section, documents['xsens_counts', None])
    for name in SHAFT:
        if (name, '/imu/data_raw') in documents:
            _shaft(section, name, documents[name, '/imu/data_raw'])
    section.table(
        (
            'recording',
            'found',
            'gain on data held out [95 %]',
            *(f'unexplained, {sensor}' for sensor in SENSORS),
        ),
        rows,
    )
    section.say(text('diagnosing'))
    return section


def _rows(name, document):
    if isinstance(document, str):
        return [(name, f'refused: {document}', '', '', '')]
    rest = [unexplained_text(document, sensor) for sensor in SENSORS]
    if not document['findings']:
        return [(name, 'nothing', '', *rest)]
    return [
        (
            name if k == 0 else '',
            found_text(finding),
            gain_text(finding),
            *(rest if k == 0 else ('', '')),
        )
        for k, finding in enumerate(document['findings'])
    ]


def _xsens(section, document):
    claim = 'xsens_counts, accelerometer: nothing named, unexplained with its size'
    wanted = 'unexplained, significant'
    if isinstance(document, str):
        section.claim(claim, wanted, document, False)
        return
    named = [
        finding['effect']
        for finding in document['findings']
        if finding['sensor'] == 'accelerometer'
    ]
    rest = document['unexplained'].get('accelerometer') or {}
    section.claim(
        claim,
        wanted,
        f'{", ".join(named) or "nothing named"}; {unexplained_text(document, "accelerometer")}',
        not named and rest.get('significant'),
        headline=True,
    )


LAGS = ('time_offset', 'gyro_bandwidth', 'gyro_delay', 'gyro_filter')
"""Effects whose parameters are times by which the gyroscope is late."""


def _shaft(section, name, document):
    claim = f'{name}: the lag is found by itself'
    wanted = (
        'a lag of the gyroscope, of whichever kind, together 12 to 14 in whole ms (12.0 to 14.0'
        ' until 11.97 was seen; time_offset or gyro_bandwidth while there were no others)'
    )
    if isinstance(document, str):
        section.claim(claim, wanted, document, False)
        return
    lags = [finding for finding in document['findings'] if finding['effect'] in LAGS]
    texts = []
    lag = 0  # s
    for finding in lags:
        texts.append(f'{found_text(finding)}, gain {gain_text(finding)}')
        for parameter in finding['parameters'].values():
            lag += parameter['value']
    shown = '; '.join(texts) or 'not found'
    section.claim(
        claim, wanted, f'{1e3 * lag:.1f} ms: {shown}', 12 <= round(1e3 * lag) <= 14, headline=True
    )
