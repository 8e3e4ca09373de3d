# %% [markdown]
# # An IMU on a turntable, in a notebook
#
# Every cell runs as it is, in Jupyter, VS Code or Spyder (percent format) and as a script: `python examples/notebook.py`.
# Two lines calibrate a bag: the import, and `imu.calibrate('session.bag', 'table.yaml')`.

# %%
from pathlib import Path

import numpy as np

import imu_calibration as imu

SESSION = Path(imu.__file__).parents[1] / 'bags' / 'sample_session'

# %%
found = imu.calibrate(SESSION, SESSION / 'table.yaml')
found

# %% [markdown]
# Every parameter has a standard deviation and a status; the verdict says what to do next. What the calibration leaves in each window, beside what noise
# alone would leave:

# %%
found.plot('accelerometer')

# %%
found.plot('gyroscope')

# %% [markdown]
# A calibration is an object that compensates arrays. The sample session was simulated, so that the truth is known: how far off is each parameter, in the
# standard deviations that are reported?

# %%
truth = imu.load(SESSION / 'truth.yaml')
names = [name for name in truth.param_names if name in found.calibration.param_names]
known = dict(zip(truth.param_names, truth.values, strict=True))
error = {name: (value - known[name]) / sd for name, value, sd in
         zip(found.calibration.param_names, found.calibration.values, found.calibration.sd, strict=True) if name in names and sd > 0}
print(f'{len(error)} parameters, largest error {max(map(abs, error.values())):.1f} sd, rms {np.sqrt(np.mean(np.square(list(error.values())))):.2f} sd')

# %%
force, rate = found.calibration.compensate(np.tile([0.0, 0.0, 9.81], (4, 1)), np.zeros((4, 3)), time=0.01 * np.arange(4))
force[-1], rate[-1]

# %% [markdown]
# ## What a model gets wrong
#
# Hide a cause in a simulated session, an IMU whose gyroscopes feel gravity, and let the diagnosis find it. Samples in memory are as good as a bag.

# %%
session = imu.simulate('short', effects=['gyro_g_sensitivity'], seed=11)
session

# %%
diagnosis = imu.diagnose(session.samples, session.table)
diagnosis

# %%
diagnosis.plot(2)

# %% [markdown]
# The extended calibration takes the cause out.

# %%
corrected = imu.compensate(session.samples, diagnosis.calibration)
corrected

# %% [markdown]
# Everything that was found as files: `found.save('result')` writes calibration.yaml and report.html, `diagnosis.save('finding')` also diagnosis.json,
# `session.save('session_bag')` a bag.
