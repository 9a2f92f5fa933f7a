"use strict";
// The page as it was written is whole without this. Here: the lamp, the slider, the curves.
(() => {
  const data = window.STATION;
  const at = (id) => document.getElementById(id);
  const two = (n) => String(n).padStart(2, "0");
  const utc = (s) => {
    const t = new Date(s * 1000);
    return `${t.getUTCFullYear()}-${two(t.getUTCMonth() + 1)}-${two(t.getUTCDate())} ` +
      `${two(t.getUTCHours())}:${two(t.getUTCMinutes())}`;
  };
  const span = (s) => s < 5400 ? `${Math.max(0, Math.round(s / 60))} min`
    : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} days`;

  // ---- the lamp: computed here, so that a service that is dead cannot hide

  const LATE = 1.5, STALE = 3, FUTURE_S = 300;
  const title = document.title;
  const shown_s = Number(document.body.dataset.written);
  let touched_ms = 0;
  document.addEventListener("input", () => { touched_ms = Date.now(); });
  document.addEventListener("click", () => { touched_ms = Date.now(); });

  function light() {
    const age_s = Date.now() / 1000 - shown_s, every_s = data.expected_every_s;
    const state = age_s > STALE * every_s ? "stale" : age_s > LATE * every_s || age_s < -FUTURE_S ? "late" : "fresh";
    const word = age_s < -FUTURE_S ? "From the future"
      : { fresh: "Up to date", late: "Late", stale: "Stale" }[state];
    const text = age_s < -FUTURE_S ? "this clock or the station's is wrong"
      : `written ${span(age_s)} ago, a scan is expected every ${span(every_s)}` +
        (state === "stale" ? `: look whether the service runs and scans arrive (systemctl status station@${data.station})` : "");
    const lamp = at("lamp");
    if (lamp.className !== `lamp ${state}`) lamp.className = `lamp ${state}`;
    if (at("lamp-word").textContent !== word) at("lamp-word").textContent = word;
    if (at("lamp-text").textContent !== text) at("lamp-text").textContent = text;
    document.title = state === "stale" ? `STALE – ${title}` : title;
    return age_s;
  }

  // A page left open learns by a file of a few bytes that there is a newer one; from a folder, too.
  function look() {
    const script = document.createElement("script");
    script.src = `written.js?${Math.floor(Date.now() / 1000)}`;
    script.onload = () => {
      script.remove();
      if (!(window.STATION_WRITTEN_S > shown_s)) return;
      if (Date.now() - touched_ms > 120000) location.reload();
      else at("reload").hidden = false;
    };
    script.onerror = () => script.remove();
    document.head.append(script);
  }
  at("reload").addEventListener("click", () => location.reload());
  light();
  setInterval(light, 15000);
  setInterval(() => { if (light() > data.expected_every_s / 4) look(); },
    1000 * Math.min(900, Math.max(30, data.expected_every_s / 8)));

  // ---- the slider

  const maps = data.maps, slider = at("slider"), image = at("map-image");
  if (image && maps.length) {
    const rest = at("map-caption").textContent.replace(/^[^.]*\. /, "");
    const show = (index) => {
      const map = maps[index], when = `${utc(map.time_s)} UTC`;
      slider.value = index;
      slider.setAttribute("aria-valuetext", when);
      at("slider-time").textContent = when;
      at("earlier").disabled = index === 0;
      at("later").disabled = index === maps.length - 1;
      if (image.getAttribute("src") === map.file) return;
      image.src = map.file;
      image.parentElement.href = map.file;
      image.alt = image.alt.replace(/\d{4}-\d\d-\d\d \d\d:\d\d/, utc(map.time_s));
      at("map-caption").textContent = `${when}. ${rest}`;
    };
    image.addEventListener("error", () => {
      at("map-caption").textContent = "This map is kept no longer: load the page again.";
    });
    slider.max = maps.length - 1;
    slider.addEventListener("input", () => show(Number(slider.value)));
    at("earlier").addEventListener("click", () => show(Number(slider.value) - 1));
    at("later").addEventListener("click", () => show(Number(slider.value) + 1));
    show(maps.length - 1);
    at("slider-row").hidden = maps.length < 2;
  }

  // ---- the curves; the tables hold the same for those who do not see them

  const charts = [], makers = [];
  const paint = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const figures = (value, digits) => value == null ? "–" : value.toFixed(digits).replace("-", "−");

  const cell = (row, tag, text) => row.appendChild(document.createElement(tag)).textContent = text;

  // The same numbers for those who do not see the curve, newest first; made when asked for.
  function table(heading, time_s, lines) {
    const fold = document.createElement("details");
    fold.appendChild(document.createElement("summary")).textContent = "As a table";
    fold.addEventListener("toggle", () => {
      if (fold.querySelector("table")) return;
      const wide = fold.appendChild(document.createElement("div"));
      wide.className = "wide high";
      wide.tabIndex = 0;
      const made = wide.appendChild(document.createElement("table"));
      made.createCaption().textContent = heading;
      const top = made.createTHead().insertRow(), body = made.createTBody();
      cell(top, "th", "time, UTC");
      for (const line of lines) {
        cell(top, "th", line.label || "value");
        if (line.half) cell(top, "th", "±");
      }
      for (let i = time_s.length - 1; i >= 0; i--) {
        const row = body.insertRow();
        cell(row, "th", utc(time_s[i]));
        for (const line of lines) {
          cell(row, "td", figures(line.values[i], line.digits));
          if (line.half) cell(row, "td", figures(line.half[i], line.digits));
        }
      }
      for (const one of made.querySelectorAll("th")) one.scope = one.closest("thead") ? "col" : "row";
    });
    return fold;
  }

  function curve(parent, heading, time_s, lines, band) {
    if (!time_s.length || !lines.some((line) => line.values.some((v) => v != null))) return;
    const card = document.createElement("div"), head = document.createElement("h3");
    const told = document.createElement("p"), place = document.createElement("div");
    card.className = "curve";
    head.textContent = heading;
    card.append(head, told, place, table(heading, time_s, lines));
    place.setAttribute("role", "img");
    parent.append(card);
    const last = time_s.length - 1;
    const say = (index) => {
      const i = index == null ? last : index;
      told.textContent = `${utc(time_s[i])}: ` + lines.map((line) =>
        (line.label ? `${line.label} ` : "") + figures(line.values[i], line.digits) +
        (line.half && line.half[i] != null ? ` ± ${figures(line.half[i], line.digits)}` : "")).join(", ");
    };
    say(null);
    place.setAttribute("aria-label", `${heading}. Newest, ${told.textContent}`);
    const rows = [time_s], series = [{}], bands = [];
    for (const line of lines) {
      const colour = paint(line.colour || "--accent");
      const points = { show: time_s.length < 60, size: 4 };
      if (line.half) {
        const edge = (sign) => line.values.map((v, i) => v == null || line.half[i] == null ? null : v + sign * line.half[i]);
        rows.push(edge(1), edge(-1));
        const hidden = { stroke: "transparent", width: 0, points: { show: false } };
        series.push(hidden, { ...hidden });
        bands.push({ series: [series.length - 2, series.length - 1], fill: paint("--band") });
      }
      rows.push(line.values);
      series.push({ stroke: colour, width: 1.6, points });
    }
    if (band) {
      for (const edge of band) {
        rows.push(time_s.map(() => edge));
        series.push({ stroke: paint("--faint"), width: 1, dash: [4, 4], points: { show: false } });
      }
    }
    makers.push(() => plot(place, say, rows, series, bands));
  }

  const TICKS = [  // uPlot's table: step, plain, then what is added where year, month, day … change
    [31536000, "{YYYY}", null, null, null, null, null, null, 1],
    [2419200, "{MMM}", "\n{YYYY}", null, null, null, null, null, 1],
    [86400, "{D} {MMM}", "\n{YYYY}", null, null, null, null, null, 1],
    [3600, "{HH}:{mm}", "\n{D} {MMM} {YYYY}", null, "\n{D} {MMM}", null, null, null, 1],
    [60, "{HH}:{mm}", "\n{D} {MMM} {YYYY}", null, "\n{D} {MMM}", null, null, null, 1],
    [1, "{mm}:{ss}", "\n{D} {MMM} {HH}:{mm}", null, "\n{D} {MMM} {HH}:{mm}", null, "\n{HH}:{mm}", null, 1],
  ];

  function plot(place, say, rows, series, bands) {
    const axis = { stroke: paint("--faint"), grid: { stroke: paint("--line"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    const chart = new uPlot({
      width: Math.max(200, place.clientWidth), height: 190, legend: { show: false }, series, bands,
      scales: { x: { time: true } },
      tzDate: (s) => uPlot.tzDate(new Date(s * 1000), "Etc/UTC"),
      axes: [{ ...axis, values: TICKS, space: 70 }, { ...axis, size: 62 }],
      cursor: { drag: { x: true, y: false } },
      hooks: { setCursor: [(u) => say(u.cursor.idx)] },
    }, rows, place);
    charts.push([chart, place]);
  }

  function draw() {
    for (const [chart] of charts.splice(0)) chart.destroy();
    const areas = at("area-curves"), health = at("health-curves");
    if (areas) areas.replaceChildren();
    health.replaceChildren();
    for (const area of data.areas) {
      curve(areas, `${area.name}: mean change since the reference, m`, data.area_time_s, [
        { values: area.mean_m, half: area.sigma_m.map((s) => s == null ? null : 1.959964 * s), digits: 3 }]);
    }
    if (data.health) drawHealth(health, data.health);
    for (const make of makers.splice(0)) make();  // when all have their place and width
  }

  function drawHealth(health, h) {
    const t = h.time_s;
    curve(health, "Change over σ where nothing moves (1 is right)", t, [{ values: h.stable_z_std, digits: 2 }], [0.8, 1.25]);
    curve(health, "Stable ground, median ± spread, m", t, [{ values: h.stable_median, half: h.stable_nmad, digits: 3 }]);
    const middle = (values) => {
      const known = values.filter((v) => v != null).sort((a, b) => a - b);
      return known.length ? known[Math.floor(known.length / 2)] : null;
    };
    const [roll, pitch] = [middle(h.platform_roll), middle(h.platform_pitch)];
    const less = (values, m) => values.map((v) => v == null ? null : v - m);
    curve(health, `Tilt less its median (roll ${figures(roll, 3)}°, pitch ${figures(pitch, 3)}°), °`, t, [
      { label: "roll", values: less(h.platform_roll, roll), digits: 4 },
      { label: "pitch", values: less(h.platform_pitch, pitch), digits: 4, colour: "--second" }]);
    curve(health, "Air temperature, °C", t, [{ values: h.air_temperature, digits: 1 }]);
    curve(health, "Air pressure, hPa", t, [{ values: h.air_pressure, digits: 1 }]);
    curve(health, "Time a scan took, s", t, [{ values: h.seconds, digits: 1 }]);
  }
  addEventListener("DOMContentLoaded", draw);  // when the last script is there; lamp and map do not wait for it
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  let width = innerWidth;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    for (const [chart, place] of charts) chart.setSize({ width: Math.max(200, place.clientWidth), height: 190 });
  });
})();
