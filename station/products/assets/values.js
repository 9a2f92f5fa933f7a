// Tiles of values: change and sigma of a scan, and heights of the reference; and pictures painted from them.
const stationValues = (() => {
  const SUN = [-0.55, 0.55, 0.63], EXAGGERATION = 1.5;  // as in the pictures
  const SIGNIFICANT = 1.959964;

  function reader(about) {
    const sigmas = Float32Array.from({ length: 256 }, (_, code) => about.sigma_min_m * Math.exp((code - 1) * about.sigma_step));
    const steps = sigmas.map((sigma) => 2 ** Math.floor(Math.log2(sigma / 4)));

    // The steps (n,) of a tile, and where they are; what is between the mask and them is in `extra` planes.
    function unpack({ head, bytes }, extra) {
      const size = head.rows * head.columns, where = [], first = Math.ceil(size / 8);
      for (let i = 0; i < size; i++) if (bytes[i >> 3] & (128 >> (i & 7))) where.push(i);
      const n = where.length, planes = [];
      for (let k = 0; k < extra; k++) planes.push(bytes.subarray(first + k * n, first + (k + 1) * n));
      const raw = stationTiles.fromPlanes(bytes, first + extra * n, n, head.planes);
      return { where, planes, steps: stationTiles.accumulate(raw, 1), size };
    }

    const empty = (size) => new Float32Array(size).fill(NaN);

    async function values(scan, level, name) {
      const tile = await stationTiles.load(`values/${scan}/${level}/${name}`, "");
      if (!tile) return null;
      const { rows, columns, share } = tile.head, { where, planes, steps: codes, size } = unpack(tile, 1 + share);
      const change = empty(size), sigma = empty(size), observed = empty(size);
      where.forEach((i, k) => {
        const code = planes[0][k];
        change[i] = codes[k] * steps[code];
        sigma[i] = sigmas[code];
        observed[i] = share ? planes[1][k] / about.share : 1;
      });
      return { rows, columns, change, sigma, observed };
    }

    async function heights(version, level, name) {
      const tile = await stationTiles.load(`ground/${version}/${level}/${name}`, "");
      if (!tile) return null;
      const { where, planes, steps: codes, size } = unpack(tile, 1), height = empty(size), sigma = empty(size);
      where.forEach((i, k) => { height[i] = codes[k] * tile.head.step; sigma[i] = sigmas[planes[0][k]]; });
      return { rows: tile.head.rows, columns: tile.head.columns, height, sigma };
    }

    return { values, heights };
  }

  // Of two scans, the change between them. The random error of the reference `ground` is in both, and cancels.
  function difference(after, before, ground) {
    const independent = (tile, i) => tile.sigma[i] ** 2 - ground.sigma[i] ** 2 / tile.observed[i];
    return {
      ...after, change: after.change.map((value, i) => value - before.change[i]),
      sigma: after.sigma.map((_, i) => Math.sqrt(Math.max(independent(after, i) + independent(before, i), 0))),
      observed: after.observed.map((share, i) => Math.min(share, before.observed[i])),
    };
  }

  // Brightness of the terrain, 0 to 1; NaN where it is unknown.
  function hillshade({ rows, columns, height }, value_m) {
    const slope = (low, high, span) => {
      const rise = height[high] - height[low];
      return Number.isFinite(rise) ? EXAGGERATION * rise / (span * value_m) : 0;
    };
    return height.map((h, i) => {
      if (!Number.isFinite(h)) return NaN;
      const row = Math.floor(i / columns), column = i % columns;
      const west = column ? i - 1 : i, east = column < columns - 1 ? i + 1 : i;
      const north = row ? i - columns : i, south = row < rows - 1 ? i + columns : i;
      const e = east > west ? slope(west, east, east - west) : 0;
      const n = south > north ? slope(south, north, (south - north) / columns) : 0;
      return Math.min(Math.max((SUN[2] - e * SUN[0] - n * SUN[1]) / Math.sqrt(1 + e * e + n * n), 0), 1);
    });
  }

  // A canvas of which `colour(i)` gives each value [r, g, b, alpha]; null leaves it transparent.
  function picture({ rows, columns }, colour) {
    const canvas = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
    const context = canvas.getContext("2d"), image = context.createImageData(columns, rows);
    for (let i = 0; i < rows * columns; i++) {
      const rgba = colour(i);
      if (rgba) image.data.set(rgba, 4 * i);
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }

  const paintGround = (ground, light) => picture(ground, (i) => {
    if (!Number.isFinite(light[i])) return null;
    const grey = 216 + 40 * light[i];
    return [grey, grey, grey, 255];
  });

  const paintContours = ({ rows, columns, height }, every_m) => {
    const band = height.map((h) => Math.floor(h / every_m));
    return picture({ rows, columns }, (i) => {
      const differs = (k) => k < band.length && Number.isFinite(band[k]) && band[k] !== band[i];
      const isLine = Number.isFinite(band[i]) && ((i % columns < columns - 1 && differs(i + 1)) || differs(i + columns));
      return isLine ? [60, 40, 20, 150] : null;
    });
  };

  // Layers: the value that the scale shows, the scale, whether what is not significant is grey, and the source
  // of the values if it is not the scan.
  const LAYERS = {
    change: { value: (t, i) => t.change[i], scale: "change", grey: true },
    level: { value: (t, i) => t.change[i], scale: "change", grey: true, source: "level" },
    rate: { value: (t, i) => t.change[i], scale: "rate", grey: true, source: "rate" },
    significance: { value: (t, i) => t.change[i] / t.sigma[i], scale: "significance" },
    sigma: { value: (t, i) => t.sigma[i], scale: "sigma" },
    coverage: { value: (t, i) => t.observed[i], scale: "coverage" },
  };

  const isSignificant = (tile, i) => Math.abs(tile.change[i]) > SIGNIFICANT * tile.sigma[i];

  function paintValues(tile, light, layer, scale) {
    const { value, grey } = LAYERS[layer];
    return picture(tile, (i) => {
      if (!Number.isFinite(tile.change[i])) return null;
      const l = Number.isFinite(light?.[i]) ? light[i] : 0.63;
      if (grey && !isSignificant(tile, i)) return [128 + 84 * l, 128 + 84 * l, 128 + 84 * l, 255];
      const [r, g, b] = scale.colour(value(tile, i)), lit = grey ? 0.8 + 0.3 * l : 1;
      return [r * lit, g * lit, b * lit, 255];
    });
  }

  // A scale of colours given as hex digits, from low to high.
  function scaleOf({ colours, low, high, log }) {
    const stops = colours.match(/.{6}/g).map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));
    const table = Array.from({ length: 256 }, (_, k) => {
      const at = k / 255 * (stops.length - 1), lower = Math.min(Math.floor(at), stops.length - 2), share = at - lower;
      return stops[lower].map((c, band) => Math.round(c + share * (stops[lower + 1][band] - c)));
    });
    const position = (v) => Math.min(Math.max(log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low), 0), 1);
    return { low, high, log, position, table, colour: (v) => table[Math.round(255 * position(v))] };
  }

  return { reader, difference, hillshade, paintGround, paintContours, paintValues, isSignificant, scaleOf, LAYERS };
})();
