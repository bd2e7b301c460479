import dataclasses
import json
import shutil

import pytest

from polarnet.benchmark.results import RowRecord, read_record, read_rows, write_benchmark, write_row
from polarnet.benchmark.run import run_benchmark
from polarnet.benchmark.score import BenchmarkConfig

pytestmark = pytest.mark.usefixtures("brief_costs")

ROWS = ["zeros", "cf", "ours"]
CONFIG = BenchmarkConfig(ROWS, ["simulated"], 1, "fp32", False, "alex", 50, 2)


@pytest.fixture(scope="module")
def benchmark(five_scenes, make_context, brief_costs):
    """All rows in one run."""
    return run_benchmark(five_scenes, make_context(), CONFIG, None)


def written(folder, benchmark, rows=ROWS):
    for row in rows:
        write_row(folder / row, row, RowRecord(row, None, {}), {"simulated": benchmark})
    return {row: folder / row for row in rows}


@pytest.mark.thorough
def test_rows_that_ran_alone_give_the_table_of_one_run_to_the_last_digit(five_scenes, context, benchmark, tmp_path):
    folders = {}
    for row in ROWS:
        alone = run_benchmark(five_scenes, context, dataclasses.replace(CONFIG, methods=[row]), None)
        folders |= written(tmp_path / "rows", alone, [row])
    write_benchmark(tmp_path / "one", benchmark, CONFIG, 1, {})
    write_benchmark(tmp_path / "two", read_rows(folders, "simulated"), CONFIG, 1, {})
    for file in ("metrics.json", "details.json", "frames.csv"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    for panel in ("a1", "c1"):
        one, two = ((tmp_path / run / "panels" / f"{panel}.npz").read_bytes() for run in ("one", "two"))
        assert one == two


def test_rows_that_were_not_run_are_refused_and_a_table_holds_those_it_is_asked_for(benchmark, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"row cf was not run; run `dvc repro`"):
        read_record(tmp_path / "cf")
    folders = written(tmp_path, benchmark)
    with pytest.raises(FileNotFoundError, match="row zeros has not run on set measured"):
        read_rows(folders, "measured")
    file = folders["cf"] / "simulated" / "results.json"
    results = json.loads(file.read_text())
    results["frames"] = [score for score in results["frames"] if score[1] != "b1"]
    file.write_text(json.dumps(results))
    with pytest.raises(ValueError, match="row cf was scored on other sequences of set simulated than row zeros"):
        read_rows(folders, "simulated")
    folders = written(tmp_path, benchmark)
    del folders["cf"]
    left = read_rows(folders, "simulated")
    assert {score.method for score in left.rows} == {"zeros", "ours"}
    assert [list(panel.predictions) for panel in left.panels] == [["zeros", "ours"]] * 2
    assert set(left.costs) == {"zeros", "ours"}


def test_a_row_written_anew_keeps_nothing_and_the_folder_of_another_or_without_a_seal_is_refused(benchmark, tmp_path):
    write_row(tmp_path / "cf", "cf", RowRecord("cf", None, {}), {"simulated": benchmark, "measured": benchmark})
    written(tmp_path, benchmark, ["cf"])
    assert sorted(path.name for path in (tmp_path / "cf").iterdir()) == ["SHA256SUMS", "row.json", "simulated"]
    folders = written(tmp_path, benchmark, ["cf", "zeros"])
    shutil.rmtree(folders["cf"])
    shutil.copytree(folders["zeros"], folders["cf"])
    with pytest.raises(ValueError, match="cf: expected row cf, got a copy of row zeros; run `dvc repro`"):
        read_record(folders["cf"])
    (folders["zeros"] / "SHA256SUMS").unlink()
    with pytest.raises(ValueError, match="SHA256SUMS is missing, so that nothing says whether"):
        read_record(folders["zeros"])
