import subprocess

import pytest

from polarnet.reports.provenance import facts


@pytest.fixture
def project(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True)

    (tmp_path / "code.py").write_text("1\n")
    (tmp_path / "dvc.lock").write_text("1\n")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "--message", "one")
    return tmp_path


def test_edited_code_is_said_but_what_the_pipeline_writes_is_no_edit(project):
    assert len(facts(project)["commit"]) == 40
    (project / "dvc.lock").write_text("2\n")
    assert len(facts(project)["commit"]) == 40
    (project / "code.py").write_text("2\n")
    assert facts(project)["commit"].endswith(", with uncommitted changes")
