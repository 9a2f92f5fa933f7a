"use strict";
// The page is complete without this script, which adds the status light, the slider and the curves.
(() => {
  const data = window.STATION, text = data.text;
  const fill = (template, values) => template.replace(/\{(\w+)\}/g, (_, name) => values[name]);
  const make = (tag, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };
  const byId = (id) => document.getElementById(id);
  const pad = (n) => String(n).padStart(2, "0");
  const utc = (s) => {
    const t = new Date(s * 1000);
    return `${t.getUTCFullYear()}-${pad(t.getUTCMonth() + 1)}-${pad(t.getUTCDate())} ` +
      `${pad(t.getUTCHours())}:${pad(t.getUTCMinutes())}`;
  };
  const span = (s) => s < 5400 ? `${Math.max(0, Math.round(s / 60))} min`
    : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} ${text.js_days}`;

  // ---- the status light: computed in the browser, so that it also shows when the service is dead

  const LATE = 1.5, STALE = 3, FUTURE_S = 300;
  const title = document.title;
  const shown_s = Number(document.body.dataset.written);
  let touched_ms = 0;
  document.addEventListener("input", () => { touched_ms = Date.now(); });
  document.addEventListener("click", () => { touched_ms = Date.now(); });

  function updateLight() {
    const age_s = Date.now() / 1000 - shown_s, every_s = data.expected_every_s;
    const state = age_s > STALE * every_s ? "stale" : age_s > LATE * every_s || age_s < -FUTURE_S ? "late" : "fresh";
    const word = age_s < -FUTURE_S ? text.js_clock_error
      : text[`js_${state}`];
    const words = age_s < -FUTURE_S ? text.js_clock_wrong
      : fill(text.js_written_ago, { age: span(age_s), every: span(every_s) }) +
        (state === "stale" ? fill(text.js_check_service, { station: data.station }) : "");
    const lamp = byId("lamp");
    if (lamp.className !== `lamp ${state}`) lamp.className = `lamp ${state}`;
    if (byId("lamp-word").textContent !== word) byId("lamp-word").textContent = word;
    if (byId("lamp-text").textContent !== words) byId("lamp-text").textContent = words;
    document.title = state === "stale" ? `${text.js_stale.toUpperCase()} – ${title}` : title;
    return age_s;
  }

  // An open page checks a file of a few bytes for a newer page; this works from a folder, too.
  function checkForUpdate() {
    const script = document.createElement("script");
    script.src = `written.js?${Math.floor(Date.now() / 1000)}`;
    script.onload = () => {
      script.remove();
      if (!(window.STATION_WRITTEN_S > shown_s)) return;
      if (Date.now() - touched_ms > 120000) location.reload();
      else byId("reload").hidden = false;
    };
    script.onerror = () => script.remove();
    document.head.append(script);
  }
  byId("reload").addEventListener("click", () => location.reload());
  updateLight();
  setInterval(updateLight, 15000);
  setInterval(() => { if (updateLight() > data.expected_every_s / 4) checkForUpdate(); },
    1000 * Math.min(900, Math.max(30, data.expected_every_s / 8)));

  // ---- the slider

  let showTime = () => {};
  const maps = data.maps, slider = byId("slider"), image = byId("map-image");
  if (image && maps.length) {
    const rest = byId("map-caption").textContent.replace(/^[^.]*\. /, "");
    const show = (index) => {
      const map = maps[index], when = `${utc(map.time_s)} UTC`;
      slider.value = index;
      document.dispatchEvent(new CustomEvent("station:shown", { detail: index }));
      slider.setAttribute("aria-valuetext", when);
      byId("slider-time").textContent = when;
      byId("earlier").disabled = index === 0;
      byId("later").disabled = index === maps.length - 1;
      if (image.getAttribute("src") === map.file) return;
      image.src = map.file;
      image.parentElement.href = map.file;
      image.alt = image.alt.replace(/\d{4}-\d\d-\d\d \d\d:\d\d/, utc(map.time_s));
      byId("map-caption").textContent = `${when}. ${rest}`;
    };
    image.addEventListener("error", () => {
      byId("map-caption").hidden = false;
      byId("map-caption").textContent = text.js_map_gone;
    });
    slider.max = maps.length - 1;
    slider.addEventListener("input", () => show(Number(slider.value)));
    byId("earlier").addEventListener("click", () => show(Number(slider.value) - 1));
    byId("later").addEventListener("click", () => show(Number(slider.value) + 1));
    show(maps.length - 1);
    byId("slider-row").hidden = maps.length < 2;
    showTime = (time_s) => show(Math.max(maps.findLastIndex((map) => map.time_s <= time_s + 59), 0));
  }

  // ---- the curves; tables contain the same values for readers who cannot see them

  const charts = [], pendingPlots = [];
  const cssColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const formatNumber = (value, digits) => value == null || !isFinite(value) ? "–"
    : value.toFixed(digits).replace(/^-(?=0*\.?0*$)/, "").replace("-", "−");

  const cell = (row, tag, text) => row.appendChild(document.createElement(tag)).textContent = text;

  const half = (sigma) => sigma.map((s) => s == null ? null : 1.959964 * s);  // of the 95 % interval

  // What a curve is drawn over: time, or the distance from the start of a line.
  const TIME = { isTime: true, head: text.js_time, csv: "start_utc", word: utc, code: (s) => new Date(s * 1000).toISOString() };
  const DISTANCE = { isTime: false, head: text.js_distance_m, csv: "distance_m", word: (m) => `${formatNumber(m, 1)} m`, code: (m) => m };

  // The values of a curve as a table, newest first; created when opened.
  function table(heading, x, lines, over) {
    const fold = document.createElement("details");
    fold.appendChild(document.createElement("summary")).textContent = text.js_as_table;
    fold.addEventListener("toggle", () => {
      if (fold.querySelector("table")) return;
      const wide = fold.appendChild(document.createElement("div"));
      wide.className = "wide high";
      wide.tabIndex = 0;
      const element = wide.appendChild(document.createElement("table"));
      element.createCaption().textContent = heading;
      const top = element.createTHead().insertRow(), body = element.createTBody();
      cell(top, "th", over.head);
      for (const line of lines) {
        cell(top, "th", line.label || text.js_value);
        if (line.half) cell(top, "th", "± (95 %)");
      }
      for (const i of over.isTime ? [...x.keys()].reverse() : x.keys()) {
        const row = body.insertRow();
        cell(row, "th", over.word(x[i]));
        for (const line of lines) {
          cell(row, "td", formatNumber(line.values[i], line.digits));
          if (line.half) cell(row, "td", formatNumber(line.half[i], line.digits));
        }
      }
      for (const header of element.querySelectorAll("th")) header.scope = header.closest("thead") ? "col" : "row";
      fold.append(make("a", { textContent: text.js_csv, download: "curve.csv", href: csvOf(x, lines, over) }));
    });
    return fold;
  }

  // The values of a curve as a file, oldest first; those that are missing are empty.
  function csvOf(x, lines, over) {
    const columns = lines.flatMap((line) => [
      [line.label || text.js_value, line.values, line.digits], ...(line.half ? [["± 95 %", line.half, line.digits + 1]] : [])]);
    const rows = x.map((value, i) => [over.code(value),
      ...columns.map(([, values, digits]) => values[i] == null ? "" : values[i].toFixed(digits))]);
    return `data:text/csv;charset=utf-8,${encodeURIComponent([[over.csv, ...columns.map(([name]) => name)], ...rows, ""].join("\n"))}`;
  }

  function curve(parent, heading, x, lines, band, over = TIME) {
    if (!x.length || !lines.some((line) => line.values.some((v) => v != null))) return;
    const card = document.createElement("div"), head = document.createElement("h3");
    const reading = document.createElement("p"), plotBox = document.createElement("div");
    card.className = "curve";
    head.textContent = heading;
    card.append(head, reading, plotBox, table(heading, x, lines, over));
    plotBox.setAttribute("role", "img");
    parent.append(card);
    const last = over.isTime ? x.length - 1 : lines[0].values.findIndex((v) => v != null);
    const showReading = (index) => {
      const i = index == null ? last : index;
      reading.textContent = `${over.word(x[i])}: ` + lines.map((line) =>
        (line.label ? `${line.label} ` : "") + formatNumber(line.values[i], line.digits) +
        (line.half && line.half[i] != null ? ` ± ${formatNumber(line.half[i], line.digits)}` : "")).join(", ");
    };
    showReading(null);
    plotBox.setAttribute("aria-label", `${heading}. ${over.isTime ? `${text.js_newest}, ` : ""}${reading.textContent}`);
    const rows = [x], series = [{}], bands = [];
    for (const line of lines) {
      const colour = cssColour(line.colour || "--accent");
      const points = { show: x.length < 60, size: 4 };
      if (line.half) {
        const edge = (sign) => line.values.map((v, i) => v == null || line.half[i] == null ? null : v + sign * line.half[i]);
        rows.push(edge(1), edge(-1));
        const hidden = { stroke: "transparent", width: 0, points: { show: false } };
        series.push(hidden, { ...hidden });
        bands.push({ series: [series.length - 2, series.length - 1], fill: cssColour("--band") });
      }
      rows.push(line.values);
      series.push({ stroke: colour, width: 1.6, points });
    }
    if (band) {
      for (const edge of band) {
        rows.push(x.map(() => edge));
        series.push({ stroke: cssColour("--faint"), width: 1, dash: [4, 4], points: { show: false } });
      }
    }
    pendingPlots.push(() => plot(plotBox, showReading, rows, series, bands, over));
  }

  const TICKS = [  // uPlot's table: step, label, then the additions where year, month, day … change
    [31536000, "{YYYY}", null, null, null, null, null, null, 1],
    [2419200, "{MMM}", "\n{YYYY}", null, null, null, null, null, 1],
    [86400, "{D} {MMM}", "\n{YYYY}", null, null, null, null, null, 1],
    [3600, "{HH}:{mm}", "\n{D} {MMM} {YYYY}", null, "\n{D} {MMM}", null, null, null, 1],
    [60, "{HH}:{mm}", "\n{D} {MMM} {YYYY}", null, "\n{D} {MMM}", null, null, null, 1],
    [1, "{mm}:{ss}", "\n{D} {MMM} {HH}:{mm}", null, "\n{D} {MMM} {HH}:{mm}", null, "\n{HH}:{mm}", null, 1],
  ];

  function plot(plotBox, showReading, rows, series, bands, over) {
    const axis = { stroke: cssColour("--faint"), grid: { stroke: cssColour("--line"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    const chart = new uPlot({
      width: Math.max(200, plotBox.clientWidth), height: 190, legend: { show: false }, series, bands,
      scales: { x: { time: over.isTime } },
      tzDate: (s) => uPlot.tzDate(new Date(s * 1000), "Etc/UTC"),
      axes: [over.isTime ? { ...axis, values: TICKS, space: 70 } : { ...axis, values: (_, ticks) => ticks.map((m) => `${m} m`) }, { ...axis, size: 62 }],
      cursor: { drag: { x: true, y: false } },
      hooks: { setCursor: [(u) => showReading(u.cursor.idx)] },
    }, rows, plotBox);
    charts.push([chart, plotBox]);
  }

  function draw() {
    charts.splice(0).forEach(([chart, plotBox]) => {
      if (plotBox.closest(".curves")) chart.destroy(); else charts.push([chart, plotBox]);
    });
    const areas = byId("area-curves"), health = byId("health-curves");
    const products = byId("product-curves");
    if (areas) areas.replaceChildren();
    if (products) products.replaceChildren();
    health.replaceChildren();
    for (const area of data.areas) {
      curve(areas, fill(text.js_area_curve, { area: area.name }), data.area_time_s, [
        { values: area.mean_m, half: half(area.sigma_m), digits: 3 }]);
    }
    for (const p of [...data.products, ...data.profiles]) {
      const x = p.distance_m, title = fill(x ? text.js_product_profile : text.js_product_curve, { ...p, time: x && utc(p.time_s) });
      curve(products, title, x || p.time_s, [{ values: p.values, half: half(p.sigma), digits: p.digits }], null, x ? DISTANCE : TIME);
    }
    if (data.health) drawHealth(health, data.health);
    flush();
  }

  function flush() {
    for (const create of pendingPlots.splice(0)) create();  // once all have their position and width
  }

  function drawHealth(health, h) {
    const t = h.time_s;
    curve(health, text.js_z, t, [{ values: h.stable_z_std, digits: 2 }], [0.8, 1.25]);
    curve(health, text.js_stable, t, [
      { label: text.js_median, values: h.stable_median, digits: 3 },
      { label: text.js_scatter, values: h.stable_nmad, digits: 3, colour: "--second" }]);
    const medianOf = (values) => {
      const known = values.filter((v) => v != null).sort((a, b) => a - b);
      return known.length ? known[Math.floor(known.length / 2)] : null;
    };
    const [roll, pitch] = [medianOf(h.platform_roll), medianOf(h.platform_pitch)];
    const subtract = (values, m) => values.map((v) => v == null ? null : v - m);
    curve(health, fill(text.js_tilt, { roll: formatNumber(roll, 3), pitch: formatNumber(pitch, 3) }), t, [
      { label: text.js_roll, values: subtract(h.platform_roll, roll), digits: 4 },
      { label: text.js_pitch, values: subtract(h.platform_pitch, pitch), digits: 4, colour: "--second" }]);
    curve(health, text.js_temperature, t, [{ values: h.air_temperature, digits: 1 }]);
    curve(health, text.js_pressure, t, [{ values: h.air_pressure, digits: 1 }]);
    curve(health, text.js_seconds, t, [{ values: h.seconds, digits: 1 }]);
  }

  // What the first words do not need comes after them: on a slow connection they would wait for it.
  function load(name) {
    const script = Object.assign(document.createElement("script"), { src: name, async: false });
    document.head.append(script);
    return new Promise((resolve) => { script.onload = resolve; });
  }
  document.head.append(Object.assign(document.createElement("link"), { rel: "stylesheet", href: "explore.css" }));
  addEventListener("DOMContentLoaded", () => { load("uplot.js").then(draw); load("explore.js"); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  window.stationPage = { make, fill, curve, flush, formatNumber, utc, showTime: (time_s) => showTime(time_s) };
  let width = innerWidth;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    for (const [chart, plotBox] of charts) chart.setSize({ width: Math.max(200, plotBox.clientWidth), height: 190 });
  });
})();
