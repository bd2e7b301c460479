"""Generated pages of the documentation site, a hook of mkdocs.yml: `make docs`.

Parameters come from params.yaml and the schema of its sections, the Python reference from docstrings, and the page on
contributing from CONTRIBUTING.md. The player of the home page shows a simulation of a few seconds. Links to files
outside docs/ lead to copies of them.
"""

import pkgutil
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pydantic import TypeAdapter
from ruamel.yaml import YAML
from torch import Tensor

import polarnet
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import Config, load
from polarnet.events.representations import polarity_sums
from polarnet.methods import METHODS
from polarnet.networks import shipped_weights
from polarnet.pictures import BUILTIN_PHOTOS, read_rgb
from polarnet.reports.player import TRUTH, Film, Map, write_player
from polarnet.simulation import MOTIONS, SENSORS, simulate
from polarnet.storage.panels import angle_bytes, fraction_bytes, signed_bytes

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = re.compile(r"\]\(\.\./([^)#]+)(#[^)]*)?\)")
LIMITS = {"minimum": ">= {}", "exclusiveMinimum": "> {}", "maximum": "<= {}", "exclusiveMaximum": "< {}",
          "minItems": "at least {} values", "maxItems": "at most {} values"}  # fmt: skip
PHOTOGRAPH = "astronaut"
SHOWN = {"polarnet": ("ours", shipped_weights()), "high-pass": ("highpass", None)}
"""Methods in the player of the home page, with their weights, by caption."""
NOT_LIBRARY = ("cli", "config")
"""Folders of polarnet that are the command line and the configuration, which other pages describe."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, and copies of the files outside docs/ that pages link to."""
    for path, text in {**generated_pages(), "player.html": player_page()}.items():
        files.append(File.generated(config, path, content=text))
    linked = {name for page in files.documentation_pages() for name, _ in OUTSIDE.findall(page.content_string)}
    for name in sorted(linked):
        if (ROOT / name).is_file():
            files.append(File.generated(config, f"source/{name}.txt", content=(ROOT / name).read_text()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to files outside docs/ to their copies."""
    return OUTSIDE.sub(r"](source/\1.txt)", markdown)


def generated_pages() -> dict[str, str]:
    """Text of each generated page by its path."""
    contributing = (ROOT / "CONTRIBUTING.md").read_text().replace("](docs/", "](")
    return {"parameters.md": parameters_page(), "contributing.md": contributing, **api_pages()}


def player_page() -> str:
    """The player on a simulated sequence: events, truth, and the methods `SHOWN`; takes seconds."""
    photo = next(one for one in BUILTIN_PHOTOS if one.path.stem == PHOTOGRAPH)
    simulated = simulate(read_rgb(photo.path), MOTIONS["default"], SENSORS["default"], seed=1)
    truth = simulated.dolp[1:], simulated.aolp[1:]
    sequence = TestSequence(
        PHOTOGRAPH, PHOTOGRAPH, simulated.events, simulated.t_us, *truth, simulated.intensities[1:, ::2].sum(1)
    )
    windows, config, size = sequence.windows, load(ROOT), sequence.dolp.shape[1:]
    counts = torch.stack([torch.stack([*map(polarity_sums, window.channels)]).sum(0) for window in windows])
    maps = [Map("Events", "events", signed_bytes(counts).numpy())]
    maps += [Map(TRUTH, "s0", fraction_bytes(sequence.s0).numpy()), *_polarization(TRUTH, *truth)]
    for caption, (name, weights) in SHOWN.items():
        method = METHODS[name].open(setup_of(config, METHODS[name], weights))
        prediction = method.step(method.start(*size), windows)[1]
        maps += _polarization(caption, prediction.dolp, prediction.aolp)
    first = config.benchmark.warmup_windows  # before, few events have arrived
    film = Film(PHOTOGRAPH, simulated.t_us[1 + first :].tolist(), [m._replace(frames=m.frames[first:]) for m in maps])
    facts = {"photograph": f"{photo.file} of scikit-image by {photo.author}, {photo.licence}",
             "sensor": f"{size[0]} x {size[1]} pixels behind four polarizers, simulated",
             "by hand": f"polarnet demo --photograph {PHOTOGRAPH}"}  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        return write_player(Path(folder, "player.html"), "A simulated camera", [film], facts).read_text()


def _polarization(source: str, dolp: Tensor, aolp: Tensor | None) -> list[Map]:
    angles = [] if aolp is None else [Map(source, "aolp", angle_bytes(aolp).numpy())]
    return [*angles, Map(source, "dolp", fraction_bytes(dolp).numpy())]


def parameters_page() -> str:
    """A table for each section of params.yaml: key, default, type and range, meaning."""
    values = YAML().load(ROOT / "params.yaml")
    schema = TypeAdapter(Config).json_schema()
    lines = [
        "# Parameters",
        "",
        "`params.yaml` holds every value that changes a result. This page lists its keys with the values of the",
        "repository, the type and range that polarnet accepts, and the meaning.",
        "[Configuration](configuration.md) says how to change them.",
    ]
    single = {key: value for key, value in values.items() if not isinstance(value, Mapping)}
    lines += ["", "## Outside sections", *_table(values, single, schema, schema)]
    for name, section in values.items():
        if isinstance(section, Mapping):
            part = _resolved(schema["properties"][name], schema)
            lines += ["", f"## {name}", *_table(section, section, part, schema)]
    return "\n".join(lines) + "\n"


def _table(commented: Any, keys: Mapping[str, Any], part: Mapping[str, Any], schema: Mapping[str, Any]) -> list[str]:
    head = ["", "| key | value | type and range | meaning |", "|---|---|---|---|"]
    return head + [" | ".join(("", *row, "")).strip() for row in _rows(commented, keys, part, schema)]


def _rows(commented: Any, keys: Mapping[str, Any], part: Mapping[str, Any], schema: Mapping[str, Any],
          prefix: str = "") -> Iterator[tuple[str, str, str, str]]:  # fmt: skip
    for key, value in keys.items():
        kind = _resolved(part.get("properties", {}).get(key, part.get("additionalProperties", {})), schema)
        if isinstance(value, Mapping) and "properties" in kind:
            yield from _rows(value, value, kind, schema, f"{prefix}{key}.")
            continue
        text = "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
        text = "a mapping" if isinstance(value, Mapping) else f"`{text}`"
        yield f"`{prefix}{key}`", text, _type(kind), _comment(commented, key).replace("|", "\\|")


def _comment(commented: Any, key: str) -> str:
    """The comment behind a value, without the lines for the next key."""
    tokens = [token for token in commented.ca.items.get(key, ()) if hasattr(token, "value")]
    first = tokens[0].value.lstrip().splitlines() if tokens else []
    return first[0].lstrip("# ").strip() if first and first[0].startswith("#") else ""


def _resolved(kind: Any, schema: Mapping[str, Any]) -> Mapping[str, Any]:
    return schema["$defs"][kind["$ref"].rpartition("/")[2]] if isinstance(kind, dict) and "$ref" in kind else kind


def _type(kind: Mapping[str, Any] | bool) -> str:
    if not isinstance(kind, dict):
        return ""
    if "anyOf" in kind:
        return " or ".join(_type(one) for one in kind["anyOf"])
    if "$ref" in kind:
        return "section"
    limits = [text.format(kind[name]) for name, text in LIMITS.items() if name in kind]
    choices = [", ".join(f"`{one}`" for one in kind["enum"])] if "enum" in kind else []
    inner = f" of {_type(kind['items'])}" if kind.get("type") == "array" and kind.get("items") else ""
    return " ".join([kind.get("type", "") + inner, *limits, *choices]).strip()


def api_pages() -> dict[str, str]:
    """A page for each folder of the library, with the docstrings of its modules."""
    folders = [name for _, name, is_folder in pkgutil.iter_modules(polarnet.__path__) if is_folder]
    folders = [name for name in folders if name not in NOT_LIBRARY]
    index = [
        "# Python",
        "",
        "The public names of a folder are those that its `__init__` exports; each page lists the modules behind them.",
        "",
        *(f"- [polarnet.{name}]({name}.md)" for name in folders),
        "",
        "## polarnet.stokes",
        "",
        "::: polarnet.stokes\n    options: {show_root_heading: false, heading_level: 3}",
    ]
    pages = {f"api/{name}.md": _folder_page(name) for name in folders}
    return {"api/index.md": "\n".join(index) + "\n", **pages}


def _folder_page(name: str) -> str:
    modules = [
        module
        for _, module, is_folder in pkgutil.iter_modules([str(ROOT / "polarnet" / name)], f"polarnet.{name}.")
        if not is_folder
    ]
    return "\n\n".join([f"# polarnet.{name}", *(f"::: {module}" for module in [f"polarnet.{name}", *modules])]) + "\n"
