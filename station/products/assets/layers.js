// The layers of the map: which values are shown, of which scan and since when, drawn from tiles as they arrive.
function stationLayers(data, text, shownIndex, redraw) {
  const tiles = stationValues.reader(data.values), size = data.values.tile;
  const scales = Object.fromEntries(Object.entries(data.scales).map(([name, scale]) => [name, stationValues.scaleOf(scale)]));
  const state = { layer: "change", since: -1, contours: false };  // since: index of a map, -1 the reference
  const painted = new Map(), KEPT = 240, DETAIL = 0.75;  // values per pixel from which a finer level is used
  let every_m = 0;

  const shown = () => data.maps[shownIndex()];
  const before = () => state.since < 0 ? null : data.maps[state.since];
  const isComparable = () => !before() || before().version === shown().version;
  const levels = () => data.frames[shown().version].levels;
  const isPicture = (now) => {  // the picture is enough, and smaller
    const frame = data.frames[shown().version];
    return state.layer === "change" && !before() && !state.contours &&
      now.view.scale * 1.5 >= (frame.extent.east - frame.extent.west) / (frame.box[2] * data.picture_px);
  };

  // What `create` gives is kept by its key; a draw follows when it is there.
  function kept(key, create) {
    if (painted.has(key)) {
      const canvas = painted.get(key);
      painted.delete(key);
      painted.set(key, canvas);
      return canvas;
    }
    painted.set(key, null);
    create().then((canvas) => { painted.set(key, canvas); if (canvas) redraw(); }, () => painted.delete(key));
    if (painted.size > KEPT) painted.delete(painted.keys().next().value);
    return null;
  }

  async function valuesAt(level, name) {
    const after = await tiles.values(shown().values, level, name);
    if (!before() || !after) return after;
    const other = await tiles.values(before().values, level, name);
    return other && stationValues.difference(after, other);
  }

  async function lightAt(version, level, name) {
    const ground = await tiles.heights(version, level, name);
    return ground && { ground, light: stationValues.hillshade(ground, levels()[level].value_m) };
  }

  const finest = () => Math.max(shown().finest, before()?.finest || 0);

  function levelFor(now) {
    const all = levels(), wanted_m = now.view.scale * DETAIL;
    const level = all.findLastIndex((candidate) => candidate.value_m <= wanted_m);
    return Math.max(level, finest());
  }

  // Tiles of a level that are in sight, as [name, west, north, width_m, height_m].
  function inSight(now, level) {
    const { value_m, rows, columns, tiles: known } = levels()[level], { extent } = data.frames[shown().version];
    const [west, north] = now.toMap(0, 0), [east, south] = now.toMap(now.width, now.height), side_m = size * value_m;
    const found = [];
    known.forEach((bits, row) => [...bits].forEach((bit, column) => {
      const left = extent.west + column * side_m, top = extent.north - row * side_m;
      if (bit === "0" || left > east || top < south || left + side_m < west || top - side_m > north) return;
      found.push([`${row}_${column}`, left, top, Math.min(size, columns - column * size) * value_m,
        Math.min(size, rows - row * size) * value_m]);
    }));
    return found;
  }

  function drawTiles(context, now, level, canvasOf) {
    for (const [name, west, north, width_m, height_m] of inSight(now, level)) {
      const canvas = canvasOf(name);
      if (!canvas) continue;
      const [x0, y0] = now.toPixel([west, north]), [x1, y1] = now.toPixel([west + width_m, north - height_m]);
      context.imageSmoothingEnabled = x1 - x0 < canvas.width;
      context.drawImage(canvas, x0, y0, x1 - x0, y1 - y0);
    }
  }

  // Ground hatched where nothing was observed, values, contours: coarse tiles first, so that there is soon something.
  function draw(context, now) {
    const fine = levelFor(now), top = levels().length - 1, order = fine === top ? [top] : [top, fine];
    const { version } = shown(), pair = [shown().values, before()?.values, state.layer].join(" ");
    for (const level of order) {
      drawTiles(context, now, level, (name) => kept(`ground ${version} ${level} ${name}`, async () => {
        const found = await lightAt(version, level, name);
        return found && stationValues.paintGround(found.ground, found.light);
      }));
    }
    context.globalCompositeOperation = "source-atop";
    hatch(context, now);
    context.globalCompositeOperation = "source-over";
    if (isComparable()) for (const level of order) {
      drawTiles(context, now, level, (name) => kept(`values ${pair} ${level} ${name}`, async () => {
        const [tile, found] = await Promise.all([valuesAt(level, name), lightAt(version, level, name)]);
        return tile && stationValues.paintValues(tile, found?.light, state.layer, scales[stationValues.LAYERS[state.layer].scale]);
      }));
    }
    if (!state.contours) return;
    every_m = niceStep(12 * now.view.scale);
    drawTiles(context, now, fine, (name) => kept(`contours ${version} ${level_m(fine)} ${every_m} ${name}`, async () => {
      const found = await lightAt(version, fine, name);
      return found && stationValues.paintContours(found.ground, every_m);
    }));
  }

  const level_m = (level) => levels()[level].value_m;
  const niceStep = (value) => {
    const decade = 10 ** Math.floor(Math.log10(value));
    return [1, 2, 5, 10].map((k) => k * decade).find((step) => step >= value);
  };

  function hatch(context, now) {
    context.strokeStyle = "#b0a8bc";
    context.lineWidth = 1;
    context.beginPath();
    for (let x = -now.height; x < now.width; x += 8) {
      context.moveTo(x, now.height);
      context.lineTo(x + now.height, 0);
    }
    context.stroke();
  }

  // The values at a place at the finest level; null if nothing was observed there.
  async function at([east, north]) {
    const level = finest(), { extent } = data.frames[shown().version], { value_m, tiles: known } = levels()[level];
    const column = Math.floor((east - extent.west) / value_m), row = Math.floor((extent.north - north) / value_m);
    const name = [row, column].map((k) => Math.floor(k / size)).join("_");
    if (row < 0 || column < 0 || known[Math.floor(row / size)]?.[Math.floor(column / size)] !== "1") return null;
    const tile = await valuesAt(level, name), ground = await tiles.heights(shown().version, level, name);
    const width = (tile || ground)?.columns, i = row % size * width + column % size;
    const change = tile ? tile.change[i] : NaN;
    return { height: ground?.height[i], change, sigma: tile?.sigma[i], isObserved: Number.isFinite(change) };
  }

  return { state, draw, at, isPicture, isComparable, scales, before, every_m: () => every_m };
}
