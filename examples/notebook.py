# %% [markdown]
# # An IMU on a turntable, in a notebook
#
# Every cell runs unchanged, in Jupyter, VS Code or Spyder (percent format) and as a script: `python
# examples/notebook.py`. Two lines calibrate a bag: the import, and `imu.calibrate('session.bag',
# 'table.yaml')`.

# %%
from pathlib import Path

import numpy as np

import imu_calibration as imu

SESSION = Path(imu.__file__).parents[1] / 'bags' / 'sample_session'

# %%
found = imu.calibrate(SESSION, SESSION / 'table.yaml')
found

# %% [markdown]
# Every parameter has a standard deviation and a status; the verdict contains the next step. The
# residual of each window, with its expectation from noise:

# %%
found.plot('accelerometer')

# %%
found.plot('gyroscope')

# %% [markdown]
# A calibration is an object that compensates arrays. The sample session was simulated, so that the
# truth is available: the error of each parameter, divided by its reported standard deviation:

# %%
truth = imu.load(SESSION / 'truth.yaml')
names = [name for name in truth.param_names if name in found.calibration.param_names]
known = dict(zip(truth.param_names, truth.values, strict=True))
error = {
    name: (value - known[name]) / sd
    for name, value, sd in zip(
        found.calibration.param_names, found.calibration.values, found.calibration.sd, strict=True
    )
    if name in names and sd > 0
}
print(
    f'{len(error)} parameters, largest error {max(map(abs, error.values())):.1f} sd, rms'
    f' {np.sqrt(np.mean(np.square(list(error.values())))):.2f} sd'
)

# %%
force, rate = found.calibration.compensate(
    np.tile([0.0, 0.0, 9.81], (4, 1)), np.zeros((4, 3)), time=0.01 * np.arange(4)
)
force[-1], rate[-1]

# %% [markdown]
# ## Errors of the sensor model
#
# The simulated session has an effect outside the model, a g-sensitivity of the gyroscopes; the
# diagnosis finds it. Samples in memory replace the bag.

# %%
session = imu.simulate('quick', effects=['gyro_g_sensitivity'], seed=11)
session

# %%
diagnosis = imu.diagnose(session.samples, session.table)
diagnosis

# %%
diagnosis.plot(2)

# %% [markdown]
# The extended calibration corrects the effect.

# %%
corrected = imu.compensate(session.samples, diagnosis.calibration)
corrected

# %% [markdown]
# Files: `found.save('result')` writes calibration.yaml and report.html, `diagnosis.save('finding')`
# also diagnosis.json, and `session.save('session_bag')` a bag.
