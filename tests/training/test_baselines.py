import json
from types import SimpleNamespace

import pytest

from polarnet.methods import METHODS
from polarnet.training.baselines import NOT_TRAINED, USERS, is_used, leave_untrained


def files(**weights):
    """Section `methods` with these weights files and no other."""
    rows = ("e2v", "firenet", "e2vid", "e2p", "paper", "firenet_published")
    return SimpleNamespace(**{row: SimpleNamespace(weights=weights.get(row)) for row in rows})


def test_the_rows_that_use_a_training_are_those_whose_records_name_its_stage():
    for baseline, rows in USERS.items():
        assert {*rows} == {
            method.section
            for method in METHODS.values()
            if method.weights is not None and method.weights.trained_by == f"train_{baseline}"
        }


@pytest.mark.parametrize("row", ["e2v", "firenet", "e2vid", "e2v+gain", "firenet+gain"])
def test_every_row_of_the_trained_intensity_network_asks_for_its_training(row):
    assert is_used("e2v", ["zeros", row], files())
    assert not is_used("e2p", ["zeros", row], files())


def test_a_row_with_a_file_of_its_own_asks_for_no_training():
    methods = files(e2v="mine.safetensors")
    assert not is_used("e2v", ["e2v", "e2v+gain"], methods)
    assert is_used("e2v", ["e2v", "firenet"], methods)


def test_rows_of_published_weights_ask_for_no_training():
    rows = ["cf", "firenet_published", "firenet_published+gain", "paper", "ours"]
    assert not any(is_used(baseline, rows, files()) for baseline in USERS)


def test_a_training_that_no_row_uses_leaves_nothing_but_the_reason(tmp_path):
    folder = tmp_path / "train_e2p"
    folder.mkdir()
    (folder / "best.safetensors").write_bytes(b"of an earlier run")
    reason = leave_untrained("e2p", folder)
    assert [path.name for path in folder.iterdir()] == [NOT_TRAINED]
    assert json.loads((folder / NOT_TRAINED).read_text()) == {"reason": reason}
    assert "no row of benchmark.methods uses weights of baselines.e2p" in reason
