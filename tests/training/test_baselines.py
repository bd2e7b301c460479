import json

import pytest

from polarnet.training.baselines import NOT_TRAINED, USERS, is_used, leave_untrained

NO_FILES = dict.fromkeys(("e2v", "firenet", "e2vid", "e2p", "paper", "firenet_published"))


@pytest.mark.parametrize("row", ["e2v", "firenet", "e2vid", "e2v+gain", "firenet+gain"])
def test_every_row_of_the_trained_intensity_network_asks_for_its_training(row):
    assert is_used("e2v", ["zeros", row], NO_FILES)
    assert not is_used("e2p", ["zeros", row], NO_FILES)


def test_a_row_with_a_file_of_its_own_asks_for_no_training():
    files = NO_FILES | {"e2v": "mine.safetensors"}
    assert not is_used("e2v", ["e2v", "e2v+gain"], files)
    assert is_used("e2v", ["e2v", "firenet"], files)


def test_rows_of_published_weights_ask_for_no_training():
    methods = ["cf", "firenet_published", "firenet_published+gain", "paper", "ours"]
    assert not any(is_used(baseline, methods, NO_FILES) for baseline in USERS)


def test_a_training_that_no_row_uses_leaves_nothing_but_the_reason(tmp_path):
    folder = tmp_path / "train_e2p"
    folder.mkdir()
    (folder / "best.safetensors").write_bytes(b"of an earlier run")
    reason = leave_untrained("e2p", folder)
    assert [path.name for path in folder.iterdir()] == [NOT_TRAINED]
    assert json.loads((folder / NOT_TRAINED).read_text()) == {"reason": reason}
    assert "no row of benchmark.methods uses weights of baselines.e2p" in reason
