"""
The claims, measured on real recordings.

`make validate` runs every section and writes docs/validation.md.
"""

import os

# Before numpy: threads that wait for each other use processor time.
for _name in (
    'OMP_NUM_THREADS',
    'OPENBLAS_NUM_THREADS',
):
    os.environ.setdefault(_name, '1')
