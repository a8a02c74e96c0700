"use strict";
// Draws what the page of a pair shows; everything it needs stands in the page itself.
(() => {
  const data = JSON.parse(document.getElementById("pair-data").textContent);
  const photos = [1, 2].map((n) => document.getElementById("photo" + n));
  const GAP = 12, GREEN = "#2fbf5b", RED = "#e5392d", BLUE = "#4a9bff", YELLOW = "#ffd23f";

  // ---- two photographs side by side on one canvas, in pixels of the photographs as stored
  class PairCanvas {
    constructor(canvas) {
      this.canvas = canvas;
      this.context = canvas.getContext("2d");
      const [[w1, h1], [w2, h2]] = data.size;
      this.scale = [(1400 - GAP) / 2 / w1, (1400 - GAP) / 2 / w2];
      this.left = [0, 700 + GAP / 2];
      canvas.width = 1400;
      canvas.height = Math.round(Math.max(h1 * this.scale[0], h2 * this.scale[1]));
      this.clear();
    }
    clear() {
      const c = this.context;
      c.clearRect(0, 0, this.canvas.width, this.canvas.height);
      photos.forEach((photo, n) => {
        const [w, h] = data.size[n];
        c.globalAlpha = 0.75;
        c.drawImage(photo, this.left[n], 0, w * this.scale[n], h * this.scale[n]);
        c.globalAlpha = 1;
      });
    }
    at(n, x, y) { return [this.left[n] + x * this.scale[n], y * this.scale[n]]; }
    whose(event) {
      const box = this.canvas.getBoundingClientRect(), k = this.canvas.width / box.width;
      const x = (event.clientX - box.left) * k, y = (event.clientY - box.top) * k;
      const n = x >= this.left[1] ? 1 : 0;
      return [n, (x - this.left[n]) / this.scale[n], y / this.scale[n]];
    }
    dot(n, x, y, radius, color) {
      const [u, v] = this.at(n, x, y), c = this.context;
      c.beginPath(); c.arc(u, v, radius, 0, 7); c.fillStyle = color; c.fill();
      c.lineWidth = 1; c.strokeStyle = "#000a"; c.stroke();
    }
    circle(n, x, y, radius, color) {
      const [u, v] = this.at(n, x, y), c = this.context;
      c.beginPath(); c.arc(u, v, Math.max(radius * this.scale[n], 1.5), 0, 7);
      c.lineWidth = 1; c.strokeStyle = color; c.stroke();
    }
    match([x1, y1, x2, y2], color) {
      const a = this.at(0, x1, y1), b = this.at(1, x2, y2), c = this.context;
      c.beginPath(); c.moveTo(...a); c.lineTo(...b); c.lineWidth = 1; c.strokeStyle = color; c.stroke();
    }
    line(n, l, color) {
      const ends = clip(l, data.size[n]), c = this.context;
      if (!ends) return;
      c.beginPath(); c.moveTo(...this.at(n, ...ends[0])); c.lineTo(...this.at(n, ...ends[1]));
      c.lineWidth = 1.5; c.strokeStyle = color; c.stroke();
    }
  }

  // the part of a line a x + b y + c = 0 that lies in a picture
  function clip([a, b, c], [w, h]) {
    const ends = [];
    for (const x of [0, w]) if (Math.abs(b) > 1e-12) ends.push([x, -(a * x + c) / b]);
    for (const y of [0, h]) if (Math.abs(a) > 1e-12) ends.push([-(b * y + c) / a, y]);
    const slack = 1e-6 * (w + h);
    const inside = ends.filter(([x, y]) => x >= -slack && x <= w + slack && y >= -slack && y <= h + slack);
    if (inside.length < 2) return null;
    let best = null, longest = 0;
    for (const p of inside) for (const q of inside) {
      const length = Math.hypot(p[0] - q[0], p[1] - q[1]);
      if (length > longest) { longest = length; best = [p, q]; }
    }
    return best;
  }
  // F x1 in picture 2, F^T x2 in picture 1
  function epipolarLine(n, x, y) {
    const f = data.fundamental;
    return [0, 1, 2].map((i) => n === 0
      ? f[i][0] * x + f[i][1] * y + f[i][2]
      : f[0][i] * x + f[1][i] * y + f[2][i]);
  }

  function showKeypoints(canvas) {
    const view = new PairCanvas(canvas);
    data.keypoints.forEach((points, n) => points.forEach(([x, y, s]) => view.circle(n, x, y, 2 * s, YELLOW)));
  }

  function showMatches(canvas) {
    const view = new PairCanvas(canvas), buttons = document.querySelectorAll("[data-matches]");
    function show(kind) {
      view.clear();
      const found = data.matches[kind];
      found.forEach((m) => view.match(m, m.length > 4 ? (m[4] ? GREEN : RED) : YELLOW));
      found.forEach((m) => {
        const color = m.length > 4 ? (m[4] ? GREEN : RED) : YELLOW;
        view.dot(0, m[0], m[1], 2.5, color); view.dot(1, m[2], m[3], 2.5, color);
      });
      buttons.forEach((b) => b.setAttribute("aria-pressed", String(b.dataset.matches === kind)));
    }
    buttons.forEach((b) => b.addEventListener("click", () => show(b.dataset.matches)));
    show("nearest");
  }

  // ---- epipolar lines, clicked point to line, and the search along it
  function showLines(canvas) {
    const view = new PairCanvas(canvas), gray = photos.map(grayOf);
    const curve = document.getElementById("search-curve"), said = document.getElementById("search-said");
    function lines() {
      view.clear();
      data.lines.forEach(([x1, y1, x2, y2], k) => {
        const color = `hsl(${(k * 360) / data.lines.length} 90% 60%)`;
        view.line(1, epipolarLine(0, x1, y1), color); view.line(0, epipolarLine(1, x2, y2), color);
        view.dot(0, x1, y1, 4, color); view.dot(1, x2, y2, 4, color);
      });
      data.epipoles.forEach((e, n) => { if (e) { view.dot(n, e[0], e[1], 7, "#fff"); view.dot(n, e[0], e[1], 4, RED); } });
    }
    function clicked(n, x, y) {
      lines();
      const other = 1 - n, l = epipolarLine(n, x, y);
      view.dot(n, x, y, 6, "#fff"); view.dot(n, x, y, 3.5, BLUE);
      view.line(other, l, "#fff");
      const found = search(gray[n], gray[other], n, other, x, y, l);
      drawCurve(curve, found);
      if (!found.best) { said.textContent = "The line does not pass through the other picture, or the point is too near the border."; return; }
      view.dot(other, found.best.x, found.best.y, 6, "#fff"); view.dot(other, found.best.x, found.best.y, 3.5, GREEN);
      const rival = found.rival ? `; the next best place, apart from it, has ${found.rival.toFixed(2)}` : "";
      said.textContent = `(${x.toFixed(0)}, ${y.toFixed(0)}) in photograph ${n + 1}: along its line in photograph ${other + 1} ` +
        `the best correlation is ${found.best.value.toFixed(2)} at (${found.best.x.toFixed(0)}, ${found.best.y.toFixed(0)})${rival}. ` +
        (found.best.value < 0.8 || (found.rival && found.rival > found.best.value - 0.05)
          ? "That is not certain: little texture, a repeated one, or a surface seen under another angle." : "");
    }
    canvas.addEventListener("click", (event) => clicked(...view.whose(event)));
    lines();
    if (data.lines.length) {
      const [x1, y1] = data.lines[Math.floor(data.lines.length / 2)];
      clicked(0, x1, y1);
    }
  }
  function grayOf(photo) {
    const canvas = document.createElement("canvas");
    canvas.width = photo.naturalWidth; canvas.height = photo.naturalHeight;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(photo, 0, 0);
    const { data: rgba, width, height } = context.getImageData(0, 0, canvas.width, canvas.height);
    const gray = new Float32Array(width * height);
    for (let i = 0; i < gray.length; i++) gray[i] = 0.299 * rgba[4 * i] + 0.587 * rgba[4 * i + 1] + 0.114 * rgba[4 * i + 2];
    return { gray, width, height };
  }
  const HALF = 7;
  // zero-mean, unit-norm window about a place in pixels of the small picture; bilinear
  function windowAt({ gray, width, height }, u, v) {
    if (u < HALF + 1 || v < HALF + 1 || u > width - HALF - 2 || v > height - HALF - 2) return null;
    const out = new Float32Array((2 * HALF + 1) ** 2);
    const x0 = Math.floor(u - 0.5), y0 = Math.floor(v - 0.5), fx = u - 0.5 - x0, fy = v - 0.5 - y0;
    let k = 0, mean = 0;
    for (let j = -HALF; j <= HALF; j++) for (let i = -HALF; i <= HALF; i++) {
      const p = (y0 + j) * width + x0 + i;
      const value = (1 - fy) * ((1 - fx) * gray[p] + fx * gray[p + 1]) + fy * ((1 - fx) * gray[p + width] + fx * gray[p + width + 1]);
      out[k++] = value; mean += value;
    }
    mean /= k;
    let norm = 0;
    for (let i = 0; i < k; i++) { out[i] -= mean; norm += out[i] * out[i]; }
    norm = Math.sqrt(norm);
    if (norm < 1) return null;
    for (let i = 0; i < k; i++) out[i] /= norm;
    return out;
  }
  function search(from, to, n, other, x, y, l) {
    const scale = [from.width / data.size[n][0], to.width / data.size[other][0]];
    const wanted = windowAt(from, x * scale[0], y * scale[0]), ends = clip(l, data.size[other]);
    if (!wanted || !ends) return { values: [], best: null };
    const length = Math.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]), steps = Math.max(2, Math.round(length * scale[1]));
    const values = [];
    for (let s = 0; s <= steps; s++) {
      const px = ends[0][0] + ((ends[1][0] - ends[0][0]) * s) / steps, py = ends[0][1] + ((ends[1][1] - ends[0][1]) * s) / steps;
      const there = windowAt(to, px * scale[1], py * scale[1]);
      let value = NaN;
      if (there) { value = 0; for (let i = 0; i < there.length; i++) value += there[i] * wanted[i]; }
      values.push({ x: px, y: py, value });
    }
    let best = null, at = 0, rival = 0;
    values.forEach((v, s) => { if (v.value > (best ? best.value : -1)) { best = v; at = s; } });
    values.forEach((v, s) => { if (Math.abs(s - at) > 2 * HALF && v.value > rival) rival = v.value; });
    return { values, best, rival };
  }
  function drawCurve(canvas, { values, best }) {
    const c = canvas.getContext("2d"), w = canvas.width, h = canvas.height;
    c.clearRect(0, 0, w, h);
    c.strokeStyle = "#8886"; c.lineWidth = 1; c.fillStyle = "#888"; c.font = "13px system-ui,sans-serif";
    [1, 0.5, 0].forEach((value) => {
      const y = 8 + (1 - value) * (h - 30);
      c.beginPath(); c.moveTo(34, y); c.lineTo(w, y); c.stroke(); c.fillText(String(value), 6, y + 4);
    });
    c.fillText("correlation of a window of 15 x 15 shown pixels along the epipolar line", 40, h - 4);
    c.beginPath();
    let open = false;
    values.forEach(({ value }, s) => {
      const x = 34 + (s / Math.max(values.length - 1, 1)) * (w - 36), y = 8 + (1 - Math.max(value, 0)) * (h - 30);
      if (Number.isNaN(value)) { open = false; return; }
      if (open) c.lineTo(x, y); else c.moveTo(x, y);
      open = true;
    });
    c.strokeStyle = BLUE; c.lineWidth = 1.5; c.stroke();
    if (best) {
      const x = 34 + (values.indexOf(best) / Math.max(values.length - 1, 1)) * (w - 36), y = 8 + (1 - best.value) * (h - 30);
      c.beginPath(); c.arc(x, y, 4, 0, 7); c.fillStyle = GREEN; c.fill();
    }
  }

  // ---- the four poses: the same drag turns all of them
  const turn = { yaw: -0.6, pitch: 0.45 }, clouds = [];
  function showCloud(canvas) {
    const pose = data.poses[Number(canvas.dataset.pose)], c = canvas.getContext("2d");
    const reach = data.reach, r = pose.rotation, t = pose.translation;
    // R^T v, and the centre -R^T t of camera 2 in the frame of camera 1
    const turned = (v) => [0, 1, 2].map((i) => r[0][i] * v[0] + r[1][i] * v[1] + r[2][i] * v[2]);
    const center = turned(t).map((v) => -v);
    const size = 0.12 * reach, shape = [[-1, -0.75, 1.3], [1, -0.75, 1.3], [1, 0.75, 1.3], [-1, 0.75, 1.3]].map((p) => p.map((v) => v * size));
    const cameras = [
      { color: BLUE, apex: [0, 0, 0], corners: shape },
      { color: RED, apex: center, corners: shape.map((p) => turned(p).map((v, i) => v + center[i])) },
    ];
    function draw() {
      const w = canvas.width, h = canvas.height, [sy, cy] = [Math.sin(turn.yaw), Math.cos(turn.yaw)], [sp, cp] = [Math.sin(turn.pitch), Math.cos(turn.pitch)];
      const zoom = 0.5 * Math.min(w, h) / reach;
      const to = ([x, y, z]) => {
        const a = cy * x + sy * z, b = -sy * x + cy * z;
        return [w / 2 + zoom * a, h / 2 + zoom * (cp * y - sp * b)];
      };
      c.clearRect(0, 0, w, h);
      pose.points.forEach(([x, y, z, front]) => {
        const [u, v] = to([x, y, z]);
        c.fillStyle = front ? GREEN : "#e58a2d"; c.fillRect(u - 1.2, v - 1.2, 2.4, 2.4);
      });
      cameras.forEach(({ color, apex, corners }) => {
        const a = to(apex), ps = corners.map(to);
        c.strokeStyle = color; c.lineWidth = 2; c.beginPath();
        ps.forEach((p, i) => { c.moveTo(...a); c.lineTo(...p); c.lineTo(...ps[(i + 1) % 4]); });
        c.stroke();
      });
    }
    let from = null;
    canvas.addEventListener("pointerdown", (e) => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { from = null; });
    canvas.addEventListener("pointermove", (e) => {
      if (!from) return;
      turn.yaw += (e.clientX - from[0]) * 0.01;
      turn.pitch = Math.max(-1.5, Math.min(1.5, turn.pitch + (e.clientY - from[1]) * 0.01));
      from = [e.clientX, e.clientY];
      clouds.forEach((again) => again());
    });
    clouds.push(draw);
    draw();
  }

  const SHOWS = { keypoints: showKeypoints, matches: showMatches, lines: showLines };
  Promise.all(photos.map((photo) => photo.decode())).then(() => {
    document.querySelectorAll("canvas[data-show]").forEach((canvas) => SHOWS[canvas.dataset.show](canvas));
    document.querySelectorAll("canvas[data-pose]").forEach(showCloud);
  });
})();
