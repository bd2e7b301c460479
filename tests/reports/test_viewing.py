import numpy as np
import pytest
import zarr

from polarnet.cli import main
from polarnet.reports.viewing import films_of


def test_a_folder_a_recovery_and_a_recording_are_films_with_their_times(data, tmp_path):
    films = {film.name: film for film in films_of(data)}
    assert {one.kind for one in films["tree-00"].maps} == {"events", "s0", "dolp", "aolp"}
    assert {one.kind for one in films["tree-00: scene"].maps} == {"s0", "dolp", "aolp"}
    group = zarr.open_group(tmp_path / "night" / "recovered.zarr", mode="w")
    group["t_us"] = np.array([33_000, 66_000])
    for name in ("dolp", "aolp"):
        group[name] = np.full((2, 4, 6), 65535 // 2, np.uint16)
    (film,) = films_of(tmp_path / "night")
    assert film.t_us == [33_000, 66_000]
    assert {one.kind for one in film.maps} == {"dolp", "aolp"}
    (tmp_path / "night.txt").write_text("40 30\n913000000 3 2 1\n913000240 4 2 1\n")
    (film,) = films_of(tmp_path / "night.txt")
    assert (film.t_us[0], film.t_us[-1]) == (10, 241)


def test_the_command_opens_the_page_that_a_recovery_has(tmp_path, monkeypatch, capsys):
    (tmp_path / "index.html").write_text("a recovery")
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(tmp_path)]) == 0
    assert opened == [(tmp_path / "index.html").as_uri()]
    assert not (tmp_path / "outputs").exists()
    assert main(["view", str(tmp_path), "--sequence", "lake"]) == 1
    assert "a folder with a page: expected no --sequence" in capsys.readouterr().err


def test_a_path_without_anything_to_show_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="found none"):
        films_of(tmp_path)


def test_the_command_writes_a_page_of_the_sequences_asked_for(data, tmp_path):
    page = tmp_path / "page.html"
    with pytest.raises(ValueError, match=r"expected sequences among .*tree-00.*, got oak"):
        films_of(data / "frames.zarr", ["oak"])
    assert main(["view", str(data / "frames.zarr"), "--sequence", "tree-00", "--out", str(page), "--no-browser"]) == 0
    assert '"name":"tree-00"' in page.read_text()
    assert "leaf-00" not in page.read_text()
