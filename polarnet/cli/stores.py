"""Commands for stores: verify, export."""

import argparse
from pathlib import Path

from polarnet.cli.outputs import run_folder
from polarnet.cli.parsers import Commands


def add_to(commands: Commands) -> None:
    """Add the commands verify and export."""
    verify = commands.add_parser("verify", help="check every byte of a store of events, frames or scenes")
    verify.add_argument("store", help="store: folder or fsspec URL")
    verify.set_defaults(run=_verify)

    export = commands.add_parser("export", help="export an event store to files for other tools")
    export.add_argument("store", help="event store: folder or fsspec URL")
    export.add_argument("folder", type=Path, help="output folder; one file for each sequence and channel")
    export.add_argument(
        "--format",
        choices=("hdf5", "text", "evt3"),
        default="hdf5",
        help="HDF5 in DSEC's layout, text lines t x y p, or Prophesee's EVT3 (default: hdf5)",
    )
    export.set_defaults(run=_export)


def _verify(options: argparse.Namespace) -> int:
    from polarnet.storage.events import EventStore
    from polarnet.storage.frames import FrameStore
    from polarnet.storage.parts import open_group
    from polarnet.storage.scenes import SceneStore

    stores = {store.FORMAT: store for store in (EventStore, FrameStore, SceneStore)}
    form = open_group(options.store).attrs.get("format")
    if form not in stores:
        raise ValueError(f"{options.store}: expected a store of format {', '.join(stores)}, got {form!r}")
    problems = stores[form].verify(options.store)
    for problem in problems:
        print(problem)
    if not problems:
        print(f"{options.store}: every sequence is intact")
    return 1 if problems else 0


def _export(options: argparse.Namespace) -> int:
    from polarnet.storage.events import EventStore
    from polarnet.storage.exchange import export_store

    store = EventStore.open(options.store)
    with run_folder(options.folder, "export") as folder:
        export_store(store, folder, options.format)
    print(f"{options.store} -> {options.folder}")
    return 0
