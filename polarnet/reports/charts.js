// Draws the page's Vega-Lite charts when they come into view, in the colours of the page, and again when those change.
"use strict";
{
  const specs = JSON.parse(document.getElementById("charts").textContent);
  const draw = (place) => {
    const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const [text, quiet, line] = ["--text", "--quiet", "--line"].map(colour);
    const axis = { labelColor: quiet, titleColor: quiet, gridColor: line, domainColor: line, tickColor: line, labelLimit: 170, labelFontSize: 11, titleFontSize: 11, titleFontWeight: 500 };
    const config = {
      background: null, font: "system-ui, sans-serif", view: { stroke: null }, axis,
      legend: { labelColor: text, titleColor: quiet, labelLimit: 200, orient: "top", columns: 2 },
      title: { color: text }, text: { color: text },
    };
    return vegaEmbed(place, { ...specs[place.dataset.chart], config }, { actions: false, renderer: "svg" })
      .then(() => { place.dataset.drawn = "yes"; });
  };
  const watch = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries)
      if (isIntersecting && !target.dataset.drawn) draw(target);
  }, { rootMargin: "300px" });
  const places = document.querySelectorAll("[data-chart]");
  places.forEach((place) => watch.observe(place));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    places.forEach((place) => place.dataset.drawn && draw(place)));
}
