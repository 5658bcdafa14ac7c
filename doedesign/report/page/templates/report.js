"use strict";
// Parts of the page that move: maps (OpenSeadragon), charts (uPlot), the model (model-viewer), PSFs and dividers.
// Every part takes its data from the script element of its block's name, when it comes near the window.

const dataOf = (name) => JSON.parse(document.getElementById(`data-${name}`).textContent);
const part = (root, name) => root.querySelector(`[data-part="${name}"]`);
const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const short = (value) => (value == null ? "–" : Number(value.toPrecision(4)).toString());

const waiting = new Set();

function whenNear(element, start) {
  const begin = () => {
    watcher.disconnect();
    if (waiting.delete(begin)) start();
  };
  const watcher = new IntersectionObserver((entries) => entries.some((entry) => entry.isIntersecting) && begin(), { rootMargin: "600px" });
  waiting.add(begin);
  watcher.observe(element);
}

// ---------------------------------------------------------------- charts

const charts = [];

function chartOptions(data, width) {
  const ink = color("--ink"), line = color("--line");
  const axis = (label, extra) => ({ label, stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line }, labelSize: 22, font: "12px system-ui", labelFont: "12px system-ui", ...extra });
  const series = data.series.map((one, k) => ({
    label: one.label, stroke: color(`--s${(one.hue ?? k) % 7}`), width: k === 0 ? 2 : 1.5, dash: one.dashed ? [6, 4] : undefined,
    points: { show: data.markers, size: 6 }, spanGaps: true, value: (_, value) => short(value),
    ...(data.steps ? { paths: uPlot.paths.stepped({ align: 1 }), fill: color("--fill"), points: { show: false } } : {}),
  }));
  // Numbers of a logarithmic axis stand at each entry of a short list of places, and at powers of ten of a long one.
  const places = data.x_log && data.x.length <= 12 ? { splits: () => data.x, filter: (_, splits) => splits, values: (_, splits) => splits.map(short) } : { values: (_, splits) => splits.map((place) => (place == null ? "" : short(place))) };
  return {
    width, height: Math.max(240, Math.min(320, width * 0.55)),
    scales: { x: { time: false, distr: data.x_log ? 3 : 1, ...(data.x_log ? { range: [data.x[0] / 1.15, data.x[data.x.length - 1] * 1.15] } : {}) }, y: { distr: data.y_log ? 3 : 1, range: data.y_log ? undefined : (_, low, high) => (low === high ? [low - 1, high + 1] : [Math.min(0, low), high + 0.06 * (high - Math.min(0, low))]) } },
    axes: [axis(data.x_label, places), axis(data.y_label, { size: 58, values: (_, splits) => splits.map((v) => (v == null ? "" : short(v))) })],
    series: [{ label: data.x_label, value: (_, value) => short(value) }, ...series],
    legend: { live: true }, cursor: { drag: { x: true, y: false } },
  };
}

function drawChart(chart) {
  const width = chart.root.clientWidth;
  if (!width) return;
  if (chart.plot) chart.plot.destroy();
  chart.root.textContent = "";
  chart.plot = new uPlot(chartOptions(chart.data, width), [chart.data.x, ...chart.data.series.map((one) => one.y)], chart.root);
  chart.width = width;
}

function startChart(root) {
  const chart = { root, data: dataOf(root.dataset.chart) };
  charts.push(chart);
  drawChart(chart);
  new ResizeObserver(() => { if (Math.abs(root.clientWidth - chart.width) > 2) drawChart(chart); }).observe(root);
}

// ---------------------------------------------------------------- maps

// One pyramid of numbers; a view is a palette. A tile's file is put together from its head, the palette and its data.
function tileSource(data, view) {
  const top = data.reductions.length - 1;
  const end = bytesOf("AAAAAElFTkSuQmCC");
  const known = new Map();
  const palettes = { whole: bytesOf(view.colours), reduced: bytesOf(view.shades) };
  const levels = Math.ceil(Math.log2(Math.max(data.width, data.height, 2)));
  const url = (level, x, y) => {
    const key = `${level}/${x}/${y}`;
    if (!known.has(key)) {
      const factor = 2 ** (levels - level);
      const rows = factor === 1 ? view.whole || data.whole : view.reduced[factor];
      const [high, wide] = [data.height, data.width].map((n) => Math.ceil(n / factor));
      const size = `${Math.min(data.tile, high - y * data.tile)}x${Math.min(data.tile, wide - x * data.tile)}`;
      const parts = [bytesOf(data.heads[size]), factor === 1 ? palettes.whole : palettes.reduced, bytesOf(rows[y][x]), end];
      known.set(key, URL.createObjectURL(new Blob(parts, { type: "image/png" })));
    }
    return known.get(key);
  };
  return {
    source: { width: data.width, height: data.height, tileSize: data.tile, minLevel: levels - top, maxLevel: levels, getTileUrl: url },
    forget: () => known.forEach((one) => URL.revokeObjectURL(one)),
  };
}

function startMap(root) {
  const data = dataOf(root.dataset.map);
  const viewer = OpenSeadragon({
    element: part(root, "viewer"), showNavigationControl: false, drawer: "canvas", imageSmoothingEnabled: false,
    maxZoomPixelRatio: 48, minZoomImageRatio: 0.6, visibilityRatio: 0.3, animationTime: matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 0.6,
    gestureSettingsMouse: { clickToZoom: false, dblClickToZoom: true }, gestureSettingsTouch: { flickEnabled: false }, crossOriginPolicy: false,
  });
  viewer.canvas.setAttribute("role", "application");
  viewer.canvas.setAttribute("aria-label", `Map of ${data.width} by ${data.height} pixels. Arrow keys move it, plus and minus zoom, 0 shows all.`);
  viewer.canvas.tabIndex = 0;
  viewer.addHandler("canvas-key", (event) => { if (/^[rRfF]$/.test(event.originalEvent.key)) event.preventDefaultAction = true; });
  let current = null, chosen = -1;
  const shown = () => data.views[part(root, "view").value];

  const show = () => {
    const bounds = viewer.world.getItemCount() ? viewer.viewport.getBounds(true) : null;
    const old = current, now = tileSource(data, shown());
    current = now;
    viewer.addTiledImage({
      tileSource: now.source, index: 0, replace: viewer.world.getItemCount() > 0,
      success: () => { if (bounds) viewer.viewport.fitBounds(bounds, true); if (old) old.forget(); marks(); root.dataset.ready = "yes"; },
    });
    legend();
  };

  const legend = () => {
    const name = shown().name, colors = bytesOf(shown().colours).slice(8);
    if (shown().legend) {
      part(root, "legend").textContent = shown().legend;
      return;
    }
    const rgb = (k) => `rgb(${colors[3 * k]},${colors[3 * k + 1]},${colors[3 * k + 2]})`;
    const count = data.heights_nm.length;
    let entries;
    if (name.startsWith("mask")) {
      const open = data.heights_nm.findIndex((_, k) => ((count - 1 - k) >> (Number(name.slice(5)) - 1)) & 1);
      entries = [[rgb(open), "open, etched"], [rgb(count - 1), "closed"]];
    } else {
      entries = data.heights_nm.map((height, k) => [rgb(k), name === "level" ? `${k}` : `${height} nm`]);
    }
    part(root, "legend").replaceChildren(...[...entries, [rgb(255), "chrome"]].map(([fill, text]) => {
      const item = document.createElement("span"), dot = document.createElement("i");
      dot.style.background = fill;
      item.append(dot, text);
      return item;
    }));
  };

  const marks = () => {
    viewer.clearOverlays();
    if (!part(root, "marks")?.checked) return;
    const name = shown().name;
    data.places.forEach((place, k) => {
      if (name.startsWith("mask") && name !== `mask ${place.mask}`) return;
      const button = document.createElement("button");
      button.type = "button";
      button.className = "place";
      button.textContent = place.mask;
      button.setAttribute("aria-label", `Place ${k + 1}: mask ${place.mask}, ${place.what}`);
      if (k === chosen) button.setAttribute("aria-current", "true");
      new OpenSeadragon.MouseTracker({ element: button, clickHandler: () => go(k), keyDownHandler: null });
      button.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); go(k); } });
      viewer.addOverlay({ element: button, location: new OpenSeadragon.Point(place.x_px / data.width, place.y_px / data.width), placement: "CENTER" });
    });
  };

  const go = (k) => {
    const place = data.places[k];
    chosen = k;
    const half = Math.max(16, 1.5 * place.reach_px) / data.width;
    viewer.viewport.fitBounds(new OpenSeadragon.Rect(place.x_px / data.width - half, place.y_px / data.width - half, 2 * half, 2 * half));
    const size = place.size_um ? `, ${place.size_um} µm wide` : "";
    part(root, "reading").textContent = `Place ${k + 1}: mask ${place.mask}, ${place.what}${size}, at x ${place.x_um} µm, y ${place.y_um} µm`;
    marks();
  };

  const pointed = new OpenSeadragon.MouseTracker({
    element: viewer.container,
    moveHandler: (event) => {
      if (!viewer.world.getItemCount()) return;
      const at = viewer.viewport.viewportToImageCoordinates(viewer.viewport.pointFromPixel(event.position));
      const x = Math.floor(at.x), y = data.height - 1 - Math.floor(at.y);
      if (x < 0 || y < 0 || x >= data.width || y >= data.height) return;
      const um = (k, n) => ((k + 0.5 - n / 2) * data.pitch_um).toFixed(2);
      part(root, "reading").textContent = `pixel ${x}, ${y}: x ${um(x, data.width)} µm, y ${um(y, data.height)} µm`;
    },
  });
  viewer.addOnceHandler("destroy", () => pointed.destroy());

  part(root, "view").addEventListener("change", show);
  part(root, "marks")?.addEventListener("change", marks);
  part(root, "in").addEventListener("click", () => viewer.leads?.() || viewer.viewport.zoomBy(2).applyConstraints());
  part(root, "out").addEventListener("click", () => viewer.leads?.() || viewer.viewport.zoomBy(0.5).applyConstraints());
  part(root, "home").addEventListener("click", () => viewer.leads?.() || viewer.viewport.goHome());
  part(root, "pixels").addEventListener("click", () => {
    viewer.leads?.();
    const image = viewer.world.getItemAt(0);
    if (image) viewer.viewport.zoomTo(image.imageToViewportZoom(16)).applyConstraints();
  });
  root.querySelectorAll("[data-place]").forEach((button) => button.addEventListener("click", () => {
    const place = data.places[button.dataset.place];
    const view = data.views.findIndex((one) => one.name === `mask ${place.mask}`);
    if (view >= 0 && part(root, "view").value !== String(view)) {
      part(root, "view").value = view;
      viewer.world.addOnceHandler("add-item", () => requestAnimationFrame(() => go(Number(button.dataset.place))));
      show();
    } else {
      go(Number(button.dataset.place));
    }
    part(root, "viewer").scrollIntoView({ block: "nearest" });
  }));
  root.viewer = viewer;
  if (root.closest(".linked")) link(viewer);
  show();
}

// Linked maps show the same part.
const linked = [];

function link(viewer) {
  let leads = false;
  linked.push(viewer);
  for (const [event, now] of [["canvas-enter", true], ["canvas-exit", false], ["canvas-key", true]]) viewer.addHandler(event, () => { leads = now; });
  viewer.follows = () => { leads = false; };
  viewer.leads = () => { linked.forEach((other) => other.follows()); leads = true; };
  viewer.addHandler("viewport-change", () => {
    if (!leads) return;
    const bounds = viewer.viewport.getBounds(true);
    linked.filter((other) => other !== viewer && other.world.getItemCount()).forEach((other) => other.viewport.fitBounds(bounds, true));
  });
}

// ---------------------------------------------------------------- PSFs

// Six colours of matplotlib's inferno, evenly spaced.
const INFERNO = [[0, 0, 4], [66, 10, 104], [147, 38, 103], [221, 81, 58], [252, 165, 10], [252, 255, 164]];

function glow(share) {
  const at = Math.min(Math.max(share, 0), 1) * (INFERNO.length - 1), k = Math.min(Math.floor(at), INFERNO.length - 2);
  return INFERNO[k].map((low, c) => Math.round(low + (at - k) * (INFERNO[k + 1][c] - low)));
}

// Blue for less, white for the same, red for more.
function sides(share) {
  const at = Math.min(Math.max(2 * share - 1, -1), 1), faint = Math.round(255 * (1 - Math.abs(at)));
  return at < 0 ? [faint, faint, 255] : [255, faint, faint];
}

function startPsf(root) {
  const data = dataOf(root.dataset.psf), known = new Map(), values = new Map();
  const canvases = [...root.querySelectorAll("canvas[data-bank]")];
  let turn = 0;
  const linear = () => part(root, "lin").checked;
  const choice = () => ({ depth: part(root, "depth").value, colour: part(root, "colour").value });
  const bankOf = (canvas) => (part(root, "bank") ? part(root, "bank").value : canvas.dataset.bank);
  const signed = (bank) => data.signed && data.signed.includes(Number(bank));

  const grey = async (key, kind) => {
    const name = `${key}/${kind}`;
    if (!known.has(name)) {
      const image = new Image();
      image.src = `data:image/webp;base64,${data.pictures[key][kind] || data.pictures[key].whole}`;
      await image.decode();
      const sheet = document.createElement("canvas");
      [sheet.width, sheet.height] = [image.naturalWidth, image.naturalHeight];
      const pen = sheet.getContext("2d", { willReadFrequently: true });
      pen.drawImage(image, 0, 0);
      const pixels = pen.getImageData(0, 0, sheet.width, sheet.height).data;
      known.set(name, { width: sheet.width, height: sheet.height, numbers: pixels.filter((_, k) => k % 4 === 0) });
    }
    return known.get(name);
  };

  const share = (number) => (number === 0 ? 0 : 10 ** ((number / 255 - 1) * data.decades));

  const paint = (canvas, found, bank) => {
    const colors = Array.from({ length: 256 }, (_, k) => (signed(bank) ? sides(k / 254) : glow(linear() ? share(k) : k / 255)));
    [canvas.width, canvas.height] = [found.width, found.height];
    const pen = canvas.getContext("2d"), image = pen.createImageData(found.width, found.height);
    found.numbers.forEach((number, k) => image.data.set([...colors[number], 255], 4 * k));
    pen.putImageData(image, 0, 0);
  };

  const draw = async () => {
    const mine = ++turn, { depth, colour } = choice();
    const kind = part(root, "middle") && part(root, "middle").checked ? "middle" : "whole";
    const found = await Promise.all(canvases.map((canvas) => grey(`${bankOf(canvas)},${depth},${colour}`, kind)));
    if (mine !== turn) return;
    const depthText = data.depths[depth], colourText = data.colours[colour];
    canvases.forEach((canvas, k) => {
      values.set(canvas, found[k]);
      paint(canvas, found[k], bankOf(canvas));
      canvas.setAttribute("aria-label", `PSF ${data.banks[bankOf(canvas)]} for a source at ${depthText}, ${colourText}, ${linear() ? "linear" : "logarithmic"} scale`);
    });
    for (const [name, text] of [["depth", depthText], ["colour", colourText]]) {
      part(root, `${name}-text`).textContent = text;
      part(root, name).setAttribute("aria-valuetext", text);
    }
    part(root, "low").textContent = linear() ? "0" : `10⁻${"⁰¹²³⁴⁵⁶⁷⁸⁹"[data.decades]} of the brightest`;
    part(root, "high").textContent = `${short(100 * data.peak[`${depth},${colour}`])} % of the light in a pixel`;
    root.dataset.ready = `${canvases.map(bankOf)};${depth},${colour},${linear() ? "lin" : "log"},${kind}`;
  };

  const scale = part(root, "scale"), pen = scale.getContext("2d");
  const strip = pen.createImageData(256, 12);
  for (let k = 0; k < 256 * 12; k += 1) strip.data.set([...glow((k % 256) / 255), 255], 4 * k);
  pen.putImageData(strip, 0, 0);
  canvases.forEach((canvas) => canvas.addEventListener("pointermove", (event) => {
    const found = values.get(canvas), bank = bankOf(canvas);
    if (!found) return;
    const box = canvas.getBoundingClientRect(), { depth, colour } = choice(), key = `${depth},${colour}`;
    const x = Math.min(found.width - 1, Math.floor((event.clientX - box.left) / box.width * found.width));
    const y = Math.min(found.height - 1, Math.floor((event.clientY - box.top) / box.height * found.height));
    const number = found.numbers[y * found.width + x], over = share(number);
    let text = `below 10⁻${"⁰¹²³⁴⁵⁶⁷⁸⁹"[data.decades]} of the brightest`;
    if (signed(bank)) text = `${((number / 127 - 1) * data.most[key] * 100).toPrecision(2)} % of the light more`;
    else if (over) text = `${over.toPrecision(2)} of the brightest pixel, ${(100 * over * data.peak[key]).toPrecision(2)} % of the light`;
    part(root, "reading").textContent = `${x - found.width / 2 + 0.5}, ${found.height / 2 - 0.5 - y} from the axis: ${text}`;
  }));
  root.addEventListener("input", draw);
  root.addEventListener("change", draw);
  draw();
}

// ---------------------------------------------------------------- dividers

function startDivider(root) {
  const data = dataOf(root.dataset.divider);
  const box = root.querySelector(".divided"), at = part(root, "at");
  const draw = () => {
    const pictures = data.scenes[part(root, "scene") ? part(root, "scene").value : 0][1];
    for (const [name, side] of [["under", "left"], ["over", "right"]]) {
      const select = part(root, side);
      if (select.options.length !== pictures.length || [...select.options].some((o, k) => o.text !== pictures[k][0])) {
        const kept = Math.min(select.selectedIndex, pictures.length - 1);
        select.replaceChildren(...pictures.map(([label], k) => new Option(label, k)));
        select.selectedIndex = kept;
      }
      const [label, source] = pictures[select.value];
      const image = part(root, name);
      if (image.getAttribute("src") !== source) image.src = source;
      image.alt = label;
    }
    box.style.setProperty("--at", `${at.value}%`);
    at.setAttribute("aria-valuetext", `${at.value} % ${part(root, "under").alt}, the rest ${part(root, "over").alt}`);
  };
  const drag = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const place = box.getBoundingClientRect();
    at.value = Math.round(100 * (event.clientX - place.left) / place.width);
    draw();
  };
  box.addEventListener("pointerdown", drag);
  box.addEventListener("pointermove", drag);
  root.querySelectorAll("img").forEach((image) => { image.draggable = false; });
  root.addEventListener("input", draw);
  draw();
}

// ---------------------------------------------------------------- the model

const library = { there: null };

async function unpacked(text, type) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return URL.createObjectURL(new Blob([await new Response(stream).arrayBuffer()], { type }));
}

function modelViewer() {
  library.there ??= unpacked(dataOf("model-viewer"), "text/javascript").then((address) => import(address));
  return library.there;
}

function startModel(root) {
  const stage = part(root, "stage"), say = (text) => { part(root, "reading").textContent = text; };
  part(root, "load").addEventListener("click", async () => {
    if (!document.createElement("canvas").getContext("webgl2")) {
      say("This browser draws no solids (WebGL 2 is off); the file of the order opens in any viewer of GLB files.");
      return;
    }
    say("Unpacking …");
    const data = dataOf(root.dataset.model);
    const file = await unpacked(data.data, "model/gltf-binary");
    await modelViewer();
    const model = document.createElement("model-viewer");
    for (const [name, value] of Object.entries({ "camera-controls": "", "touch-action": "pan-y", "interaction-prompt": "none", "camera-orbit": "25deg 52deg 100%", "tone-mapping": "neutral", "shadow-intensity": "0", exposure: "1.1", alt: `Model of the plate, ${data.file}` })) model.setAttribute(name, value);
    // Steps of a micrometre on a plate of millimetres are seen only if they are drawn higher, and walls darker than floors.
    model.setAttribute("scale", `1 ${data.higher} 1`);
    const bar = document.createElement("div");
    bar.slot = "progress-bar";
    model.append(bar);
    model.addEventListener("load", () => {
      for (const material of model.model.materials) {
        material.pbrMetallicRoughness.setBaseColorFactor([0.16, 0.33, 0.5, 1]);
        material.pbrMetallicRoughness.setMetallicFactor(0.55);
        material.pbrMetallicRoughness.setRoughnessFactor(0.45);
      }
      say("");
      root.dataset.ready = "yes";
    });
    // Where keys turn it; it can take the focus once it is shown.
    model.addEventListener("poster-dismissed", () => setTimeout(() => model.shadowRoot.querySelector(".userInput")?.focus(), 100));
    model.addEventListener("error", () => say("The model could not be drawn."));
    model.src = file;
    stage.replaceChildren(model);
  });
}

// ---------------------------------------------------------------- the page

const STARTS = { chart: startChart, map: startMap, psf: startPsf, divider: startDivider, model: startModel };
for (const [kind, start] of Object.entries(STARTS)) {
  document.querySelectorAll(`[data-${kind}]`).forEach((root) => (kind === "model" ? start(root) : whenNear(root, () => start(root))));
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach(drawChart));

// On paper everything is light, and what was not looked at yet is drawn before.
addEventListener("beforeprint", () => {
  document.documentElement.classList.add("printing");
  waiting.forEach((begin) => begin());
  charts.forEach(drawChart);
});
addEventListener("afterprint", () => {
  document.documentElement.classList.remove("printing");
  charts.forEach(drawChart);
});
document.documentElement.dataset.ready = "yes";
