# ---
# jupyter:
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Bring your own camera
#
# This notebook goes from a recording of a camera with polarizers on its pixels to DoLP. It first writes a recording
# of a simulated camera. Set `recording` to a file of your own camera, and `mosaic` to its angles, to use yours instead.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import zarr

from polarnet.cli import main
from polarnet.simulation import BUILTIN_PHOTOS

recording, mosaic = None, "90 45 / 135 0"

# %%
if recording is None:
    photograph = str(BUILTIN_PHOTOS[2].path)
    size = ["ingest.height=256", "ingest.width=384", "synthesize.sensor_height=128", "synthesize.sensor_width=192"]
    settings = ["polarizers=micropolarizers", "synthesize.duration_s=0.4", *size]
    assert main(["simulate", photograph, *settings, "--to", "evt3", "--no-preview", "--out", "simulated"]) == 0
    recording = next(Path("simulated").glob("sensor*.raw"))

# %% [markdown]
# ## Inspect the file
#
# The summary names format, size, rates and hot pixels.

# %%
assert main(["inspect", str(recording), "--out", "pictures"]) == 0

# %% [markdown]
# ## Recover DoLP

# %%
assert main(["recover", str(recording), "--mosaic", mosaic, "--write", "zarr", "--out", "recovered"]) == 0

# %% [markdown]
# ## Look at the last frame
#
# `recovered.zarr` holds DoLP, AoLP and the expected error of each frame.

# %%
frames = zarr.open_group("recovered/recovered.zarr", mode="r")
figure, panels = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for axes, name in zip(panels, ("dolp", "aolp"), strict=True):
    axes.imshow(frames[name][-1], cmap="viridis" if name == "dolp" else "hsv")
    axes.set_title(name)
    axes.axis("off")
print({name: array.shape for name, array in frames.arrays()})
