// The layers of the map: which values are shown, of which scan and since when, drawn from tiles as they arrive.
function stationLayers(data, shownIndex, redraw) {
  const tiles = stationValues.reader(data.values), size = data.values.tile;
  const scales = Object.fromEntries(Object.entries(data.scales).map(([name, scale]) => [name, stationValues.scaleOf(scale)]));
  const state = { layer: "change", since: -1, contours: false, swipe: null };  // since: index of a map, -1 the reference
  const painted = new Map(), KEPT = 240, DETAIL = 0.75;  // values per pixel from which a finer level is used
  let every_m = 0, awaited = 0;

  const shown = () => data.maps[shownIndex()], source = () => stationValues.LAYERS[state.layer].source;
  const before = () => state.since < 0 ? null : data.maps[state.since];
  const isSwiped = () => state.swipe !== null && Boolean(before());
  const isComparable = ({ after, before: other }) => !other || other.version === after.version;
  const border_px = (now) => state.swipe * now.width;
  // What is drawn from one pixel to another: a map since the reference or another map; two beside each other if swiped.
  const pairs = (now) => isSwiped()
    ? [{ after: before(), before: null, from: 0, to: border_px(now) }, { after: shown(), before: null, from: border_px(now), to: now.width }]
    : [{ after: shown(), before: source() === "rate" ? null : before(), from: 0, to: now.width }];
  const levels = ({ after }) => data.frames[after.version].levels;
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
    awaited++;
    create().catch(() => null).then((canvas) => { painted.set(key, canvas); awaited--; redraw(); });
    if (painted.size > KEPT) painted.delete(painted.keys().next().value);
    return null;
  }

  const folderOf = (map) => source() ? map.level && `${source()}_${map.level}` : map.values;

  async function valuesAt(pair, level, name) {
    const [after, other] = [pair.after, pair.before].map((map) => map && folderOf(map));
    const values = after && await tiles.values(after, level, name);
    if (!pair.before || !values) return values;
    const subtracted = other && await tiles.values(other, level, name);
    const ground = await tiles.heights(pair.after.version, level, name);
    return subtracted && ground && stationValues.difference(values, subtracted, ground);
  }

  async function lightAt(pair, level, name) {
    const ground = await tiles.heights(pair.after.version, level, name);
    return ground && { ground, light: stationValues.hillshade(ground, levels(pair)[level].value_m) };
  }

  const finest = (pair) => source() ? data.frames[pair.after.version].means : Math.max(pair.after.finest, pair.before?.finest || 0);

  function levelFor(now, pair) {
    const all = levels(pair), wanted_m = now.view.scale * DETAIL;
    const level = all.findLastIndex((candidate) => candidate.value_m <= wanted_m);
    return Math.max(level, finest(pair));
  }

  // Tiles of a level that are in sight, as [name, west, north, width_m, height_m].
  function inSight(now, pair, level) {
    const { value_m, rows, columns, tiles: known } = levels(pair)[level], { extent } = data.frames[pair.after.version];
    const [west, north] = now.toMap(pair.from, 0), [east, south] = now.toMap(pair.to, now.height), side_m = size * value_m;
    const found = [];
    known.forEach((bits, row) => [...bits].forEach((bit, column) => {
      const left = extent.west + column * side_m, top = extent.north - row * side_m;
      if (bit === "0" || left > east || top < south || left + side_m < west || top - side_m > north) return;
      found.push([`${row}_${column}`, left, top, Math.min(size, columns - column * size) * value_m,
        Math.min(size, rows - row * size) * value_m]);
    }));
    return found;
  }

  function drawTiles(context, now, pair, level, canvasOf) {
    for (const [name, west, north, width_m, height_m] of inSight(now, pair, level)) {
      const canvas = canvasOf(name);
      if (!canvas) continue;
      const [x0, y0] = now.toPixel([west, north]), [x1, y1] = now.toPixel([west + width_m, north - height_m]);
      context.imageSmoothingEnabled = x1 - x0 < canvas.width;
      context.drawImage(canvas, x0, y0, x1 - x0, y1 - y0);
    }
  }

  function draw(context, now) {
    for (const pair of pairs(now)) {
      context.save();
      context.beginPath();
      context.rect(pair.from, 0, pair.to - pair.from, now.height);
      context.clip();
      drawPair(context, now, pair);
      context.restore();
    }
  }

  // Ground hatched where nothing was observed, values, contours: coarse tiles first, so that there is soon something.
  function drawPair(context, now, pair) {
    const fine = levelFor(now, pair), top = levels(pair).length - 1, order = fine === top ? [top] : [top, fine];
    const { version } = pair.after, names = [folderOf(pair.after), pair.before && folderOf(pair.before), state.layer].join(" ");
    for (const level of order) {
      drawTiles(context, now, pair, level, (name) => kept(`ground ${version} ${level} ${name}`, async () => {
        const found = await lightAt(pair, level, name);
        return found && stationValues.paintGround(found.ground, found.light);
      }));
    }
    context.globalCompositeOperation = "source-atop";
    hatch(context, now);
    context.globalCompositeOperation = "source-over";
    if (isComparable(pair)) for (const level of order) {
      drawTiles(context, now, pair, level, (name) => kept(`values ${names} ${level} ${name}`, async () => {
        const [tile, found] = await Promise.all([valuesAt(pair, level, name), lightAt(pair, level, name)]);
        return tile && stationValues.paintValues(tile, found?.light, state.layer, scales[stationValues.LAYERS[state.layer].scale]);
      }));
    }
    if (!state.contours) return;
    every_m = niceStep(12 * now.view.scale);
    drawTiles(context, now, pair, fine, (name) => kept(`contours ${version} ${fine} ${every_m} ${name}`, async () => {
      const found = await lightAt(pair, fine, name);
      return found && stationValues.paintContours(found.ground, every_m);
    }));
  }

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

  // The values at a place at the finest level; null if nothing is known there.
  async function at(now, [east, north]) {
    const x = now.toPixel([east, north])[0], pair = pairs(now).find(({ to }) => x <= to) || pairs(now)[0];
    const level = finest(pair), { extent } = data.frames[pair.after.version], { value_m, tiles: known } = levels(pair)[level];
    const column = Math.floor((east - extent.west) / value_m), row = Math.floor((extent.north - north) / value_m);
    const name = [row, column].map((k) => Math.floor(k / size)).join("_");
    if (row < 0 || column < 0 || known[Math.floor(row / size)]?.[Math.floor(column / size)] !== "1") return null;
    const unit = source() === "rate" ? "m/d" : "m";
    const tile = await valuesAt(pair, level, name), ground = await tiles.heights(pair.after.version, level, name);
    const width = (tile || ground)?.columns, i = row % size * width + column % size;
    const change = tile ? tile.change[i] : NaN;
    return { height: ground?.height[i], change, sigma: tile?.sigma[i], isObserved: Number.isFinite(change), unit };
  }

  const levelTime = (map) => data.level_times[map.level];

  return { state, draw, at, pairs, isPicture, isComparable, isSwiped, border_px, levelTime, scales, before, every_m: () => every_m, isComplete: () => !awaited };
}
