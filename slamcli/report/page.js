"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const n = data.time.length;
  const RAMP = [[59, 76, 192], [98, 160, 220], [120, 198, 121], [253, 191, 80], [200, 40, 40]];
  const INK = "#1d2329", SOFT = "#5d6873", LINE = "#e3e7eb", BLUE = "#0072b2", LOST = "rgba(194,59,34,0.14)", DOUBT = "rgba(230,159,0,0.3)", LOOP = "#d55e00", KEY = "#17212b", START = "#00805e";
  const doubtful = new Set(data.doubtful), begins = new Set(data.starts);
  const hasPose = i => data.position[0][i] !== null;
  let cursor = -1;
  const listeners = [];
  const moveCursor = i => { if (i !== cursor) { cursor = i; listeners.forEach(draw => draw()); } };

  const rampAt = share => {
    const x = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1), k = Math.min(Math.floor(x), RAMP.length - 2), f = x - k;
    return "rgb(" + RAMP[k].map((v, c) => Math.round(v + f * (RAMP[k + 1][c] - v))).join(",") + ")";
  };
  const finite = values => values.filter(v => v !== null).sort((a, b) => a - b);
  const quantile = (sorted, q) => sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))] : 0;
  const errorTop = quantile(finite(data.error), 0.98) || 1;

  const fit = canvas => {
    const scale = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    const context = canvas.getContext("2d");
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.clearRect(0, 0, width, height);
    return [context, width, height];
  };
  const niceStep = (range, wanted) => {
    const raw = range / Math.max(wanted, 1), power = Math.pow(10, Math.floor(Math.log10(raw)));
    return [1, 2, 5, 10].map(k => k * power).find(step => step >= raw);
  };

  // The scene: an orbiting camera around the trajectory.
  const scene = document.getElementById("scene");
  const bounds = [0, 1, 2].map(k => {
    const values = finite(data.position[k].concat(data.truth[k]));
    return values.length ? [values[0], values[values.length - 1]] : [0, 1];
  });
  const size = Math.max(0.3, ...bounds.map(b => b[1] - b[0]));
  const start = () => ({ azimuth: -2.2, elevation: 0.75, zoom: 1, target: bounds.map(b => (b[0] + b[1]) / 2) });
  let view = start();

  const projector = (width, height) => {
    const ca = Math.cos(view.azimuth), sa = Math.sin(view.azimuth), ce = Math.cos(view.elevation), se = Math.sin(view.elevation);
    const scale = view.zoom * Math.min(width, height) * 0.82 / size, distance = 4 * size;
    return (x, y, z) => {
      const dx = x - view.target[0], dy = y - view.target[1], dz = z - view.target[2];
      const right = -sa * dx + ca * dy, up = -se * (ca * dx + sa * dy) + ce * dz, near = ce * (ca * dx + sa * dy) + se * dz;
      const f = distance / Math.max(distance - near, 0.2 * size);
      return [width / 2 + scale * right * f, height / 2 - scale * up * f];
    };
  };

  const drawScene = () => {
    const [context, width, height] = fit(scene), at = projector(width, height);
    const point = i => at(data.position[0][i], data.position[1][i], data.position[2][i]);
    const line = (points, colour, lineWidth, dash) => {
      context.strokeStyle = colour; context.lineWidth = lineWidth; context.setLineDash(dash || []);
      context.beginPath();
      points.forEach((p, i) => p && (points[i - 1] ? context.lineTo(p[0], p[1]) : context.moveTo(p[0], p[1])));
      context.stroke();
    };
    const step = niceStep(size * 1.4, 6), isOnFloor = data.hasFloor && bounds[2][0] < 1.2 * size, floor = isOnFloor ? 0 : Math.floor(bounds[2][0] / step) * step;
    const low = [0, 1].map(k => Math.floor((bounds[k][0] - 0.2 * size) / step) * step), high = [0, 1].map(k => Math.ceil((bounds[k][1] + 0.2 * size) / step) * step);
    for (let x = low[0]; x <= high[0] + 1e-9; x += step) line([at(x, low[1], floor), at(x, high[1], floor)], LINE, 1);
    for (let y = low[1]; y <= high[1] + 1e-9; y += step) line([at(low[0], y, floor), at(high[0], y, floor)], LINE, 1);
    context.fillStyle = SOFT; context.font = "11px sans-serif";
    context.fillText("squares of " + step + " m" + (isOnFloor ? " on the floor" : ", " + floor.toFixed(2) + " m " + (data.hasFloor ? "above the floor" : "high")), 10, height - (width < 420 ? 52 : 9));
    const truth = data.truth[0].map((x, i) => x === null ? null : at(x, data.truth[1][i], data.truth[2][i]));
    if (truth.length) line(truth, "#8a949e", 1.6, [5, 4]);
    context.setLineDash([]);
    data.loops.forEach(([i, k]) => { if (hasPose(i) && hasPose(k)) line([point(i), point(k)], LOOP, 1); });
    for (let i = 1; i < n; i++) {
      if (begins.has(i) || !hasPose(i) || !hasPose(i - 1)) continue;
      const error = data.error.length ? data.error[i] : null;
      line([point(i - 1), point(i)], error === null ? BLUE : rampAt(error / errorTop), 2.2);
    }
    context.fillStyle = KEY;
    for (let i = 0; i < n; i++) {
      if (data.state[i] !== 2 || !hasPose(i)) continue;
      const p = point(i);
      context.beginPath(); context.arc(p[0], p[1], 1.7, 0, 2 * Math.PI); context.fill();
    }
    drawStart(context, at, line);
    drawGizmo(context, width, line);
    if (cursor >= 0 && hasPose(cursor)) drawCamera(context, at, cursor, line);
  };

  // Where the recording began and which way the camera looked: the initial pose of a robot.
  const drawStart = (context, at, line) => {
    const first = data.position[0].findIndex(x => x !== null);
    if (first < 0) return;
    const p = [0, 1, 2].map(k => data.position[k][first]), f = [0, 1].map(k => data.forward[k][first]);
    const norm = Math.hypot(f[0], f[1]);
    const a = at(...p);
    context.fillStyle = START; context.beginPath(); context.arc(a[0], a[1], 4, 0, 2 * Math.PI); context.fill();
    if (norm > 0.2) {
      const d = [f[0] / norm, f[1] / norm], s = 0.14 * size / Math.sqrt(view.zoom);
      const to = (x, y) => at(p[0] + s * (x * d[0] - y * d[1]), p[1] + s * (x * d[1] + y * d[0]), p[2]);
      line([a, to(1, 0)], START, 2.4);
      line([to(0.72, 0.16), to(1, 0), to(0.72, -0.16)], START, 2.4);
    }
    context.fillText("start", a[0] + 7, a[1] + 15);
  };

  // The axes, in the corner where nothing hides them.
  const drawGizmo = (context, width, line) => {
    const ca = Math.cos(view.azimuth), sa = Math.sin(view.azimuth), ce = Math.cos(view.elevation), se = Math.sin(view.elevation);
    const origin = [width - 42, 42], reach = 26;
    [[[1, 0, 0], "x", "#c23b22"], [[0, 1, 0], "y", "#00805e"], [[0, 0, 1], "z", BLUE]].forEach(([d, name, colour]) => {
      const tip = [origin[0] + reach * (-sa * d[0] + ca * d[1]), origin[1] - reach * (-se * (ca * d[0] + sa * d[1]) + ce * d[2])];
      line([origin, tip], colour, 2);
      context.fillStyle = colour;
      context.fillText(name, tip[0] + (tip[0] < origin[0] ? -10 : 4), tip[1] + 3);
    });
  };

  const drawCamera = (context, at, i, line) => {
    const column = values => values.map(v => v[i]);
    const c = column(data.position), f = column(data.forward), r = column(data.right);
    const down = [f[1] * r[2] - f[2] * r[1], f[2] * r[0] - f[0] * r[2], f[0] * r[1] - f[1] * r[0]];
    const s = 0.09 * size / Math.sqrt(view.zoom);
    const corner = (a, b) => at(...c.map((v, k) => v + s * (f[k] + 0.6 * a * r[k] + 0.45 * b * down[k])));
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    line([...corners, corners[0]], INK, 1.8);
    corners.forEach(p => line([at(...c), p], INK, 1.2));
  };

  const turn = (dx, dy) => {
    view.azimuth -= 0.008 * dx;
    view.elevation = Math.min(Math.max(view.elevation + 0.008 * dy, -0.2), 1.5707);
  };
  const shift = (dx, dy) => {
    const unit = size / (view.zoom * Math.min(scene.clientWidth, scene.clientHeight) * 0.82);
    const ca = Math.cos(view.azimuth), sa = Math.sin(view.azimuth), se = Math.sin(view.elevation), ce = Math.cos(view.elevation);
    view.target[0] += unit * (sa * dx - se * ca * dy);
    view.target[1] += unit * (-ca * dx - se * sa * dy);
    view.target[2] += unit * ce * dy;
  };
  const zoom = factor => { view.zoom = Math.min(Math.max(view.zoom * factor, 0.3), 40); };

  // A mouse or a pen turns; one finger scrolls the page, two turn and zoom; the wheel scrolls unless Ctrl is held, as when pinching a touchpad.
  const dragging = { active: false, move: false, x: 0, y: 0 };
  const stopDragging = () => { dragging.active = false; };
  scene.addEventListener("pointerdown", e => {
    if (e.pointerType === "touch") return;
    Object.assign(dragging, { active: true, move: e.shiftKey || e.button === 1, x: e.clientX, y: e.clientY });
    scene.setPointerCapture(e.pointerId);
  });
  scene.addEventListener("pointerup", stopDragging);
  scene.addEventListener("pointercancel", stopDragging);
  scene.addEventListener("pointermove", e => {
    if (!dragging.active) return;
    (dragging.move ? shift : turn)(e.clientX - dragging.x, e.clientY - dragging.y);
    dragging.x = e.clientX; dragging.y = e.clientY;
    drawScene();
  });
  let pinch = null;
  const pinchOf = touches => {
    const [a, b] = [touches[0], touches[1]];
    return { x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2, d: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) || 1 };
  };
  const startPinch = e => { if (e.touches.length === 2) { e.preventDefault(); pinch = pinchOf(e.touches); } else pinch = null; };
  scene.addEventListener("touchstart", startPinch, { passive: false });
  scene.addEventListener("touchmove", e => {
    if (e.touches.length !== 2 || pinch === null) return;
    e.preventDefault();
    const now = pinchOf(e.touches);
    turn(now.x - pinch.x, now.y - pinch.y);
    zoom(now.d / pinch.d);
    pinch = now;
    drawScene();
  }, { passive: false });
  ["touchend", "touchcancel"].forEach(name => scene.addEventListener(name, startPinch, { passive: false }));
  scene.addEventListener("wheel", e => { if (!e.ctrlKey) return; e.preventDefault(); zoom(Math.exp(-0.01 * e.deltaY)); drawScene(); }, { passive: false });
  const reset = () => { view = start(); drawScene(); };
  scene.addEventListener("dblclick", reset);
  document.getElementById("zoom-in").addEventListener("click", () => { zoom(1.4); drawScene(); });
  document.getElementById("zoom-out").addEventListener("click", () => { zoom(1 / 1.4); drawScene(); });
  document.getElementById("zoom-reset").addEventListener("click", reset);
  listeners.push(drawScene);

  const legend = document.getElementById("legend");
  const entry = (colour, text) => { const row = document.createElement("div"), mark = document.createElement("i"); mark.style.background = colour; row.append(mark, text); legend.append(row); };
  if (data.error.length) {
    const row = document.createElement("div"), mark = document.createElement("i");
    mark.className = "ramp";
    mark.style.background = "linear-gradient(90deg," + RAMP.map(c => "rgb(" + c.join(",") + ")").join(",") + ")";
    row.append("error 0", mark, (1000 * errorTop).toPrecision(3) + " mm");
    legend.append(row);
  } else entry(BLUE, "camera");
  if (data.truth[0].length) entry("#8a949e", "ground truth");
  if (data.loops.length) entry(LOOP, "loop closures");
  entry(KEY, "dots: key frames");

  // The charts: one time axis for all.
  const last = data.time[n - 1] || 1e-3;
  let range = [0, last];
  const charts = [], constant = [];
  const LEFT = 52, RIGHT = 8, TOP = 20, BOTTOM = 18;
  const addChart = (title, values, unit, digits, factor) => {
    const known = finite(values);
    if (known.length && known[0] === known[known.length - 1]) {  // a line that says one number is better said in words
      constant.push(title + ": " + (known[0] * factor).toFixed(digits) + (unit ? " " + unit : "") + " in every frame");
      return;
    }
    const canvas = document.createElement("canvas");
    document.getElementById("charts").append(canvas);
    charts.push({ canvas, title, values, unit, digits, factor });
  };
  if (data.error.length) addChart("absolute pose error", data.error, "mm", 1, 1000);
  addChart("landmarks a pose rests on", data.inliers, "", 0, 1);
  if (data.features.length) addChart("features", data.features, "", 0, 1);
  if (!data.error.length) addChart("height of the camera", data.position[2], "m", 2, 1);

  if (data.state.includes(0)) constant.push("red in the charts: lost");
  if (doubtful.size) constant.push("amber in the charts: doubtful");
  document.getElementById("constant").textContent = constant.join("; ");

  const moment = i => {
    const k = Math.max(data.starts.filter(first => first <= i).length - 1, 0);
    return (data.names.length ? data.names[k] + " at " : "") + (data.time[i] - data.time[data.starts[k]]).toFixed(2) + " s";
  };
  const drawChart = chart => {
    const [context, width, height] = fit(chart.canvas);
    const w = width - LEFT - RIGHT, h = height - TOP - BOTTOM;
    const x = t => LEFT + w * (t - range[0]) / (range[1] - range[0]);
    const shown = [];
    for (let i = 0; i < n; i++) if (data.time[i] >= range[0] && data.time[i] <= range[1] && chart.values[i] !== null) shown.push(chart.values[i] * chart.factor);
    const bottom = shown.reduce((a, b) => Math.min(a, b), 0), span = shown.reduce((a, b) => Math.max(a, b), bottom + 1e-9) - bottom, top = bottom + 1.08 * span;
    const y = v => TOP + h * (1 - (v - bottom) / (top - bottom));
    context.font = "11px sans-serif";
    for (let i = 0; i < n; i++) {
      if (data.state[i] !== 0 && !doubtful.has(i)) continue;
      context.fillStyle = data.state[i] === 0 ? LOST : DOUBT;
      const a = x(data.time[i]), b = i + 1 < n ? x(data.time[i + 1]) : a + 1;
      if (b >= LEFT && a <= width - RIGHT) context.fillRect(Math.max(a, LEFT), TOP, Math.max(Math.min(b, width - RIGHT) - Math.max(a, LEFT), 1), h);
    }
    context.strokeStyle = LINE; context.fillStyle = SOFT; context.lineWidth = 1;
    const stepY = niceStep(top - bottom, Math.max(2, h / 34)), stepX = niceStep(range[1] - range[0], w / 80);
    context.textAlign = "right"; context.textBaseline = "middle";
    for (let v = Math.ceil(bottom / stepY) * stepY; v <= top; v += stepY) {
      context.beginPath(); context.moveTo(LEFT, y(v)); context.lineTo(width - RIGHT, y(v)); context.stroke();
      context.fillText(Number(v.toPrecision(4)), LEFT - 5, y(v));
    }
    context.textAlign = "left"; context.textBaseline = "top";
    data.names.forEach((name, k) => {  // where each of several recordings begins
      const a = x(data.time[data.starts[k]]);
      if (a < LEFT - 1 || a > width - RIGHT) return;
      context.beginPath(); context.moveTo(a, TOP); context.lineTo(a, TOP + h); context.stroke();
      context.fillText(name, a + 3, TOP + 1);
    });
    context.textAlign = "center"; context.textBaseline = "top";
    for (let t = Math.ceil(range[0] / stepX) * stepX; t <= range[1]; t += stepX) context.fillText(Number(t.toPrecision(5)) + " s", Math.min(Math.max(x(t), LEFT + 8), width - RIGHT - 12), TOP + h + 3);
    context.save();
    context.beginPath(); context.rect(LEFT, TOP - 2, w, h + 4); context.clip();
    context.strokeStyle = BLUE; context.lineWidth = 1.3; context.beginPath();
    let pen = false;
    for (let i = 0; i < n; i++) {
      const v = chart.values[i];
      if (v === null || begins.has(i) || (pen && data.time[i] - data.time[i - 1] > 0.5)) pen = false;
      if (v === null) continue;
      if (pen) context.lineTo(x(data.time[i]), y(v * chart.factor)); else context.moveTo(x(data.time[i]), y(v * chart.factor));
      pen = true;
    }
    context.stroke();
    if (selection) { context.fillStyle = "rgba(0,114,178,0.15)"; context.fillRect(selection[0], TOP, selection[1] - selection[0], h); }
    context.restore();
    context.textAlign = "left"; context.textBaseline = "top"; context.fillStyle = INK;
    let text = chart.title + (chart.unit ? " [" + chart.unit + "]" : "");
    if (cursor >= 0) {
      const cx = x(data.time[cursor]), v = chart.values[cursor];
      context.strokeStyle = INK; context.lineWidth = 1; context.beginPath(); context.moveTo(cx, TOP); context.lineTo(cx, TOP + h); context.stroke();
      text += "   frame " + cursor + ", " + moment(cursor) + ": " + (v === null ? (data.state[cursor] === 0 ? "lost" : "-") : (v * chart.factor).toFixed(chart.digits)) + (doubtful.has(cursor) ? ", doubtful" : "");
    }
    context.fillText(text, LEFT, 4);
  };
  let selection = null, anchor = null;
  const drawCharts = () => charts.forEach(drawChart);
  listeners.push(drawCharts);
  const timeAt = (chart, px) => range[0] + (px - LEFT) / (chart.canvas.clientWidth - LEFT - RIGHT) * (range[1] - range[0]);
  const frameAt = t => {
    let a = 0, b = n - 1;
    while (b - a > 1) { const m = (a + b) >> 1; if (data.time[m] > t) b = m; else a = m; }
    return Math.abs(data.time[a] - t) <= Math.abs(data.time[b] - t) ? a : b;
  };
  charts.forEach(chart => {
    const canvas = chart.canvas;
    canvas.addEventListener("pointermove", e => {
      if (anchor !== null) { selection = [Math.min(anchor, e.offsetX), Math.max(anchor, e.offsetX)]; drawCharts(); }
      moveCursor(frameAt(timeAt(chart, e.offsetX)));
    });
    canvas.addEventListener("pointerdown", e => { anchor = e.offsetX; moveCursor(frameAt(timeAt(chart, e.offsetX))); if (e.pointerType !== "touch") canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => {
      if (selection && selection[1] - selection[0] > 6) {
        const [a, b] = [Math.max(timeAt(chart, selection[0]), 0), Math.min(timeAt(chart, selection[1]), last)];
        if (b - a > 0.05) range = [a, b];
      }
      anchor = selection = null;
      drawCharts();
    });
    canvas.addEventListener("pointercancel", () => { anchor = selection = null; drawCharts(); });  // the finger scrolls the page instead
    canvas.addEventListener("pointerleave", () => { if (anchor === null) moveCursor(-1); });
    canvas.addEventListener("dblclick", () => { range = [0, last]; drawCharts(); });
  });

  // Pictures enlarge on a click; another click, or Escape, closes them.
  const large = document.getElementById("large"), largeImage = large.querySelector("img");
  document.querySelectorAll("figure img").forEach(image => {
    const open = () => { largeImage.src = image.src; largeImage.alt = image.alt; large.showModal(); };
    image.addEventListener("click", open);
    image.addEventListener("keydown", e => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); open(); } });
  });
  large.addEventListener("click", () => large.close());

  const drawAll = () => { drawScene(); drawCharts(); };
  window.addEventListener("resize", drawAll);
  drawAll();
})();
