"""Docs blocks from docs/results/recordings.json; missing sections are left out."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from polarnet.reports.provenance import origin
from polarnet.reports.tables import as_markdown, score_table

Figures = Mapping[str, Any]
ENDINGS = ("read", "repaired", "refused")
"""Possible outcomes of reading a damaged file."""


def recordings_block(results: Figures) -> str:
    """Speed and memory of the readers, their handling of damage, and the simulated rig, each with its machine."""
    sections = {"readers": readers_lines, "fuzz": fuzz_lines, "rig": rig_lines, "rig_full": rig_lines}
    lines: list[str] = []
    for name, lines_of in sections.items():
        if name in results:
            lines += [*lines_of(results[name]), "", origin(results["records"][name]), ""]
    return "\n".join(lines)


def readers_lines(readers: Figures) -> Iterator[str]:
    """A row per format: millions of events a second for each reader, and the memory of polarnet's."""
    own = [name for name in readers if not any(name.endswith(f"_{other}") for other in readers)]
    libraries = sorted({name.removesuffix(f"_{form}") for form in own for name in readers if name.endswith(f"_{form}")})
    sizes = list(dict.fromkeys(size for form in own for size in readers[form]["peak_mib"]))
    yield "Millions of events a second, and polarnet's memory, in MiB, for files of so many events:"
    yield ""
    yield from table(
        ["format", "polarnet", *libraries, *(f"MiB at {size}" for size in sizes)],
        (
            [
                f"`{form}`",
                *(_speed(readers.get(name)) for name in (form, *(f"{library}_{form}" for library in libraries))),
                *(str(readers[form]["peak_mib"].get(size, "-")) for size in sizes),
            ]
            for form in own
        ),
    )


def fuzz_lines(fuzz: Figures) -> Iterator[str]:
    """A row per reader: the number of damaged files, and of each outcome."""
    yield f"Damaged files, at least {fuzz['cases_per_reader']:,} for each reader, none of which ended otherwise:"
    yield ""
    yield from table(
        ["reader", "files", "read", "repaired, with a count", "refused, with the reason"],
        (
            [f"`{name}`", *(f"{n:,}" for n in (one["cases"], *(one["endings"].get(e, 0) for e in ENDINGS)))]
            for name, one in sorted(fuzz["readers"].items())
        ),
    )


def rig_lines(rig: Figures) -> Iterator[str]:
    """The errors of start times and DoLP, and the benchmark."""
    height, width = rig["sensor"]
    yield (
        f"Simulated rig, {rig['captures']} captures of a sensor of {width} x {height} px: start times by the landmark "
        f"are right within {rig['start_error_frames_max']:.2f} pictures of the camera, refined ones within "
        f"{rig['refined_error_ms_max']:.2f} ms of each other (the zero of their common clock, a convention, is up to "
        f"{rig['clock_zero_ms_max']:.1f} ms from the landmark's); the DoLP of the truth differs from the scene's own "
        f"by {rig['dolp_rms']:.4f} RMS, at most {rig['dolp_rms_max']:.4f} in a target. The benchmark on it:"
    )
    yield ""
    yield as_markdown(score_table(rig["benchmark"]))


def recover_block(results: Figures) -> str:
    """Speed of `polarnet recover` with each method, from a file and live."""
    found = results["recover"]
    names = {"network": f"network `{found['network']}`, {found['precision']}"}
    rows = (
        [
            names.get(name, f"`{name}`"),
            f"{one['realtime_factor']:.2f}",
            f"{one['latency_ms']:.1f}",
            f"{one['live_latency_ms']:.0f}" if "live_latency_ms" in one else "-",
        ]
        for name, one in found["methods"].items()
    )
    headings = ["method", "times real time", "a step, ms", "live, from event to frame, ms"]
    stream = f"{found['events']:,} events in {found['seconds']:g} s"
    return "\n".join(
        [f"{stream}; Zarr, PNG and video written, live Zarr and video:", "", *table(headings, rows), "", origin(found)]
    )


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Lines of a GitHub table with text in the first column and numbers in the others."""
    yield f"| {' | '.join(headings)} |"
    yield "|---|" + "---:|" * (len(headings) - 1)
    for row in rows:
        yield f"| {' | '.join(row)} |"


def _speed(figures: Figures | None) -> str:
    return f"{figures['mevents_per_s']:.1f}" if figures else "-"
