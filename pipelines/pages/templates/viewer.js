/* The viewer of a report: two pictures under one wipe, side by side, or all; their numbers with units; no other file.
   Places in a picture are (u, v) in widths of the picture, so that pictures of several depths lie over one another. */
const viewer = (() => {
  const root = document.getElementById("viewer");
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const { pictures, scales, places } = data;
  const UNKNOWN = 65535, BINS = 160, MOST = 64, FILM_MS = 600, GRAB_PX = 14, TOUCH_PX = 26;
  // Pictures narrower than this have so many lines of label, in so small a font
  const SMALL_PX = 240, SMALL_LINES = 3, SMALL_FONT_PX = 11;
  const make = (tag, props = {}, ...children) => {
    const one = document.createElement(tag);
    for (const [key, value] of Object.entries(props)) if (key in one) one[key] = value; else one.setAttribute(key, value);
    one.append(...children);
    return one;
  };
  const between = (low, value, high) => Math.min(Math.max(value, low), high);
  const minus = text => String(text).replace("-", "\u2212");
  /** A number with as many decimals as its step can tell. */
  const told = (value, step) => minus(value.toFixed(step > 0 ? between(0, Math.ceil(-Math.log10(step)), 6) : 3));
  const brief = value => Number(value.toPrecision(4));
  /** Decimals that leave two digits of a number. */
  const decimals = value => value > 0 ? between(0, 1 - Math.floor(Math.log10(value)), 6) : 3;
  /** Viridis, from the lowest to the highest of 256 levels, as a canvas has its bytes. */
  const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
  const bytesOf = ([red, green, blue]) => (0xff000000 | blue << 16 | green << 8 | red) >>> 0;
  const colourOf = level => {
    const at = level / 255 * (VIRIDIS.length - 1), from = Math.min(Math.floor(at), VIRIDIS.length - 2);
    return VIRIDIS[from].map((value, index) => Math.round(value + (at - from) * (VIRIDIS[from + 1][index] - value)));
  };

  // ---- Numbers -------------------------------------------------------------------------------------------------
  /** Decode a picture: levels (row, column, colour) and how often each occurs. */
  async function load(one) {
    const image = one.element ? document.getElementById(one.element) : new Image();
    if (!one.element) image.src = one.src;
    await image.decode();
    const [width, whole] = [image.naturalWidth, image.naturalHeight];
    const canvas = make("canvas", { width, height: whole });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    const bytes = context.getImageData(0, 0, width, whole).data;
    const height = one.element ? whole : whole / 2, samples = width * height;
    let colours = 1;
    for (let i = 0; i < bytes.length && colours === 1; i += 4) if (bytes[i] !== bytes[i + 1] || bytes[i] !== bytes[i + 2]) colours = 3;
    const levels = new Uint16Array(samples * colours), counts = new Uint32Array(UNKNOWN + 1);
    for (let i = 0; i < samples; i++) for (let c = 0; c < colours; c++) {
      const level = one.element ? bytes[4 * i + c] : 256 * bytes[4 * i + c] + bytes[4 * (i + samples) + c];
      levels[i * colours + c] = level;
      counts[level]++;
    }
    return Object.assign(one, { width, height, colours, levels, counts, src: null });
  }
  /** The tone curve of sRGB, and light by it, both 0 to 1. */
  const encoded = light => light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055;
  const decoded = value => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const number = (one, level) => one.low + one.step * (one.toned ? 255 * decoded(level / 255) : level);
  /** The level below which a share of the known samples lies. */
  function quantile(one, share) {
    let rest = share * one.counts.subarray(0, UNKNOWN).reduce((sum, count) => sum + count, 0);
    for (let level = 0; level < UNKNOWN; level++) { rest -= one.counts[level]; if (rest <= 0) return number(one, level); }
    return one.low;
  }
  /** A picture as a canvas on its grey scale; painted anew only if that has changed. */
  function painted(one, { black, white } = scales[one.kind]) {
    const doubt = one.confidence === undefined ? null : pictures[one.confidence];
    const key = black + " " + white + Boolean(doubt?.levels);
    if (one.key === key) return one.canvas;
    const grey = new Uint8Array(UNKNOWN + 1), reach = Math.max(white - black, 1e-12);
    const toned = data.toned && ["light", "view", "bright"].includes(one.kind) ? encoded : share => share;
    for (let level = 0; level < UNKNOWN; level++) grey[level] = Math.round(255 * toned(between(0, (number(one, level) - black) / reach, 1)));
    one.canvas ??= make("canvas", { width: one.width, height: one.height });
    const context = one.canvas.getContext("2d"), image = context.createImageData(one.width, one.height);
    const pixels = new Uint32Array(image.data.buffer), bytes = image.data, { levels, colours, width } = one;
    const inks = Array.from({ length: 256 }, (_, level) => bytesOf(scales[one.kind].colours ? colourOf(level) : [level, level, level]));
    // Hatching as in the previews of maps (depth_map.py) and of light (image_files.py): where nothing is known, and
    // through what is not sure
    const period = Math.max(6, Math.round(width / 53));
    const [stripe, dark, bright] = scales[one.kind].colours ? [period / 6, [128, 128, 128], [158, 158, 158]] : [period / 4, [125, 0, 95], [240, 60, 205]];
    const hatch = i => (i % width + Math.floor(i / width)) % period < stripe ? dark : bright;
    const unknown = i => { for (let c = 0; c < colours; c++) if (levels[i * colours + c] === UNKNOWN) return true; return false; };
    for (let i = 0; i < pixels.length; i++) {
      const known = !unknown(i);
      if (!known) pixels[i] = bytesOf(hatch(i));
      else if (colours === 1) pixels[i] = inks[grey[levels[i]]];
      else pixels[i] = 0xff000000 | grey[levels[3 * i + 2]] << 16 | grey[levels[3 * i + 1]] << 8 | grey[levels[3 * i]];
      if (known && doubt?.levels && !sure(one, doubt, i)) for (let c = 0; c < 3; c++) bytes[4 * i + c] = 0.3 * bytes[4 * i + c] + 0.7 * hatch(i)[c];
    }
    context.putImageData(image, 0, 0);
    one.key = key;
    return one.canvas;
  }
  const sure = (one, doubt, at) => doubt.levels[at] !== UNKNOWN && number(doubt, doubt.levels[at]) >= one.sure_above;
  const name = one => one.title + ", " + one.label;
  /** Numbers of the sample at a place, in words with their units; null outside the picture. */
  function valueAt(one, u, v) {
    const [column, row] = [Math.floor(u * one.width), Math.floor(v * one.width)];
    if (!one.levels || column < 0 || row < 0 || column >= one.width || row >= one.height) return null;
    const at = (row * one.width + column) * one.colours, unknown = one.saturated ? "saturated" : "not known";
    const levels = [...one.levels.subarray(at, at + one.colours)], known = levels.some(level => level !== UNKNOWN);
    const sigma = one.sigma === undefined ? null : pictures[one.sigma], off = [];
    const sigmas = known && sigma?.levels ? [...sigma.levels.subarray(at / one.colours * sigma.colours, (at / one.colours + 1) * sigma.colours)].map(level => level === UNKNOWN ? NaN : number(sigma, level)) : [];
    const values = levels.map((level, index) => {
      if (level === UNKNOWN) return unknown;
      // Grey levels of a view stand for the integers that they were made of; beyond black and white nothing is known
      if (one.whole) return (level === 0 ? "\u2264 " : level === 255 ? "\u2265 " : "") + minus(Math.round(number(one, level)));
      const deviation = sigmas[index] ?? NaN;
      return deviation > 0 ? minus(number(one, level).toFixed(decimals(deviation))) + " \u00b1 " + deviation.toFixed(decimals(deviation)) : told(number(one, level), one.step);
    });
    const halves = levels.filter(level => level !== UNKNOWN).map(level => (number(one, level + 1) - number(one, level - 1)) / 4);
    const rounded = one.whole && one.step <= 1 && !one.toned ? 0 : Math.max(0, ...halves);
    if (sigmas.some(deviation => deviation > 0)) off.push("\u00b1 is \u03c3");
    if (sigma?.step && sigmas.some(deviation => sigma.step > 0.1 * deviation)) off.push("\u03c3 rounded by up to " + minus(Number((sigma.step / 2).toPrecision(1))));
    if (known && rounded > 0 && !sigmas.some(deviation => rounded < 0.1 * deviation)) off.push("rounded by up to " + minus(Number(rounded.toPrecision(1))));
    const doubt = one.confidence === undefined ? null : pictures[one.confidence];
    if (known && doubt?.levels) off.push((sure(one, doubt, at) ? "sure" : "not sure") + ": right within 2 % with a probability of " + number(doubt, doubt.levels[at]).toFixed(2));
    const value = !known ? unknown : (one.colours === 3 ? "R " + values[0] + ", G " + values[1] + ", B " + values[2] : values[0]) + " " + one.unit;
    const [x, y] = one.pitch ? [one.origin[0] + column * one.pitch, one.origin[1] + row * one.pitch] : [];
    const many = one.bins > 1 ? "mean of " + one.bins + " \u00d7 " + one.bins + " samples, first " : "";
    return { value, off: off.length ? " (" + off.join("; ") + ")" : "", x, y, at: many + "column " + column * one.bins + ", row " + row * one.bins,
      where: one.pitch ? "x " + told(x, one.pitch / 10) + ", y " + told(y, one.pitch / 10) + " " + data.length : "" };
  }

  // ---- What is shown -------------------------------------------------------------------------------------------
  // Of a dark view beside a plane most of the plane is shown: there is little to see in the view
  const asOpened = () => ({ zoom: 1, u: 0.5, v: 0, wipe: pictures[data.first[0]].place === null ? 0.25 : 0.5 });
  const state = { shown: [...data.first], layout: "wipe", cursor: null, ...asOpened() };
  const opened = structuredClone(scales);
  const stage = make("div", { className: "v-stage", tabIndex: 0, role: "application", "aria-roledescription": "picture viewer",
    "aria-label": "Pictures; arrows pan, plus and minus zoom, comma and full stop wipe, R reads out", "aria-describedby": "v-keys" });
  const canvas = make("canvas", { "aria-hidden": "true" }), context = canvas.getContext("2d");
  stage.append(canvas);
  const live = make("p", { className: "v-hidden", role: "status" });
  const [A, B] = [0, 1];
  const picture = side => pictures[state.shown[side]];
  const aspect = () => picture(B).height / picture(B).width || 0.75;
  /** The pictures of the layout "all": those at the depth of the right one, and those without a depth. */
  const all = () => pictures.filter(one => one.levels && (one.place === null || one.place === picture(B).place));
  /** The parts of the stage in its own pixels, with their picture. */
  function cells() {
    const [width, height] = [stage.clientWidth, stage.clientHeight];
    if (state.layout === "wipe") return [A, B].map(side => ({ one: picture(side), side, x: 0, y: 0, w: width, h: height }));
    const shown = state.layout === "pair" ? [picture(A), picture(B)] : all();
    const [columns, rows] = grid(shown.length), gap = 4, above = labelsAbove(columns);
    const [w, h] = [(width - gap * (columns - 1)) / columns, (height - gap * (rows - 1)) / rows];
    return shown.map((one, index) => ({ one, side: state.layout === "pair" ? index : null, w, h: h - above,
      x: (index % columns) * (w + gap), y: Math.floor(index / columns) * (h + gap) + above }));
  }
  function grid(count) {
    const narrow = stage.clientWidth < 600;
    const across = state.layout === "pair" ? (narrow ? 1 : 2) : narrow ? 2 : Math.min(count, count <= 4 ? 2 : 3);
    return [across, Math.ceil(count / across)];
  }
  /** Height of the labels above small pictures, which they would hide; larger ones have them within. */
  const labelsAbove = columns => state.layout !== "wipe" && stage.clientWidth / columns < SMALL_PX ? SMALL_LINES * (SMALL_FONT_PX + 4) + 5 : 0;
  /** Pixels of the stage per width of a picture, in a cell. */
  const magnified = cell => Math.min(cell.w, cell.h / aspect()) * state.zoom;
  const toStage = (cell, u, v) => [cell.x + cell.w / 2 + (u - state.u) * magnified(cell), cell.y + cell.h / 2 + (v - state.v) * magnified(cell)];
  const toPlace = (cell, x, y) => [state.u + (x - cell.x - cell.w / 2) / magnified(cell), state.v + (y - cell.y - cell.h / 2) / magnified(cell)];
  const cellAt = (x, y) => cells().find(cell => x >= cell.x && x <= cell.x + cell.w && y >= cell.y && y <= cell.y + cell.h) ?? cells()[0];
  function hold() {
    state.zoom = between(1, state.zoom, MOST);
    const cell = cells()[0], [wide, high] = [cell.w, cell.h].map(size => size / 2 / magnified(cell));
    state.u = wide >= 0.5 ? 0.5 : between(wide, state.u, 1 - wide);
    state.v = 2 * high >= aspect() ? aspect() / 2 : between(high, state.v, aspect() - high);
    stage.classList.toggle("v-deep", state.zoom > 1);
  }
  function fit() {
    const [columns, rows] = grid(state.layout === "wipe" ? 1 : state.layout === "pair" ? 2 : all().length);
    const above = rows * labelsAbove(columns);
    const tall = state.layout === "wipe" ? aspect() * stage.clientWidth : rows * aspect() * stage.clientWidth / columns;
    stage.style.height = Math.round(above + Math.min(tall, Math.max(state.layout === "wipe" ? 0.72 * innerHeight : 1.3 * innerHeight, 240))) + "px";
  }

  // ---- Drawing -------------------------------------------------------------------------------------------------
  function label(text, x, y, right, most, size, above) {
    context.font = "600 " + size + "px system-ui, sans-serif";
    const lines = [""];
    for (const word of text.split(" ")) {
      const longer = lines.at(-1) + (lines.at(-1) ? " " : "") + word;
      if (lines.at(-1) && context.measureText(longer).width > most) lines.push(word); else lines[lines.length - 1] = longer;
    }
    if (above && lines.length > SMALL_LINES) { lines.length = SMALL_LINES; lines[SMALL_LINES - 1] += "\u2026"; }
    if (above) y -= (size + 4) * lines.length + 5;
    const width = Math.max(...lines.map(line => context.measureText(line).width));
    const left = right ? x - width - 12 : x;
    context.fillStyle = "rgba(0, 0, 0, .72)";
    context.fillRect(left, y, width + 12, (size + 4) * lines.length + 5);
    context.fillStyle = "#fff";
    context.textBaseline = "middle";
    lines.forEach((line, index) => context.fillText(line, left + 6, y + size / 2 + 5 + (size + 4) * index));
  }
  /** The longest of 1, 2, 5, 10 ... that takes at most `most` pixels: its length and its pixels. */
  function barOf(one, cell, most) {
    const perUnit = magnified(cell) / (one.width * one.pitch);
    const ten = 10 ** Math.floor(Math.log10(most / perUnit));
    const length = [5, 2, 1].map(times => times * ten).find(it => it * perUnit <= most) ?? ten;
    return { length, pixels: length * perUnit };
  }
  function drawBar(cell, right) {
    const { one } = cell;
    if (!one.pitch) return;
    const { length, pixels } = barOf(one, cell, Math.min(150, cell.w * 0.28));
    const text = brief(length) + " " + data.length;
    const [x, y] = [right ? cell.x + cell.w - pixels - 16 : cell.x + 16, cell.y + cell.h - 16];
    context.font = "600 13px system-ui, sans-serif";
    const width = Math.max(pixels, context.measureText(text).width);
    context.fillStyle = "rgba(0, 0, 0, .72)";
    context.fillRect((right ? x + pixels - width : x) - 6, y - 22, width + 12, 32);
    context.fillStyle = "#fff";
    context.fillRect(x, y, pixels, 4);
    context.textBaseline = "middle";
    context.fillText(text, right ? x + pixels - context.measureText(text).width : x, y - 10);
    stage.dataset["bar" + (cell.side === A ? "A" : "B")] = length + " " + data.length + ", " + pixels + " px";
  }
  function drawCell(cell, from, to) {
    const { one } = cell;
    if (!one.levels) return;
    const size = magnified(cell), [x, y] = toStage(cell, 0, 0);
    context.save();
    context.beginPath();
    context.rect(from, cell.y, to - from, cell.h);
    context.clip();
    context.imageSmoothingEnabled = size * devicePixelRatio < 2 * one.width;
    context.imageSmoothingQuality = "high";
    context.drawImage(painted(one), x, y, size, size * one.height / one.width);
    if (state.cursor) drawCross(cell);
    context.restore();
  }
  function drawCross(cell) {
    const [x, y] = toStage(cell, ...state.cursor);
    for (const [colour, width] of [["#000", 3], ["#ffd84d", 1.2]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { context.moveTo(x + 5 * dx, y + 5 * dy); context.lineTo(x + 13 * dx, y + 13 * dy); }
      context.stroke();
    }
  }
  function drawWipe(x, height) {
    context.fillStyle = "rgba(0, 0, 0, .8)";
    context.fillRect(x - 2, 0, 4, height);
    context.fillStyle = "#fff";
    context.fillRect(x - 1, 0, 2, height);
    context.beginPath();
    context.arc(x, height / 2, 13, 0, 7);
    context.fill();
    context.fillStyle = "#111";
    for (const way of [-1, 1]) {
      context.beginPath();
      context.moveTo(x + 9 * way, height / 2);
      context.lineTo(x + 3 * way, height / 2 - 5);
      context.lineTo(x + 3 * way, height / 2 + 5);
      context.fill();
    }
  }
  let asked = false;
  /** Draw at the next frame, however often it is asked for. */
  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; drawNow(); });
  }
  function drawNow() {
    const [width, height] = [stage.clientWidth, stage.clientHeight], fine = Math.min(devicePixelRatio, 3);
    if (canvas.width !== Math.round(width * fine) || canvas.height !== Math.round(height * fine))
      Object.assign(canvas, { width: Math.round(width * fine), height: Math.round(height * fine) });
    hold();
    context.setTransform(fine, 0, 0, fine, 0, 0);
    context.clearRect(0, 0, width, height);
    delete stage.dataset.barA;
    delete stage.dataset.barB;
    const at = state.wipe * width, wiped = state.layout === "wipe", parts = cells(), lastWithScale = parts.findLast(cell => cell.one.pitch);
    for (const cell of parts) {
      const right = wiped && cell.side === B;
      drawCell(cell, right ? at : cell.x, wiped && !right ? at : cell.x + cell.w);
      const told = state.cursor && state.layout === "all" ? valueAt(cell.one, ...state.cursor) : null;
      const side = cell.side === null ? "" : "AB"[cell.side] + ": ";
      const small = cell.w < SMALL_PX, inset = small ? 3 : 8, above = small && !wiped, words = state.layout === "all" && cell.one.place !== null ? cell.one.title : name(cell.one);
      label(side + (told ? told.value + ": " : "") + words, right ? width - 8 : cell.x + inset, above ? cell.y : cell.y + inset, right, wiped ? Math.max(right ? width - at : at, 120) - 30 : cell.w - 24, small ? SMALL_FONT_PX : 13, above);
      // Planes at one depth have one scale, and small pictures no room for it in each
      if (!small || cell === lastWithScale) drawBar(cell, right);
    }
    if (wiped) drawWipe(at, height);
    Object.assign(stage.dataset, { zoom: state.zoom, u: state.u, v: state.v, wipe: state.wipe, layout: state.layout, size: magnified(cells()[0]) });
    readOut();
  }

  // ---- Read-out ------------------------------------------------------------------------------------------------
  const outs = [A, B].map(side => make("output", { id: "v-out-" + "AB"[side], "aria-live": "off" }));
  function readOut() {
    const place = state.cursor ?? [state.u, state.v];
    [A, B].forEach(side => {
      const one = picture(side), found = one.levels && valueAt(one, ...place);
      const head = make("span", { className: "soft" }, "AB"[side] + ": " + name(one) + (state.cursor ? "" : ", in the middle"));
      outs[side].replaceChildren(head, make("br"), ...(found ? [make("strong", {}, found.value), found.off + " ", make("br"),
        make("span", {}, [found.where, found.at].filter(Boolean).join("; "))] : ["outside the picture"]));
    });
  }
  const say = words => { live.textContent = words; };

  // ---- Doing ---------------------------------------------------------------------------------------------------
  function zoomBy(times, x = stage.clientWidth / 2, y = stage.clientHeight / 2) {
    const cell = state.layout === "wipe" ? cells()[0] : cellAt(x, y), place = toPlace(cell, x, y);
    state.zoom = between(1, state.zoom * times, MOST);
    const now = toPlace(cell, x, y);
    state.u += place[0] - now[0];
    state.v += place[1] - now[1];
    draw();
  }
  function panBy(dx, dy) { const size = magnified(cells()[0]); state.u -= dx / size; state.v -= dy / size; draw(); }
  function wipeTo(share) { state.wipe = between(0, share, 1); wipe.value = state.wipe; draw(); }
  function whole() { Object.assign(state, asOpened(), { wipe: state.wipe }); draw(); }
  function oneToOne() { state.zoom = picture(B).width / (magnified(cells()[0]) / state.zoom); draw(); }
  function stepCursor(dx, dy) {
    const { width } = picture(B), [u, v] = state.cursor ?? [state.u, state.v];
    state.cursor = [(between(0, Math.floor(u * width) + dx, width - 1) + 0.5) / width, (between(0, Math.floor(v * width) + dy, picture(B).height - 1) + 0.5) / width];
    draw();
  }
  function choose(side, index) {
    state.shown[side] = index;
    choices[side].value = index;
    if (depth && picture(B).place !== null) { depth.value = picture(B).place; depthWords.value = places[depth.value]; depth.setAttribute("aria-valuetext", depthWords.value); }
    fillScales();
    fit();
    draw();
  }
  function swap() { const [a, b] = state.shown; choose(A, b); choose(B, a); }
  /** Go to a depth: the right picture goes, and the left one with it if both are at one depth. */
  function toPlaceOf(place) {
    const together = picture(A).place === picture(B).place;
    for (const side of together || picture(B).place === null ? [A, B] : [B]) {
      const one = picture(side), index = pictures.findIndex(it => it.kind === one.kind && it.title === one.title && it.place === place);
      if (one.place !== null && index >= 0) choose(side, index);
    }
  }
  let film = null, way = 1;
  function stepFilm() {
    const place = picture(B).place ?? 0;
    if (place + way < 0 || place + way >= places.length) way = -way;
    toPlaceOf(place + way);
  }
  function playOrStop() {
    film = film === null ? setInterval(stepFilm, FILM_MS) : clearInterval(film) ?? null;
    play.textContent = film === null ? "\u25b6 Film" : "\u25a0 Stop";
    play.setAttribute("aria-pressed", film !== null);
  }
  function layOut(layout) {
    state.layout = layout;
    for (const [key, button] of Object.entries(layouts)) button.setAttribute("aria-pressed", key === layout);
    wipe.disabled = layout !== "wipe";
    fillScales();
    fit();
    draw();
  }
  function readAloud() {
    say(outs.map(one => [...one.childNodes].map(node => node.textContent || " ").join(" ")).join(". "));
  }
  function reset() {
    Object.assign(state, asOpened(), { cursor: null });
    for (const [kind, scale] of Object.entries(opened)) Object.assign(scales[kind], scale);
    wipe.value = state.wipe;
    if (film !== null) playOrStop();
    choose(A, data.first[A]);
    choose(B, data.first[B]);
    layOut("wipe");
  }

  // ---- Controls ------------------------------------------------------------------------------------------------
  const button = (words, does, label) => make("button", { type: "button", onclick: does, ...(label ? { "aria-label": label, title: label } : {}) }, words);
  function choice(side) {
    const groups = new Map();
    pictures.forEach((one, index) => {
      const group = one.element ? "Views" : one.title;
      if (!groups.has(group)) groups.set(group, make("optgroup", { label: group }));
      groups.get(group).append(make("option", { value: index }, name(one)));
    });
    return make("select", { id: "v-" + "AB"[side], onchange: event => choose(side, Number(event.target.value)) }, ...groups.values());
  }
  const choices = [choice(A), choice(B)];
  const wipe = make("input", { type: "range", min: 0, max: 1, step: 0.01, id: "v-wipe", oninput: () => wipeTo(Number(wipe.value)) });
  wipe.value = state.wipe;
  const layouts = { wipe: button("Wipe", () => layOut("wipe")), pair: button("Side by side", () => layOut("pair")), all: button("All", () => layOut("all"), "All pictures at this " + data.quantity) };
  const steps = places.length > 1;
  const depth = steps ? make("input", { type: "range", min: 0, max: places.length - 1, step: 1, id: "v-depth", "aria-label": "Plane by " + data.quantity, oninput: () => toPlaceOf(Number(depth.value)) }) : null;
  const depthWords = make("output", { id: "v-depth-words" });
  const play = button("\u25b6 Film", playOrStop, "Play all " + data.quantity + " steps as a film, or stop");
  play.setAttribute("aria-pressed", false);

  // ---- Grey scales ---------------------------------------------------------------------------------------------
  const scalesBox = make("div", { className: "v-scales" });
  let controls = [];
  function fillScales() {
    const kinds = [...new Set([picture(A), picture(B), ...(state.layout === "all" ? all() : [])].map(one => one.kind))];
    if (controls.map(one => one.kind).join() !== kinds.join()) {
      controls = kinds.map(scaleControl);
      scalesBox.replaceChildren(...controls.map(one => one.box));
    }
    controls.forEach(one => one.update());
  }
  /** Minimum and maximum of one kind of pictures: handles on a histogram, numbers, and buttons. */
  function scaleControl(kind) {
    const scale = scales[kind], unit = pictures.find(one => one.kind === kind).unit;
    const ofKind = found => found.filter(one => one.kind === kind && one.levels);
    const shown = () => { const chosen = ofKind([A, B].map(picture)); return chosen.length ? chosen : ofKind(all()).slice(0, 2); };
    const plot = make("canvas", { role: "img", "aria-label": "Histogram of " + scale.name });
    const inkOf = one => one === picture(B) ? "--accent" : "--second";
    const range = end => make("input", { type: "range", step: "any", id: "v-" + end + "-" + kind, "aria-label": (end === "black" ? "Black" : "White") + " of the " + scale.name + (unit && ", " + unit), oninput: event => set(end, Number(event.target.value)) });
    const typed = end => make("input", { type: "number", step: "any", id: "v-" + end + "-number-" + kind, onchange: event => { if (event.target.value) set(end, Number(event.target.value)); } });
    const ends = { black: [range("black"), typed("black")], white: [range("white"), typed("white")] };
    let axis = [0, 1];
    function set(end, value) {
      const least = (axis[1] - axis[0]) / 1000;
      scale[end] = end === "black" ? Math.min(value, scale.white - least) : Math.max(value, scale.black + least);
      update();
      draw();
    }
    const keys = make("span");
    function update() {
      const found = shown();
      const both = picture(A) !== picture(B) && [A, B].every(side => picture(side).kind === kind);
      keys.replaceChildren(...(both ? [A, B] : []).map(side => make("span", { className: "v-keyed", style: "color: var(" + inkOf(picture(side)) + ")" }, "AB"[side])));
      if (!found.length) return;
      const low = Math.min(...found.map(one => quantile(one, 0.001))), high = Math.max(...found.map(one => quantile(one, 0.999)));
      axis = [Math.min(low - 0.05 * (high - low), scale.black), Math.max(high + 0.15 * (high - low), scale.white)];
      for (const [end, [slide, typing]] of Object.entries(ends)) {
        Object.assign(slide, { min: axis[0], max: axis[1] });
        slide.value = scale[end];
        slide.setAttribute("aria-valuetext", brief(scale[end]) + " " + unit);
        typing.value = brief(scale[end]);
      }
      plotHistogram(found);
    }
    function plotHistogram(found) {
      const style = getComputedStyle(document.documentElement), pen = plot.getContext("2d");
      const [width, height] = [plot.clientWidth * devicePixelRatio || 300, plot.clientHeight * devicePixelRatio || 60];
      Object.assign(plot, { width, height });
      const across = value => (value - axis[0]) / (axis[1] - axis[0]) * width;
      pen.fillStyle = style.getPropertyValue("--line");
      pen.fillRect(across(scale.black), 0, across(scale.white) - across(scale.black), height);
      found.forEach((one, index) => {
        // Bins of as many levels each: others would be a comb where levels are few
        const grain = Math.max(one.step || (axis[1] - axis[0]) / BINS, one.unit === "DN" && one.element ? 1 : 0);
        const wide = grain * Math.max(1, Math.ceil((axis[1] - axis[0]) / BINS / grain)), from = one.low - wide / 2 - wide * Math.ceil((one.low - axis[0]) / wide);
        const heights = new Float64Array(Math.ceil((axis[1] - from) / wide) + 1);
        for (let level = 0; level < UNKNOWN; level++) if (one.counts[level]) {
          const bin = Math.floor((number(one, level) - from) / wide + 1e-6);
          if (bin >= 0 && bin < heights.length) heights[bin] += one.counts[level];
        }
        const top = Math.log1p(heights.reduce((most, it) => Math.max(most, it), 1));
        pen.beginPath();
        pen.moveTo(0, height);
        heights.forEach((count, bin) => { const y = height * (1 - 0.95 * Math.log1p(count) / top); pen.lineTo(across(from + bin * wide), y); pen.lineTo(across(from + (bin + 1) * wide), y); });
        pen.lineTo(width, height);
        pen.lineWidth = 1.5 * devicePixelRatio;
        pen.strokeStyle = style.getPropertyValue(inkOf(one));
        pen.globalAlpha = 0.22;
        pen.fillStyle = pen.strokeStyle;
        if (index === 0) pen.fill();
        pen.globalAlpha = 1;
        pen.stroke();
      });
    }
    const auto = button("Auto", () => {
      const found = shown();
      scale.black = Math.min(...found.map(one => quantile(one, 0.002)));
      scale.white = Math.max(...found.map(one => quantile(one, 0.998)));
      update();
      draw();
    }, "Scale of the " + scale.name + " by what is shown: 0.2 % black, 0.2 % white");
    const back = button("As opened", () => { Object.assign(scale, opened[kind]); update(); draw(); });
    const box = make("fieldset", {}, make("legend", {}, (scale.colours ? "Colour scale of the " : "Grey scale of the ") + scale.name + (unit && ", " + unit) + " (histogram: logarithm of counts)", keys),
      make("div", { className: "v-histogram" }, plot, ends.black[0], ends.white[0]),
      make("div", { className: "v-numbers" }, make("label", {}, "black ", ends.black[1]), make("label", {}, "white ", ends.white[1]), auto, back));
    return { kind, box, update, auto };
  }

  // ---- Hands and keys ------------------------------------------------------------------------------------------
  const hands = new Map();
  let grabbed = null, last = null;
  const local = event => { const box = stage.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const nearWipe = (x, reach) => state.layout === "wipe" && Math.abs(x - state.wipe * stage.clientWidth) < reach;
  const pinch = () => { const [[x, y], [p, q]] = [...hands.values()]; return { x: (x + p) / 2, y: (y + q) / 2, apart: Math.hypot(x - p, y - q) }; };
  function pointAt(x, y) { state.cursor = toPlace(cellAt(x, y), x, y); draw(); }
  stage.addEventListener("pointerdown", event => {
    const [x, y] = local(event), touch = event.pointerType !== "mouse";
    stage.focus({ preventScroll: true });
    stage.setPointerCapture(event.pointerId);
    hands.set(event.pointerId, [x, y]);
    grabbed = hands.size === 2 ? "pinch" : nearWipe(x, touch ? TOUCH_PX : GRAB_PX) || (touch && state.zoom === 1 && state.layout === "wipe") ? "wipe" : "pan";
    last = hands.size === 2 ? pinch() : { x, y };
    if (grabbed !== "wipe") pointAt(x, y);
  });
  stage.addEventListener("pointermove", event => {
    const [x, y] = local(event);
    if (!hands.has(event.pointerId)) {
      stage.style.cursor = nearWipe(x, GRAB_PX) ? "ew-resize" : "";
      return pointAt(x, y);
    }
    hands.set(event.pointerId, [x, y]);
    if (grabbed === "pinch" && hands.size === 2) {
      const now = pinch();
      panBy(now.x - last.x, now.y - last.y);
      zoomBy(now.apart / (last.apart || 1), now.x, now.y);
      last = now;
    } else if (grabbed === "wipe") wipeTo(x / stage.clientWidth);
    else if (grabbed === "pan") { panBy(x - last.x, y - last.y); last = { x, y }; }
  });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, event => {
    hands.delete(event.pointerId);
    grabbed = null;
  });
  // The wheel scrolls the page until the pictures have been clicked; pinching on a touch pad comes with Ctrl
  stage.addEventListener("wheel", event => {
    if (document.activeElement !== stage && !event.ctrlKey) return;
    event.preventDefault();
    zoomBy(Math.exp(-event.deltaY * (event.deltaMode ? 0.03 : 0.0015) * (event.ctrlKey ? 4 : 1)), ...local(event));
  }, { passive: false });
  stage.addEventListener("dblclick", event => zoomBy(2, ...local(event)));
  const PAN_PX = 60, pans = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  const keys = {
    "+": () => zoomBy(1.5), "=": () => zoomBy(1.5), "-": () => zoomBy(1 / 1.5), 0: whole, 1: oneToOne,
    ",": () => wipeTo(state.wipe - 0.02), ".": () => wipeTo(state.wipe + 0.02), x: swap, r: readAloud, m: () => controls.forEach(one => one.auto.click()),
    l: () => layOut({ wipe: "pair", pair: "all", all: "wipe" }[state.layout]), backspace: reset,
    ...(steps ? { "[": () => toPlaceOf(Math.max((picture(B).place ?? 0) - 1, 0)), "]": () => toPlaceOf(Math.min((picture(B).place ?? 0) + 1, places.length - 1)), " ": playOrStop } : {}),
  };
  stage.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const pan = pans[event.key];
    if (pan && event.shiftKey) stepCursor(-pan[0], -pan[1]);
    else if (pan && state.zoom > 1) panBy(PAN_PX * pan[0], PAN_PX * pan[1]);
    else if (!pan && keys[event.key.toLowerCase()]) keys[event.key.toLowerCase()]();
    else return;
    event.preventDefault();
  });

  // ---- Put together --------------------------------------------------------------------------------------------
  const help = [["+ \u2212", "zoom; the wheel, too, once the picture is clicked; two fingers"], ["0", "whole picture"], ["1", "one sample per pixel"],
    ["arrows", "pan; or drag"], ["Shift arrows", "move the cross by a sample"], ["R", "read the numbers aloud (screen reader)"], [", .", "move the wipe; or drag it"],
    ["X", "swap A and B"], ["L", "wipe, side by side, all"], ["M", "grey scales by what is shown"],
    ...(steps ? [["[ ]", "nearer and farther plane"], ["Space", "film"]] : []), ["Backspace", "all as opened"]];
  const key = ([words, does]) => make("li", {}, ...words.split(" ").flatMap(it => [make("kbd", {}, it), " "]), does);
  const group = (label, ...children) => make("div", { className: "v-group", role: "group", "aria-label": label }, ...children);
  root.append(
    make("div", { className: "v-row" }, make("label", {}, "Left, A", choices[A]), group("Swap", button("\u21c4", swap, "Swap A and B")), make("label", {}, "Right, B", choices[B])),
    make("div", { className: "v-row v-tools" }, group("Layout", ...Object.values(layouts)),
      group("Zoom", button("\u2212", () => zoomBy(1 / 1.5), "Zoom out"), button("+", () => zoomBy(1.5), "Zoom in"), button("1 : 1", oneToOne, "One sample per pixel"), button("Whole", whole, "Whole picture"), button("Reset", reset, "All as opened")),
      make("label", { className: "v-slide" }, "Wipe ", wipe), ...(steps ? [make("div", { className: "v-slide v-film" }, play, depth, depthWords)] : [])),
    stage, make("div", { className: "v-told" }, ...outs), scalesBox,
    make("details", {}, make("summary", {}, "Keys and hands"), make("ul", { className: "v-keys", id: "v-keys" }, ...help.map(key))), live);
  root.hidden = false;
  let wide = 0;
  new ResizeObserver(() => { if (stage.clientWidth !== wide) { wide = stage.clientWidth; fit(); fillScales(); } draw(); }).observe(stage);
  new MutationObserver(() => controls.forEach(one => one.update())).observe(document.documentElement, { attributeFilter: ["class"] });
  addEventListener("resize", () => { fit(); draw(); });

  /** A picture as a data URI on the scale that the page opened with, for the sliders. */
  function still(one, width) {
    const small = make("canvas", { width: Math.min(width, one.width), height: Math.round(Math.min(width, one.width) * one.height / one.width) });
    const pen = small.getContext("2d");
    pen.imageSmoothingQuality = "high";
    pen.drawImage(painted(one, opened[one.kind]), 0, 0, small.width, small.height);
    return small.toDataURL("image/jpeg", 0.92);
  }
  const ready = (async () => {
    await load(picture(A));
    if (picture(B) !== picture(A)) await load(picture(B));
    choose(A, state.shown[A]);
    choose(B, state.shown[B]);
    layOut("wipe");
    for (const one of pictures) if (!one.levels) await load(one);
    stage.dataset.ready = "all";
    draw();
  })();
  return { ready, still, find: (title, label) => pictures.find(one => one.kind === "light" && one.title === title && one.label === label) };
})();
