// The map of a run in 3D on a 2D canvas: no WebGL, no library, no network. Everything comes from the JSON in #scene.
"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const byId = (id) => document.getElementById(id);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

  function element(name, text, className) {
    const node = document.createElement(name);
    if (text !== undefined) node.textContent = text;  // never HTML: names come from files
    if (className) node.className = className;
    return node;
  }

  // --- colours -------------------------------------------------------------------------------------------------------

  const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];  // viridis

  function ramp(share) {
    const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
    const i = Math.min(Math.floor(at), RAMP.length - 2);
    return RAMP[i].map((low, k) => Math.round(low + (at - i) * (RAMP[i + 1][k] - low)));
  }

  const sigmas = scene.planes.map((plane) => plane.sigma_mm).sort((a, b) => a - b);
  const sigmaLimit = sigmas.length ? sigmas[Math.floor(0.95 * (sigmas.length - 1))] || 1 : 1;
  const rgb = (colour, alpha) => `rgba(${colour[0]}, ${colour[1]}, ${colour[2]}, ${alpha})`;

  function colourOf(plane) {
    return view.colour === "sigma" ? ramp(plane.sigma_mm / sigmaLimit) : plane.colour;
  }

  // --- camera --------------------------------------------------------------------------------------------------------

  const canvas = byId("map");
  const context = canvas.getContext("2d");
  const [low, high] = scene.bounds;
  const middle = low.map((value, k) => 0.5 * (value + high[k]));
  const radius = Math.max(0.5 * Math.hypot(...sub(high, low)), 0.5);
  const FOCAL = 1.6, NEAR = 0.02;
  const view = { yaw: -2.2, pitch: 0.75, distance: 0, target: middle, colour: "side", hovered: null, drawn: [] };

  const corners = scene.planes.map((plane) => [...plane.faces.flat(2), ...plane.segments.flat()]);
  const landmarks = [...corners.flat(), ...scene.estimate];

  function look(yaw, pitch) {
    // from this side, as near as the whole map allows
    Object.assign(view, { yaw, pitch, target: middle });
    const { right, up, back } = axes();
    const aspect = Math.min(canvas.clientWidth / canvas.clientHeight, 4);
    for (let round = 0; round < 3; round++) {
      const seen = landmarks.map((p) => sub(p, view.target)).map((q) => [dot(q, right), dot(q, up), dot(q, back)]);
      if (!seen.length) { view.distance = 3 * radius; return; }
      view.distance = Math.max(...seen.map((q) => q[2] + 1.06 * FOCAL * Math.max(Math.abs(q[0]) / aspect, 1.12 * Math.abs(q[1]), 0.1)));
      const shares = [0, 1].map((k) => seen.map((q) => q[k] * view.distance / (view.distance - q[2])));
      const lift = 0.05 * view.distance / FOCAL;  // room for the controls
      const shift = shares.map((values) => 0.5 * (Math.min(...values) + Math.max(...values)));
      view.target = view.target.map((value, k) => value + shift[0] * right[k] + (shift[1] + lift) * up[k]);
    }
  }

  const home = () => look(-2.2, 0.75);

  function axes() {
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    return { right: [-sy, cy, 0], up: [-sp * cy, -sp * sy, cp], back: [cp * cy, cp * sy, sp] };
  }

  function camera() {
    const { right, up, back } = axes();
    const eye = view.target.map((value, k) => value + view.distance * back[k]);
    const scale = 0.5 * FOCAL * canvas.clientHeight;
    return {
      eye,
      toCamera: (p) => { const q = sub(p, eye); return [dot(q, right), dot(q, up), -dot(q, back)]; },
      toScreen: (c) => [0.5 * canvas.clientWidth + scale * c[0] / c[2], 0.5 * canvas.clientHeight - scale * c[1] / c[2]],
    };
  }

  function clip(points, closed) {
    // the part of a chain in front of the camera, Sutherland and Hodgman's way; an open chain may come out in pieces
    const pieces = [];
    let piece = [];
    const count = points.length;
    for (let i = 0; i < count; i++) {
      const a = points[i], b = points[(i + 1) % count];
      if (a[2] >= NEAR) piece.push(a);
      if (i === count - 1 && !closed) break;
      if ((a[2] >= NEAR) !== (b[2] >= NEAR)) {
        const t = (NEAR - a[2]) / (b[2] - a[2]);
        piece.push([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), NEAR]);
        if (!closed && a[2] >= NEAR) { pieces.push(piece); piece = []; }
      }
    }
    if (piece.length > 1) pieces.push(piece);
    return pieces;
  }

  function trace(path, points, closed, eye) {
    for (const piece of clip(points.map(eye.toCamera), closed)) {
      piece.forEach((c, i) => { const s = eye.toScreen(c); if (i) path.lineTo(...s); else path.moveTo(...s); });
      if (closed) path.closePath();
    }
  }

  // --- the order in which planes are painted --------------------------------------------------------------------------

  const MARGIN = 0.05;  // walls and floor reach a little past the edge in which they meet, m

  function sideOf(i, j) {
    // 1, -1: plane j lies wholly on the positive, negative side of plane i; 0: on both
    let above = false, below = false;
    for (const p of corners[j]) {
      const height = dot(scene.planes[i].normal, p) - scene.planes[i].d;
      above = above || height > MARGIN;
      below = below || height < -MARGIN;
    }
    return above === below ? 0 : above ? 1 : -1;
  }

  const few = scene.planes.length <= 250;
  const sides = few ? scene.planes.map((_, i) => scene.planes.map((__, j) => (i === j ? 0 : sideOf(i, j)))) : null;

  function isBehind(i, j, front) {
    // whether plane j, painted after i, would wrongly cover it
    const s = sides[i][j], t = sides[j][i];
    if (s !== 0) return s !== front[i];
    return t !== 0 && t === front[j];
  }

  function paintingOrder(eye) {
    const front = scene.planes.map((plane) => (dot(plane.normal, eye.eye) > plane.d ? 1 : -1));
    const depth = corners.map((points) => points.reduce((sum, p) => sum + eye.toCamera(p)[2], 0) / points.length);
    const order = scene.planes.map((_, i) => i).sort((a, b) => depth[b] - depth[a]);
    if (!few) return { order, front };
    // repeatedly paint the farthest plane that no other unpainted one must precede; a cycle is cut at the farthest
    const result = [];
    while (order.length) {
      let pick = order.findIndex((i) => order.every((j) => i === j || !isBehind(i, j, front) || isBehind(j, i, front)));
      if (pick < 0) pick = 0;
      result.push(...order.splice(pick, 1));
    }
    return { order: result, front };
  }

  // --- drawing -------------------------------------------------------------------------------------------------------

  const LIGHT = [0.35, 0.25, 0.9];
  let queued = false;

  function redraw() {
    if (queued) return;
    queued = true;
    requestAnimationFrame(() => { queued = false; draw(); });
  }

  function sharp(board) {
    // an empty canvas with the pixels of the device, drawn on in those of the page
    const ratio = window.devicePixelRatio || 1, [width, height] = [board.clientWidth, board.clientHeight];
    board.width = Math.round(width * ratio);
    board.height = Math.round(height * ratio);
    const pen = board.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { pen, width, height };
  }

  function draw() {
    sharp(canvas);
    const eye = camera();
    view.drawn = [];
    if (byId("show-planes").checked) drawPlanes(eye);
    if (byId("show-points")?.checked) drawPoints(eye);
    if (byId("show-odometry")?.checked) drawPath(scene.odometry, eye, "#c53030", 1.5, [6, 4]);
    if (byId("show-estimate").checked) drawPath(scene.estimate, eye, "#111111", 2, []);
    if (byId("show-estimate").checked) drawDoubtful(eye, "#dd6b20");
    drawTriad();
  }

  function drawPlanes(eye) {
    const { order, front } = paintingOrder(eye);
    const all = byId("show-behind").checked;
    for (const filled of all ? [true] : [false, true]) {  // outlines of what is seen from behind lie under everything
      for (const i of order) {
        const seen = front[i] > 0 || all;
        if (!all && filled !== seen && scene.planes[i].faces.length) continue;
        if (!scene.planes[i].faces.length && !filled) continue;
        drawPlane(i, eye, seen);
      }
    }
  }

  function drawPlane(i, eye, filled) {
    const plane = scene.planes[i];
    const hot = view.hovered === i;
    const shade = 0.72 + 0.28 * Math.abs(dot(plane.normal, LIGHT));
    const base = colourOf(plane), colour = base.map((value) => Math.round(value * shade));
    const faces = new Path2D(), lines = new Path2D();
    for (const face of plane.faces) for (const ring of face) trace(faces, ring, true, eye);
    for (const segment of plane.segments) trace(lines, segment, false, eye);
    context.lineJoin = "round";
    if (filled) {
      context.fillStyle = rgb(colour, hot ? 1 : 0.9);
      context.fill(faces, "evenodd");
    }
    context.lineWidth = hot ? 2.5 : 1;
    context.strokeStyle = hot ? "#111" : rgb(base.map((value) => Math.round(value * 0.55)), filled ? 0.9 : 0.3);
    context.stroke(faces);
    context.lineWidth = hot ? 5 : 3;
    context.strokeStyle = hot ? "#111" : rgb(base, 1);
    context.stroke(lines);
    view.drawn.push({ i, faces: filled ? faces : null, lines });
  }

  function drawDot(point, eye, colour, size) {
    const place = eye.toCamera(point);
    if (place[2] < NEAR) return;
    context.fillStyle = colour;
    context.beginPath();
    context.arc(...eye.toScreen(place), size, 0, 2 * Math.PI);
    context.fill();
  }

  function drawChain(points, eye, colour, width) {
    const path = new Path2D();
    trace(path, points, false, eye);
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.stroke(path);
  }

  function drawDoubtful(eye, colour) {
    // stretches of the way; a keyframe alone is a dot
    for (const part of scene.doubtful) {
      if (part.length === 1) drawDot(part[0], eye, colour, 4);
      else drawChain(part, eye, colour, 5);
    }
  }

  function drawPoints(eye) {
    const numbers = scene.points_cm;
    context.fillStyle = "rgba(20, 30, 45, .55)";
    for (let i = 0; i < numbers.length; i += 3) {
      const place = eye.toCamera([0.01 * numbers[i], 0.01 * numbers[i + 1], 0.01 * numbers[i + 2]]);
      if (place[2] < NEAR) continue;
      const [x, y] = eye.toScreen(place);
      context.fillRect(x - 0.7, y - 0.7, 1.4, 1.4);
    }
  }

  function drawPath(points, eye, colour, width, dashes) {
    if (!points.length) return;
    context.setLineDash(dashes);
    drawChain(points, eye, colour, width);
    context.setLineDash([]);
    drawDot(points[0], eye, colour, 3.5);
  }

  function drawTriad() {
    // which way x, y and z point, in the corner
    const { right, up } = axes();
    const origin = [46, canvas.clientHeight - 46];
    context.font = "12px system-ui, sans-serif";
    context.lineWidth = 2;
    [["x", "#c53030"], ["y", "#2f855a"], ["z", "#2b6cb0"]].forEach(([name, colour], k) => {
      const tip = [origin[0] + 30 * right[k], origin[1] - 30 * up[k]];
      context.strokeStyle = context.fillStyle = colour;
      context.beginPath();
      context.moveTo(...origin);
      context.lineTo(...tip);
      context.stroke();
      context.fillText(name, tip[0] + 6 * right[k] - 3, tip[1] - 8 * up[k] + 4);
    });
  }

  // --- pointing at planes --------------------------------------------------------------------------------------------

  const tip = byId("tip");

  function planeAt(x, y) {
    // paths are kept in page pixels: hit tests must not be scaled by the device
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.lineWidth = 9;
    const hit = [...view.drawn].reverse().find(({ faces, lines }) =>
      context.isPointInStroke(lines, x, y) || (faces && context.isPointInPath(faces, x, y, "evenodd")));
    context.restore();
    return hit ? hit.i : null;
  }

  function numbersOf(plane) {
    const rows = [
      ["normal", plane.normal.map((value) => value.toFixed(4)).join(", ")],
      ["d", `${plane.d.toFixed(4)} m`],
      ["σ along the normal", `${plane.sigma_mm.toPrecision(3)} mm`],
      ["σ of tilts", `${plane.tilts_deg.map((value) => value.toPrecision(2)).join(", ")}°`],
      ["points", plane.points.toLocaleString("en")],
      ["keyframes", String(plane.observations)],
    ];
    if (plane.area_m2 > 0) rows.push(["area", `${plane.area_m2.toFixed(2)} m²`]);
    if (plane.kinds.length) rows.push(["seen as", plane.kinds.join(", ")]);
    return rows;
  }

  function hover(index, x, y) {
    if (view.hovered !== index) { view.hovered = index; redraw(); }
    if (index === null) { tip.style.display = "none"; return; }
    const list = element("dl");
    for (const [name, value] of numbersOf(scene.planes[index])) list.append(element("dt", name), element("dd", value));
    tip.replaceChildren(element("b", `plane ${scene.planes[index].id}`), list);
    tip.style.display = "block";
    const stage = byId("stage");
    tip.style.left = `${Math.min(x + 16, stage.clientWidth - tip.offsetWidth - 8)}px`;
    tip.style.top = `${Math.max(8, Math.min(y + 16, stage.clientHeight - tip.offsetHeight - 8))}px`;
  }

  // --- turning, moving, zooming ----------------------------------------------------------------------------------------

  let grip = null;

  function turn(dx, dy) {
    view.yaw -= dx;
    view.pitch = Math.min(Math.max(view.pitch + dy, -1.55), 1.55);
    redraw();
  }

  function zoom(factor) {
    view.distance = Math.min(Math.max(view.distance * factor, 0.02 * radius), 50 * radius);
    redraw();
  }

  function move(dx, dy) {
    const { right, up } = axes();
    const step = view.distance / (0.5 * FOCAL * canvas.clientHeight);
    view.target = view.target.map((value, k) => value + step * (dy * up[k] - dx * right[k]));
    redraw();
  }

  canvas.addEventListener("pointerdown", (event) => {
    grip = [event.clientX, event.clientY, event.shiftKey || event.button !== 0];
    canvas.setPointerCapture(event.pointerId);
    canvas.classList.add("turning");
  });
  canvas.addEventListener("pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    if (!grip) { hover(planeAt(x, y), x, y); return; }
    const [dx, dy] = [event.clientX - grip[0], event.clientY - grip[1]];
    if (grip[2]) move(dx, dy); else turn(0.008 * dx, 0.008 * dy);
    grip = [event.clientX, event.clientY, grip[2]];
    hover(null);
  });
  const release = () => { grip = null; canvas.classList.remove("turning"); };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => hover(null));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.0012 * event.deltaY));
  }, { passive: false });

  const keys = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1),
    ArrowDown: () => turn(0, 0.1), "+": () => zoom(0.87), "=": () => zoom(0.87), "-": () => zoom(1.15),
    0: () => { home(); redraw(); }, 1: () => { look(-Math.PI / 2, 1.55); redraw(); },
    2: () => { look(-Math.PI / 2, 0.02); redraw(); },
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  byId("home").addEventListener("click", keys[0]);
  byId("top").addEventListener("click", keys[1]);
  byId("side").addEventListener("click", keys[2]);
  byId("controls").addEventListener("change", () => { view.colour = byId("colour").value; legend(); redraw(); });
  byId("controls").addEventListener("submit", (event) => event.preventDefault());
  window.addEventListener("resize", redraw);

  // --- legend and table ----------------------------------------------------------------------------------------------

  function legend() {
    const box = byId("legend");
    box.replaceChildren();
    if (scene.estimate.length) box.append(element("span", "━ trajectory ", "estimate"));
    if (scene.doubtful.length) box.append(element("span", "━ doubtful ", "doubtful"));
    if (scene.odometry.length) box.append(element("span", "╌ odometry alone ", "odometry"));
    if (view.colour !== "sigma") return;
    const bar = element("span", undefined, "ramp");
    bar.style.background = `linear-gradient(90deg, ${RAMP.map((colour) => rgb(colour, 1)).join(", ")})`;
    box.append(element("span", "σ 0"), bar, element("span", `${sigmaLimit.toPrecision(2)} mm`));
  }

  function table() {
    const grid = element("table"), head = element("tr");
    ["plane", "normal", "d [m]", "σ [mm]", "tilts σ [°]", "points", "keyframes", "area [m²]"].forEach((name, k) =>
      head.append(element("th", name, k ? "n" : "")));
    grid.append(head);
    scene.planes.forEach((plane, i) => {
      const row = element("tr");
      const cells = [plane.id, plane.normal.map((value) => value.toFixed(3)).join(", "), plane.d.toFixed(3),
        plane.sigma_mm.toPrecision(3), plane.tilts_deg.map((value) => value.toPrecision(2)).join(", "), plane.points,
        plane.observations, plane.area_m2.toFixed(2)];
      cells.forEach((cell, k) => row.append(element("td", String(cell), k ? "n" : "")));
      row.addEventListener("mouseenter", () => { view.hovered = i; redraw(); });
      row.addEventListener("mouseleave", () => { view.hovered = null; redraw(); });
      grid.append(row);
    });
    byId("planes").querySelector(".scroll").append(grid);
  }

  // --- NIS over time -------------------------------------------------------------------------------------------------

  function chart(series) {
    const box = byId("charts");
    box.append(element("h2", `NIS over time, ${series.kind} factors`));
    const plot = element("canvas", undefined, "chart");
    box.append(plot, element("p", series.caption, "hint"));
    const paint = () => paintChart(plot, series);
    window.addEventListener("resize", paint);
    paint();
  }

  function paintChart(plot, series) {
    const { pen, width, height } = sharp(plot);
    const last = series.last ?? Math.max(1, scene.keyframes - 1);
    const most = 1.15 * Math.max(2, ...series.blocks.map((block) => Math.max(block.mean, block.high)));
    const x = (keyframe) => 46 + (width - 60) * keyframe / last;
    const y = (value) => 8 + (height - 36) * (1 - Math.min(value, most) / most);
    pen.fillStyle = "rgba(56, 161, 105, .18)";
    for (const block of series.blocks) {
      const left = x(block.from), right = Math.max(x(block.to), left + 2);
      pen.fillRect(left, y(block.high), right - left, y(block.low) - y(block.high));
    }
    const [ink, half] = series.dots.length < 200 ? [0.65, 2] : [0.28, 1.2];
    pen.fillStyle = `rgba(60, 80, 110, ${ink})`;
    for (const [place, value] of series.dots) pen.fillRect(x(place) - half, y(value) - half, 2 * half, 2 * half);
    pen.strokeStyle = "#2f855a";
    pen.setLineDash([4, 4]);
    line(pen, [[x(0), y(1)], [x(last), y(1)]]);
    pen.setLineDash([]);
    pen.strokeStyle = "#2b6cb0";
    pen.lineWidth = 2;
    const [first, ...more] = series.blocks;
    line(pen, more.length ? series.blocks.map((block) => [x(0.5 * (block.from + block.to)), y(block.mean)])
      : [[x(first.from), y(first.mean)], [x(first.to), y(first.mean)]]);
    for (const block of series.blocks) {
      pen.fillStyle = block.mean > block.high ? "#c53030" : "#2b6cb0";
      pen.beginPath();
      pen.arc(x(0.5 * (block.from + block.to)), y(block.mean), 3, 0, 2 * Math.PI);
      pen.fill();
    }
    axisLabels(pen, x, y, last, most, width, height, series.over);
  }

  function line(pen, points) {
    pen.beginPath();
    points.forEach((point, i) => (i ? pen.lineTo(...point) : pen.moveTo(...point)));
    pen.stroke();
  }

  function axisLabels(pen, x, y, last, most, width, height, over) {
    pen.lineWidth = 1;
    pen.strokeStyle = "#b9c2cc";
    line(pen, [[46, 8], [46, height - 28], [width - 14, height - 28]]);
    pen.fillStyle = "#66707c";
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "right";
    const step = most > 6 ? Math.ceil(most / 5) : 1;
    for (let value = 0; value <= most; value += step) pen.fillText(String(value), 40, y(value) + 4);
    pen.textAlign = "center";
    const stride = Math.max(1, Math.ceil(last / 8));
    for (let keyframe = 0; keyframe <= last; keyframe += stride) pen.fillText(String(keyframe), x(keyframe), height - 12);
    pen.textAlign = "left";
    pen.fillText(`chi2 per degree of freedom, by ${over}`, 54, 18);
  }

  // --- start ---------------------------------------------------------------------------------------------------------

  if (!scene.points_cm.length) byId("show-points").parentElement.remove();
  else byId("show-points").checked = window.location.hash === "#points";  // report.html#points shows them from the start
  if (!scene.odometry.length) byId("show-odometry").parentElement.remove();
  home();
  legend();
  table();
  scene.nis.forEach(chart);
  draw();
  // for scripts: how one looks at the map, where a point or a plane is on the screen, and what is at a place
  const project = (p) => { const eye = camera(), c = eye.toCamera(p); return c[2] < NEAR ? null : eye.toScreen(c); };
  window.spplanes = {
    view, draw, look, planeAt, project,
    idOf: (index) => scene.planes[index].id,
    screenOf: (id) => project(scene.planes.find((plane) => plane.id === id).inside),
  };
})();
