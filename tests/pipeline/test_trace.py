"""dvc.yaml against what the stages really run and read: nothing is missing, and docs/pipeline.md says what re-runs."""

import functools
import json
import os
from pathlib import Path
from typing import NamedTuple

import preloaded
import pytest
import tracer
from ruamel.yaml import YAML
from test_stages import TINY, save_time

from polarnet.config.origins import Stage, pipeline


class Trace(NamedTuple):
    """What one stage ran and read."""

    files: set[str]
    keys: set[str]


@pytest.fixture(scope="module")
def stages(project_root: Path) -> dict[str, Stage]:
    return pipeline(project_root, YAML(typ="safe").load(project_root / "params.yaml"))


@pytest.fixture(scope="module")
def traces(project_root: Path, stages: dict[str, Stage], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Trace]:
    """Every stage of the pipeline, run once at toy size."""
    folder = tmp_path_factory.mktemp("traces")
    found = {}
    for name, stage in stages.items():
        arguments = [*TINY, f"paths.data={folder / 'data'}", f"paths.resume={folder / 'resume'}",
                     f"hydra.run.dir={folder / 'logs' / name}", *stage.overrides]  # fmt: skip
        file = folder / f"{name}.json"
        done = preloaded.run_stage(project_root, stage.script, arguments, functools.partial(prepare, file))
        assert done.returncode == 0, done.stdout
        content = json.loads(file.read_text())
        found[name] = Trace(set(content["files"]), set(content["keys"]))
    return found


def prepare(file: Path) -> None:
    save_time()
    tracer.record_to(file)


def covered(path: str, deps: list[str]) -> bool:
    return any(Path(path).is_relative_to(dep) for dep in deps)


def missing(trace: Trace, stage: Stage) -> tuple[set[str], set[str]]:
    """Files and keys that a stage uses and dvc.yaml does not name."""
    files = {file for file in trace.files if not file.startswith(tracer.ENTRY) and not covered(file, stage.deps)}
    plumbing = ("paths.", "runtime.", "cluster.")
    keys = {key for key in trace.keys if not key.startswith(plumbing) and key not in ("row", "baseline")}
    return files, {key for key in keys if not any(key == one or key.startswith(f"{one}.") for one in stage.params)}


pytestmark = pytest.mark.thorough


def test_a_stage_depends_on_all_code_that_it_runs_and_on_every_key_that_it_reads(traces, stages):
    found = {name: missing(traces[name], stage) for name, stage in stages.items()}
    assert {name: one for name, one in found.items() if any(one)} == {}


def test_the_docs_say_which_stages_a_change_runs_again(project_root, traces, stages, capsys):
    """POLARNET_WRITE=1 writes the table of docs/pipeline.md, and the counts of docs/results/pipeline.json."""
    unused = {name: unused_deps(traces[name], stage) for name, stage in stages.items()}
    with capsys.disabled():
        for name, deps in unused.items():
            print(f"{name}: depends on {', '.join(deps) or 'nothing'} without running it")
    page, results = project_root / "docs" / "pipeline.md", project_root / "docs" / "results" / "pipeline.json"
    before, _, rest = page.read_text().partition(START)
    assert rest, f"{page} has no {START}"
    text = f"{before}{START}\n\n{table_of(stages)}\n\n{END}{rest.partition(END)[2]}"
    figures = json.loads(results.read_text())
    counts = {
        "missing_dependencies": sum(len(missing(traces[name], stage)[0]) for name, stage in stages.items()),
        "unread_keys_missing": sum(len(missing(traces[name], stage)[1]) for name, stage in stages.items()),
        "unused_dependencies": sum(map(len, unused.values())),
        "dvc_yaml_lines": len((project_root / "dvc.yaml").read_text().splitlines()),
        "params_yaml_lines": len((project_root / "params.yaml").read_text().splitlines()),
    }
    if os.environ.get("POLARNET_WRITE"):
        page.write_text(text)
        results.write_text(json.dumps(figures | counts, indent=2) + "\n")
    assert page.read_text() == text, "run this test with POLARNET_WRITE=1"
    written = json.loads(results.read_text())
    assert {name: written[name] for name in counts} == counts, "run this test with POLARNET_WRITE=1"


START, END = "<!-- stages that a change runs again -->", "<!-- end -->"


def unused_deps(trace: Trace, stage: Stage) -> list[str]:
    """Folders of code among the dependencies of a stage of which it runs nothing."""
    code = [dep for dep in stage.deps if dep.startswith(("polarnet/", "stages/"))]
    return [dep for dep in code if not any(covered(file, [dep]) for file in trace.files)]


def table_of(stages: dict[str, Stage]) -> str:
    """Markdown table of the code, the data and the sections of params.yaml that each stage reads; all rows are one."""
    used: dict[str, tuple[set[str], set[str], set[str]]] = {}
    for name, stage in stages.items():
        code, data, sections = used.setdefault(name.partition("@")[0], (set(), set(), set()))
        code |= {dep.removeprefix("polarnet/") for dep in stage.deps if dep.startswith("polarnet/")}
        data |= {dep.removeprefix("data/") for dep in stage.deps if dep.startswith("data/")}
        sections |= {key.partition(".")[0] for key in stage.params}
    cells = [[", ".join(f"`{one}`" for one in sorted(kind)) for kind in kinds] for kinds in used.values()]
    lines = [f"| `{name}` | {' | '.join(kinds)} |" for name, kinds in zip(used, cells, strict=True)]
    head = "| stage | code below `polarnet/` | files below `data/` | sections of `params.yaml` |"
    return "\n".join([head, "|---|---|---|---|", *lines])
