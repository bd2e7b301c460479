// Plays the films of a page: colours the grey strips, shares time, zoom and cursor among pictures.
"use strict";

const TITLES = { events: "Events", s0: "S0", dolp: "DoLP", aolp: "AoLP", error: "error of DoLP" };
const FRAMES_PER_SECOND = 6;
const FULL_ERROR = 0.5; // DoLP at the end of the colours
const SCALED = ["dolp", "error"]; // quantities whose colours may end at the DoLP of the scene
const SCENE_QUANTILE = 0.99; // of the pixels of a scene, at which its scale ends
const NARROWEST = 208, GAP = 12; // pixels of a picture on a page, and between two

/** Grey values of a strip: a byte for each pixel of each frame. */
async function strip(source, width) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const canvas = new OffscreenCanvas(width, image.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const rgba = context.getImageData(0, 0, width, image.height).data;
  return Uint8ClampedArray.from({ length: rgba.length / 4 }, (_, i) => rgba[4 * i]);
}

/** Bytes of a map over the frames; AoLP comes as cosine and sine of twice the angle. */
async function decoded(map, width) {
  const values = await strip(map.strip, width);
  if (map.kind !== "aolp") return values;
  const half = values.length / 2;
  return Uint8ClampedArray.from({ length: half }, (_, i) => {
    const angle = Math.atan2(values[half + i] - 128, values[i] - 128);
    return Math.floor((angle / (2 * Math.PI) + 1) * 256) % 256;
  });
}

function printed(kind, value, scale) {
  if (kind === "events") return ((value - 128) / 127 * scale).toFixed(0);
  if (kind === "aolp") return `${(value / 256 * 180).toFixed(0)}°`;
  return (value / 255 * (kind === "error" ? FULL_ERROR : 1)).toFixed(2);
}

/** Share of the full range of bytes below which `SCENE_QUANTILE` of the values lie. */
function range(values) {
  const sorted = values.slice().sort();
  return Math.max(1, sorted[Math.floor(SCENE_QUANTILE * (sorted.length - 1))]) / 255;
}

function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

function option(select, labels, chosen) {
  select.replaceChildren(...labels.map((label, i) => new Option(label, i, i === chosen, i === chosen)));
}

class Player {
  constructor(root) {
    this.root = root;
    this.find = (role) => root.querySelector(`[data-role=${role}]`);
    const data = JSON.parse(this.find("data").textContent);
    this.scenes = data.scenes;
    this.colours = Object.fromEntries(
      Object.entries(data.colours).map(([name, hex]) => [name, hex.match(/../g).map((byte) => parseInt(byte, 16))])
    );
    this.cursor = null;
    this.view = { zoom: 1, x: 50, y: 50 };
    option(this.find("scene"), this.scenes.map((scene) => scene.name), 0);
    this.find("scene").parentElement.hidden = this.scenes.length < 2;
    this.listen();
    this.show(0);
  }

  listen() {
    const on = (role, event, action) => this.find(role).addEventListener(event, action);
    on("scene", "change", (event) => this.show(Number(event.target.value)));
    on("time", "input", () => this.draw());
    on("quantity", "change", () => this.arrange());
    on("play", "click", () => this.play(!this.timer));
    on("scale", "change", () => { this.legends(); this.draw(); });
    on("zoom", "input", (event) => this.look({ zoom: Number(event.target.value) }));
    const panes = this.find("panes");
    panes.addEventListener("pointermove", (event) => this.point(event));
    panes.addEventListener("keydown", (event) => this.step(event));
    new ResizeObserver(() => this.columns()).observe(panes);
  }

  async show(number) {
    this.root.dataset.ready = "no";
    const scene = this.scenes[number];
    const maps = await Promise.all(
      scene.maps.map(async (map) => ({ ...map, values: await decoded(map, scene.width) }))
    );
    const first = !this.scene;
    this.scene = scene;
    this.find("scene").value = number;
    const truth = maps.find((map) => map.source === "truth" && map.kind === "dolp");
    const errors = maps.filter((map) => truth && map.kind === "dolp" && map !== truth).map((map) => ({
      ...map, kind: "error",
      values: map.values.map((value, i) => Math.abs(value - truth.values[i]) / FULL_ERROR),
    }));
    for (const map of maps.filter((one) => one.kind === "aolp")) {
      map.pale = maps.find((one) => one.source === map.source && one.kind === "dolp")?.values;
    }
    this.maps = [...maps, ...errors];
    const measured = truth ? [truth] : maps.filter((map) => map.kind === "dolp");
    this.range = Math.max(0, ...measured.map((map) => range(map.values)));
    this.find("scale").parentElement.hidden = !this.range;
    const of_methods = ["dolp", "aolp", "error"].filter((kind) => this.maps.some((map) => map.kind === kind && map.source !== "truth"));
    const before = this.kinds?.[this.find("quantity").value];
    this.kinds = of_methods;
    option(this.find("quantity"), of_methods.map((kind) => TITLES[kind]), Math.max(0, of_methods.indexOf(before)));
    this.find("quantity").parentElement.hidden = of_methods.length < 2;
    const time = this.find("time");
    time.max = scene.ms.length - 1;
    time.value = first ? time.max : Math.min(time.value, time.max); // late, because the first frames have few events
    for (const role of ["time", "play"]) this.find(role).disabled = scene.ms.length < 2;
    this.cursor = null;
    this.arrange();
    this.root.dataset.ready = "yes";
  }

  /** Make a pane for events, S0, the truth, and the chosen quantity of each method. */
  arrange() {
    const quantity = this.kinds[this.find("quantity").value];
    const scene = this.scene;
    this.shown = this.maps.filter((map) => ["events", "s0", quantity].includes(map.kind) || map.source === "truth");
    const titled = (map) => map.kind === "events" ? "Events" : map.source === "truth" ? `True ${TITLES[map.kind]}` : map.source;
    this.panes = this.shown.map((map) => {
      const title = titled(map), value = element("span", {});
      const label = `${title}${map.kind === "error" ? `: ${TITLES[map.kind]}` : ""}, scene ${scene.name}`;
      const canvas = element("canvas", { width: scene.width, height: scene.height, role: "img", "aria-label": label });
      const caption = element("figcaption", {}, title, value);
      return { map, value, canvas, title, figure: element("figure", {}, caption, element("div", { class: "pane" }, canvas)) };
    });
    this.find("panes").replaceChildren(...this.panes.map((pane) => pane.figure));
    this.columns();
    this.legends();
    this.draw();
  }

  /** Arrange the pictures in as many columns as fit, or up to half as many if that fills the last row better. */
  columns() {
    const panes = this.find("panes"), count = this.panes?.length;
    if (!count) return;
    const most = Math.max(2, Math.min(count, Math.floor((panes.clientWidth + GAP) / (NARROWEST + GAP))));
    const empty = (columns) => (columns - count % columns) % columns;
    let best = most;
    for (let columns = most; columns >= Math.max(2, most / 2); columns--) if (empty(columns) < empty(best)) best = columns;
    panes.style.setProperty("--columns", count === 1 ? 1 : best);
  }

  /** End of the colours of a quantity, as a share of its whole range. */
  end(kind) {
    return SCALED.includes(kind) && this.find("scale").checked ? this.range : 1;
  }

  /** The colours of each quantity between its ends. */
  legends() {
    const number = (kind, full) => `${Number((full * this.end(kind)).toFixed(2))}`;
    const ends = {
      events: ["darker (OFF)", "brighter (ON)"], dolp: ["DoLP 0", number("dolp", 1)], error: ["error 0", number("error", FULL_ERROR)],
      aolp: ["AoLP 0° (to the right), paler where DoLP is small", "180°"],
    };
    const kinds = [...new Set(this.shown.map((map) => map.kind))].filter((kind) => ends[kind]);
    this.find("legend").replaceChildren(...kinds.map((kind) => {
      const bar = element("canvas", { width: 128, height: 1, class: "bar", "aria-hidden": "true" });
      this.paint(bar, { kind, values: Float32Array.from({ length: 128 }, (_, i) => (2 * i + 1) * this.end(kind)) }, 0);
      return element("span", {}, ends[kind][0], bar, ends[kind][1]);
    }));
  }

  /** Colour one byte a pixel; AoLP is paler where the DoLP beside it is small. */
  paint(canvas, { kind, values, pale }, frame) {
    const context = canvas.getContext("2d"), size = canvas.width * canvas.height, table = this.colours[kind];
    const image = context.createImageData(canvas.width, canvas.height), top = table.length / 3, full = 256 * this.end(kind);
    for (let i = 0; i < size; i++) {
      const entry = 3 * Math.min(top - 1, Math.floor(values[frame * size + i] / full * top));
      const saturation = pale ? Math.min(1, pale[frame * size + i] / 255 / this.end("dolp")) : 1;
      for (const k of [0, 1, 2]) image.data[4 * i + k] = 255 - saturation * (255 - table[entry + k]);
      image.data[4 * i + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  }

  get frame() {
    return Number(this.find("time").value);
  }

  draw() {
    const ms = `${this.scene.ms[this.frame]} ms`;
    this.find("ms").textContent = ms;
    this.find("time").setAttribute("aria-valuetext", ms);
    for (const pane of this.panes) this.paint(pane.canvas, pane.map, this.frame);
    this.read(false);
  }

  play(start) {
    clearInterval(this.timer);
    const time = this.find("time"), button = this.find("play");
    const next = () => { time.value = (this.frame + 1) % this.scene.ms.length; this.draw(); };
    this.timer = start ? setInterval(next, 1000 / FRAMES_PER_SECOND) : undefined;
    button.setAttribute("aria-pressed", String(start));
    button.textContent = start ? "❚❚ Pause" : "▶ Play";
  }

  look(changes) {
    const within = (value) => Math.min(100, Math.max(0, value));
    Object.assign(this.view, changes);
    this.view = { zoom: this.view.zoom, x: within(this.view.x), y: within(this.view.y) };
    for (const [name, unit] of [["zoom", ""], ["x", "%"], ["y", "%"]]) this.root.style.setProperty(`--${name}`, this.view[name] + unit);
    this.mark();
  }

  point(event) {
    if (event.target.tagName !== "CANVAS") return;
    const box = event.target.getBoundingClientRect(), { width, height } = this.scene;
    if (event.buttons && this.view.zoom > 1) {
      const room = 100 / (box.width * (1 - 1 / this.view.zoom)), tall = 100 / (box.height * (1 - 1 / this.view.zoom));
      this.look({ x: this.view.x - event.movementX * room, y: this.view.y - event.movementY * tall });
    }
    const place = (offset, length, pixels) => Math.min(pixels - 1, Math.max(0, Math.floor(offset / length * pixels)));
    this.cursor = [place(event.clientX - box.left, box.width, width), place(event.clientY - box.top, box.height, height)];
    this.read(false);
  }

  step(event) {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!move) return;
    event.preventDefault();
    const { width, height } = this.scene, [x, y] = this.cursor ?? [width >> 1, height >> 1];
    this.cursor = [(x + move[0] + width) % width, (y + move[1] + height) % height];
    this.read(true);
  }

  /** Show the values at the cursor; `aloud` also writes them into the line that screen readers follow. */
  read(aloud) {
    this.mark();
    if (!this.cursor) return;
    const { width, height, rows } = this.scene, [x, y] = this.cursor;
    const texts = this.panes.map(({ map, value, title }) => {
      value.textContent = printed(map.kind, map.values[(this.frame * height + y) * width + x], map.scale);
      return `${title} ${value.textContent}`;
    });
    const place = `Column ${Math.floor(x * rows / height)}, row ${Math.floor(y * rows / height)}`;
    if (aloud) this.find("values").textContent = `${place}: ${texts.join(", ")}`;
  }

  mark() {
    this.find("panes").classList.toggle("marked", Boolean(this.cursor));
    if (!this.cursor) return;
    const { zoom, x, y } = this.view, { width, height } = this.scene;
    const shown = (origin, pixel, pixels) => `${origin + ((pixel + 0.5) / pixels * 100 - origin) * zoom}%`;
    this.find("panes").style.setProperty("--left", shown(x, this.cursor[0], width));
    this.find("panes").style.setProperty("--top", shown(y, this.cursor[1], height));
  }
}

for (const root of document.querySelectorAll(".player")) {
  const player = new Player(root);
  for (const button of document.querySelectorAll("button[data-scene]"))
    button.addEventListener("click", () => {
      player.show(player.scenes.findIndex((scene) => scene.name === button.dataset.scene));
      root.scrollIntoView({ block: "start" });
      root.querySelector("select").focus({ preventScroll: true });
    });
}
