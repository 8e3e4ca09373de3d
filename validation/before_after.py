"""
Two versions of the code on the same recordings: calibration.yaml in standard deviations, findings of diagnose, seconds.

Run as ``python validation/before_after.py OLD`` with OLD the root of the earlier version; kept while the packages are being rebuilt.
``--work`` keeps recordings and results, so that each version runs once; ``--cases`` picks some by a part of their name.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get('IMU_CALIBRATION_DATA', ROOT.parent / 'shared' / 'data'))
SHAFTS = ('shaft_pitch_slow', 'shaft_roll_fast', 'shaft_roll_fast_later', 'shaft_yaw_medium', 'shaft_yaw_slow_later')
BOARDS = tuple((name, f'/imu_{k}/data_raw') for name in ('array_2', 'array_5') for k in (1, 3, 5, 7))
BY_HAND = (('xsens_counts', None), ('mpu9150_0', None), ('mpu9150_3', None), ('ferraris', None), *BOARDS)
SIMULATED = (
    ((), ()), (('--profile', 'quick'), ()), (('--profile', 'short'), ()), (('--profile', 'random'), ()), (('--profile', 'random_short'), ()),
    (('--profile', 'separating_short'), ()), (('--profile', 'static_only'), ()), (('--grade', 'consumer'), ()),
    (('--grade', 'tactical', '--profile', 'random'), ()), (('--grade', 'navigation', '--profile', 'short'), ()),
    (('--effect', 'time_offset', '--profile', 'random_short'), ('--reference-model', 'table_tilt+time_offset')),
    (('--effect', 'gyro_bandwidth', '--profile', 'random_short'), ('--gyroscope-model', 'bias+matrix+gyro_bandwidth')),
    (('--effect', 'accel_quadratic', '--profile', 'random'), ()), (('--effect', 'gyro_g_sensitivity', '--profile', 'random'), ()),
    (('--effect', 'accel_bias_drift', '--profile', 'random'), ('--accelerometer-model', 'bias+matrix+accel_bias_drift')),
    (('--effect', 'accel_thermal_bias', '--temperature', '--profile', 'random'), ('--accelerometer-model', 'bias+matrix+accel_thermal_bias')),
    (('--effect', 'encoder_harmonic', '--profile', 'random'), ('--reference-model', 'encoder_harmonic+table_tilt')),
    (('--effect', 'table_tilt', '--effect', 'accel_cubic', '--profile', 'random'), ()),
    (('--effect', 'gyro_scale_asymmetry', '--profile', 'random'), ()), (('--encoder-resolution-deg', '0.01', '--profile', 'random'), ()))
"""(options of simulate, options of calibrate) of the simulated sessions; their number is the seed."""


def cases(work):
    """Return [(name, verb, arguments)] of everything that is compared."""
    sample = ROOT / 'bags' / 'sample_session'
    found = [('sample', verb, [sample, '--table', sample / 'table.yaml']) for verb in ('calibrate', 'diagnose')]
    for number, (_, options) in enumerate(SIMULATED):
        bag = work / 'bags' / f'simulated_{number}'
        arguments = [bag, '--table', bag / 'table.yaml']
        found += [(bag.name, 'calibrate', [*arguments, *options]), (bag.name, 'diagnose', arguments)]
    pair = [work / 'bags' / f'simulated_{number}' for number in (3, 4)]
    found.append(('two_recordings', 'calibrate', [*pair, '--table', pair[0] / 'table.yaml']))
    for name in SHAFTS:
        arguments = [DATA / name, '--table', DATA / name / 'table.yaml', '--imu-topic', '/imu/data_raw']
        found += [(name, verb, arguments) for verb in ('calibrate', 'diagnose')]
        found.append((f'{name}_lag', 'calibrate', [*arguments, '--reference-model', 'time_offset']))
    for name, topic in BY_HAND:
        label = name if topic is None else f'{name}{topic.split("/")[1]}'
        arguments = [DATA / name, *(['--imu-topic', topic] if topic else []), *_reference(name, work)]
        found += [(label, verb, arguments) for verb in ('calibrate', 'diagnose')]
    return found


def _reference(name, work):
    path = DATA / name / 'reference.yaml'
    known = yaml.safe_load(path.read_text()) if path.is_file() else {}
    options = ['--gravity', str(known['gravity'])] if known.get('gravity') else []
    if 'nominal' in known:
        path = work / f'{name}_nominal.yaml'
        path.write_text(yaml.safe_dump(known['nominal']))
        options += ['--nominal', path]
    return options


def simulate(old, work):
    """Write the simulated sessions with the old code, where they are not there yet."""
    for number, (options, _) in enumerate(SIMULATED):
        bag = work / 'bags' / f'simulated_{number}'
        if not (bag / 'table.yaml').is_file():
            seed = '3' if number == 4 else str(number)
            command = [sys.executable, '-m', 'imu_calibration', 'simulate', '--output', str(bag), '--seed', str(number), '--imu-seed', seed, *options]
            subprocess.run(command, cwd=old, env={**os.environ, 'PYTHONPATH': str(old)}, check=True, capture_output=True)


def run(root, chosen, results):
    """Run verbs in this process with the code in `root`; results go to `results`."""
    sys.path.insert(0, str(root))
    from imu_calibration.cli.parser import make_parser
    from imu_calibration.errors import ImuCalibrationError
    for name, verb, arguments in chosen:
        folder = results / f'{name}.{verb}'
        if (folder / 'seconds').is_file():
            continue
        folder.mkdir(parents=True, exist_ok=True)
        options = make_parser(verb).parse_args([verb, *map(str, arguments), '--output', str(folder)])
        start, said = time.process_time(), ''
        try:
            with open(os.devnull, 'w') as nowhere:
                shown, sys.stdout = sys.stdout, nowhere
                options.run(options)
        except ImuCalibrationError as error:
            said = str(error)
        except Exception as error:   # noqa: B902 - one broken case must not cost the others
            said = f'BROKEN {error!r}'
        finally:
            sys.stdout = shown
        (folder / 'said').write_text(said)
        (folder / 'seconds').write_text(f'{time.process_time() - start:.2f}')


def parameters(path):
    """Return values and standard deviations by parameter name of a calibration.yaml."""
    document = yaml.safe_load(path.read_text())
    names, matrix = document['covariance']['names'], document['covariance']['matrix']
    keys = dict.fromkeys(tuple(name.split('.')[:2]) for name in names)
    places = [document[sensor].get(effect) or document['reference'][effect] for sensor, effect in keys]
    values = np.concatenate([np.ravel(place['value']) for place in places])
    return dict(zip(names, values)), dict(zip(names, np.sqrt(np.abs(np.diag(np.array(matrix, float))))))


def compared(old, new):
    """Return one line about a case in the two versions."""
    said = [(folder / 'said').read_text() for folder in (old, new)]
    seconds = ' -> '.join((folder / 'seconds').read_text() for folder in (old, new))
    if any(said):
        return 'same refusal' if said[0] == said[1] else f'SAID {said[0]!r} -> {said[1]!r}'
    text = [f'{seconds} s']
    files = [folder / 'calibration.yaml' for folder in (old, new)]
    if all(map(Path.is_file, files)):
        text.append(_distance(*map(parameters, files)))
    files = [folder / 'diagnosis.json' for folder in (old, new)]
    if all(map(Path.is_file, files)):
        found = [json.loads(path.read_text()) for path in files]
        texts = [_findings(document) for document in found]
        text.append(texts[0] if texts[0] == texts[1] else f'FOUND {texts[0]} -> {texts[1]}')
        pairs = [pair for one, other in zip(*(d['findings'] for d in found)) if one['effect'] == other['effect']
                 for pair in zip(one['parameters'].values(), other['parameters'].values())]
        if pairs:
            text.append('findings {:.1e} sd, sd x {:.4f}'.format(
                max(abs(b['value'] - a['value']) / max(a['sd'], 1e-300) for a, b in pairs),
                max((b['sd'] / a['sd'] for a, b in pairs if a['sd']), key=lambda r: abs(np.log(max(r, 1e-9))), default=1.0)))
    return '; '.join(text)


def _distance(old, new):
    if old[0].keys() != new[0].keys():
        return f'PARAMETERS {sorted(old[0].keys() ^ new[0].keys())}'
    names = [name for name in old[0] if old[1][name] > 0]
    change = {name: abs(new[0][name] - old[0][name]) / old[1][name] for name in names}
    ratio = {name: new[1][name] / old[1][name] for name in names}
    worst, wide = max(names, key=change.get), max(names, key=lambda name: abs(np.log(max(ratio[name], 1e-9))))
    return f'{change[worst]:.1e} sd ({worst}), sd x {ratio[wide]:.6f} ({wide})'


def _findings(document):
    named = [' = '.join([f['effect'], *f['indistinguishable_from']]) for f in document['findings']]
    rest = [sensor for sensor, rest in document['unexplained'].items() if rest.get('significant')]
    return f"[{', '.join(named)}] unexplained {rest}"


def main():
    """Run both versions and print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('old', type=Path)
    parser.add_argument('--work', type=Path, default=Path('/tmp/before_after'))
    parser.add_argument('--cases', default='')
    parser.add_argument('--again', action='store_true', help='run the new code anew')
    parser.add_argument('--only', choices=('old', 'new'), help='run one version, say nothing')
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    simulate(options.old, options.work)
    chosen = [case for case in cases(options.work) if all(part in f'{case[0]}.{case[1]}' for part in options.cases.split(','))]
    if options.only:
        run(options.old if options.only == 'old' else ROOT, chosen, options.work / options.only)
        return
    if options.again:
        for name, verb, _ in chosen:
            (options.work / 'new' / f'{name}.{verb}' / 'seconds').unlink(missing_ok=True)
    for version in ('old', 'new'):
        subprocess.run([sys.executable, __file__, str(options.old), '--work', str(options.work), '--cases', options.cases, '--only', version], check=True)
    for name, verb, _ in chosen:
        print(f'{name:24} {verb:9} {compared(*(options.work / version / f"{name}.{verb}" for version in ("old", "new")))}', flush=True)


if __name__ == '__main__':
    main()
