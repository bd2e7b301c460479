import pytest

from polarnet.cli import main
from polarnet.reports.viewing import films_of


def test_a_folder_gives_events_and_truth_of_a_sequence_in_one_film(paths):
    films = {film.name: film for film in films_of(paths.events.parent)}
    assert {one.kind for one in films["tree-00"].maps} == {"events", "s0", "dolp", "aolp"}
    assert {one.kind for one in films["tree-00: scene"].maps} == {"s0", "dolp", "aolp"}


def test_an_unknown_sequence_is_refused_with_the_names_there_are(paths):
    with pytest.raises(ValueError, match=r"expected sequences among .*tree-00.*, got oak"):
        films_of(paths.frames, ["oak"])


def test_a_path_without_anything_to_show_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="found none"):
        films_of(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such path"):
        films_of(tmp_path / "nowhere")


def test_the_command_writes_a_page_of_the_sequences_asked_for(paths, tmp_path):
    page = tmp_path / "page.html"
    assert main(["view", str(paths.frames), "--sequence", "tree-00", "--out", str(page), "--no-browser"]) == 0
    assert '"name":"tree-00"' in page.read_text()
    assert "leaf-00" not in page.read_text()
