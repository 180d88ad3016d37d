// The window's map on a canvas: outlines, links, transmitters, and the chosen place and area.
"use strict";
const plan = (() => {
  let canvas, context, data = { links: [], transmitters: [] }, buildings, walls;
  let centre = [0, 0], zoom = 1, point = null, area = null, suggested = [], drawing = false, grip = null, moved = false, whole = true;
  let width = 1, height = 1, queued = false;
  const pointers = new Map(); // position of each finger, or of the mouse while its button is down
  let layer = null; // cached image of the content that stays the same while the map is dragged: twice the map's size, with centre and zoom

  const color = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();
  const toScreen = (x, y) => [width / 2 + (x - centre[0]) * zoom, height / 2 - (y - centre[1]) * zoom];
  const toScene = (x, y) => [centre[0] + (x - width / 2) / zoom, centre[1] - (y - height / 2) / zoom];

  function paint(ratio) {
    const image = new OffscreenCanvas(2 * width * ratio, 2 * height * ratio), ground = image.getContext("2d");
    layer = { image, centre: [...centre], zoom, ratio };
    ground.fillStyle = color("--map-ground");
    ground.fillRect(0, 0, image.width, image.height);
    if (buildings) {
      const [x, y] = toScreen(data.west, data.north), size = zoom / data.scale;
      ground.setTransform(ratio * size, 0, 0, ratio * size, ratio * (x + width / 2), ratio * (y + height / 2));
      ground.fillStyle = color("--map-building");
      ground.fill(buildings);
      ground.strokeStyle = color("--map-wall");
      ground.lineWidth = 1 / size;
      ground.stroke(walls);
    }
    ground.setTransform(ratio, 0, 0, ratio, 0, 0);
    const colors = [color("--map-link"), color("--map-warning")];
    for (const mark of [0, 1]) {
      ground.fillStyle = colors[mark];
      for (const [x, y, , flag] of data.links) {
        const u = width + (x - centre[0]) * zoom, v = height - (y - centre[1]) * zoom;
        if (flag === mark && u > 0 && v > 0 && u < 2 * width && v < 2 * height) ground.fillRect(u - 2, v - 2, 4 + mark, 4 + mark);
      }
    }
  }
  function draw() {
    queued = false;
    const ratio = devicePixelRatio || 1;
    let [a, b] = layer ? toScreen(...layer.centre) : [0, 0];
    if (!layer || layer.zoom !== zoom || layer.ratio !== ratio || a < 0 || a > width || b < 0 || b > height) {
      paint(ratio);
      [a, b] = [width / 2, height / 2];
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(layer.image, Math.round((a - width) * ratio), Math.round((b - height) * ratio));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.strokeStyle = color("--map-ground");
    context.lineWidth = 1;
    for (const [x, y] of data.transmitters) {
      const [u, v] = toScreen(x, y);
      context.fillStyle = color("--map-transmitter");
      context.beginPath(); context.moveTo(u, v - 8); context.lineTo(u + 7, v + 5); context.lineTo(u - 7, v + 5);
      context.closePath(); context.fill(); context.stroke();
    }
    context.strokeStyle = color("--map-choice");
    context.lineWidth = 2;
    for (const [x, y] of suggested) ring(...toScreen(x, y), 6);
    if (point) { const [u, v] = toScreen(...point); ring(u, v, 9); ring(u, v, 1); }
    if (area) {
      const [u, v] = toScreen(area.west, area.north), [s, t] = toScreen(area.east, area.south);
      context.strokeRect(u, v, s - u, t - v);
    }
    canvas.dataset.area = area ? [area.west, area.south, area.east, area.north] : "";
    canvas.dataset.place = point ? point.map((length) => length.toFixed(1)) : "";
    canvas.dataset.zoom = zoom.toPrecision(4);
    canvas.dataset.links = data.links.length;
    canvas.dataset.drawn = Number(canvas.dataset.drawn || 0) + 1;
  }
  function ring(u, v, radius) { context.beginPath(); context.arc(u, v, radius, 0, 7); context.stroke(); }
  function renew() { layer = null; redraw(); }
  function redraw() { if (!queued && context) { queued = true; requestAnimationFrame(draw); } }

  function size() {
    const box = canvas.getBoundingClientRect(), ratio = devicePixelRatio || 1;
    [width, height] = [box.width, box.height];
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    layer = null;
    if (whole) fit(); else redraw();
  }
  function fit() {
    whole = true;
    if (data.scale) {
      const across = 1000 / data.scale, down = data.height / data.scale;
      centre = [data.west + across / 2, data.north - down / 2];
      zoom = Math.min(width / across, height / down);
    }
    redraw();
  }
  function zoomAt(factor, u, v) {
    const [x, y] = toScene(u, v);
    whole = false;
    zoom = Math.min(Math.max(zoom * factor, 1e-4), 1e4);
    centre = [x - (u - width / 2) / zoom, y + (v - height / 2) / zoom];
    redraw();
  }
  function pinch(event) {
    const [fixed] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, position]) => position);
    const apart = ([u, v]) => Math.max(Math.hypot(u - fixed[0], v - fixed[1]), 1);
    const factor = apart(place(event)) / apart(pointers.get(event.pointerId));
    pointers.set(event.pointerId, place(event));
    zoomAt(factor, ...fixed);
  }
  function choose(u, v) {
    point = toScene(u, v);
    emitEvent("picked", { x: point[0], y: point[1] });
    redraw();
  }
  function place(event) {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }
  function listen() {
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, place(event));
      grip = pointers.size === 1 ? place(event) : null;
      moved = false;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (pointers.size === 2 && pointers.has(event.pointerId)) pinch(event);
      if (!grip) return;
      const [u, v] = place(event);
      if (Math.hypot(u - grip[0], v - grip[1]) > 3) moved = true;
      if (!moved) return;
      if (drawing) {
        const [a, b] = toScene(...grip), [c, d] = toScene(u, v);
        area = { west: Math.min(a, c), east: Math.max(a, c), south: Math.min(b, d), north: Math.max(b, d) };
      } else {
        centre = [centre[0] - (u - grip[0]) / zoom, centre[1] + (v - grip[1]) / zoom];
        grip = [u, v];
        whole = false;
      }
      redraw();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (grip && !moved) choose(...place(event));
      else if (grip && drawing && area) { drawing = false; canvas.classList.remove("drawing"); emitEvent("area", area); }
      pointers.delete(event.pointerId);
      grip = null;
    });
    canvas.addEventListener("pointercancel", (event) => { pointers.delete(event.pointerId); grip = null; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoomAt(Math.exp(-event.deltaY / 400), ...place(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
      if (steps[event.key]) {
        centre = [centre[0] + steps[event.key][0] * 40 / zoom, centre[1] + steps[event.key][1] * 40 / zoom];
        whole = false;
        redraw();
      } else if (event.key === "+") zoomAt(1.25, width / 2, height / 2);
      else if (event.key === "-") zoomAt(0.8, width / 2, height / 2);
      else if (event.key === "Home") fit();
      else if (event.key === "Enter") choose(width / 2, height / 2);
      else return;
      event.preventDefault();
    });
  }
  // The request is sent while the page is still being built.
  const ask = (scene) => fetch("/data/plan.json" + (scene ? "?scene=" + encodeURIComponent(scene) : ""));
  let early = ask();
  async function load(scene) {
    canvas = document.getElementById("plan");
    if (!context) {
      context = canvas.getContext("2d");
      listen();
      new ResizeObserver(size).observe(canvas);
      // A file dropped outside the upload fields would replace the page.
      for (const name of ["dragover", "drop"]) {
        window.addEventListener(name, (event) => {
          if (!event.dataTransfer.types.includes("Files")) return;
          event.preventDefault();
          event.dataTransfer.dropEffect = "none";
        });
      }
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => setTimeout(renew, 50));
    }
    const answer = await (early || ask(scene));
    early = null;
    if (!answer.ok) return;
    data = await answer.json();
    buildings = data.scale ? new Path2D(data.buildings) : null;
    walls = data.scale ? new Path2D(data.walls) : null;
    size();
    emitEvent("plan", { sites: data.sites });
    const suspicions = data.error ? [data.error] : await (await fetch("/data/findings.json")).json();
    emitEvent("findings", { findings: suspicions });
  }
  return {
    load, fit,
    drawArea() { drawing = true; canvas.classList.add("drawing"); },
    mark(place, bounds) { point = place; area = bounds; redraw(); },
    suggest(points) { suggested = points; redraw(); },
  };
})();
