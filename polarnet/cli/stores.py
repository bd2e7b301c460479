"""Commands on stores: check, export, import."""

import argparse
from pathlib import Path

from polarnet.cli.outputs import run_folder
from polarnet.cli.parsers import Commands


def add_to(commands: Commands) -> None:
    """Its commands."""
    verify = commands.add_parser("verify", help="check every byte of a store of events, frames or scenes")
    verify.add_argument("store", help="folder, zip or fsspec URL")
    verify.set_defaults(run=_verify)

    export = commands.add_parser("export", help="an event store as files that other tools read")
    export.add_argument("store", help="folder, zip or fsspec URL")
    export.add_argument("folder", type=Path, help="gets a file for each sequence and polarizer")
    export.add_argument("--format", choices=("hdf5", "text"), default="hdf5", help="DSEC's HDF5, or lines of t x y p")
    export.set_defaults(run=_export)

    import_ = commands.add_parser("import", help="the files that export wrote, as an event store")
    import_.add_argument("folder", type=Path)
    import_.add_argument("store", type=Path, help="written anew")
    import_.set_defaults(run=_import)


def _verify(options: argparse.Namespace) -> int:
    from polarnet.storage.events import EventStore
    from polarnet.storage.frames import FrameStore
    from polarnet.storage.parts import open_group
    from polarnet.storage.scenes import SceneStore

    stores = {store.FORMAT: store for store in (EventStore, FrameStore, SceneStore)}
    form = open_group(options.store).attrs.get("format")
    if form not in stores:
        raise ValueError(f"{options.store}: expected a store of {', '.join(stores)}, its format is {form!r}")
    problems = stores[form].verify(options.store)
    for problem in problems:
        print(problem)
    if not problems:
        print(f"{options.store}: every sequence is whole")
    return 1 if problems else 0


def _export(options: argparse.Namespace) -> int:
    from polarnet.storage.events import EventStore
    from polarnet.storage.exchange import export_store

    store = EventStore.open(options.store)
    with run_folder(options.folder, "export") as folder:
        export_store(store, folder, options.format)
    print(f"{options.store} -> {options.folder}")
    return 0


def _import(options: argparse.Namespace) -> int:
    from polarnet.storage.exchange import import_store

    import_store(options.folder, options.store)
    print(f"{options.folder} -> {options.store}")
    return 0
