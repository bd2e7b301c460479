import shutil

from ruamel.yaml import YAML

from studies.new_baselines import PUBLISHED, TRAINED, add


def folder_of_a_clone(project_root, tmp_path):
    for room in ("methods", "networks", "training"):
        (tmp_path / "polarnet" / room).mkdir(parents=True)
    shutil.copy(project_root / "params.yaml", tmp_path)
    return tmp_path


def test_a_published_baseline_gets_two_modules_and_its_keys(project_root, tmp_path):
    clone = folder_of_a_clone(project_root, tmp_path)
    before = YAML(typ="safe").load(clone / "params.yaml")
    add(clone, PUBLISHED)
    after = YAML(typ="safe").load(clone / "params.yaml")
    assert sorted(path.name for path in clone.rglob("calm_firenet.py")) == ["calm_firenet.py"] * 2
    assert after["rows"]["calm_firenet"]["settings"] == "methods.calm_firenet"
    assert after["methods"].pop("calm_firenet") == {"weights": "../calm_firenet.pth"}
    del after["rows"]["calm_firenet"]
    assert after == before
    assert "# visits; each of the four channels of a visit is one stream" in (clone / "params.yaml").read_text()


def test_a_trained_baseline_also_gets_its_training_with_the_values_of_e2v(project_root, tmp_path):
    clone = folder_of_a_clone(project_root, tmp_path)
    add(clone, TRAINED)
    baselines = YAML(typ="safe").load(clone / "params.yaml")["baselines"]
    assert (clone / "polarnet" / "training" / "small_firenet.py").exists()
    assert baselines["trained"] == ["e2v", "small_firenet"]
    assert baselines["small_firenet"] == baselines["e2v"]
