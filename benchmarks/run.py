"""
Run every benchmark of this folder, one after the other.

Exit code 1 when one of them misses a target.
"""

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent


def main():
    """Run bench_*.py in order of their names, each in its own process with the same options."""
    failed = []
    for path in sorted(FOLDER.glob('bench_*.py')):
        print(f'--- {path.stem}', flush=True)
        if subprocess.run([sys.executable, str(path), *sys.argv[1:]], cwd=FOLDER.parent).returncode:
            failed.append(path.stem)
    if failed:
        print('targets missed: ' + ', '.join(failed))
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
