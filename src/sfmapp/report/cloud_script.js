"use strict";
// Draws point clouds that can be turned by dragging, and scaled by the wheel.
(() => {
  const data = JSON.parse(document.getElementById("cloud-data").textContent);
  document.querySelectorAll("canvas[data-cloud]").forEach((canvas) => {
    const points = data[canvas.dataset.cloud];
    const centers = canvas.dataset.cloud === "metric" ? data.centers : [];
    const size = 620, context = canvas.getContext("2d");
    canvas.width = canvas.height = size;
    const reach = Math.max(1, ...centers.map((c) => Math.hypot(...c)));
    let yaw = 0.6, pitch = -0.4, zoom = 0.42 / reach, from = null;
    function at([x, y, z]) {
      const u = x * Math.cos(yaw) + z * Math.sin(yaw), w = -x * Math.sin(yaw) + z * Math.cos(yaw);
      return [size * (0.5 + zoom * u), size * (0.5 + zoom * (y * Math.cos(pitch) - w * Math.sin(pitch))), y * Math.sin(pitch) + w * Math.cos(pitch)];
    }
    function draw() {
      context.clearRect(0, 0, size, size);
      const shown = points.map((p, k) => [...at(p), k]).sort((a, b) => b[2] - a[2]);
      shown.forEach(([x, y, , k]) => { context.fillStyle = `rgb(${data.rgb[k]})`; context.fillRect(x, y, 2, 2); });
      context.fillStyle = "#ff5548";
      centers.forEach((c) => { const [x, y] = at(c); context.fillRect(x - 2.5, y - 2.5, 5, 5); });
    }
    canvas.addEventListener("pointerdown", (e) => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { from = null; });
    canvas.addEventListener("pointermove", (e) => {
      if (!from) return;
      yaw += (e.clientX - from[0]) / 150; pitch += (e.clientY - from[1]) / 150; from = [e.clientX, e.clientY];
      draw();
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom *= Math.exp(-e.deltaY / 600); draw(); }, { passive: false });
    draw();
  });
})();
