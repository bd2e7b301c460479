import json
from pathlib import Path

from polarnet.sweep import sweep_points, sweep_table


def finished_job(folder: Path, number: int, overrides: list[str], mse: float) -> None:
    job = folder / str(number)
    (job / ".hydra").mkdir(parents=True)
    (job / "benchmark").mkdir()
    (job / ".hydra" / "overrides.yaml").write_text("".join(f"- {override}\n" for override in overrides))
    scores = {"mse": mse, "psnr": 15.0, "ssim": 0.5, "lpips": None, "corr": 0.25}
    (job / "benchmark" / "metrics.json").write_text(json.dumps({"ours": scores, "zeros": {}}))


def test_the_table_has_one_row_a_job_best_first_and_says_where_lpips_is_missing(tmp_path):
    finished_job(tmp_path, 0, ["loss.ssim=0.0"], 0.04)
    finished_job(tmp_path, 1, ["loss.ssim=1.0"], 0.03)
    (tmp_path / "2").mkdir()  # a job that failed
    points = sweep_points(tmp_path)
    assert [point["job"] for point in points] == ["1", "0"]
    assert sweep_table(points).splitlines()[2:] == [
        "| 1 | loss.ssim=1.0 | 0.0300 | 15.0000 | 0.5000 | - | 0.2500 |",
        "| 0 | loss.ssim=0.0 | 0.0400 | 15.0000 | 0.5000 | - | 0.2500 |",
    ]
