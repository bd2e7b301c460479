# ---
# jupyter:
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Tutorial: from a photograph to DoLP
#
# This notebook simulates an event camera behind four polarizers, recovers DoLP from its events, and compares it with
# the truth. `jupytext --to ipynb docs/notebooks/tutorial.py` makes a notebook of this file.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt

from polarnet.recovery import recover
from polarnet.simulation import BUILTIN_PHOTOS, MOTIONS, SENSORS, read_rgb, simulate

# %% [markdown]
# ## Simulate
#
# Hue becomes AoLP, saturation DoLP and value intensity. A small sensor moves over this scene for half a second.

# %%
motion = replace(MOTIONS["default"], duration_s=0.5, sensor_height=64, sensor_width=96)
result = simulate(read_rgb(BUILTIN_PHOTOS[2].path), motion, SENSORS["default"], seed=1)
print("events behind 0, 45, 90 and 135 degrees:", [len(events) for events in result.events])

# %% [markdown]
# ## Recover
#
# The network sees windows of 1/30 s. It carries a state from one window to the next.

# %%
prediction = recover(result.events, t_us=result.t_us).prediction

# %% [markdown]
# ## Compare
#
# The panels show DoLP from 0 (dark violet) to 1 (yellow) at the end of the sequence.

# %%
figure, panels = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for axes, name, dolp in zip(panels, ("true", "recovered"), (result.dolp[-1], prediction.dolp[-1]), strict=True):
    axes.imshow(dolp, vmin=0, vmax=1)
    axes.set_title(f"{name} DoLP")
    axes.axis("off")
rms = float((prediction.dolp[-1] - result.dolp[-1]).square().mean().sqrt())
print(f"RMS error of DoLP: {rms:.3f}")
