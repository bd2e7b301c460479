"""Charts of the pages as Vega-Lite specifications made with Altair; charts.js draws them with Vega inside the page."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import altair as alt

from polarnet.reports.artefacts import BudgetPoint, EventRate, History, Results
from polarnet.reports.legend import Legend, in_order, with_structure
from polarnet.reports.tables import Column

Spec = Mapping[str, Any]

TERMS = {
    "total": "total (weighted)",
    "mse": "MSE",
    "mae": "MAE",
    "ssim_loss": "1 - SSIM",
    "lpips": "LPIPS",
    "stokes": "S1/S0, S2/S0",
    "relative_mse": "MSE (relative)",
    "relative_stokes": "S1/S0, S2/S0 (relative)",
}
"""Legend labels of loss terms."""
BRANCHES = {"intensity": "intensity", "aolp": "AoLP", "dolp": "DoLP"}
"""Outputs of a network with one loss per output; their terms are named BRANCH_TERM."""
ROW_HEIGHT = 22  # pixels
METHOD_AXIS = alt.Axis(labelLimit=170, ticks=False, domain=False)


@functools.cache
def vega_bundle() -> str:
    """Vega, Vega-Lite and Vega-Embed as one script, so that a page needs no network."""
    import vl_convert

    return vl_convert.javascript_bundle()  # type: ignore[call-arg]  # its stub lacks the default


def score_chart(metrics: Mapping[str, Mapping[str, Any]], columns: Mapping[str, Column], legend: Legend) -> Spec:
    """Scores with their 95 % intervals, one metric at a time."""
    methods = in_order(metrics)
    values: list[dict[str, Any]] = [
        _score(columns[key], key, legend, method, metrics[method])
        for key in columns
        for method in methods
        if metrics[method].get(key) is not None
    ]
    names = list(dict.fromkeys(value["metric"] for value in values))
    chosen = alt.param("metric", value=names[0], bind=alt.binding_select(options=names, name="Score "))
    x = alt.X("value:Q", title=None, scale=alt.Scale(zero=False, nice=True), axis=alt.Axis(tickCount=5))
    order = [legend.label(method) for method in methods]
    base = alt.Chart(alt.Data(values=values)).encode(
        y=alt.Y("method:N", sort=order, title=None, axis=METHOD_AXIS), color=alt.Color("colour:N", scale=None)
    )
    dots = base.mark_point(filled=True, size=60, opacity=1).encode(
        x=x, tooltip=["method:N", "metric:N", "value:Q", "low:Q", "high:Q"]
    )
    bars = base.mark_rule(strokeWidth=2).encode(x="low:Q", x2="high:Q").transform_filter("isValid(datum.low)")
    chart = alt.layer(bars, dots).transform_filter("datum.metric == metric").add_params(chosen)
    return _finished(chart, ROW_HEIGHT * len(methods))


def _score(column: Column, key: str, legend: Legend, method: str, row: Mapping[str, Any]) -> dict[str, Any]:
    low, high = row.get(f"{key}_ci") or (None, None)
    label, colour = legend.label(method), legend.colour(method)
    return {"metric": column.heading, "method": label, "colour": colour, "value": row[key], "low": low, "high": high}


def scatter_chart(means: Mapping[str, Mapping[str, float]], legend: Legend) -> Spec | None:
    """MSE of ours against that of another method, a dot a scene; below the line ours is better.

    `means` is method, then scene. None without `ours` or another method.
    """
    rivals = [method for method in in_order(means) if method != "ours"]
    if "ours" not in means or not rivals:
        return None
    values: list[dict[str, Any]] = [
        {"scene": scene, "rival": legend.label(rival), "other": means[rival][scene], "ours": ours}
        for rival in rivals
        for scene, ours in means["ours"].items()
        if scene in means[rival]
    ]
    names = [legend.label(rival) for rival in rivals]
    chosen = alt.param("rival", value=names[-1], bind=alt.binding_select(options=names, name="Compare with "))
    ends = [value[axis] for value in values for axis in ("other", "ours")]
    domain = [max(min(ends) * 0.8, 1e-6), max(ends) * 1.25]
    scale = alt.Scale(type="log", domain=domain, nice=False)
    x = alt.X("other:Q", scale=scale, title="MSE of the other method", axis=alt.Axis(tickCount=5, format="~g"))
    y = alt.Y("ours:Q", scale=scale, title=f"MSE of {legend.label('ours')}", axis=alt.Axis(tickCount=5, format="~g"))
    line = alt.Chart(alt.Data(values=[{"other": end, "ours": end} for end in domain]))
    dots = alt.Chart(alt.Data(values=values)).mark_point(filled=True, size=70, color=legend.colour("ours"))
    dots = dots.encode(x=x, y=y, tooltip=["scene:N", "rival:N", "other:Q", "ours:Q"])
    dots = dots.transform_filter("datum.rival == rival").add_params(chosen)
    return _finished(line.mark_line(color="#8a93a3", strokeDash=[4, 4]).encode(x=x, y=y) + dots, 280)


def spread_chart(means: Mapping[str, Mapping[str, float]], legend: Legend) -> Spec:
    """MSE of every scene and method; the stroke is the median."""
    methods = in_order(means)
    values: list[dict[str, Any]] = [
        {"method": legend.label(method), "colour": legend.colour(method), "scene": scene, "mse": mse}
        for method in methods
        for scene, mse in means[method].items()
        if mse > 0
    ]
    order = [legend.label(method) for method in methods]
    x = alt.X("mse:Q", scale=alt.Scale(type="log"), title="MSE of a scene", axis=alt.Axis(tickCount=5, format="~g"))
    base = alt.Chart(alt.Data(values=values)).encode(y=alt.Y("method:N", sort=order, title=None, axis=METHOD_AXIS))
    dots = base.mark_point(filled=True, size=35, opacity=0.6).encode(
        x=x, color=alt.Color("colour:N", scale=None), tooltip=["method:N", "scene:N", "mse:Q"]
    )
    medians = base.mark_tick(thickness=2, size=16, color="#8a93a3").encode(
        x=alt.X("median(mse):Q", scale=alt.Scale(type="log"))
    )
    return _finished(dots + medians, ROW_HEIGHT * len(methods))


def training_chart(history: History, output: str) -> Sequence[Spec]:
    """Loss terms (logarithmic) and validation PSNR over epochs from 1: two charts, one below the other on a phone."""
    losses: list[dict[str, Any]] = [
        {"epoch": epoch + 1, "term": term_label(term), "loss": loss}
        for term, values in history.loss.items()
        for epoch, loss in enumerate(values)
    ]
    scores = [{"epoch": epoch + 1, "psnr": psnr} for epoch, psnr in enumerate(history.validation["psnr"])]
    kind: Literal["log", "linear"] = "log" if all(value["loss"] > 0 for value in losses) else "linear"
    epochs = alt.X("epoch:Q", title="epoch", axis=alt.Axis(tickMinStep=1, format="d"), scale=alt.Scale(nice=False))
    loss = alt.Chart(alt.Data(values=losses)).mark_line(point=True)
    y = alt.Y("loss:Q", title="training loss", scale=alt.Scale(type=kind), axis=alt.Axis(tickCount=5, format="~g"))
    loss = loss.encode(x=epochs, y=y, color=alt.Color("term:N", title=None), tooltip=["epoch:Q", "term:N", "loss:Q"])
    psnr = alt.Chart(alt.Data(values=scores)).mark_line(point=True)
    y = alt.Y("psnr:Q", title=f"validation PSNR of {output}, dB", scale=alt.Scale(zero=False))
    return [_finished(chart, 220) for chart in (loss, psnr.encode(x=epochs, y=y, tooltip=["epoch:Q", "psnr:Q"]))]


def term_label(name: str) -> str:
    """Legend label of a loss term."""
    branch, _, term = name.partition("_")
    return f"{BRANCHES[branch]}: {TERMS[term]}" if branch in BRANCHES and term in TERMS else TERMS.get(name, name)


def reliability_chart(details: Mapping[str, Any], legend: Legend) -> Spec | None:
    """Measured against predicted squared error; dots grow with the pixels. None if no method predicts its error."""
    values: list[dict[str, Any]] = [
        {"method": legend.label(method), "expected": expected, "measured": measured, "pixels": pixels}
        for method, entry in details.get("reliability", {}).items()
        for expected, measured, pixels in entry["curve"]
        if expected > 0 and measured > 0
    ]
    if not values:
        return None
    ends = [value[key] for value in values for key in ("expected", "measured")]
    diagonal = [{"expected": end, "measured": end} for end in (min(ends), max(ends))]
    scale, axis = alt.Scale(type="log"), alt.Axis(tickCount=5, format="~g")
    x = alt.X("expected:Q", scale=scale, axis=axis, title="expected squared error")
    y = alt.Y("measured:Q", scale=scale, axis=axis, title="measured squared error")
    line = alt.Chart(alt.Data(values=diagonal)).mark_line(color="#8a93a3", strokeDash=[4, 4]).encode(x=x, y=y)
    curves = alt.Chart(alt.Data(values=values)).encode(x=x, y=y, color=alt.Color("method:N", title=None))
    dots = curves.mark_point(filled=True).encode(
        size=alt.Size("pixels:Q", legend=None), tooltip=["method:N", "expected:Q", "measured:Q", "pixels:Q"]
    )
    return _finished(line + curves.mark_line() + dots, 280)


def budget_chart(points: Sequence[BudgetPoint], legend: Legend) -> Spec:
    """Mean MSE against the events per pixel since the start of a sequence, a line a method."""
    methods = in_order(dict.fromkeys(point.method for point in points))
    values = [{**one._asdict(), "method": legend.label(one.method)} for one in points if one.events_per_pixel > 0]
    scale = alt.Scale(domain=[*map(legend.label, methods)], range=[*map(legend.colour, methods)])
    scale_x = alt.Scale(type="log", nice=False, padding=10)
    x = alt.X("events_per_pixel:Q", title="events per pixel since the start", scale=scale_x)
    y = alt.Y("mse:Q", title="MSE", axis=alt.Axis(tickCount=5, format="~g"))
    lines = alt.Chart(alt.Data(values=values)).mark_line(point=True)
    tooltip = ["method:N", "events_per_pixel:Q", "mse:Q", "frames:Q"]
    return _finished(lines.encode(x=x, y=y, color=alt.Color("method:N", scale=scale, title=None), tooltip=tooltip), 280)


def rates_chart(rates: Sequence[EventRate]) -> Spec:
    """Events per pixel, polarizer and second of each split."""
    values = [rate._asdict() for rate in rates]
    bars = alt.Chart(alt.Data(values=values)).mark_bar()
    tooltip = ["split:N", "sequences:Q", "seconds:Q", "events:Q", "per_pixel_second:Q"]
    x = alt.X("per_pixel_second:Q", title="events per pixel, polarizer and second")
    y = alt.Y("split:N", sort=None, title=None)
    return _finished(bars.encode(x=x, y=y, tooltip=tooltip), 30 * len(values))


def sets_chart(sets: Sequence[Results], titles: Mapping[str, str], legend: Legend) -> Spec | None:
    """Heat map: MSE of each method on each test set, divided by the best constant's. None for a single set."""
    constant = "oracle_mean"
    values: list[dict[str, Any]] = [
        {
            "method": legend.label(method),
            "set": titles.get(one.name, one.name),
            "ratio": one.metrics[method]["mse"] / one.metrics[constant]["mse"],
        }
        for one in sets
        if one.metrics.get(constant, {}).get("mse")
        for method in with_structure(one.metrics)
        if one.metrics[method].get("mse") is not None
    ]
    if len({value["set"] for value in values}) < 2:
        return None
    order = [legend.label(method) for method in with_structure(dict.fromkeys(m for one in sets for m in one.metrics))]
    base = alt.Chart(alt.Data(values=values)).encode(
        x=alt.X("set:N", sort=None, title=None, axis=alt.Axis(labelAngle=0, orient="top", labelLimit=90)),
        y=alt.Y("method:N", sort=order, title=None, axis=METHOD_AXIS),
        tooltip=["method:N", "set:N", "ratio:Q"],
    )
    scale = alt.Scale(type="log", scheme="cividis", reverse=True)
    tiles = base.mark_rect().encode(color=alt.Color("ratio:Q", scale=scale, legend=None))
    middle = (min(v["ratio"] for v in values) * max(v["ratio"] for v in values)) ** 0.5
    ink = alt.condition(f"datum.ratio > {middle}", alt.value("#ffffff"), alt.value("#10141b"))
    return _finished(
        tiles + base.mark_text().encode(text=alt.Text("ratio:Q", format=".2f"), color=ink), 24 * len(order)
    )


def _finished(chart: Any, height: int) -> Spec:
    """The specification, as wide as its place on the page."""
    return chart.properties(width="container", height=height).to_dict()
