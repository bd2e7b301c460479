import pytest
import torch
from method_fixtures import context, make_context, make_sequence, make_setup, sequence

from polarnet.benchmark.sequences import BenchmarkSet
from polarnet.events.stream import Events
from polarnet.stokes import intensities_from_stokes, stokes_from_polarization
from polarnet.storage import Contents, EventStore, FrameStore

__all__ = ["context", "make_context", "make_sequence", "make_setup", "sequence"]

SCENES = {"t1": "photo", "a1": "lake", "a2": "lake", "b1": "wood", "c1": "town"}


@pytest.fixture(scope="session")
def five_scenes(make_sequence, tmp_path_factory):
    folder = tmp_path_factory.mktemp("five_scenes")
    splits = {name: "train" if name.startswith("t") else "test" for name in SCENES}
    frames = FrameStore.create(folder / "frames.zarr", Contents(splits, {"scenes": SCENES}), 18, 20)
    events = EventStore.create(folder / "events.zarr", list(SCENES), 18, 20, {})
    rotating = EventStore.create(folder / "rotating.zarr", list(SCENES), 18, 20, {})
    for seed, name in enumerate(SCENES):
        clip = make_sequence(name, seed=seed)
        dolp, aolp, s0 = (torch.cat([x[:1], x]) for x in (clip.dolp, clip.aolp, clip.s0))
        frames.write(name, clip.t_us, intensities_from_stokes(stokes_from_polarization(s0, dolp, aolp)), dolp, aolp)
        events.write(name, clip.events, 4000)
        rotating.write(name, [clip.rotating, *[Events.empty(18, 20)] * 3], 4000)
    for store in (frames, events, rotating):
        store.finish()
    stores = EventStore.open(folder / "events.zarr"), FrameStore.open(folder / "frames.zarr")
    return BenchmarkSet("simulated", *stores, EventStore.open(folder / "rotating.zarr"))
