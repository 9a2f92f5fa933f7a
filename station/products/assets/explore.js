"use strict";
// The map to pan, zoom and ask. Without this script the picture of the map remains.
(() => {
  const data = window.STATION, text = data.text, byId = (id) => document.getElementById(id);
  const image = byId("map-image");
  if (!image || !data.curves || !("DecompressionStream" in window)) return;
  const page = window.stationPage, about = data.curves, reader = stationCurves.reader(about);
  const { make, fill } = page, number = page.formatNumber;
  const HALF_95 = 1.959964, SNAP_PX = 14, PLAY_MS = 800;
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // ---- elements

  const canvas = make("canvas", { tabIndex: 0, id: "map-canvas" });
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", text.map_label);
  const hover = make("output", { id: "map-hover" }), bar = make("div", { id: "map-scale" });
  const hint = make("p", { id: "map-hint" }), panel = make("div", { id: "asked", hidden: true });
  panel.setAttribute("aria-live", "polite");
  const tools = make("div", { id: "map-tools" });
  tools.setAttribute("role", "toolbar");
  let tool = "place";
  const buttons = ["place", "compare", "box", "polygon"].map((name) => {
    const button = make("button", { type: "button", textContent: text[`tool_${name}`] });
    button.addEventListener("click", () => choose(name));
    button.dataset.tool = name;
    return button;
  });
  const command = (label, title, act) => {
    const button = make("button", { type: "button", textContent: label, title });
    button.setAttribute("aria-label", title);
    button.addEventListener("click", act);
    return button;
  };
  const field = make("input", { name: "position", placeholder: text.go_label, size: 22, autocomplete: "off" });
  field.setAttribute("aria-label", text.go_label);
  const form = make("form", {}, field, make("button", { textContent: text.go }));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const numbers = (field.value.replace(/[\u202f\u00a0]/g, "").match(/-?\d+(\.\d+)?/g) || []).map(Number);
    field.setCustomValidity(numbers.length === 2 ? "" : text.go_wrong);
    if (field.reportValidity()) { map.centre(numbers); tap(numbers); }
  });
  field.addEventListener("input", () => field.setCustomValidity(""));
  tools.append(...buttons, command("+", text.zoom_in, () => map.zoom(1.5)), command("−", text.zoom_out, () => map.zoom(1 / 1.5)),
    command("⤢", text.whole_map, () => map.home()), form);
  const figure = image.closest("figure");
  let shown = data.maps.length - 1;
  const layers = stationLayers(data, () => shown, () => map.draw());
  const controls = stationControls(data, text, layers, page, () => { map.draw(); link(); showValues(); });
  const drawing = stationDrawing(about, data.outlines, text);
  const frame = make("div", { id: "map-frame" }, canvas, controls.swipe, hover, bar);
  figure.prepend(tools, hint, frame, controls.key, controls.row);
  image.loading = "eager";  // a hidden picture would never be loaded
  image.parentElement.hidden = true;  // the picture itself is drawn on the canvas
  byId("map-caption").hidden = true;  // says the same of the picture, for readers without scripts
  byId("slider-row").append(playButton());
  byId("slider-row").after(controls.sinceRow, panel);

  // ---- what is drawn

  const extent = data.frames[data.maps.at(-1).version].extent;
  let places = [], polygon = [], closed = false;

  const map = stationMap(canvas, extent, (context, now) => {
    const frameOf = data.frames[data.maps[shown].version];
    context.clearRect(0, 0, now.width, now.height);
    if (!layers.isPicture(now)) layers.draw(context, now);
    else if (image.complete && image.naturalWidth) drawing.picture(context, now, image, frameOf);
    context.globalCompositeOperation = "destination-over";
    context.fillStyle = colour("--card");
    context.fillRect(0, 0, now.width, now.height);
    context.globalCompositeOperation = "source-over";
    controls.drawKey(now);
    if (controls.shown.outlines) drawing.areasAndEvents(context, now);
    if (polygon.length) drawing.shape(context, now, polygon, closed);
    if (map.box()) {
      const [a, b] = map.box();
      drawing.shape(context, now, [a, [b[0], a[1]], b, [a[0], b[1]]], true);
    }
    drawing.scanner(context, now);
    places.forEach((place, i) => drawing.place(context, now, place, "AB"[i]));
    if (layers.isSwiped()) {
      drawing.border(context, now, layers.border_px(now), controls.timeOf(layers.before()), controls.timeOf(data.maps[shown]));
    }
    drawScale(now);
    return layers.isPicture(now) ? image.complete : layers.isComplete();
  });

  function drawScale(now) {
    const { west, east, south, north } = extent, [x0, y1] = now.toPixel([west, south]), [x1, y0] = now.toPixel([east, north]);
    bar.hidden = x0 >= -1 && y0 >= -1 && x1 <= now.width + 1 && y1 <= now.height + 1;  // the picture has its own
    const target_m = 110 * now.view.scale, decade = 10 ** Math.floor(Math.log10(target_m));
    const length_m = [5, 2, 1].map((k) => k * decade).find((m) => m <= target_m) || decade;
    bar.style.width = `${length_m / now.view.scale}px`;
    bar.textContent = length_m >= 1000 ? `${length_m / 1000} km` : `${length_m} m`;
  }

  function playButton() {
    const button = make("button", { type: "button", textContent: text.play });
    let timer = 0;
    const stop = () => { clearInterval(timer); timer = 0; button.textContent = text.play; };
    button.addEventListener("click", () => {
      if (timer) { stop(); return; }
      button.textContent = text.pause;
      if (shown === data.maps.length - 1) page.showTime(data.maps[0].time_s);
      timer = setInterval(() => {
        if (shown === data.maps.length - 1) stop(); else page.showTime(data.maps[shown + 1].time_s);
      }, PLAY_MS);
    });
    return button;
  }

  // A row of the table of events shows the event: its change, from the scan before it to its last, and its curve.
  for (const event of data.outlines.events) {
    const row = document.querySelector(`tr[data-event="${CSS.escape(event.id)}"]`);
    if (!row || !event.rings.length) continue;
    const button = command(text.event_show, text.event_show, () => {
      const at = (utc) => data.maps.findLastIndex((m) => m.time_s <= Date.parse(utc) / 1000);
      page.showTime(Date.parse(event.end) / 1000);
      controls.choose("change", Math.max(at(event.after), -1));
      const ring = event.rings[0], middle = [0, 1].map((k) => ring.reduce((sum, p) => sum + p[k], 0) / ring.length);
      const side_m = Math.max(...[0, 1].map((k) => Math.max(...ring.map((p) => p[k])) - Math.min(...ring.map((p) => p[k]))));
      map.centre(middle, 3 * side_m / canvas.clientWidth);
      askArea(ring.slice(0, -1));
      byId("map").scrollIntoView();
    });
    row.cells[0].append(" ", button);
  }

  const grouped = (value, digits = 0) => number(value, digits).replace(/\B(?=(\d{3})+(?!\d))/g, "\u202f");
  let hovered = 0;
  map.on.hover = async (position) => {
    const mine = ++hovered, words = position ? `${grouped(position[0])} E, ${grouped(position[1])} N` : "";
    hover.textContent = words;
    if (!position || map.isMoving() || layers.isPicture(map.now())) return;
    const at = await layers.at(map.now(), position);
    if (mine !== hovered || !at) return;
    const height = Number.isFinite(at.height) ? `, ${grouped(at.height, 1)} m` : "";
    hover.textContent = `${words}${height}: ${at.isObserved ? withHalf(at.change, at.sigma, 3, at.unit) : text.key_unseen}`;
  };

  // ---- tools

  function choose(name) {
    tool = name;
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.tool === name));
    hint.textContent = text[`hint_${name}`];
    if (name !== "polygon" && !closed) polygon = [];
    map.draw();
  }

  map.on.drawsBox = () => tool === "box";
  map.on.box = (corners) => askArea(corners);
  map.on.tap = (position, event) => tap(position, event);
  map.on.finish = (event) => {
    if (tool === "polygon" && !closed && event && polygon.length > 2) askArea(polygon);
    else if (!event) { places = []; polygon = []; closed = false; panel.hidden = true; link(); map.draw(); }
  };

  function tap(position) {
    if (tool === "polygon") {
      if (closed) { polygon = []; closed = false; places = []; }
      const near = polygon.length > 2 && Math.hypot(...position.map((x, k) => x - polygon[0][k])) < SNAP_PX * map.view.scale;
      if (near) { askArea(polygon); return; }
      polygon.push(position);
      map.draw();
      return;
    }
    if (tool === "compare" && places.length) askDifference(places[0], position);
    else askPlace(position);
  }

  // ---- answers; an answer that a newer question has overtaken is dropped

  let question = 0;
  async function ask(promise, show) {
    const mine = ++question;
    panel.hidden = false;
    panel.replaceChildren(make("p", { textContent: text.loading }));
    map.draw();
    link();
    const answer = await promise;
    if (mine === question) show(answer);
  }

  function askPlace(position) {
    places = [position];
    polygon = [];
    ask(reader.place(position), (answer) => {
      if (!answer) { tell(text.not_observed); return; }
      const heading = fill(text.title_place, { size: about.block_m, east: grouped(position[0]), north: grouped(position[1]) });
      show(heading, text.curve_change, answer.curve, (at) => [
        [text.change, withHalf(at.change, at.sigma, 3, "m")],
        [text.random, `${number(at.random, 4)} m`], [text.systematic, `${number(at.systematic, 4)} m`],
        [text.height, `${number(answer.height_m, 1)} m`], [text.range, `${grouped(answer.range_m)} m`],
        [text.incidence, `${number(answer.incidence_deg, 0)}°`],
      ]);
      showLevels(position);
    });
  }

  // Level and rate below the curve of a place, when they are there: the curve does not wait for them.
  async function showLevels(position) {
    const mine = question, levels = await reader.levels(position);
    if (!levels || mine !== question) return;
    current.levels = levels;
    for (const [title, curve] of [[text.curve_level, levels.level], [text.curve_rate, levels.rate]]) drawCurve(title, curve);
    page.flush();
    showValues();
  }

  function askDifference(first, second) {
    places = [first, second];
    polygon = [];
    ask(reader.difference(first, second), (curve) => {
      if (!curve) { tell(text.not_observed); return; }
      const distance = grouped(Math.hypot(first[0] - second[0], first[1] - second[1]));
      show(fill(text.title_difference, { east: grouped(second[0]), north: grouped(second[1]), distance }),
        text.curve_difference, curve, (at) => [
          [text.difference, withHalf(at.change, at.sigma, 3, "m")],
          [text.random, `${number(at.random, 4)} m`], [text.systematic, `${number(at.systematic, 4)} m`]]);
    });
  }

  function askArea(corners) {
    polygon = corners;
    closed = true;
    places = [];
    ask(reader.area(corners), (answer) => {
      if (answer.tooLarge) { tell(fill(text.too_large, { area: number(reader.maxArea_m2 / 1e6, 2) })); return; }
      if (!answer.curve.length) { tell(text.not_observed); return; }
      show(fill(text.title_area, { area: grouped(answer.size_m2) }), text.curve_mean, answer.curve, (at) => [
        [text.mean, withHalf(at.change, at.sigma, 3, "m")],
        [text.volume, withHalf(at.change * answer.size_m2, at.sigma * answer.size_m2, 0, "m³")],
        [text.random, `${number(at.random, 4)} m`], [text.systematic, `${number(at.systematic, 4)} m`],
        [text.observed, `${number(100 * at.observed, 0)} %`]]);
    });
  }

  const withHalf = (value, sigma, digits, unit) => `${grouped(value, digits)} ± ${grouped(HALF_95 * sigma, digits)} ${unit}`;
  const tell = (words) => panel.replaceChildren(make("p", { textContent: words }));

  const endOfDay = (time_s) => (Math.floor(time_s / 86400) + 1) * 86400;  // a map shows the level of its day
  let current = null;
  function show(heading, title, curve, rows) {
    current = { curve, rows };
    const list = make("dl", { id: "asked-values" });
    panel.replaceChildren(make("h3", { textContent: heading }), list, make("div", { id: "asked-curves" }));
    drawCurve(title, curve);
    page.flush();
    const close = make("button", { type: "button", textContent: text.close });
    close.addEventListener("click", () => map.on.finish(null));
    const csv = make("a", { textContent: text.csv, download: "curve.csv", href: csvOf(curve) });
    panel.append(make("p", { textContent: text.interval, className: "note" }),
      make("p", {}, make("a", { href: location.hash, textContent: text.share, className: "share" }), " ", csv, " ", close));
    showValues();
  }

  const drawCurve = (title, curve) => page.curve(byId("asked-curves"), title, curve.map((point) => point.time_s),
    [{ values: curve.map((p) => p.change), half: curve.map((p) => p.change == null ? null : HALF_95 * p.sigma), digits: 3 }]);

  function csvOf(curve) {
    const lines = curve.filter((p) => p.change != null).map((p) =>
      [new Date(p.time_s * 1000).toISOString(), ...[p.change, p.sigma, p.random, p.systematic].map((v) => v.toFixed(5))].join(","));
    const head = "start_utc,change_m,sigma_m,sigma_random_m,sigma_systematic_m";
    return `data:text/csv,${encodeURIComponent([head, ...lines, ""].join("\n"))}`;
  }

  let correlation = null;  // of the change of two scans, once needed
  // The values at the time of the shown map, or at the last one before it that has any.
  function showValues() {
    const list = byId("asked-values");
    if (!list || !current) return;
    const until_s = data.maps[shown].time_s + 1, known = current.curve.filter((p) => p.change != null);
    const at = known.filter((p) => p.time_s <= until_s).at(-1) || known[0];
    list.replaceChildren();
    if (!at) { list.append(make("p", { textContent: text.not_observed })); return; }
    const from = layers.before() && known.filter((p) => p.time_s <= layers.before().time_s + 1).at(-1);
    if (from) {
      if (!correlation) reader.correlations().then((found) => { correlation = found; showValues(); });
      const { change, sigma } = stationCurves.between(at, from, correlation ? correlation(at.time_s, from.time_s) : 0);
      list.append(make("div", {}, make("dt", { textContent: fill(text.since_scan, { time: page.utc(from.time_s) }) }), make("dd", { textContent: withHalf(change, sigma, 3, "m"), title: text.pair_sigma })));
    }
    const levels = Object.entries(current.levels || {}).flatMap(([name, curve]) => {
      const last = curve.filter((p) => p.change != null && p.time_s <= endOfDay(data.maps[shown].time_s)).at(-1);
      return last ? [[`${text[`layer_${name}`]} (${page.utc(last.time_s)})`, withHalf(last.change, last.sigma, 3, name === "rate" ? "m/d" : "m")]] : [];
    });
    for (const [name, value] of [...current.rows(at), ...levels]) list.append(make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: value })));
    list.append(make("div", {}, make("dt", { textContent: "UTC" }), make("dd", { textContent: page.utc(at.time_s) })));
  }

  // ---- links

  const minute = (shownMap) => `${new Date(shownMap.time_s * 1000).toISOString().slice(0, 16)}Z`;
  const point = (position) => position.map((x) => x.toFixed(1)).join(",");
  function link() {
    const parts = [];
    if (polygon.length && closed) parts.push(`area=${polygon.map(point).join(";")}`);
    if (places.length) parts.push(`at=${point(places[0])}`);
    if (places.length > 1) parts.push(`minus=${point(places[1])}`);
    if (layers.state.layer !== "change") parts.push(`layer=${layers.state.layer}`);
    if (layers.before()) parts.push(`since=${minute(layers.before())}`);
    if (shown < data.maps.length - 1) parts.push(`time=${minute(data.maps[shown])}`);
    history.replaceState(null, "", parts.length ? `#${parts.join("&")}` : location.pathname + location.search);
    const share = panel.querySelector(".share");
    if (share) share.href = location.hash;
  }

  function follow() {
    const hash = new URLSearchParams(decodeURIComponent(location.hash.slice(1)));
    const read = (words) => words.split(",").map(Number);
    const isPoint = (p) => p.length === 2 && p.every(Number.isFinite);
    if (hash.get("time")) page.showTime(Date.parse(hash.get("time")) / 1000);
    const since_s = Date.parse(hash.get("since")) / 1000, layer = hash.get("layer");
    controls.choose(layer, data.maps.findLastIndex((m) => m.time_s <= since_s + 59));
    const area = hash.get("area")?.split(";").map(read), at = hash.get("at") && read(hash.get("at"));
    const other = hash.get("minus") && read(hash.get("minus"));
    if (area && area.length > 2 && area.every(isPoint)) askArea(area);
    else if (at && isPoint(at) && other && isPoint(other)) askDifference(at, other);
    else if (at && isPoint(at)) askPlace(at);
  }

  document.addEventListener("station:shown", (event) => {
    shown = event.detail;
    map.draw();
    showValues();
    if (current) link();
  });
  image.addEventListener("load", () => map.draw());
  addEventListener("hashchange", follow);
  choose("place");
  follow();
})();
