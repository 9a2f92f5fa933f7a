// Curves of places and areas from the tiles of blocks, with their sigma.
const stationCurves = (() => {
  const MAX_BLOCKS = 1600;
  const HEIGHT = 0, RANGE = 1, INCIDENCE = 2, REFERENCE = 3, NEAR = 4, JACOBIAN = 5, JACOBIAN_ROWS = 14;

  function reader(about) {
    const sigma = (code) => code ? about.sigma_min_m * Math.exp((code - 1) * about.sigma_step) : 0;
    let model;  // of the systematic errors, once needed

    function parseCurve({ head, bytes }, isLevel) {
      const { times, blocks } = head, cells = times * blocks;
      let start = 0;
      const take = (count, size) => {
        const values = stationTiles.fromPlanes(bytes, start, count, size);
        start += count * size;
        return values;
      };
      const local = bytes.subarray(0, blocks);
      start = blocks;
      const steps_s = take(times, 4);
      const time_s = Array.from(steps_s, ((sum) => (step) => sum += step >>> 0)(0));
      const usable = bytes.subarray(start, start += times);
      const common = take(times, 2);
      const sizes = [3, 2, 2, 1, ...(isLevel ? [3, 2, 2] : [])];
      const [change, random, systematic, coverage, ...rate] = sizes.map(
        (size) => stationTiles.accumulate(take(cells, size), blocks));
      return { blocks, local, time_s, usable, common, change, random, systematic, coverage, rate };
    }

    function parsePlace({ head, bytes }) {
      const { blocks, values } = head, local = bytes.subarray(0, blocks);
      const floats = new Float32Array(bytes.slice(blocks).buffer);
      return { local, column: (k, i) => floats[k * blocks + i], values };
    }

    const exists = Uint8Array.from(atob(about.tiles), (c) => c.charCodeAt(0));  // a bit for each tile

    const size = about.tile_blocks, TIERS = ["older", "recent", "latest"].filter((tier) => tier in about.versions);
    const tileOf = (tier, row, column) => [Math.floor(row / size[tier]), Math.floor(column / size[tier])];
    const localOf = (tier, row, column) => row % size[tier] * size[tier] + column % size[tier];

    function isKnown(row, column) {
      const [tileRow, tileColumn] = tileOf("places", row, column), index = tileRow * about.columns + tileColumn;
      return row >= 0 && column >= 0 && tileColumn < about.columns && (exists[index >> 3] & (128 >> (index & 7))) !== 0;
    }

    async function load(tier, name) {
      const tile = await stationTiles.load(`${tier}/${name}`, about.versions[tier]);
      return tile && (tier === "places" ? parsePlace(tile) : parseCurve(tile, tier === "levels"));
    }

    // The blocks (row, column, weight) of tiles, with their values over time; those never observed are left out.
    async function read(blocks) {
      const tiles = new Map(), inside = blocks.filter(([row, column]) => isKnown(row, column));
      const get = (tier, row, column) => {
        const name = tileOf(tier, row, column).join("_"), key = `${tier}/${name}`;
        if (!tiles.has(key)) tiles.set(key, load(tier, name));
        return tiles.get(key);
      };
      for (const [row, column] of inside) for (const tier of ["places", ...TIERS]) get(tier, row, column);
      const found = [];
      for (const [row, column, weight] of inside) {
        const place = await get("places", row, column);
        const index = place ? place.local.indexOf(localOf("places", row, column)) : -1;
        if (index < 0) continue;
        const values = new Map();
        for (const name of TIERS) {
          const tier = await get(name, row, column);
          if (!tier) continue;
          const at = tier.local.indexOf(localOf(name, row, column));
          tier.time_s.forEach((time_s, t) => {
            const i = t * tier.blocks + at;
            if (at < 0 || !tier.usable[t]) return;
            const coverage = tier.coverage[i] / about.full;
            values.set(time_s, coverage ? {
              change: tier.change[i] * about.quantum_m,
              random: sigma(tier.random[i]) / Math.sqrt(coverage), systematic: sigma(tier.systematic[i]),
              coverage, common: sigma(tier.common[t]),
            } : null);
          });
        }
        const jacobian = place.values > JACOBIAN
          ? Array.from({ length: JACOBIAN_ROWS }, (_, k) => place.column(JACOBIAN + k, index)) : null;
        found.push({
          row, column, weight, values, jacobian, reference_m: place.column(REFERENCE, index), near: place.column(NEAR, index), height_m: place.column(HEIGHT, index), range_m: place.column(RANGE, index),
          incidence_deg: place.column(INCIDENCE, index),
        });
      }
      return found;
    }

    async function prepare(blocks) {
      if (model === undefined) {
        const script = await stationTiles.load("systematic", about.versions.places);
        model = script && stationCovariance.parse(script);
      }
      for (const block of blocks) {
        block.own_m = model && block.jacobian ? Math.sqrt(stationCovariance.variance(model, [block.jacobian], [1])) : 0;
      }
    }

    // The weighted sum of blocks at each time: weights add up to 1, or to 0 for a difference of two places.
    function sums(blocks, isDifference) {
      const times = [...new Set(blocks.flatMap((block) => [...block.values.keys()]))].sort((a, b) => a - b);
      return times.map((time_s) => {
        const seen = blocks.filter((block) => block.values.get(time_s)), at = seen.map((block) => block.values.get(time_s));
        if (!seen.length || (isDifference && seen.length < blocks.length)) return { time_s, change: null };
        const raw = seen.map((block, i) => block.weight * (isDifference ? 1 : at[i].coverage));
        const total = isDifference ? 1 : raw.reduce((a, b) => a + b, 0), weights = raw.map((w) => w / total);
        const dot = (f) => weights.reduce((sum, w, i) => sum + f(w, at[i], i), 0);
        const random2 = dot((w, v) => w * w * v.random ** 2);
        const reference2 = dot((w, v, i) => w * w * seen[i].reference_m ** 2 / v.coverage);  // the part that all times share
        let systematic2;
        if (seen.length === 1) {
          systematic2 = (weights[0] * at[0].systematic * seen[0].near) ** 2;
        } else if (model && seen.every((block) => block.own_m)) {
          const scaled = seen.map((block, i) => weights[i] * (isDifference ? block.near : 1) * at[i].systematic / block.own_m);
          systematic2 = stationCovariance.variance(model, seen.map((block) => block.jacobian), scaled);
        } else {
          systematic2 = dot((w, v) => Math.abs(w) * v.systematic) ** 2;
        }
        const inside = blocks.reduce((sum, block) => sum + Math.abs(block.weight), 0);
        return {
          time_s, change: dot((w, v) => w * v.change), random: Math.sqrt(random2), systematic: Math.sqrt(systematic2), reference2,
          common: isDifference ? 0 : Math.min(dot((w, v) => w * v.common), Math.sqrt(systematic2)),  // changes little within an area
          sigma: Math.sqrt(random2 + systematic2), observed: isDifference ? 1 : total / inside,
        };
      });
    }

    const blockOf = ([east, north]) =>
      [Math.floor((about.north_m - north) / about.block_m), Math.floor((east - about.west_m) / about.block_m)];

    async function place(position) {
      const [block] = await read([[...blockOf(position), 1]]);
      return block ? { ...block, curve: sums([block], false) } : null;
    }

    async function difference(position, other) {
      const blocks = await read([[...blockOf(position), -1], [...blockOf(other), 1]]);
      if (blocks.length < 2) return null;
      await prepare(blocks);
      return sums(blocks, true);
    }

    // Level and rate of a place at the end of each day; null where the station keeps no levels.
    async function levels(position) {
      const [row, column] = blockOf(position);
      if (!about.versions.levels || !isKnown(row, column)) return null;
      const tile = await load("levels", tileOf("levels", row, column).join("_"));
      const at = tile ? tile.local.indexOf(localOf("levels", row, column)) : -1;
      if (at < 0) return null;
      const curve = (unit, [value, random, systematic]) => tile.time_s.map((time_s, t) => {
        const i = t * tile.blocks + at, coverage = tile.coverage[i] / about.full;
        if (!coverage) return { time_s, change: null };
        return { time_s, change: value[i] * unit, sigma: Math.hypot(sigma(random[i]) / Math.sqrt(coverage), sigma(systematic[i])) };
      });
      return {
        level: curve(about.quantum_m, [tile.change, tile.random, tile.systematic]), rate: curve(about.rate_quantum_m, tile.rate),
      };
    }

    // Blocks whose share of their area inside the polygon is at least that of one of 16 points.
    function blocksInside(polygon) {
      const [rows, columns] = [0, 1].map((k) => polygon.map((point) => blockOf(point)[k]));
      const blocks = [];
      const span = Math.max(Math.max(...rows) - Math.min(...rows), Math.max(...columns) - Math.min(...columns)) + 1;
      if (span > 400) return { blocks: null, span };
      for (let row = Math.max(0, Math.min(...rows)); row <= Math.max(...rows); row++) {
        for (let column = Math.max(0, Math.min(...columns)); column <= Math.max(...columns); column++) {
          let inside = 0;
          for (let k = 0; k < 16; k++) {
            const east = about.west_m + (column + (k % 4 + 0.5) / 4) * about.block_m;
            const north = about.north_m - (row + (Math.floor(k / 4) + 0.5) / 4) * about.block_m;
            inside += contains(polygon, east, north);
          }
          if (inside) blocks.push([row, column, inside / 16]);
        }
      }
      return { blocks: blocks.length > MAX_BLOCKS ? null : blocks, span };
    }

    async function area(polygon) {
      const { blocks: chosen, span } = blocksInside(polygon);
      if (!chosen) return { tooLarge: true };
      const blocks = await read(chosen), size_m2 = areaOf(polygon);
      if (!blocks.length) return { curve: [], size_m2 };
      await prepare(blocks);
      const weight = chosen.reduce((sum, block) => sum + block[2], 0);
      const known = blocks.reduce((sum, block) => sum + block.weight, 0);
      const curve = sums(blocks, false);
      for (const point of curve) if (point.observed) point.observed *= known / weight;
      return { curve, size_m2, blocks: blocks.length };
    }

    // A function that gives the correlation of the change of two times; 0 where it is unknown.
    async function correlations() {
      const tile = await stationTiles.load("pairs", about.versions.pairs);
      if (!tile) return () => 0;
      const { times, full } = tile.head, steps_s = stationTiles.fromPlanes(tile.bytes, 0, times, 4);
      const index = new Map(Array.from(steps_s, ((sum) => (step, i) => [sum += step >>> 0, i])(0)));
      return (...times_s) => {
        const [low, high] = times_s.map((time_s) => index.get(time_s)).sort((a, b) => a - b);
        return high > low ? tile.bytes[4 * times + high * (high - 1) / 2 + low] / full - 1 : 0;
      };
    }

    return { place, levels, difference, area, correlations, maxArea_m2: MAX_BLOCKS * about.block_m ** 2 };
  }

  // The change between two times of a curve, of which the change has a correlation. The error of the reference
  // is in both, and cancels; so do the errors that similar change causes in both.
  function between(after, before, correlation) {
    const random2 = after.random ** 2 + before.random ** 2 - after.reference2 - before.reference2;
    const systematic2 = after.systematic ** 2 + before.systematic ** 2 - 2 * correlation * after.common * before.common;
    return { change: after.change - before.change, sigma: Math.sqrt(Math.max(random2, 0) + Math.max(systematic2, 0)) };
  }

  function contains(polygon, east, north) {
    let inside = false;
    polygon.forEach(([e, n], i) => {
      const [f, m] = polygon[(i + 1) % polygon.length];
      if (n > north !== m > north && east < e + (f - e) * (north - n) / (m - n)) inside = !inside;
    });
    return inside;
  }

  const areaOf = (polygon) => Math.abs(polygon.reduce((sum, [e, n], i) => {
    const [f, m] = polygon[(i + 1) % polygon.length], [e0, n0] = polygon[0];
    return sum + (e - e0) * (m - n0) - (f - e0) * (n - n0);
  }, 0)) / 2;

  return { reader, between, contains, areaOf };
})();
