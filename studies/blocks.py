"""The result blocks of README.md and docs/*.md: which file each one shows, its rows, columns and caption."""

import functools
from collections.abc import Callable, Iterator
from operator import getitem
from pathlib import Path

from polarnet.config.experiments import preset_values
from polarnet.reports.legend import LABELS, legend_of
from polarnet.reports.tables import COLUMNS, COSTS, as_markdown, score_table
from studies.comparisons import paired_lines, standing
from studies.instruction_sets import SETTINGS, VARIABLES
from studies.network_blocks import NETWORK_BLOCKS
from studies.paper import duration_rows, table_rows
from studies.planning import PLANNING_BLOCKS
from studies.recorded import RECORDED_BLOCK
from studies.robustness_blocks import ROBUSTNESS_BLOCKS
from studies.rotating import CURVES
from studies.tables import Block, Columns, Results, Row, listed

ROOT = Path(__file__).resolve().parents[1]
GOLDEN_CASES = 23  # 15 of v2e, 8 of ESIM
BENCHMARK_COLUMNS = {**COLUMNS, **COSTS}
ROTATING_COLUMNS = {
    "DoLP RMS": "{dolp_rms:.4f}", "bias": "{dolp_bias:+.4f}", "AoLP error, degrees": "{aolp_deg:.2f}",
    "expected RMS": "{expected_rms:.4f}", "errors within the expected": "{within_expected:.0%}",
    "within twice": "{within_twice_expected:.0%}",
}  # fmt: skip


def _rotating_curve_rows(results: Results) -> Iterator[Row]:
    for curve, points in results["rotating"]["curves"].items():
        label, _ = CURVES[curve]
        for score, about, form in (("dolp_rms", "DoLP RMS", "{:.3f}"), ("aolp_deg", "AoLP, degrees", "{:.1f}")):
            errors = ", ".join(f"{point['value']:g}: {form.format(point[score])}" for point in points)
            yield {"label": label, "about": about, "errors": errors}


def _formats(readers: Results) -> list[str]:
    """Names of polarnet's own readers; other libraries' entries are called LIBRARY_FORMAT."""
    return [name for name in readers if not any(name.endswith(f"_{other}") for other in readers)]


def _reader_rows(results: Results) -> Iterator[Row]:
    readers = results["readers"]
    for form in _formats(readers):
        others = {name.removesuffix(f"_{form}"): one for name, one in readers.items() if name.endswith(f"_{form}")}
        yield {"name": form, "polarnet": readers[form], **others}


def _reader_columns(results: Results) -> Columns:
    rows = list(_reader_rows(results))
    libraries = sorted({name for row in rows for name in row} - {"name", "polarnet"})
    sizes = dict.fromkeys(size for row in rows for size in row["polarnet"]["peak_mib"])
    speeds = {name: f"{{{name}[mevents_per_s]:.1f}}" for name in ("polarnet", *libraries)}
    return {"format": "`{name}`", **speeds, **{f"MiB at {size}": f"{{polarnet[peak_mib][{size}]}}" for size in sizes}}


def _recover_rows(results: Results) -> Iterator[Row]:
    for name, one in results["recover"]["methods"].items():
        network = "network `{network}`, {precision}".format_map(results["recover"])
        yield {"label": name.replace("network", network) if "network" in name else f"`{name}`", **one}


def _endings_by_kind(*path: str) -> Callable[[Results], list[Row]]:
    """Rows of the counts that lie at `path` in a file, one of each kind."""
    return lambda results: [{"name": k, **one} for k, one in sorted(functools.reduce(getitem, path, results).items())]


def _benchmark_lines(name: str) -> Callable[[Results], list[str]]:
    def lines(results: Results) -> list[str]:
        scores = results[name]
        solved = [row for row in scores if f"{row}+gain" in scores]
        gains = {LABELS[row]: scores[f"{row}+gain"]["psnr"] - scores[row]["psnr"] for row in solved}
        improvement = [f"Solved gains change PSNR by: {listed(gains, '{:+.2f} dB')}."] if gains else []
        return ["\n".join(f"- {line}" for line in [*paired_lines(results["paired"][name]), *improvement])]

    return lines


def _benchmark(name: str) -> Block:
    def rows(results: Results) -> str:
        warmup_windows = results["about"][name]["warmup_windows"]
        return as_markdown(score_table(results[name], BENCHMARK_COLUMNS, warmup_windows=warmup_windows))

    caption = f"{{about[{name}][scenes]}} scenes, {{about[{name}][frames]}} frames. {{origin}}"
    return Block(
        "benchmark", name, "studies.study", rows, caption=caption, lines=_benchmark_lines(name),
    )  # fmt: skip


def _demo_table(scores: Results, weights: Results) -> str:
    """Scores measured with the values of params.yaml; `weights` name the network behind each row."""
    warmup_windows = preset_values(ROOT, "experiment", "demo")["benchmark.warmup_windows"]
    return as_markdown(score_table(scores, labels=legend_of(weights).labels, warmup_windows=warmup_windows))


HOUSE_FIGURES = {
    "package_lines": "lines of Python in `polarnet/`",
    "top_level_modules": "modules at the top level of `polarnet/`",
    "dvc_yaml_lines": "lines of `dvc.yaml`",
    "body_median": "lines of a function body, median",
    "body_p90": "lines of a function body, 90th percentile",
    "retired_words": "uses of words that the glossary retires",
    "files_per_published_baseline": "files that a baseline with published weights touches",
    "files_per_trained_baseline": "files that a trained baseline touches",
    "test_minutes": "minutes of `make test`",
}


def _sensor_fit(section: str, stimulus: str) -> Block:
    """Truth and estimate of each simulated sensor."""
    pairs = {
        "threshold ON": "contrast_threshold_on", "OFF": "contrast_threshold_off",
        "deviation ON": "threshold_deviation_on", "deviation OFF": "threshold_deviation_off",
        "bandwidth, Hz": "cutoff_hz", "leak, Hz": "leak_rate_hz", "shot noise, Hz": "shot_noise_rate_hz",
    }  # fmt: skip
    errors = ", ".join(
        f"{label} {{{section}[{key}]:.1%}}"
        for label, key in (
            ("thresholds", "threshold_error_max"), ("deviations", "deviation_error_max"),
            ("leak and shot noise", "noise_error_max"), ("bandwidth", "bandwidth_error_max"),
        )
    )  # fmt: skip
    return Block(
        "camera", section, "studies.sensor_fit",
        lambda results: [{"number": k + 1, **row} for k, row in enumerate(results[section]["sensors"])],
        {"sensor": "{number}"} | {
            heading: f"{{truth[{name}]:.3g}} / {{estimate[{name}]:.3g}}" for heading, name in pairs.items()
        },
        f"True value / estimate of simulated sensors, from {stimulus}; {{{section}[height]}} x {{{section}[width]}} "
        f"pixels. Largest errors: {errors}. {{origin}}",
    )  # fmt: skip


BLOCKS = ROBUSTNESS_BLOCKS | NETWORK_BLOCKS | PLANNING_BLOCKS | {
    "pipeline-scores": Block(
        "pipeline", "metrics", "studies.measure",
        lambda results: _demo_table(results["metrics"], results.get("weights", {})),
        caption="Means over the test scenes; small figures are 95 % bootstrap intervals over scenes. {origin}",
        lines=lambda results: ["\n".join(f"- {line}" for line in standing(results["metrics"]))],
    ),
    "pipeline-minutes": Block(
        "pipeline", "test_minutes", "studies.measure",
        caption="In a fresh clone, the set-up takes {setup_minutes:.1f} minutes, `make repro` another "
        "{repro_minutes:.1f} and `make test` {test_minutes:.1f}. {origin}",
    ),
    "pipeline-stages": Block(
        "pipeline", "stage_minutes", "studies.measure", caption="",
        lines=lambda results: [f"Minutes by stage: {listed(results['stage_minutes'], '{:.1f}')}."],
    ),
    "benchmark-simulated": _benchmark("simulated"),
    "benchmark-measured": _benchmark("measured"),
    "recorded": RECORDED_BLOCK,
    "emulation": Block(
        "emulation", "paper_set", "studies.emulation",
        lambda results: [
            {"name": name, **results[name]} for name in ("v2e_default", "exact", "esim", "dvs_voltmeter")
        ],
        {
            "model": "`{name}`", "seconds, 1 thread": "{seconds_1_thread:.3f}", "2 threads": "{seconds_2_threads:.3f}",
            "Mpixel updates / s": "{mpixel_updates_per_s:,.0f}", "Mevents / s": "{mevents_per_s:,.1f}",
            "peak MiB": "{peak_mib:,.0f}", "timing error at 300 fps, ms": "{timing_error_ms_300fps:.3f}",
            "at 120 fps, ms": "{timing_error_ms_120fps:.3f}",
        },
        f"Reference cases of v2e and ESIM met: {{golden_cases_passed}} of {GOLDEN_CASES}. A set of "
        "{paper_set[sequences]} sequences, from pictures to the event store on disk, took {paper_set[minutes]:.1f} "
        "minutes (ingest {paper_set[stage_minutes][ingest]:.1f}, synthesize {paper_set[stage_minutes][synthesize]:.1f}"
        ", emulate {paper_set[stage_minutes][emulate]:.1f}) with at most {paper_set[peak_mib]:,} MiB of memory. "
        "{origin}",
    ),
    "walk": Block(
        "report", "walk", "studies.walk --write",
        lambda results: [
            {**one, "typed": "<br>".join(f"`{command}`" for command in one["commands"]), "total": sum(one["seconds"])}
            for one in results["walk"].values()
        ],
        {"from nothing to": "{title}", "commands": "{typed}", "seconds": "{total:.0f}"},
        "At most {new_user_commands} commands. The seconds contain the compilation of the simulation, but not the "
        "download of the packages that polarnet needs. {origin}",
    ),
    "remotes": Block(
        "sweeps", "push", "studies.clones push --write",
        caption="At smoke size, with stages: {push[target]}. The remote holds {push[files]:,.0f} files of together "
        "{push[bytes]:,.0f} bytes; in the other clone `dvc repro` executes {push[repro_executes]:.0f} stages. {origin}",
    ),
    "search": Block(
        "sweeps", "search", "studies.speed search --data FOLDER --write",
        caption="A search of {search[trials]:,.0f} trials at smoke size: {search[stopped]:.0f} were stopped after an "
        "epoch. Best validation MSE: {search[best][validation_mse]:.4f}. {origin}",
    ),
    "ddp": Block(
        "sweeps", "ddp", "studies.speed ddp --data FOLDER --write",
        caption="Largest difference of a loss between two processes and one: {ddp[ddp_loss_difference]:.1e}, at "
        "smoke size in float32. {origin}",
    ),
    "readers": Block(
        "recordings", "readers", "studies.recordings", _reader_rows, _reader_columns,
        "Columns: millions of events a second, then the memory of polarnet's reader by number of events. {origin}",
    ),
    "fuzz": Block(
        "recordings", "fuzz", "studies.fuzz_recordings",
        lambda results: [
            {"name": name, "cases": one["cases"], "repaired": 0, **one["endings"]}
            for name, one in sorted(results["fuzz"]["readers"].items())
        ],
        {
            "reader": "`{name}`", "damaged files": "{cases:,}", "read": "{read:,}",
            "repaired, with a count": "{repaired:,}", "refused, with the reason": "{refused:,}",
        },
        "At least {fuzz[cases_per_reader]:,} damaged files for each reader; none ended otherwise. {origin}",
    ),
    "rig": Block(
        "recordings", "rig", "studies.rig", lambda results: _demo_table(results["rig"]["benchmark"], {}),
        caption="{rig[captures]} captures of a simulated sensor, {rig[sensor][1]} x {rig[sensor][0]} pixels. Start "
        "times found from the landmark are right within {rig[start_error_frames_max]:.2f} camera frames; refined "
        "ones agree within {rig[refined_error_ms_max]:.2f} ms. The zero of their common clock is a convention, up to "
        "{rig[clock_zero_ms_max]:.1f} ms from the landmark's. The DoLP of the truth differs from the scene's own by "
        "{rig[dolp_rms]:.4f} RMS, and by at most {rig[dolp_rms_max]:.4f} in a target. {origin}",
    ),
    "recover": Block(
        "recordings", "recover", "studies.recover", _recover_rows,
        {
            "method": "{label}", "speed relative to real time": "{realtime_factor:.2f}",
            "time of a step, ms": "{latency_ms:.1f}", "live: from event to frame, ms": "{live_latency_ms:.0f}",
        },
        "{recover[events]:,} events in {recover[seconds]:g} s. Runs from a file write Zarr, PNG and video; live runs "
        "write Zarr and video. {origin}",
    ),
    "inspection": Block(
        "inspection", "lines", "studies.rig", lambda results: "\n".join(["```", *results["lines"], "```"]), caption=""
    ),
    "rotating": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: [results["rotating"]],
        {"turns/s": "{rate_hz:g}", "window, turns": "{window_turns:g}", **ROTATING_COLUMNS},
        "{rotating[scenes]} scenes. {origin}",
    ),
    "rotating-dolp": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: results["rotating"]["by_dolp"],
        {"DoLP": "{low:g} to {high:g}", "pixels": "{pixels:,}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-s0": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: results["rotating"]["by_s0"],
        {"S0": "{low:g} to {high:g}", "pixels": "{pixels:,}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-cases": Block(
        "camera", "rotating", "studies.rotating --write",
        lambda results: [{"name": name, **one} for name, one in results["rotating"]["cases"].items()],
        {"case": "{name}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-curves": Block(
        "camera", "rotating", "studies.rotating --write", _rotating_curve_rows,
        {"setting": "{label}", "error": "{about}", "value: error": "{errors}"}, caption="",
    ),
    "faults": Block(
        "reliability", "artefacts", "studies.faults --write", _endings_by_kind("artefacts", "artefacts"),
        {
            "artefact": "{name}", "refused": "{refused:,}", "harmless": "{harmless:,}", "refused without a name":
            "{unnamed:,}", "traceback": "{traceback:,}", "used silently": "{silent:,}", "lost": "{lost:,}",
        },
        "{artefacts[faults_injected]:,} faults. {origin}",
    ),
    "fuzz-inputs": Block(
        "reliability", "fuzz", "studies.fuzz --write", _endings_by_kind("fuzz"),
        {
            "input": "{name}", "read": "{read:,}", "refused": "{refused:,}", "traceback": "{traceback:,}",
            "crash": "{crash:,}", "hang": "{hang:,}", "memory": "{memory:,}",
        },
        "{fuzz_cases:,} cases. {origin}",
    ),
    "same-bytes": Block(
        "reliability", "same_bytes", "studies.same_bytes --write",
        lambda results: [{"name": name, **row} for name, row in results["same_bytes"].items()],
        {
            "setting": "{name}", "workers": "{workers}",
            **{library: f"{{levels[{library}]}}" for library in VARIABLES},
            **{name: f"{{{name}[different]}} of {{{name}[of]}}" for name in ("images", "scenes", "frames", "events")},
        },
        f"Settings with equal bytes: {{isa_settings_equal}} of {len(SETTINGS)}. {{origin}}",
    ),
    "mutation": Block(
        "reliability", "mutation", "studies.mutation --write",
        lambda results: [
            {"name": module, "killed": 0, "timeout": 0, "survived": 0, **counted}
            for module, counted in results["mutation"]["modules"].items()
        ],
        {
            "module": "`{name}`", "mutants": "{mutants}", "killed": "{killed}", "tests without end": "{timeout}",
            "survived": "{survived}",
        },
        "Score: {mutation_score:.1%} of {mutation[mutants]} mutants. {origin}",
    ),
    "survivors": Block(
        "reliability", "mutation", "studies.mutation --write",
        lambda results: [
            {"name": name.replace("|", "\\|"), "why": why} for name, why in results["mutation"]["survivors"].items()
        ],
        {"surviving mutant": "`{name}`", "why": "{why}"}, caption="",
    ),
    "soak": Block(
        "reliability", "soak", "studies.soak --write",
        lambda results: [{"name": name, **row} for name, row in results["soak"].items()],
        {
            "run": "{name}", "hours": "{hours:.2f}", "hours of the camera": "{camera_hours:.2f}",
            "sequences": "{sequences:,}", "events": "{events:,}", "MiB after warm-up": "{memory_mib[start]:,.1f}",
            "at the end": "{memory_mib[end]:,.1f}", "growth": "{growth_mib:+.1f}",
            "descriptors after warm-up": "{descriptors[start]}", "then": "{descriptors[end]}",
        },
    ),
    "house": Block(
        "house", "house", "studies.house --write",
        lambda results: [{"about": about, "value": results["house"][key]} for key, about in HOUSE_FIGURES.items()],
        {"figure": "{about}", "value": "{value:,}"},
    ),
    "house-folders": Block(
        "house", "house", "studies.house --write",
        lambda results: [{"name": name, **one} for name, one in results["house"]["folders"].items()],
        {"folder": "`{name}`", "files": "{files:,}", "lines": "{lines:,}"}, caption="",
    ),
    "paper-rows": Block(
        "paper", "rows", "studies.paper", table_rows,
        {
            "the paper": "{row}", "section": "§ {paper}", "status": "{status}", "where in polarnet": "{where}",
            "note": "{note}", "tested by": "{test}",
        },
        "{rows_total} rows: {rows_exact} exact, {rows_chosen} chosen, {rows_stated} stated.",
    ),
    "paper-duration": Block(
        "lpips", "cost", "studies.lpips", duration_rows,
        {
            "precision": "{precision}", "training": "{windows:,} windows", "windows/s": "{rate:.2f}",
            "days": "{days:.0f}",
        },
        "Training of the network of `experiment=paper` with its loss, VGG included, on two cores; without E2VID, "
        "validation and simulation. "
        "{origin}",
    ),
    "paper-small": Block(
        "paper", "paper_small", "studies.paper --small DATA --write",
        lambda results: [{"name": name, **scores} for name, scores in results["paper_small"].items()],
        {
            "row": "`{name}`", "MSE": "{mse:.4f}", "PSNR": "{psnr:.2f}", "SSIM": "{ssim:.3f}", "LPIPS": "{lpips:.3f}",
            "correlation": "{corr:.3f}", "AoLP error, °": "{aolp_deg:.1f}", "skill": "{skill:.3f}",
        },
        "`paper` is the network that experiment=paper_small trains, `ours` the shipped one. {origin}",
    ),
    "polarizer-presets": Block(
        "camera", "polarizer_presets", "studies.polarizer_presets",
        lambda results: [
            {"name": name, **figures} for name, figures in results["polarizer_presets"]["presets"].items()
        ],
        {
            "`polarizers=`": "`{name}`", "DoLP of fully polarized light": "{dolp_of_full_polarization:.4f}",
            "its AoLP, RMS error": "{aolp_error_deg:.2f}°", "DoLP of the photograph, RMS error": "{scene_dolp_rms:.4f}",
        },
        "{polarizer_presets[number]} presets; fully polarized light at {polarizer_presets[angles]} angles, and "
        "`{polarizer_presets[scene]}`. {origin}",
    ),
    "polarizer-checks": Block(
        "recordings", "polarizers", "studies.polarizers --write", lambda results: results["polarizers"]["rows"],
        {
            "": "{kind}", "mean DoLP": "{dolp_from:g} to {dolp_to:g}", "recordings": "{recordings}",
            "counts, busiest over quietest": "{counts_min:.2f} to {counts_max:.2f}",
            "misfit ratio of the other pairings": "{misfit_min:.2f} to {misfit_max:.2f}",
            "warned: no polarizers": "{warned_no_polarizers}", "warned: order": "{warned_order}",
            "warned after an exchange": "{warned_exchanged} of {exchanged}",
        },
        "{polarizers[photographs]} photographs. {origin}",
    ),
    "sensor-fit": _sensor_fit(
        "sensor_fit",
        "{sensor_fit[static_s]} s of constant light and {sensor_fit[moving_s]:g} s of drifting leaves with "
        "{sensor_fit[frame_rate_hz]} frames/s",
    ),
    "sensor-fit-flicker": _sensor_fit(
        "sensor_fit_flicker",
        "{sensor_fit_flicker[static_s]} s of constant light and lamps that flicker with contrast "
        "{sensor_fit_flicker[contrast]:g}",
    ),
}  # fmt: skip
"""Every block by the name that its markers have."""
