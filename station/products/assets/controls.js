// The controls of the layers and of the scans they compare, and the key of the map.
function stationControls(data, text, layers, page, changed) {
  const { make, fill } = page, { LAYERS } = stationValues;
  const timeOf = (map) => map ? `${page.utc(map.time_s)} UTC` : text.the_reference;
  const shown = { outlines: true };

  const kept = Object.keys(LAYERS).filter((name) => !LAYERS[name].source || data.maps.some((map) => map.level));
  const choice = make("select", { id: "layer" },
    ...kept.map((name) => make("option", { value: name, textContent: text[`layer_${name}`] })));
  choice.addEventListener("change", () => { layers.state.layer = choice.value; changed(); });
  const box = (name, checked, act) => {
    const input = make("input", { type: "checkbox", id: `show-${name}`, checked });
    input.addEventListener("change", () => { act(input.checked); changed(); });
    return make("label", {}, input, ` ${text[`show_${name}`]}`);
  };
  const row = make("div", { id: "map-layers" }, make("label", {}, `${text.layer} `, choice),
    box("outlines", true, (on) => { shown.outlines = on; }),
    box("contours", false, (on) => { layers.state.contours = on; }));

  // ---- the scan that the change is counted from, and the border between both

  const since = make("input", { type: "range", id: "since", min: -1, max: data.maps.length - 1, value: -1 });
  const output = make("output", { id: "since-time" });
  const swipe = make("input", { type: "range", id: "swipe", min: 0, max: 100, value: 50, hidden: true });
  swipe.setAttribute("aria-label", text.swipe_label);
  const swipeBox = make("input", { type: "checkbox", id: "show-swipe" });
  const sinceRow = make("div", { className: "slider", hidden: data.maps.length < 2 },
    make("label", { htmlFor: "since", textContent: text.since }), since, output, make("label", {}, swipeBox, ` ${text.swipe}`));
  function showSince() {
    layers.state.since = Number(since.value);
    output.textContent = timeOf(layers.before());
    since.setAttribute("aria-valuetext", output.textContent);
    swipeBox.disabled = !layers.before();
    swipe.hidden = !(layers.before() && swipeBox.checked);
    layers.state.swipe = swipe.hidden ? null : swipe.value / 100;
  }
  for (const input of [since, swipe, swipeBox]) input.addEventListener("input", () => { showSince(); changed(); });
  showSince();

  function choose(layer, index) {
    layers.state.layer = choice.value = kept.includes(layer) ? layer : "change";
    since.value = index;
    showSince();
    changed();
  }

  // ---- the colour bar and the legend in words

  const key = make("div", { id: "map-key" });
  let keyShown = "";
  function drawKey(now) {
    const { layer, contours } = layers.state, { scale: name, source } = LAYERS[layer], scale = layers.scales[name];
    const pair = layers.pairs(now)[0], level = source && layers.levelTime(pair.after);
    const every_m = contours ? layers.every_m() : 0;
    const words = source && !level ? text.no_level
      : fill(text[`key_${layer}`], { since: timeOf(pair.before), time: level && `${page.utc(level)} UTC` });
    const note = pair.before && (layers.isComparable(pair) ? text.pair_sigma : text.pair_reference);
    const wanted = [layer, words, every_m, note].join();
    if (wanted === keyShown) return;
    keyShown = wanted;
    const bar = make("canvas", { width: 256, height: 1 }), context = bar.getContext("2d");
    scale.table.forEach((rgb, i) => {
      context.fillStyle = `rgb(${rgb.join()})`;
      context.fillRect(i, 0, 1, 1);
    });
    bar.setAttribute("aria-hidden", "true");
    const ticks = data.scales[name].ticks.map((tick) => {
      const mark = make("span", { textContent: String(Number(tick.toPrecision(3))).replace("-", "−") });
      mark.style.left = `${100 * scale.position(tick)}%`;
      return mark;
    });
    const entry = (kind) => make("span", { className: `swatch ${kind}`, textContent: text[`key_${kind}`] });
    const contour = () => make("span", { className: "swatch contour", textContent: fill(text.key_contour, { every: every_m }) });
    key.replaceChildren(make("p", { textContent: words }), make("div", { className: "bar" }, bar, ...ticks),
      make("p", {}, ...(LAYERS[layer].grey ? [entry("grey")] : []), entry("unseen"), ...(every_m ? [contour()] : [])),
      ...(note ? [make("p", { className: "note", textContent: note })] : []));
  }

  return { row, sinceRow, swipe, key, drawKey, choose, shown, timeOf };
}
