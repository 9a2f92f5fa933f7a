// A map to pan and zoom: a canvas with pictures of the ground, and drawings on them in map coordinates.
// `redraw` draws all that is there, and returns true if nothing is missing: until then the canvas is busy.
function stationMap(canvas, extent, redraw) {
  const context = canvas.getContext("2d");
  const view = { east: 0, north: 0, scale: 1 };  // map coordinates of the middle; metres per pixel of the page
  const MAX_ZOOM = 200, HOLD_MS = 500, CLICK_PX = 6;
  let width = 0, height = 0, frame = 0, fitted = 1, isHome = true;

  const toPixel = ([east, north]) => [width / 2 + (east - view.east) / view.scale, height / 2 - (north - view.north) / view.scale];
  const toMap = (x, y) => [view.east + (x - width / 2) * view.scale, view.north - (y - height / 2) * view.scale];

  const now = () => ({ width, height, view, toPixel, toMap });

  function draw() {
    if (frame) return;
    canvas.setAttribute("aria-busy", "true");
    frame = requestAnimationFrame(() => {
      frame = 0;
      const ratio = devicePixelRatio || 1;
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      canvas.setAttribute("aria-busy", String(!redraw(context, now())));
    });
  }

  // The size may change late, with styles or the window: a place that is shown stays in the middle.
  function resize() {
    const ratio = devicePixelRatio || 1, isFitted = view.scale === fitted;
    width = canvas.clientWidth;
    height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    fitted = Math.max((extent.east - extent.west) / width, (extent.north - extent.south) / height);
    if (isFitted) view.scale = fitted;
    if (isHome) home(); else draw();
  }

  function home() {
    isHome = true;
    view.east = (extent.west + extent.east) / 2;
    view.north = (extent.south + extent.north) / 2;
    view.scale = fitted;
    draw();
  }

  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  function move(x_px, y_px) {
    isHome = false;
    view.east = clamp(view.east - x_px * view.scale, extent.west, extent.east);
    view.north = clamp(view.north + y_px * view.scale, extent.south, extent.north);
    draw();
  }

  // Zoom so that the point of the map at a pixel stays where it is.
  function zoom(factor, x = width / 2, y = height / 2) {
    const [east, north] = toMap(x, y);
    isHome = false;
    view.scale = clamp(view.scale / factor, fitted / MAX_ZOOM, fitted * 1.5);
    view.east = clamp(east - (x - width / 2) * view.scale, extent.west, extent.east);
    view.north = clamp(north + (y - height / 2) * view.scale, extent.south, extent.north);
    draw();
  }

  function centre([east, north], scale) {
    isHome = false;
    view.east = east;
    view.north = north;
    if (scale) view.scale = clamp(scale, fitted / MAX_ZOOM, fitted * 1.5);
    draw();
  }

  // ---- pointers: one pans or draws a box, two zoom; a tap and a double tap call `on`

  const on = { tap: () => {}, box: () => {}, hover: () => {}, finish: () => {}, drawsBox: () => false };
  const pointers = new Map();
  let box = null, start = null, moved = 0, hold = 0;
  const at = (event) => {
    const frame_px = canvas.getBoundingClientRect();
    return [event.clientX - frame_px.left, event.clientY - frame_px.top];
  };

  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at(event));
    clearTimeout(hold);
    if (pointers.size > 1) { box = null; moved = Infinity; return; }
    start = at(event);
    moved = 0;
    box = on.drawsBox() || event.shiftKey ? [start, start] : null;
    hold = setTimeout(() => { if (moved < CLICK_PX && pointers.size === 1) { box = [start, start]; draw(); } }, HOLD_MS);
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = at(event), before = pointers.get(event.pointerId);
    if (!before) { on.hover(toMap(...now)); return; }
    moved = Math.max(moved, Math.hypot(now[0] - start[0], now[1] - start[1]));
    if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], other = before === a ? b : a;
      const spread = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 10);
      zoom(spread(now) / spread(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    } else if (box) {
      box = [start, now];
      draw();
    } else if (moved >= CLICK_PX) {
      clearTimeout(hold);
      move(now[0] - before[0], now[1] - before[1]);
    }
    pointers.set(event.pointerId, now);
  });
  const up = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    clearTimeout(hold);
    if (event.type === "pointercancel") { box = null; draw(); return; }
    const finished = box;
    if (!pointers.size) box = null;
    if (finished && moved >= CLICK_PX) {
      const [a, b] = finished.map((p) => toMap(...p));
      on.box([[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]]);
    } else if (moved < CLICK_PX) {
      on.tap(toMap(...at(event)), event);
    }
    draw();
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", () => on.hover(null));
  canvas.addEventListener("dblclick", (event) => on.finish(event));
  canvas.addEventListener("contextmenu", (event) => { if (box || moved < CLICK_PX) event.preventDefault(); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-clamp(event.deltaY, -200, 200) / 300), ...at(event));
  }, { passive: false });

  const STEP = 60;
  const KEYS = {
    ArrowLeft: () => move(STEP, 0), ArrowRight: () => move(-STEP, 0), ArrowUp: () => move(0, STEP), ArrowDown: () => move(0, -STEP),
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: home,
    Enter: (event) => on.tap([view.east, view.north], event), " ": (event) => on.tap([view.east, view.north], event),
    Escape: () => on.finish(null),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    KEYS[event.key](event);
  });
  resize();
  new ResizeObserver(resize).observe(canvas);

  return { draw, home, zoom, centre, on, view, now, isMoving: () => pointers.size > 0, box: () => box && box.map((p) => toMap(...p)) };
}
