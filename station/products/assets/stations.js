"use strict";
// Rows of stations: each loads the small script that its station writes with every scan.
(() => {
  const { stations, text } = window.STATIONS_DATA;
  const fill = (key, values) => text[key].replace(/\{(\w+)\}/g, (_, name) => values[name]);
  const utc = (s) => new Date(s * 1000).toISOString().slice(0, 16).replace("T", " ");
  const span = (s) => s < 5400 ? `${Math.max(0, Math.round(s / 60))} min`
    : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} ${text.js_days}`;
  const LATE = 1.5, STALE = 3, FUTURE_S = 300, RELOAD_S = 60;
  window.STATIONS = {};

  function show(row, station) {
    const state = window.STATIONS[station.id], [lampCell, scan, alarm, map] = row.querySelectorAll("td");
    const lamp = lampCell.firstChild;
    if (!state) {
      lamp.className = "lamp stale";
      lamp.textContent = text.index_unreachable;
      return;
    }
    const age_s = Date.now() / 1000 - state.written_s, every_s = state.expected_every_s;
    const light = age_s < -FUTURE_S ? "late" : age_s > STALE * every_s ? "stale" : age_s > LATE * every_s ? "late" : "fresh";
    lamp.className = `lamp ${light}`;
    lamp.textContent = age_s < -FUTURE_S ? text.js_clock_error : `${text[`js_${light}`]} (${span(age_s)})`;
    scan.className = `words ${state.verdict || ""}`;
    scan.textContent = state.scan_s ? `${utc(state.scan_s)} UTC: ${state.verdict_word}${state.reason ? `: ${state.reason}` : ""}` : text.index_none;
    alarm.className = state.alarm ? "words unusable" : "words";
    alarm.textContent = state.alarm || text.index_none;
    if (state.map && map.dataset.file !== state.map) {
      map.dataset.file = state.map;
      const image = document.createElement("img");
      image.src = station.page + state.map;
      image.alt = fill("index_map_alt", { time: utc(state.map_s) });
      map.replaceChildren(image);
    }
  }

  function load() {
    for (const station of stations) {
      const row = document.querySelector(`tr[data-id="${CSS.escape(station.id)}"]`);
      const script = document.createElement("script");
      script.src = `${station.page}summary.js?${Math.floor(Date.now() / 1000)}`;
      script.onload = script.onerror = () => { script.remove(); show(row, station); };
      document.head.append(script);
    }
  }
  load();
  setInterval(load, RELOAD_S * 1000);
})();
