"""Pictures of docs/theory-*.md and docs/architecture.md: python -m studies.theory_pictures [FOLDER]"""

import math
from collections.abc import Mapping

import matplotlib
import torch
from jaxtyping import Float64
from matplotlib.figure import Figure
from ruamel.yaml import YAML
from torch import Tensor

from polarnet.config.tree import load
from polarnet.methods.stokes_gain import consistent
from polarnet.reports.figures import LIGHT, chart_style, show_picture
from polarnet.reports.maps import dolp_image
from polarnet.stokes import (
    POLARIZER_ANGLES_DEG,
    dolp,
    intensities_from_stokes,
    intensity_behind_polarizer,
    stokes_from_intensities,
    stokes_from_polarization,
)
from studies.blocks import ROOT
from studies.polarizer_presets import photograph, true_stokes
from studies.simulation_pictures import write_pictures

DEGREES = (0.2, 0.6, 1.0)
COLOURS = ("#1c2330", "#2f7fc1", "#e08a1e")
AOLP_DEG = 30.0
WRONG_FACTORS = (1.0, 0.7, 1.4, 1.1)  # of the intensities behind 0, 45, 90 and 135 degrees
NOISE = 0.02  # relative standard deviation of the intensities
DARKEST = 0.004  # of white; added behind every polarizer, as stray light
BOX = {"boxstyle": "round,pad=0.45", "facecolor": "#eef3f8", "edgecolor": "#2f7fc1", "linewidth": 0.9}
SHIFT = 0.3  # of every second column upwards, so that arrows pass between boxes
ARROW = {"arrowstyle": "-|>", "color": LIGHT.quiet, "linewidth": 0.8, "shrinkA": 30, "shrinkB": 30}


def malus_figure() -> Figure:
    """Draw intensity behind a polarizer against its angle, with the four measured angles marked."""
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(6.4, 3.0), layout="constrained", facecolor=LIGHT.face)
        axes = figure.subplots()
        for degree, colour in zip(DEGREES, COLOURS, strict=True):
            axes.plot(
                range(181), [_behind(degree, angle) for angle in range(181)], color=colour, label=f"DoLP {degree:g}"
            )
            marked = [_behind(degree, angle) for angle in POLARIZER_ANGLES_DEG]
            axes.plot(POLARIZER_ANGLES_DEG, marked, "o", color=colour)
        axes.axvline(AOLP_DEG, color=LIGHT.quiet, linestyle=":", label=f"AoLP {AOLP_DEG:g}°")
        axes.set(xlabel="angle of the polarizer, degrees", ylabel="intensity / S0", xticks=range(0, 181, 45))
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def _behind(degree: float, angle_deg: float) -> float:
    plane = torch.ones(1, 1, dtype=torch.float64)
    stokes = stokes_from_polarization(plane, degree * plane, math.radians(AOLP_DEG) * plane)
    return float(intensity_behind_polarizer(stokes, math.radians(angle_deg)))


def gains_figure() -> Figure:
    """Draw true DoLP, DoLP with wrong factors of the polarizers, and DoLP with factors from the redundancy."""
    truth = true_stokes(photograph())
    noise = 1 + NOISE * torch.randn((4, *truth.shape[1:]), generator=torch.Generator().manual_seed(1))
    measured = (intensities_from_stokes(truth) + DARKEST) * noise
    wrong = measured * measured.new_tensor(WRONG_FACTORS)[:, None, None]
    solved = consistent(wrong[None], load(ROOT).baselines.gain)[0]
    panels = {"true": dolp(truth), "factors unknown": _dolp_of(wrong), "factors solved": _dolp_of(solved)}
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(7.2, 2.0), layout="constrained", facecolor=LIGHT.face)
        for axes, (name, degree) in zip(figure.subplots(1, 3), panels.items(), strict=True):
            show_picture(axes, dolp_image(degree), LIGHT)
            rms = float((degree.clamp(0, 1) - panels["true"]).square().mean().sqrt())
            axes.set_title("true DoLP" if name == "true" else f"{name}: RMS error {rms:.3f}", fontsize=9)
    return figure


def _dolp_of(intensities: Float64[Tensor, "4 h w"]) -> Float64[Tensor, "h w"]:
    return dolp(stokes_from_intensities(intensities))


def architecture_figure() -> Figure:
    """Draw the stages of dvc.yaml from left to right, with an arrow for each output that a later stage reads.

    An arrow is left out where others already lead from one stage to the other.
    """
    sources = _sources()
    column: dict[str, int] = {}
    for stage in sources:  # dvc.yaml lists a stage after those it reads from
        column[stage] = 1 + max((column[source] for source in sources[stage]), default=-1)
    rows = {c: [stage for stage in column if column[stage] == c] for c in range(max(column.values()) + 1)}
    place = {
        stage: (c, (len(row) - 1) / 2 - row.index(stage) + SHIFT * (c % 2)) for c, row in rows.items() for stage in row
    }
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(9.6, 3.4), layout="constrained", facecolor=LIGHT.face)
        axes = figure.subplots()
        for stage, origins in sources.items():
            for origin in origins - _behind_others(stage, sources):
                axes.annotate("", place[stage], place[origin], arrowprops=ARROW, zorder=1)
        for stage, (x, y) in place.items():
            axes.text(x, y, stage.replace("_", "_\n"), ha="center", va="center", fontsize=8, bbox=BOX, zorder=2)
        height = max(map(len, rows.values())) / 2
        axes.set(xlim=(-0.6, len(rows) - 0.4), ylim=(-height, height + SHIFT))
        axes.axis("off")
    return figure


def _behind_others(stage: str, sources: Mapping[str, set[str]]) -> set[str]:
    """Stages that come before one of those that `stage` reads from."""
    before = [sources[origin] | _behind_others(origin, sources) for origin in sources[stage]]
    return set().union(*before)


def _sources() -> Mapping[str, set[str]]:
    """The stages whose outputs each stage of dvc.yaml reads; a `foreach` counts as one stage."""
    rows = YAML(typ="safe").load(ROOT / "params.yaml")["rows"].values()
    stages = {name: one.get("do", one) for name, one in YAML(typ="safe").load(ROOT / "dvc.yaml")["stages"].items()}
    outputs = {name: [_path(out).partition("$")[0] for out in one.get("outs", ())] for name, one in stages.items()}
    sources: dict[str, set[str]] = {}
    for name, one in stages.items():
        needed = [_path(dep) for dep in one["deps"]]
        needed += [row["needs"] for row in rows if "${item.needs}" in needed]
        sources[name] = {
            other for other, made in outputs.items()
            if other != name and any(dep.startswith(out.rstrip("/")) for dep in needed for out in made)
        }  # fmt: skip
    return sources


def _path(entry: str | Mapping[str, object]) -> str:
    return entry if isinstance(entry, str) else next(iter(entry))


FIGURES = {"theory_malus": malus_figure, "theory_gains": gains_figure, "architecture": architecture_figure}

if __name__ == "__main__":
    write_pictures(FIGURES, "Draw pictures of docs/theory-*.md and docs/architecture.md.")
