"use strict";
// Draws the figures from the JSON of the page.
(async function () {
  try {
    const library = document.createElement("script");
    library.textContent = await unpacked("plotly");
    document.body.append(library);
  } catch (error) {
    document.querySelectorAll(".plot:not(#model-figure)").forEach(function (element) { fail(element, error); });
    return;
  }
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const bar = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["resetCameraLastSave3d", "hoverClosest3d", "pan2d", "select2d", "lasso2d", "zoom2d", "zoomIn2d", "zoomOut2d", "autoScale2d", "resetScale2d"] };

  const START = [0.35, -1.45, 0.6];
  const FIELD = 0.9 * Math.tan(Math.PI / 8);  // plotly.js has a vertical field of view of 45 degrees; 10 % margin

  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }
  function unit(a) { const n = Math.sqrt(dot(a, a)); return a.map(function (v) { return v / n; }); }

  // Some vertices of a trace along three axes, in plotly.js camera coordinates.
  function vertices(figure, trace, axes) {
    const box = figure.layout.scene, found = [];
    const step = Math.max(1, Math.floor(trace.x.length / 1500));
    for (let n = 0; n < trace.x.length; n += step) {
      if (trace.x[n] === null) { continue; }
      const p = ["x", "y", "z"].map(function (name) {
        const range = box[name + "axis"].range;
        return ((trace[name][n] - range[0]) / (range[1] - range[0]) - 0.5) * box.aspectratio[name];
      });
      found.push(axes.map(function (axis) { return dot(p, axis); }));
    }
    return found;
  }

  // The nearest eye in a direction that shows every camera and 99 % of the points.
  function camera(element, figure, direction) {
    const back = unit(direction), right = unit(cross([0, 0, 1], back)), up = cross(back, right);
    // Each model has three traces: points, pyramids, centres.
    const all = function (kind) {
      return figure.data.filter(function (_, n) { return n % 3 === kind; })
        .flatMap(function (trace) { return vertices(figure, trace, [right, up, back]); });
    };
    const points = all(0), pyramids = all(1);
    const fields = [FIELD * element.clientWidth / Math.max(element.clientHeight, 1), FIELD];
    // Positions of the eye along axis d from which everything lies within the field of view.
    function bounds(distance, d) {
      function ends(seen, outliers) {
        const low = seen.map(function (p) { return p[d] - fields[d] * (distance - p[2]); });
        const high = seen.map(function (p) { return p[d] + fields[d] * (distance - p[2]); });
        low.sort(function (a, b) { return b - a; });
        high.sort(function (a, b) { return a - b; });
        return seen.length > 0 ? [low[outliers], high[outliers]] : [-Infinity, Infinity];
      }
      const a = ends(points, Math.floor(0.01 * points.length)), b = ends(pyramids, 0);
      return [Math.max(a[0], b[0]), Math.min(a[1], b[1])];
    }
    let near = 0, far = 20;
    for (let n = 0; n < 20; n += 1) {
      const middle = (near + far) / 2;
      const fits = [0, 1].every(function (d) { const b = bounds(middle, d); return b[0] <= b[1]; });
      if (fits) { far = middle; } else { near = middle; }
    }
    const across = bounds(far, 0), along = bounds(far, 1);
    const shift = [(across[0] + across[1]) / 2, (along[0] + along[1]) / 2];
    const centre = [0, 1, 2].map(function (k) { return shift[0] * right[k] + shift[1] * up[k]; });
    const eye = centre.map(function (v, k) { return v + far * back[k]; });
    return { eye: { x: eye[0], y: eye[1], z: eye[2] }, center: { x: centre[0], y: centre[1], z: centre[2] }, up: { x: 0, y: 0, z: 1 } };
  }

  function fail(element, error) {
    element.classList.add("broken");
    element.textContent = "This browser could not draw the figure: " + error.message;
  }

  Object.keys(figures).forEach(function (id) {
    const element = document.getElementById(id);
    if (element.classList.contains("scene")) {
      figures[id].layout.scene.camera = camera(element, figures[id], START);
      if (element.clientWidth < 600) { figures[id].data[0].marker.size = 1.2; figures[id].data[2].marker.size = 2.5; }
    }
    const cells = figures[id].data[0];
    if (id === "matrix-figure" && element.clientWidth < 36 * cells.x.length) {
      figures[id].data.forEach(function (trace) { delete trace.texttemplate; });
    }
    const options = Object.assign({}, bar, element.classList.contains("scene") ? {} : { displayModeBar: false });
    try {
      Plotly.newPlot(element, figures[id].data, figures[id].layout, options).then(
        function () { element.dataset.drawn = "yes"; },
        function (error) { fail(element, error); });
    } catch (error) {
      fail(element, error);
    }
  });

  // The wheel scrolls the page until the figure is clicked.
  document.querySelectorAll(".plot.scene").forEach(function (scene) {
    let active = false;
    scene.addEventListener("pointerdown", function () { active = true; });
    document.addEventListener("pointerdown", function (event) { if (!scene.contains(event.target)) { active = false; } });
    scene.addEventListener("wheel", function (event) { if (!active) { event.stopPropagation(); } }, { capture: true });
  });

  const scene = document.getElementById("scene-figure");
  if (scene === null) { return; }

  document.querySelectorAll("button[data-eye]").forEach(function (button) {
    button.addEventListener("click", function () {
      const eye = button.dataset.eye.split(",").map(Number);
      Plotly.relayout(scene, { "scene.camera": camera(scene, figures["scene-figure"], eye) });
    });
  });
})();
