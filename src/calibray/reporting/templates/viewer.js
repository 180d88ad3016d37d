// Script of the report: the list of links, the map and the 3-D scene, which all show the selected link.
// Names come from files, so they are inserted as text only (textContent), never as markup.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent);
  if (!data) return;
  const decode = (text, Type) => {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new Type(bytes.buffer);
  };
  const make = (tag, text, parent, name) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (name) element.className = name;
    if (parent) parent.append(element);
    return element;
  };
  // Adding 0 removes the sign of a negative zero.
  const fixed = (value) => (Math.round(10 * value) / 10 + 0).toFixed(1);
  const decibel = (value) => (value === null ? "none" : `${fixed(value)} ${data.quantity.unit}`);
  const signed = (value) => (value === null ? "none" : `${fixed(value) < 0 ? "−" : "+"}${fixed(Math.abs(value))} dB`);
  const links = data.links, count = links.row.length;
  const residual = links.predicted.map((predicted, i) => (predicted === null || links.faint[i] ? null : predicted - links.measured[i]));
  const marks = (i) => (links.held[i] ? ", held out" : "") + (links.lost[i] ? ", no path" : "") + (links.faint[i] ? ", near or below the noise floor" : "");
  const tx = decode(data.solid.tx, Uint16Array), rx = decode(data.solid.rx, Uint16Array);
  // The end with more positions represents the link: receivers, or transmitters if there are more of these.
  const places = (ends) => new Set(Array.from({ length: count }, (_, i) => ends.slice(3 * i, 3 * i + 3).join())).size;
  const moving = places(tx) > places(rx) ? tx : rx, standing = moving === tx ? rx : tx;
  const metres = (ends, i) => [0, 1, 2].map((k) => data.solid.low[k] + data.solid.step * ends[3 * i + k]);
  const title = (i) => `Row ${links.row[i]}` + (data.groups.length ? `, ${data.groups[links.group[i]]}` : "");

  // Paths ----------------------------------------------------------------------------------------------------------
  const KINDS = { 1: "reflection", 2: "diffuse reflection", 4: "transmission", 8: "diffraction" };
  const paths = data.solid.paths && (() => {
    const packed = data.solid.paths;
    const perLink = decode(packed.count, Uint8Array), depth = decode(packed.depth, Uint8Array);
    const first = new Uint32Array(count + 1), start = new Uint32Array(depth.length + 1);
    perLink.forEach((n, i) => { first[i + 1] = first[i] + n; });
    depth.forEach((n, i) => { start[i + 1] = start[i] + n; });
    return {
      first, start, loss: decode(packed.loss, Uint16Array), kind: decode(packed.kind, Uint8Array),
      material: decode(packed.material, Uint16Array), vertex: decode(packed.vertex, Uint16Array), names: packed.materials,
    };
  })();
  const pathsOf = (link) => {
    if (!paths) return [];
    const found = [];
    for (let path = paths.first[link]; path < paths.first[link + 1]; path++) {
      const points = [Array.from(tx.slice(3 * link, 3 * link + 3))], met = [];
      for (let k = paths.start[path]; k < paths.start[path + 1]; k++) {
        points.push(Array.from(paths.vertex.slice(3 * k, 3 * k + 3)));
        met.push(`${KINDS[paths.kind[k]]} at ${paths.names[paths.material[k]]}`);
      }
      points.push(Array.from(rx.slice(3 * link, 3 * link + 3)));
      let length = 0;
      for (let k = 1; k < points.length; k++) length += Math.hypot(...points[k].map((x, a) => x - points[k - 1][a]));
      found.push({ gain: -paths.loss[path] / 100, points, met: met.join(", ") || "direct", length: length * data.solid.step });
    }
    return found;
  };
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
  // From weak to strong; both ends contrast with the background of the theme.
  const POWER = { light: ["#5b3f99", "#26748e", "#1f9d6b", "#c48a00"], dark: ["#7a6fd0", "#35a3b8", "#5fd08a", "#fde06a"] };
  const RANGE = 30;
  const power = (share) => {
    const stops = POWER[dark.matches ? "dark" : "light"].map(rgb);
    const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1), low = Math.min(Math.floor(at), stops.length - 2);
    return stops[low].map((x, k) => x + (at - low) * (stops[low + 1][k] - x));
  };
  const css = (color) => `rgb(${color.map((x) => Math.round(255 * x)).join()})`;

  // Selection --------------------------------------------------------------------------------------------------------
  const list = byId("links"), order = byId("order"), chosen = { link: -1, paths: [], path: -1 };
  const fill = () => {
    const index = Array.from({ length: count }, (_, i) => i);
    const size = (i) => (links.faint[i] ? -1 : residual[i] === null ? Infinity : Math.abs(residual[i]));
    if (order.value === "residual") index.sort((a, b) => size(b) - size(a));
    list.replaceChildren(...index.map((i) => {
      const option = make("option", `${title(i)}: ${signed(residual[i])}${marks(i)}`);
      option.value = i;
      return option;
    }));
    if (chosen.link >= 0) list.value = chosen.link;
  };
  const describe = (i) => {
    const end = (which) => metres(which, i).map(fixed).join(", ");
    const facts = [
      [`measured ${data.quantity.name}`, decibel(links.measured[i])], ["before calibration", decibel(links.before[i])],
      ["predicted", decibel(links.predicted[i])], ["predicted − measured", signed(residual[i])],
      ["held out", links.held_out[i]], ["basis", links.lost[i] ? "no path" : "prediction model"], ["transmitter [m]", end(tx)], ["receiver [m]", end(rx)],
    ];
    const box = byId("facts");
    box.replaceChildren();
    make("h3", title(i), box);
    const terms = make("dl", undefined, box);
    for (const [name, value] of facts) { make("dt", name, terms); make("dd", value, terms); }
    byId("map-text").textContent = `${title(i)}: measured ${decibel(links.measured[i])}, predicted ${decibel(links.predicted[i])}, ` +
      `residual ${signed(residual[i])}${marks(i)}.`;
  };
  const tabulate = () => {
    const body = byId("paths");
    body.replaceChildren();
    chosen.paths.forEach((path, k) => {
      const row = make("tr", undefined, body), swatch = make("td", undefined, row);
      const color = css(power(1 + (path.gain - chosen.paths[0].gain) / RANGE));
      make("span", undefined, swatch, "swatch").style.background = color;
      make("td", path.gain.toFixed(1), row, "number");
      make("td", path.length.toFixed(1), row, "number");
      make("td", path.met, row);
      row.tabIndex = 0;
      const light = (which) => () => { chosen.path = which; view.draw(); };
      row.onfocus = row.onpointerenter = light(k);
      row.onblur = row.onpointerleave = light(-1);
    });
    byId("paths-table").hidden = !chosen.paths.length;
    byId("legend").hidden = !chosen.paths.length;
    if (chosen.paths.length) {
      const strongest = chosen.paths[0].gain;
      byId("legend-bar").style.background =
        `linear-gradient(to right, ${[0, 1 / 3, 2 / 3, 1].map((x) => css(power(x))).join()})`;
      byId("legend-low").textContent = `${(strongest - RANGE).toFixed(0)} dB`;
      byId("legend-high").textContent = `${strongest.toFixed(0)} dB`;
    }
  };
  const select = (i) => {
    chosen.link = i; chosen.paths = pathsOf(i); chosen.path = -1;
    list.value = i;
    describe(i); tabulate(); mark(i); view.draw();
    document.documentElement.dataset.link = links.row[i];
    document.documentElement.dataset.paths = chosen.paths.length;
  };

  // Map --------------------------------------------------------------------------------------------------------------
  const map = byId("map"), at = (ends, i) => {
    const [x, y] = metres(ends, i);
    return [(x - data.map.west) * data.map.scale, (data.map.north - y) * data.map.scale];
  };
  const mark = (i) => {
    const [x1, y1] = at(standing, i), [x2, y2] = at(moving, i);
    const line = byId("map-line"), ring = byId("map-ring");
    for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) line.setAttribute(name, value);
    ring.setAttribute("cx", x2); ring.setAttribute("cy", y2);
    byId("map-chosen").removeAttribute("visibility");
  };
  const nearest = (x, y, where, reach) => {
    let best = -1, least = reach * reach;
    for (let i = 0; i < count; i++) {
      const p = where(i), d = p ? (p[0] - x) ** 2 + (p[1] - y) ** 2 : Infinity;
      if (d < least) { least = d; best = i; }
    }
    return best;
  };
  map.addEventListener("click", (event) => {
    const units = map.getScreenCTM().inverse(), where = new DOMPoint(event.clientX, event.clientY).matrixTransform(units);
    const found = nearest(where.x, where.y, (i) => at(moving, i), 24 * units.a);
    if (found >= 0) select(found);
  });

  // Scene ------------------------------------------------------------------------------------------------------------
  const canvas = byId("scene-canvas");
  const view = viewer(canvas) || { draw() {} };

  function viewer(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
    if (!gl) {
      canvas.hidden = true;
      byId("scene-none").hidden = false;
      return null;
    }
    const program = (vertex, fragment) => {
      const made = gl.createProgram();
      for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
        const shader = gl.createShader(type);
        gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${source}`);
        gl.compileShader(shader);
        gl.attachShader(made, shader);
      }
      gl.linkProgram(made);
      if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
      return { made, at: (name) => gl.getUniformLocation(made, name) };
    };
    const buffer = (target, values) => {
      const made = gl.createBuffer();
      gl.bindBuffer(target, made);
      gl.bufferData(target, values, gl.STATIC_DRAW);
      return made;
    };
    const surfaces = program(
      "layout(location=0) in vec3 p; uniform mat4 m; uniform vec3 eye; out vec3 from; void main() { from = p - eye; gl_Position = m * vec4(p, 1.0); }",
      `in vec3 from; uniform vec3 color, fog; uniform float far, cut; out vec4 o;
       void main() {
         // Leave out buildings between the camera and the point that it looks at.
         if (1.0 / gl_FragCoord.w < cut) discard;
         vec3 n = normalize(cross(dFdx(from), dFdy(from)));
         float light = 0.62 + 0.30 * abs(n.z) + 0.14 * abs(dot(n, normalize(vec3(0.8, 0.45, 0.0))));
         o = vec4(mix(color * light, fog, 0.75 * smoothstep(0.35, 1.0, length(from) / far)), 1.0);
       }`);
    const tubes = program(
      `layout(location=0) in vec3 a; layout(location=1) in vec3 b; layout(location=2) in vec4 color;
       uniform mat4 m; uniform vec2 size; uniform float width, fade; out vec4 c;
       void main() {
         vec4 u = m * vec4(a, 1.0), v = m * vec4(b, 1.0);
         float n = 1.0;
         if (u.w < n && v.w < n) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
         if (u.w < n) u = mix(u, v, (n - u.w) / (v.w - u.w)); else if (v.w < n) v = mix(v, u, (n - v.w) / (u.w - v.w));
         vec2 d = (v.xy / v.w - u.xy / u.w) * size;
         d = length(d) > 0.0 ? normalize(d) : vec2(1.0, 0.0);
         int k = gl_VertexID;
         vec4 end = k < 2 ? u : v;
         float side = k % 2 == 0 ? 1.0 : -1.0;
         gl_Position = end + vec4(vec2(-d.y, d.x) * side * width / size * end.w, 0.0, 0.0);
         c = vec4(color.rgb, color.a * fade);
       }`,
      "in vec4 c; out vec4 o; void main() { o = c; }");
    const dots = program(
      `layout(location=0) in vec3 p; layout(location=1) in vec4 color; layout(location=2) in float size;
       uniform mat4 m; uniform float ratio; out vec4 c; out float s;
       void main() { gl_Position = m * vec4(p, 1.0); gl_PointSize = (abs(size) + 2.0) * ratio; c = color; s = size; }`,
      `in vec4 c; in float s; uniform vec3 rim; uniform float fade; out vec4 o;
       void main() {
         vec2 q = 2.0 * gl_PointCoord - 1.0;
         float r = s < 0.0 ? max(q.y / 0.8, 1.8 * abs(q.x) - q.y) : length(q);
         if (r > 1.0) discard;
         o = vec4(r > 0.74 && abs(s) > 6.0 ? rim : c.rgb, c.a * fade);
       }`);
    const mesh = data.solid.mesh;
    const land = mesh && { vertex: buffer(gl.ARRAY_BUFFER, decode(mesh.vertex, Uint16Array)), face: buffer(gl.ELEMENT_ARRAY_BUFFER, decode(mesh.face, Uint32Array)) };

    // All positions, including the camera's, are in steps of the grid.
    const span = (ends) => [0, 1, 2].map((k) => {
      let low = Infinity, high = -Infinity;
      for (let i = k; i < 3 * count; i += 3) { low = Math.min(low, ends[i]); high = Math.max(high, ends[i]); }
      return [low, high];
    });
    const [one, two] = [span(tx), span(rx)], range = one.map(([a, b], k) => [Math.min(a, two[k][0]), Math.max(b, two[k][1])]);
    const extent = Math.max(range[0][1] - range[0][0], range[1][1] - range[1][0], 5 / data.solid.step);
    // The initial view looks along the principal axis of the links, for instance down a street.
    const along = () => {
      const mean = [0, 1].map((k) => { let sum = 0; for (let i = k; i < 3 * count; i += 3) sum += moving[i]; return sum / count; });
      let xx = 0, xy = 0, yy = 0;
      for (let i = 0; i < count; i++) {
        const [x, y] = [moving[3 * i] - mean[0], moving[3 * i + 1] - mean[1]];
        xx += x * x; xy += x * y; yy += y * y;
      }
      return Math.atan2(2 * xy, xx - yy) / 2;
    };
    const home = () => ({ target: range.map(([a, b], k) => (k === 2 ? a : (a + b) / 2)), distance: 1.6 * extent * Math.max(1, 0.9 * canvas.clientHeight / canvas.clientWidth), azimuth: along() + Math.PI + 0.3, elevation: 0.72 });
    let camera = home();
    const FIELD = 0.75;
    const eye = () => {
      const { target, distance, azimuth, elevation } = camera, flat = distance * Math.cos(elevation);
      return [target[0] + flat * Math.cos(azimuth), target[1] + flat * Math.sin(azimuth), target[2] + distance * Math.sin(elevation)];
    };
    const axes = () => {
      const { azimuth, elevation } = camera;
      const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
      const up = [-Math.sin(elevation) * Math.cos(azimuth), -Math.sin(elevation) * Math.sin(azimuth), Math.cos(elevation)];
      const back = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
      return [right, up, back];
    };
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const matrix = () => {
      const from = eye(), [r, u, b] = axes(), f = 1 / Math.tan(FIELD / 2), aspect = canvas.width / canvas.height;
      const near = camera.distance / 50, far = camera.distance + 140000, z = (far + near) / (near - far), w = 2 * far * near / (near - far);
      const rows = [[...r, -dot(r, from)], [...u, -dot(u, from)], [...b, -dot(b, from)]];
      const m = [rows[0].map((x) => x * f / aspect), rows[1].map((x) => x * f), rows[2].map((x, k) => x * z + (k === 3 ? w : 0)), rows[2].map((x) => -x)];
      return Float32Array.from([0, 1, 2, 3].flatMap((column) => m.map((row) => row[column])));
    };
    const onScreen = (m, x, y, z) => {
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      if (w <= 0) return null;
      return [((m[0] * x + m[4] * y + m[8] * z + m[12]) / w + 1) / 2 * canvas.clientWidth, (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) / 2 * canvas.clientHeight];
    };
    const hit = (event) => {
      const box = canvas.getBoundingClientRect(), m = matrix();
      return nearest(event.clientX - box.left, event.clientY - box.top, (i) => onScreen(m, moving[3 * i], moving[3 * i + 1], moving[3 * i + 2]), 22);
    };
    // Tints of materials: similar hues, close to the grey of the page.
    const tint = (k) => {
      const base = rgb(style("--building")), turn = 2.4 * k;
      return k < 0 ? rgb(style("--ground")) : base.map((x, c) => x + 0.05 * Math.cos(turn + 2.1 * c));
    };
    const names = data.materials;
    const attribute = (place, size, stride, offset, type = gl.FLOAT) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, false, stride, offset);
    };
    const stream = gl.createBuffer();
    const upload = (values) => { gl.bindBuffer(gl.ARRAY_BUFFER, stream); gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW); };
    // The points of the links change only with the theme.
    let points = null;
    const makePoints = () => {
      const far = count > 2000 ? 3 : 8, values = [], seen = new Set();
      for (let i = 0; i < count; i++) {
        const color = links.color[i] === "none" ? rgb(style("--paper")) : rgb(links.color[i]);
        values.push(moving[3 * i], moving[3 * i + 1], moving[3 * i + 2], ...color, 1, far);
      }
      for (let i = 0; i < count; i++) {
        const place = [standing[3 * i], standing[3 * i + 1], standing[3 * i + 2]];
        if (seen.has(place.join())) continue;
        seen.add(place.join());
        values.push(...place, ...rgb(style("--mast")), 1, -14);
      }
      points = { values: buffer(gl.ARRAY_BUFFER, Float32Array.from(values)), count: values.length / 8 };
    };
    const drawDots = (m, values, number, ratio, fade) => {
      gl.useProgram(dots.made);
      gl.uniformMatrix4fv(dots.at("m"), false, m);
      gl.uniform1f(dots.at("ratio"), ratio);
      gl.uniform1f(dots.at("fade"), fade);
      gl.uniform3fv(dots.at("rim"), rgb(style("--ink")));
      if (values) { gl.bindBuffer(gl.ARRAY_BUFFER, values); }
      attribute(0, 3, 32, 0); attribute(1, 4, 32, 12); attribute(2, 1, 32, 28);
      for (const k of [0, 1, 2]) gl.vertexAttribDivisor(k, 0);
      gl.drawArrays(gl.POINTS, 0, number);
    };
    const segments = () => {
      const values = [], add = (a, b, color, alpha) => values.push(...a, ...b, ...color, alpha);
      const strongest = chosen.paths.length ? chosen.paths[0].gain : 0;
      // The strongest path is drawn last, over the others.
      chosen.paths.map((path, k) => [path, k]).reverse().forEach(([path, k]) => {
        const alpha = chosen.path < 0 ? 1 : chosen.path === k ? 1 : 0.12;
        const color = power(1 + (path.gain - strongest) / RANGE);
        for (let j = 1; j < path.points.length; j++) add(path.points[j - 1], path.points[j], color, alpha);
      });
      if (chosen.link >= 0 && !chosen.paths.length) {
        const end = (ends) => Array.from(ends.slice(3 * chosen.link, 3 * chosen.link + 3));
        add(end(tx), end(rx), rgb(style("--ink")), 0.7);
      }
      return Float32Array.from(values);
    };
    const drawTubes = (m, number, ratio, fade) => {
      gl.useProgram(tubes.made);
      gl.uniformMatrix4fv(tubes.at("m"), false, m);
      gl.uniform2f(tubes.at("size"), canvas.width, canvas.height);
      gl.uniform1f(tubes.at("width"), 2.2 * ratio);
      gl.uniform1f(tubes.at("fade"), fade);
      gl.bindBuffer(gl.ARRAY_BUFFER, stream);
      attribute(0, 3, 40, 0); attribute(1, 3, 40, 12); attribute(2, 4, 40, 24);
      for (const k of [0, 1, 2]) gl.vertexAttribDivisor(k, 1);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, number);
      for (const k of [0, 1, 2]) gl.vertexAttribDivisor(k, 0);
    };
    let waiting = false;
    const draw = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; paint(); });
    };
    const paint = () => {
      const ratio = Math.min(devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
      if (!points) makePoints();
      const m = matrix(), sky = rgb(style("--sky"));
      gl.viewport(0, 0, width, height);
      gl.clearColor(...sky, 1);
      gl.depthMask(true);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      if (land) {
        gl.useProgram(surfaces.made);
        gl.uniformMatrix4fv(surfaces.at("m"), false, m);
        gl.uniform3fv(surfaces.at("eye"), eye());
        gl.uniform3fv(surfaces.at("fog"), sky);
        gl.uniform1f(surfaces.at("far"), Math.max(6 * camera.distance, 2.5 * extent));
        gl.bindBuffer(gl.ARRAY_BUFFER, land.vertex);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, land.face);
        attribute(0, 3, 6, 0, gl.UNSIGNED_SHORT);
        for (const k of [1, 2]) gl.disableVertexAttribArray(k);
        gl.enable(gl.POLYGON_OFFSET_FILL);
        gl.polygonOffset(1, 1);
        let start = 0;
        for (const part of mesh.parts) {
          const ground = part.ground;
          gl.uniform3fv(surfaces.at("color"), tint(ground ? -1 : names.indexOf(part.name)));
          gl.uniform1f(surfaces.at("cut"), ground ? 0 : 0.55 * camera.distance);
          gl.drawElements(gl.TRIANGLES, 3 * part.count, gl.UNSIGNED_INT, 12 * start);
          start += part.count;
        }
        gl.disable(gl.POLYGON_OFFSET_FILL);
      }
      gl.depthMask(false);
      const lines = segments(), number = lines.length / 10;
      // First draw all parts faintly, including those that buildings hide, then the visible parts.
      gl.disable(gl.DEPTH_TEST);
      drawDots(m, points.values, points.count, ratio, 0.22);
      if (number) { upload(lines); drawTubes(m, number, ratio, 0.4); }
      gl.enable(gl.DEPTH_TEST);
      drawDots(m, points.values, points.count, ratio, 1);
      if (number) drawTubes(m, number, ratio, 1);
      if (chosen.link >= 0) {
        const ring = [moving, standing].flatMap((ends, k) => [...ends.slice(3 * chosen.link, 3 * chosen.link + 3),
          ...(k ? rgb(style("--mast")) : rgb(links.color[chosen.link] === "none" ? style("--paper") : links.color[chosen.link])), 1, k ? -20 : 15]);
        gl.disable(gl.DEPTH_TEST);
        upload(Float32Array.from(ring));
        drawDots(m, null, 2, ratio, 1);
      }
      // Tests wait for this counter.
      document.documentElement.dataset.drawn = Number(document.documentElement.dataset.drawn || 0) + 1;
    };

    // Pointer and keyboard
    const held = new Map();
    let moved = 0, spread = 0;
    const turn = (x, y) => {
      camera.azimuth -= x;
      camera.elevation = Math.min(Math.max(camera.elevation + y, 0.03), 1.55);
      draw();
    };
    const slide = (x, y) => {
      const [r, u] = axes(), unit = 2 * camera.distance * Math.tan(FIELD / 2) / canvas.clientHeight;
      const ahead = [u[0], u[1], 0].map((v) => v / Math.max(Math.hypot(u[0], u[1]), 0.2));
      camera.target = camera.target.map((t, k) => t - unit * x * r[k] + unit * y * ahead[k]);
      draw();
    };
    const zoom = (factor) => { camera.distance = Math.min(Math.max(camera.distance * factor, 3 / data.solid.step), 200000); draw(); };
    const tip = byId("tip");
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
      moved = spread = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = held.get(event.pointerId);
      if (!last) {
        const found = hit(event), box = canvas.getBoundingClientRect();
        tip.hidden = found < 0;
        canvas.style.cursor = found < 0 ? "grab" : "pointer";
        if (found >= 0) {
          tip.textContent = `${title(found)}: ${signed(residual[found])}`;
          tip.style.left = `${event.clientX - box.left + 14}px`;
          tip.style.top = `${event.clientY - box.top + 14}px`;
        }
        return;
      }
      const [x, y] = [event.clientX - last[0], event.clientY - last[1]];
      held.set(event.pointerId, [event.clientX, event.clientY]);
      moved += Math.hypot(x, y);
      if (held.size === 2) {
        const [a, b] = [...held.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (spread) zoom(spread / now);
        spread = now;
        slide(x / 2, y / 2);
      } else if (event.shiftKey || event.ctrlKey || event.buttons & 6) slide(x, y);
      else turn(0.008 * x, 0.008 * y);
    });
    const release = (event) => {
      if (held.delete(event.pointerId) && !held.size && moved < 6 && event.type === "pointerup") {
        const found = hit(event);
        if (found >= 0) select(found);
      }
      spread = 0;
    };
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, release);
    canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
    canvas.addEventListener("wheel", (event) => {
      // Zoom only after a click on the scene; otherwise the page could not be scrolled past it.
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = (by) => {
        const next = Math.min(Math.max(list.selectedIndex + by, 0), count - 1);
        select(Number(list.options[next].value));
      };
      const slow = event.shiftKey;
      const action = {
        ArrowLeft: () => (slow ? slide(30, 0) : turn(-0.08, 0)), ArrowRight: () => (slow ? slide(-30, 0) : turn(0.08, 0)),
        ArrowUp: () => (slow ? slide(0, 30) : turn(0, 0.06)), ArrowDown: () => (slow ? slide(0, -30) : turn(0, -0.06)),
        "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1 / 0.85), Home: () => { camera = home(); draw(); },
        n: () => step(1), p: () => step(-1),
      }[event.key];
      if (action) { event.preventDefault(); action(); }
    });
    byId("reset").onclick = () => { camera = home(); draw(); };
    new ResizeObserver(draw).observe(canvas);
    dark.addEventListener("change", () => { points = null; tabulate(); draw(); });
    addEventListener("beforeprint", paint);
    return { draw };
  }

  order.onchange = fill;
  list.onchange = () => select(Number(list.value));
  fill();
  const worst = residual.reduce((best, value, i) => (value !== null && (best < 0 || Math.abs(value) > Math.abs(residual[best])) ? i : best), -1);
  select(Math.max(worst, 0));
})();
