"""A search stops hopeless trials, survives failed ones, and continues where it was stopped."""

import sys

import pytest

from polarnet.config import search as module
from polarnet.config.search import STUDY, parse_space, search

optuna = pytest.importorskip("optuna")

TRIAL = """
import sys, time, pathlib
given = dict(word.split("=", 1) for word in sys.argv[1:])
job = pathlib.Path(given["hydra.run.dir"])
mse = float(given["x"])
if mse > 9:
    (job / "failure.txt").write_text("train: x is too large\\n")
    sys.exit(1)
training = job / "train" / "ours"
training.mkdir(parents=True)
lines = ["epoch,train_total,val_mse"]
for epoch in range(2):
    lines.append(f"{epoch},1.0,{mse}")
    (training / "partial").write_text("\\n".join(lines) + "\\n")
    (training / "partial").rename(training / "history.csv")
    time.sleep(60 if mse > 5 and epoch == 0 else 0)  # a hopeless trial would go on for a minute
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a search over given values of x in the folder `search`."""
    monkeypatch.setattr(module, "POLL_S", 0.02)
    script = tmp_path / "trial.py"
    script.write_text(TRIAL)
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def of(values, trials):
        remaining = iter(values)
        space = {"x": lambda trial: trial.suggest_float("x", value := next(remaining), value)}
        return search([sys.executable, str(script)], space, [], tmp_path / "search", trials, 1, 1)

    return of


def trials_in(folder):
    return optuna.load_study(study_name="search", storage=f"sqlite:///{folder / STUDY}").get_trials()


def test_a_hopeless_trial_is_stopped_and_a_failed_one_stops_no_other(run, tmp_path):
    assert run([1.0, 2.0, 3.0, 8.0, 10.0, 0.5], 6) == 6
    states = [trial.state.name for trial in trials_in(tmp_path / "search")]
    assert states == ["COMPLETE", "COMPLETE", "COMPLETE", "PRUNED", "FAIL", "COMPLETE"]
    reasons = [(tmp_path / "search" / job / "failure.txt").read_text() for job in ("3", "4")]
    assert reasons == ["stopped after epoch 1: worse than the median\n", "train: x is too large\n"]


def test_a_search_continues_with_what_is_missing_and_repeats_an_interrupted_trial(run, tmp_path):
    assert run([1.0, 2.0], 2) == 2
    study = optuna.load_study(study_name="search", storage=f"sqlite:///{tmp_path / 'search' / STUDY}")
    study.ask()  # a trial whose search was killed
    assert run([0.5, 0.4], 4) == 2
    assert [trial.state.name for trial in trials_in(tmp_path / "search")].count("COMPLETE") == 4
    assert run([], 4) == 0


def test_words_span_a_space_and_others_are_refused():
    trial = optuna.trial.FixedTrial({"loss.mse": 3.0, "network": "paper"})
    space = parse_space(["loss.mse=1.0:30.0:log", "network=polarnet,paper"])
    assert {key: draw(trial) for key, draw in space.items()} == {"loss.mse": 3.0, "network": "paper"}
    for word in ("seed=1", "seed=3:1", "seed=0:1:log", "seed=1:2:linear"):
        with pytest.raises(ValueError, match="LOW:HIGH"):
            parse_space([word])
