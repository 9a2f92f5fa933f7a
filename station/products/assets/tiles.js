// Tiles: scripts that call STATION_TILE(name, head, data). Scripts also load from a folder, where fetch does not.
const stationTiles = (() => {
  const waiting = new Map(), known = new Map();
  const KEPT = 400;

  async function inflate(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  window.STATION_TILE = (_, head, data) => {
    const entry = waiting.get(document.currentScript.dataset.tile);
    if (entry) inflate(data).then((bytes) => entry.resolve({ head, bytes }), entry.reject);
  };

  // A promise of a tile; null if there is none. `version` makes a browser fetch a tile that was replaced.
  function load(name, version) {
    const key = `${name}?${version}`;
    if (known.has(key)) {
      const tile = known.get(key);
      known.delete(key);
      known.set(key, tile);  // the last one used
      return tile;
    }
    const tile = new Promise((resolve, reject) => {
      waiting.set(name, { resolve, reject });
      const script = document.createElement("script");
      script.src = version ? `${name}.js?${version}` : `${name}.js`;
      script.dataset.tile = name;
      script.onload = () => script.remove();
      script.onerror = () => { script.remove(); resolve(null); };
      document.head.append(script);
    }).catch(() => { known.delete(key); return null; });
    known.set(key, tile);
    if (known.size > KEPT) known.delete(known.keys().next().value);
    return tile;
  }

  // Integers of `size` bytes each from planes of their bytes, the lowest first.
  function fromPlanes(bytes, start, count, size) {
    const values = new Int32Array(count);
    for (let plane = 0; plane < size; plane++) {
      const first = start + plane * count, shift = 8 * plane;
      for (let i = 0; i < count; i++) values[i] |= bytes[first + i] << shift;
    }
    return values;
  }

  // Undo zigzag differences over time of values (times × blocks).
  function accumulate(values, blocks) {
    for (let i = 0; i < values.length; i++) {
      const step = (values[i] >>> 1) ^ -(values[i] & 1);
      values[i] = step + (i < blocks ? 0 : values[i - blocks]);
    }
    return values;
  }

  return { load, fromPlanes, accumulate };
})();
