// What is drawn on the map besides values: outlines, places, scanner and scale.
function stationDrawing(about, outlines, text) {
  function stroke(context, ink, width) {  // dark on white: seen on any ground
    context.strokeStyle = "#fff";
    context.lineWidth = width + 3;
    context.stroke();
    context.strokeStyle = context.fillStyle = ink;
    context.lineWidth = width;
    context.stroke();
  }

  function shape(context, now, corners, isClosed, width = 2.5) {
    context.beginPath();
    corners.forEach((corner, i) => context[i ? "lineTo" : "moveTo"](...now.toPixel(corner)));
    if (isClosed) context.closePath();
    stroke(context, "#000", width);
    if (!isClosed) for (const corner of corners) {
      const [x, y] = now.toPixel(corner);
      context.fillRect(x - 3, y - 3, 6, 6);
    }
  }

  // Write words, unless they would cover one of the boxes [left, top, right, bottom] of those written before.
  function label(context, words, x, y, written = []) {
    context.font = "600 14px system-ui, sans-serif";
    const box = [x, y - 14, x + context.measureText(words).width, y + 4];
    if (written.some((other) => [0, 1].every((k) => box[k] < other[k + 2] && other[k] < box[k + 2]))) return;
    written.push(box);
    context.lineWidth = 4;
    context.strokeStyle = "#fff";
    context.fillStyle = "#000";
    context.strokeText(words, x, y);
    context.fillText(words, x, y);
  }

  function areasAndEvents(context, now) {
    const written = [];  // a name that would cover another is left out: the tables have all
    const draw = (rings, name, dash = []) => {
      if (!rings.length) return;
      context.setLineDash(dash);
      for (const ring of rings) shape(context, now, ring, true, 1.2);
      context.setLineDash([]);
      const end = rings[0].reduce((a, b) => b[1] > a[1] === !dash.length ? b : a), [x, y] = now.toPixel(end);
      label(context, name, x + 4, dash.length ? y + 15 : y - 5, written);  // areas above, events below
    };
    for (const area of outlines.areas) draw(area.rings, area.name);
    for (const event of outlines.events) draw(event.rings, text[`event_${event.kind}`] || event.kind, [5, 4]);
  }

  function place(context, now, position, name) {
    const [x, y] = now.toPixel(position), size = Math.max(about.block_m / now.view.scale / 2, 4);
    if (about.scanner_m) {  // the line of sight
      context.setLineDash([6, 5]);
      context.beginPath();
      context.moveTo(...now.toPixel(about.scanner_m));
      context.lineTo(x, y);
      stroke(context, "#444", 1);
      context.setLineDash([]);
    }
    context.beginPath();
    context.rect(x - size, y - size, 2 * size, 2 * size);
    stroke(context, "#000", 2);
    label(context, name, x + size + 5, y - size - 3);
  }

  function scanner(context, now) {
    if (!about.scanner_m) return;
    const [x, y] = now.toPixel(about.scanner_m);
    context.beginPath();
    context.moveTo(x, y - 8);
    context.lineTo(x + 7, y + 5);
    context.lineTo(x - 7, y + 5);
    context.closePath();
    stroke(context, "#000", 2);
    context.fill();
  }

  // The border between two scans, and the time of each on its side.
  function border(context, now, x, before, after) {
    context.beginPath();
    context.moveTo(x, 0);
    context.lineTo(x, now.height);
    stroke(context, "#000", 1.5);
    context.textAlign = "right";
    label(context, before, x - 8, 20);
    context.textAlign = "left";
    label(context, after, x + 8, 20);
  }

  function picture(context, now, image, { box: [left, top, width, height], extent }) {
    const [x0, y0] = now.toPixel([extent.west, extent.north]), [x1, y1] = now.toPixel([extent.east, extent.south]);
    context.imageSmoothingEnabled = x1 - x0 < width * image.naturalWidth;
    context.drawImage(image, left * image.naturalWidth, top * image.naturalHeight, width * image.naturalWidth,
      height * image.naturalHeight, x0, y0, x1 - x0, y1 - y0);
  }

  return { shape, areasAndEvents, place, scanner, border, picture };
}
