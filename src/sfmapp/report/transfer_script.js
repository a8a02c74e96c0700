"use strict";
// Draws what the page of a transfer shows: a point of photographs 1 and 2, and where it is in photograph 3.
(() => {
  const data = JSON.parse(document.getElementById("transfer-data").textContent);
  const photos = [1, 2, 3].map((n) => document.getElementById("photo" + n));
  const canvases = [1, 2, 3].map((n) => document.getElementById("view" + n));
  const said = document.getElementById("transfer-said");
  const BLUE = "#4a9bff", YELLOW = "#ffd23f", RED = "#e5392d", GREEN = "#2fbf5b", GREY = "#ccc8";
  const state = { one: null, two: null, shown: 0 };

  const times = (m, x) => m.map((row) => row.reduce((sum, v, k) => sum + v * x[k], 0));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (l) => { const s = Math.hypot(l[0], l[1]); return l.map((v) => v / s); };
  const flat = (x) => [x[0] / x[2], x[1] / x[2]];

  // the part of a line a x + b y + c = 0 that lies in a picture
  function clip([a, b, c], [w, h]) {
    const ends = [];
    if (b) [0, w].forEach((x) => { const y = -(a * x + c) / b; if (y >= 0 && y <= h) ends.push([x, y]); });
    if (a) [0, h].forEach((y) => { const x = -(b * y + c) / a; if (x >= 0 && x <= w) ends.push([x, y]); });
    return ends.length > 1 ? [ends[0], ends[ends.length - 1]] : null;
  }
  class View {
    constructor(n) {
      this.n = n; this.size = data.size[n]; this.context = canvases[n].getContext("2d");
      this.scale = 900 / this.size[0];
      canvases[n].width = 900; canvases[n].height = Math.round(this.size[1] * this.scale);
      canvases[n].addEventListener("click", (event) => {
        const box = canvases[n].getBoundingClientRect();
        clicked(n, (event.clientX - box.left) / box.width * this.size[0], (event.clientY - box.top) / box.height * this.size[1]);
      });
    }
    clear() { this.context.drawImage(photos[this.n], 0, 0, canvases[this.n].width, canvases[this.n].height); }
    line(l, color, width) {
      const ends = clip(l, this.size), c = this.context;
      if (!ends) return;
      c.beginPath(); ends.forEach(([x, y], k) => c[k ? "lineTo" : "moveTo"](x * this.scale, y * this.scale));
      c.lineWidth = width || 2; c.strokeStyle = color; c.stroke();
    }
    mark([x, y], color, radius, filled) {
      const c = this.context;
      c.beginPath(); c.arc(x * this.scale, y * this.scale, radius, 0, 7);
      if (filled) { c.fillStyle = color; c.fill(); c.strokeStyle = "#000a"; c.lineWidth = 1; } else { c.strokeStyle = color; c.lineWidth = 3; }
      c.stroke();
    }
  }
  const views = [0, 1, 2].map((n) => new View(n));

  function draw() {
    views.forEach((view) => view.clear());
    views[2].line(data.plane, GREY, 6);
    if (!state.one) { said.textContent = "Click into photograph 1."; return; }
    const x1 = [...state.one, 1], l2 = unit(times(data.f21, x1)), l3 = unit(times(data.f31, x1));
    views[0].mark(state.one, BLUE, 6, true);
    views[1].line(l2, BLUE); views[2].line(l3, BLUE);
    if (!state.two) { said.textContent = "Its partner is on the blue line of photograph 2: click there."; return; }
    const x2 = [...state.two, 1], m3 = unit(times(data.f32, x2));
    views[1].mark(state.two, YELLOW, 6, true); views[2].line(m3, YELLOW);
    const angle = Math.asin(Math.min(1, Math.abs(l3[0] * m3[1] - l3[1] * m3[0]))) * 180 / Math.PI;
    const byLines = flat(cross(l3, m3));
    // through x2 at right angles to its epipolar line
    const across = [l2[1], -l2[0], state.two[1] * l2[0] - state.two[0] * l2[1]];
    const byTensor = flat([0, 1, 2].map((k) => x1.reduce((sum, v, i) => sum + v * across.reduce((s, w, j) => s + w * data.tensor[i][j][k], 0), 0)));
    // offsets of both lines by the noise of their points, and by F's own sigma, at the angle between them
    const reach = data.line_sigma / Math.sin(angle * Math.PI / 180);
    const refused = !(reach < data.limit);
    views[2].mark(byLines, refused ? RED : YELLOW, 11, false); views[2].mark(byTensor, GREEN, 6, true);
    said.innerHTML = `The lines cross at ${angle.toFixed(1)}&deg;: ${refused ? "<b>transfer by lines is refused</b>, about " + (Number.isFinite(reach) ? reach.toFixed(1) : "any number of") + " px uncertain so near the trifocal plane" : "ring at (" + byLines.map((v) => v.toFixed(1)) + "), good to " + reach.toFixed(1) + " px"}. By the tensor: green dot at (${byTensor.map((v) => v.toFixed(1))}).`;
  }
  function clicked(n, x, y) {
    if (n === 0) { state.one = [x, y]; state.two = null; }
    if (n === 1 && state.one) {
      const l = unit(times(data.f21, [...state.one, 1])), off = l[0] * x + l[1] * y + l[2];
      state.two = [x - off * l[0], y - off * l[1]];
    }
    draw();
  }
  function show(step) {
    if (!data.matches.length) return;
    state.shown = (state.shown + step + data.matches.length) % data.matches.length;
    const m = data.matches[state.shown];
    state.one = [m[0], m[1]]; state.two = [m[2], m[3]];
    draw();
  }
  document.getElementById("next-match").addEventListener("click", () => show(1));
  const start = () => show(0);
  if (photos.every((photo) => photo.complete)) start(); else window.addEventListener("load", start);
})();
