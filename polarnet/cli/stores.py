"""Commands for stores: view, verify, export, labels."""

import argparse
from pathlib import Path

from polarnet.cli.outputs import run_folder
from polarnet.cli.parsers import Commands, add_hot_pixel_factor, add_reading, add_stored_sequence, reading_of

PICTURE_US = 33_333


def add_to(commands: Commands) -> None:
    """Add the commands view, verify, export and labels."""
    view = commands.add_parser(
        "view",
        help="look at a store, a recording or a recovery in a page that plays it",
        description="Writes a page that plays events, S0, DoLP and AoLP, and opens it in the browser.",
        epilog="example: polarnet view data/frames.zarr --sequence lake-00",
    )
    view.add_argument("path", type=Path, help="store, folder with stores (of simulate or recover), or a camera's file")
    view.add_argument("--sequence", nargs="+", default=[], metavar="NAME", help="sequences (default: the first twelve)")
    view.add_argument("--out", type=Path, help="page (default: outputs/view/NAME.html)")
    view.add_argument("--no-browser", action="store_true", help="write the page without opening it")
    add_reading(view)
    view.set_defaults(run=_view)

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

    labels = commands.add_parser(
        "labels",
        help="count and draw a stored sequence's events by cause, and score the removal of hot pixels",
        description="Needs an event store that was written with storage.labels=true. Score a denoiser of your own with "
        "polarnet.metrics.denoising.denoising_scores.",
    )
    add_stored_sequence(labels)
    add_hot_pixel_factor(labels)
    labels.add_argument(
        "--picture",
        type=Path,
        help="PNG of 33 ms in the middle of the sequence, coloured by cause (default: not drawn)",
    )
    labels.set_defaults(run=_labels)


def _view(options: argparse.Namespace) -> int:
    import functools
    import webbrowser

    from polarnet.recordings.recording import read_recording
    from polarnet.reports.player import write_player
    from polarnet.reports.viewing import films_of

    films = films_of(options.path, options.sequence, functools.partial(read_recording, **reading_of(options)))
    path = options.out or Path("outputs", "view", f"{options.path.resolve().name}.html")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_player(path, f"{options.path}", films, {"command": f"polarnet view {options.path}"})
    print(f"page {path}")
    if not options.no_browser:
        webbrowser.open(path.resolve().as_uri())
    return 0


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


def _labels(options: argparse.Namespace) -> int:
    import torch

    from polarnet.metrics.denoising import denoising_scores
    from polarnet.recordings.pixels import event_counts, hot_pixels
    from polarnet.reports.recordings import draw_labels
    from polarnet.storage.events import EventStore

    store = EventStore.open(options.store)
    if not store.labelled:
        raise ValueError(f"{options.store}: expected a store with labels; write it again with storage.labels=true")
    channels, seconds = store.read(options.sequence), store.duration_us(options.sequence) * 1e-6
    hot = [torch.from_numpy(hot_pixels(event_counts(e), seconds, options.hot_pixel_factor)) for e in channels]
    keep = torch.cat([~bad[e.y.long(), e.x.long()] for bad, e in zip(hot, channels, strict=True)])
    scores = denoising_scores(torch.cat([e.label for e in channels if e.label is not None]), keep)
    print(f"{'cause':8s}{'events':>12s}{'in hot pixels':>15s}")
    for label, (removed, events) in scores.removed.items():
        print(f"{label:8s}{events:12,d}{removed:15,d}")
    print(
        f"removal of {sum(int(bad.sum()) for bad in hot)} hot pixels: precision {scores.precision:.4f}, "
        f"recall {scores.recall:.4f}, signal kept {scores.signal_kept:.4f}"
    )
    if options.picture:
        middle_us = store.duration_us(options.sequence) // 2
        draw_labels(store.read(options.sequence, middle_us, middle_us + PICTURE_US), options.picture)
        print(f"picture {options.picture}")
    return 0
