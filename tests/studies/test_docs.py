import json
import math

import pytest

from studies.docs import benchmark_block, update_results_blocks
from studies.measure import BENCHMARK_KEYS
from studies.recording_tables import recordings_block, recover_block
from studies.study_tables import (
    ablation_block,
    choices_block,
    designs_block,
    event_budget_block,
    expected_errors_block,
    headline_block,
    lpips_block,
    study_block,
)

RESULTS = {
    "setup_minutes": 1.5,
    "repro_minutes": 12.34,
    "stage_minutes": {"ingest": 0.25, "train": 8.0},
    "test_minutes": 4.5,
    "cores": 2,
    "load": 0.1,
    "versions": {"python": "3.11", "torch": "2.13.0"},
    "commit": "abc1234",
    "machine": "a processor",
    "metrics": {"zeros": {"mse": 0.1, "psnr": 10.0}, "ours": {"mse": 0.02, "psnr": 17.0}},
}
BEFORE = "# title\n\n<!-- results:pipeline -->\n<!-- /results:pipeline -->\n\nafter\n"


@pytest.fixture
def project(tmp_path):
    (tmp_path / "docs" / "results").mkdir(parents=True)
    (tmp_path / "docs" / "results" / "pipeline.json").write_text(json.dumps(RESULTS))
    (tmp_path / "README.md").write_text(BEFORE)
    return tmp_path


def test_the_block_shows_the_committed_results_and_nothing_else_changes(project):
    assert update_results_blocks(project, check=False) == [project / "README.md"]
    text = (project / "README.md").read_text()
    assert text.startswith("# title\n\n<!-- results:pipeline -->\n")
    assert text.endswith("\n<!-- /results:pipeline -->\n\nafter\n")
    assert "| ours | **0.0200** | **17.00** |" in text
    assert "`make repro` took 12.3 minutes after a set-up of 1.5, `make test` 4.5, on 2 cores (a processor" in text
    assert "Minutes by stage: ingest 0.2, train 8.0." in text


def test_a_run_whose_tests_failed_is_shown_without_their_minutes(project):
    results = {key: value for key, value in RESULTS.items() if key != "test_minutes"}
    (project / "docs" / "results" / "pipeline.json").write_text(json.dumps(results))
    update_results_blocks(project, check=False)
    assert "after a set-up of 1.5, on 2 cores (a processor" in (project / "README.md").read_text()


def test_a_second_update_changes_nothing(project):
    update_results_blocks(project, check=False)
    assert update_results_blocks(project, check=False) == []


def test_check_reports_drift_and_writes_nothing(project):
    assert update_results_blocks(project, check=True) == [project / "README.md"]
    assert (project / "README.md").read_text() == BEFORE


def test_check_passes_after_an_update_and_fails_after_an_edit_by_hand(project):
    update_results_blocks(project, check=False)
    assert update_results_blocks(project, check=True) == []
    readme = project / "README.md"
    readme.write_text(readme.read_text().replace("17.00", "27.00"))
    assert update_results_blocks(project, check=True) == [readme]


def test_documents_below_docs_are_updated_too(project):
    (project / "docs" / "pipeline.md").write_text(BEFORE)
    assert project / "docs" / "pipeline.md" in update_results_blocks(project, check=False)


def test_a_block_that_is_not_closed_is_an_error(project):
    (project / "README.md").write_text("<!-- results:pipeline -->\n")
    with pytest.raises(ValueError, match="close each block"):
        update_results_blocks(project, check=True)


def test_a_block_without_a_renderer_is_an_error(project):
    (project / "README.md").write_text("<!-- results:dreams -->\n<!-- /results:dreams -->\n")
    with pytest.raises(ValueError, match="no renderer for results:dreams; there are pipeline"):
        update_results_blocks(project, check=True)


def test_a_block_without_results_says_which_command_measures_them(project):
    (project / "docs" / "results" / "pipeline.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"run `python -m studies\.measure`"):
        update_results_blocks(project, check=True)


EMULATION = {
    "machine": "a processor",
    "cores": 2,
    "load": 0.4,
    "versions": {"python": "3.11", "numba": "0.68.1"},
    "commit": "abc1234567890",
    "v2e_default": {"seconds_1_thread": 0.0912, "seconds_2_threads": 0.0497, "timing_error_ms_300fps": 1.75},
    "exact": {"seconds_1_thread": 0.1104, "seconds_2_threads": 0.0605, "timing_error_ms_300fps": 0.21},
    "esim": {"seconds_1_thread": 0.05, "seconds_2_threads": 0.03},
    "golden_cases_passed": 22,
    "paper_set": {"sequences": 1000, "minutes": 4.25, "peak_mib": 1234, "stage_minutes": {"ingest": 0.5}},
}
EMULATION_PAGE = "<!-- results:emulation -->\n<!-- /results:emulation -->\n"


def test_the_emulation_block_has_a_row_a_model_and_what_the_paper_set_took(project):
    (project / "docs" / "results" / "emulation.json").write_text(json.dumps(EMULATION))
    page = project / "docs" / "scaling.md"
    page.write_text(EMULATION_PAGE)
    assert page in update_results_blocks(project, check=False)
    text = page.read_text()
    assert "| model | seconds, 1 thread | 2 threads | timing error at 300 fps, ms |" in text
    assert "| `exact` | 0.110 | 0.060 | 0.210 |" in text
    assert "| `esim` | 0.050 | 0.030 | - |" in text
    assert "met: 22 of 23" in text
    assert "A set of 1000 sequences" in text
    assert "took 4.2 minutes with at most 1,234 MiB of memory (ingest 0.5)" in text
    assert "On 2 cores (a processor, load 0.4" in text
    assert "commit `abc1234567`" in text


def test_the_emulation_block_says_how_to_measure_while_nobody_has(project):
    (project / "docs" / "scaling.md").write_text(EMULATION_PAGE)
    update_results_blocks(project, check=False)
    assert "Not measured yet: `python -m studies.emulation --write`" in (project / "docs/scaling.md").read_text()
    assert update_results_blocks(project, check=True) == []


MACHINE = {"machine": "a processor", "cores": 2, "load": 1.0, "versions": {"python": "3.11"}, "commit": "abc1234"}


def study_seed(mse, minutes):
    """What docs/results/network.json holds of a seed."""

    def scores(mse):
        rest = dict.fromkeys(("pattern_mse", "psnr", "ssim", "corr"), 0.0)
        return {"mse": mse, "level_mse": mse / 2, **rest, "aolp_deg": None}

    rows = {"zeros": 0.2, "oracle_mean": 0.03, "cf": 0.1, "firenet+gain": 0.05, "paper": 0.04, "ours": mse}
    table = {row: scores(value) for row, value in rows.items()}
    return {
        "rows": {"simulated": table, "measured": table},
        "minutes_trained": {"paper": minutes, "ours": None},
        "threads": 1,
        "gain_over_paper_db": 1.5,
        "mse_over_paper": mse / 0.04,
        "mse_over_oracle_mean": mse / 0.03,
        "measured": {"mse_over_best_baseline": mse / 0.05},
    }


def test_the_headlines_are_means_over_the_seeds_and_name_the_best_reconstruction_s_error():
    record = {**MACHINE, "machine": "a laptop"}
    results = {
        "seed_1": study_seed(0.02, 36.0),
        "seed_2": study_seed(0.03, 30.0),
        "ours": {"infer_windows_per_s": 50.6},
        "throughput": {"height": 120, "width": 180, "threads": 2, "device": "cpu"},
        "records": {"throughput": record},
    }
    *table, _, last = headline_block(results).splitlines()
    assert table[2:] == [
        "| each frame's own mean, as if it were known | 0.0300 | 0.00 | 0.0300 | 0.00 |",
        "| the best reconstruction of intensities from events | 0.0500 | 0.00 | 0.0500 | 0.00 |",
        "| the paper's network | 0.0400 | 0.00 | 0.0400 | 0.00 |",
        "| ours: polarnet's network | 0.0250 | 0.00 | 0.0250 | 0.00 |",
    ]
    assert "Means of 2 training(s); minutes that one took: the paper's network 33." in last
    assert "51 windows of 120 x 180 pixels a second with 2 threads (cpu, a laptop)" in last


def test_the_study_of_the_networks_shows_every_seed_beside_what_must_be_beaten():
    results = {
        "seed_1": study_seed(0.02, 36.2),
        "seed_2": study_seed(0.025, 30.0),
        "shipped": study_seed(0.015, 1.0),
        "records": {"seed_1": MACHINE, "seed_2": MACHINE},
        "throughput": {},
    }
    lines = study_block(results).splitlines()
    shown = [line.split(" | ")[0].removeprefix("| ") for line in lines if line.startswith("| ") and "↓" not in line]
    kinds = ("seed 1", "seed 2", "mean of 2 seeds ± standard deviation")
    networks = [f"{network}, {kind}" for network in ("the paper's network", "ours") for kind in kinds]
    assert shown == ["oracle mean", "FireNet, gains solved", *networks, "ours, shipped weights"] * 2
    said = "\n".join(lines)
    assert "| ours, seed 2 | 0.0250 | 0.0125 |" in said
    assert "| ours, mean of 2 seeds ± standard deviation | 0.0225 ± 0.0035 |" in said
    assert "PSNR over the paper's network +1.50 dB, MSE over its 0.56; over the oracle mean's 0.75; on measured" in said
    assert (
        "Shipped weights: PSNR over the paper's network +1.50 dB, MSE over its 0.38; over the oracle mean's 0.50;"
        in said
    )
    assert "Seed 1: minutes of training: paper 36; trained and scored on 1 core(s) (a processor" in said


def test_expected_errors_are_shown_as_factors_a_line_for_each_seed():
    def expecting(factor):
        return {"sets": {name: {"mse": 0.03, "log_error": math.log(factor)} for name in ("simulated", "measured")}}

    records = {"seed_1": MACHINE, "seed_2": MACHINE}
    lines = expected_errors_block({"seed_1": expecting(1.5), "seed_2": expecting(2), "records": records}).splitlines()
    assert lines[0].count("off by a factor of") == 2
    assert lines[2:4] == [
        "| ours, seed 1 | 0.0300 | 1.50 | 0.0300 | 1.50 |",
        "| ours, seed 2 | 0.0300 | 2.00 | 0.0300 | 2.00 |",
    ]
    assert [line for line in lines if line.startswith("Seed 2: a processor")]


def test_an_ablation_shows_the_whole_first_and_then_what_is_missed_most():
    def scores(mse, about):
        return dict.fromkeys(("level_mse", "pattern_mse", "psnr", "ssim", "corr"), 0.0) | {
            "mse": mse, "aolp_deg": None, "about": about,
        }  # fmt: skip

    rows = {"sums": scores(0.04, "No sums."), "scales": scores(0.05, "One."), "nothing": scores(0.045, "All.")}
    found = {"ablation": {"rows": rows, "overrides": ["train.epochs=1"]}, "records": {"ablation": MACHINE}}
    lines = ablation_block(found).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:5]] == ["| `nothing`", "| `scales`", "| `sums`"]
    assert lines[3].startswith("| `scales` | One. | 0.0500 | 0.0000 |")
    assert "One training each, `train.epochs=1`." in lines[-1]


def test_choices_of_scenes_are_means_over_their_trainings():
    def scores(mse, aolp):
        return dict.fromkeys(("level_mse", "pattern_mse", "psnr", "ssim", "corr"), 0.5) | {"mse": mse, "aolp_deg": aolp}

    rows = {
        "shipped": {"about": "As shipped.", "seeds": [scores(0.02, 10.0), scores(0.03, 12.0)]},
        "oracle_mean": {"about": "Each frame's own mean.", "seeds": [scores(0.04, None)]},
    }
    found = {"choices": {"rows": rows, "overrides": ["train.windows=6"]}, "records": {"choices": MACHINE}}
    lines = choices_block(found).splitlines()
    assert "Trained with `train.windows=6`;" in lines[-1]
    assert lines[2].startswith("| As shipped. | 2 | 0.0250 ± 0.0071 |")
    assert lines[2].endswith("| 11.0 ± 1.4 |")
    assert lines[3].startswith("| Each frame's own mean. | - | 0.0400 | 0.5000 |")
    assert lines[3].endswith("| - |")


def test_the_benchmark_says_what_solved_gains_bring():
    rows = {"zeros": 9.0, "cf": 8.0, "cf+gain": 9.25, "highpass": 12.0, "highpass+gain": 11.5, "ours": 17.0}
    scores = {
        row: dict.fromkeys(BENCHMARK_KEYS, 0.1) | {"psnr": psnr, "lpips_backbone": "vgg"} for row, psnr in rows.items()
    }
    about = {"scenes": 30, "frames": 750}
    results = MACHINE | {"simulated": scores, "about": {"simulated": about}, "paired": {"simulated": {}}}
    block = benchmark_block(results)
    assert "**Simulated**: 30 scenes, 750 frames" in block
    assert "- PSNR that solved gains bring: CF +1.25 dB, high-pass -0.50 dB." in block


def test_the_cost_of_lpips_has_a_row_for_each_backbone_and_one_without():
    demo = {"network": "polarnet", "precision": "bf16", "frames": 40, "step_ms": {"none": 900.0, "alex": 1000.0}}
    paper = {"network": "paper", "precision": "fp32", "frames": 10, "step_ms": {"none": 500.0, "vgg": 2000.0}}
    shares = {"demo": demo | {"share": {"alex": 0.1}}, "paper": paper | {"share": {"vgg": 0.75}}}
    cost = {"threads": 2, "device": "cpu"} | shares
    found = {"alex_error_max": 4e-7, "scoring_ms_per_frame": {"alex": 2.54}}
    block = lpips_block(found | {"cost": cost, "records": {"cost": MACHINE}})
    assert "| without LPIPS | - | - | 900 | - |" in block
    assert "| `alex` | 4.0e-07 | 2.5 | 1000 | 10 % |" in block
    assert "takes 2000 ms with VGG and 500 ms without LPIPS: 75 % are LPIPS's." in block


def test_the_event_budget_is_held_against_the_papers_claim():
    def entries(psnr):
        bins = ((0.0, 0.75, 0.5), (0.75, 1.5, 1.1), (1.5, None, 4.0))
        return [
            {"from": low, "to": high, "events_per_pixel": at, "scenes": 3, "psnr": psnr + k, "corr": 0.1 * k}
            for k, (low, high, at) in enumerate(bins)
        ]

    budget = {"since_start": {"ours": entries(14.0), "oracle_mean": entries(18.0)}, "sequences": ["a", "b", "c"]}
    block = event_budget_block({"budget": budget, "records": {"budget": MACHINE}})
    assert "| events per pixel | scenes | oracle mean: PSNR | corr. | ours: PSNR | corr. |" in block
    assert "| 1.10 | 3 | 19.00 | 0.100 | 15.00 | 0.100 |" in block
    assert "At 1.10 events per pixel, the bin of the paper's 1.04, ours has 15.00 dB" in block
    assert "the highest correlation, 0.200 with 16.00 dB, comes at 4.0." in block


def test_recordings_are_shown_reader_by_reader_with_libraries_beside_them():
    readers = {
        "evt2": {"mevents_per_s": 60.25, "peak_mib": {"1M": 12, "10M": 13}},
        "faery_evt2": {"mevents_per_s": 80.0, "peak_mib": {"1M": 1}},
        "celex5_csv": {"mevents_per_s": 4.0, "peak_mib": {"1M": 20}},
    }
    fuzz = {"cases_per_reader": 10000, "readers": {"evt": {"cases": 10000, "endings": {"read": 1999, "refused": 8001}}}}
    block = recordings_block({"readers": readers, "fuzz": fuzz, "records": {"readers": MACHINE, "fuzz": MACHINE}})
    assert "| format | polarnet | faery | MiB at 1M | MiB at 10M |" in block
    assert "| `evt2` | 60.2 | 80.0 | 12 | 13 |" in block
    assert "| `celex5_csv` | 4.0 | - | 20 | - |" in block
    assert "at least 10,000 for each reader" in block
    assert "| `evt` | 10,000 | 1,999 | 0 | 8,001 |" in block
    assert block.count("On 2 cores (a processor, load 1.0 before the start; python 3.11; commit `abc1234`).") == 2


def test_the_speed_of_recover_is_shown_method_by_method():
    network = {"realtime_factor": 1.234, "latency_ms": 21.84, "live_latency_ms": 40.2}
    methods = {"network": network, "highpass+gain": {"realtime_factor": 2.0, "latency_ms": 9.0}}
    about = {"network": "x", "precision": "bf16", "events": 2500, "seconds": 10.0, "methods": methods}
    block = recover_block({"recover": MACHINE | about})
    assert block.startswith("2,500 events in 10 s")
    assert "| network `x`, bf16 | 1.23 | 21.8 | 40 |" in block
    assert "| `highpass+gain` | 2.00 | 9.0 | - |" in block
    assert "On 2 cores (a processor" in block


def test_designs_stand_in_the_order_they_were_tried_with_the_commit_of_their_figures():
    scores = {
        "mse": 0.04,
        "level_mse": 0.03,
        "pattern_mse": 0.01,
        "psnr": 14.0,
        "ssim": 0.5,
        "corr": 0.6,
        "aolp_deg": 15.0,
    }
    found = [
        {"about": "First.", "commit": "a1", "seeds": [scores], "mse_over_oracle_mean": [1.3], "measured_mse": [0.02]},
        {
            "about": "Second.", "commit": "b2", "seeds": [scores, scores | {"mse": 0.02}],
            "mse_over_oracle_mean": [1.3, 1.1], "measured_mse": [0.02, 0.03],
        },
    ]  # fmt: skip
    lines = designs_block({"rows": {"designs": found}}).splitlines()
    assert lines[2].startswith("| First. | 1 | 1.300 | 0.0400 | 0.0300 |")
    assert lines[2].endswith("| 0.0200 | `a1` |")
    assert lines[3].startswith("| Second. | 2 | 1.200 | 0.0300 ± 0.0141 |")
    assert lines[3].endswith("| 0.0250 | `b2` |")
    assert len({line.count("|") for line in lines}) == 1


def test_the_rig_is_shown_with_its_errors_and_its_benchmark():
    rig = {
        "captures": 64, "sensor": [200, 320], "start_error_frames_max": 0.957, "refined_error_ms_max": 0.593,
        "clock_zero_ms_max": 11.6, "dolp_rms": 0.005, "dolp_rms_max": 0.00685,
        "benchmark": {"zeros": {"mse": 0.1}, "cf": {"mse": 0.05}},
    }  # fmt: skip
    block = recordings_block({"rig": rig, "records": {"rig": MACHINE}})
    assert "64 captures of a sensor of 320 x 200 px" in block
    assert "within 0.96 pictures of the camera, refined ones within 0.59 ms of each other" in block
    assert "| CF | **0.0500** |" in block


def test_a_section_of_a_results_file_has_a_block_of_its_own(project):
    row = {"precision": "fp32", "gflop_per_window": 10.0, "peak_gflop_per_s": 100.0, "infer_windows_per_s": 5.0}
    setting = row | {"train_frames_per_s": 2.0, "train_profile": {"aten::mm": 60.4, "x": 0.2}, "infer_profile": {}}
    ratio = {"train_frames_per_s": 1.0, "infer_windows_per_s": 1.0}
    network = {"naive": setting, "shipped": setting, "shipped_over_naive": ratio}
    throughput = {"threads": 1, "device": "cpu", "networks": {"paper": network}}
    file = project / "docs" / "results" / "network.json"
    (project / "docs" / "training.md").write_text(BEFORE.replace("pipeline", "network-throughput"))
    file.write_text(json.dumps({"other": 1}))
    update_results_blocks(project, check=False)
    assert "Not measured yet" in (project / "docs" / "training.md").read_text()
    file.write_text(json.dumps({"throughput": throughput, "records": {"throughput": RESULTS}}))
    update_results_blocks(project, check=False)
    text = (project / "docs" / "training.md").read_text()
    assert "| `paper` | shipped | fp32 | 2.00 | 5.00 | 10.00 | 60 % | 50 % | 10 |" in text
    assert "| `paper`, naive, train | aten::mm 60 |" in text
