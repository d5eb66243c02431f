"use strict";
// Draws the figures of the page from the JSON beside this script.
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const bar = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["resetCameraLastSave3d", "hoverClosest3d", "pan2d", "select2d", "lasso2d", "zoom2d", "zoomIn2d", "zoomOut2d", "autoScale2d", "resetScale2d"] };

  const START = [0.35, -1.45, 0.6];

  // The angle of view is vertical, so a narrow picture is seen from farther away.
  function camera(element, eye) {
    const away = Math.max(1, 1.45 * element.clientHeight / Math.max(element.clientWidth, 1));
    return { eye: { x: away * eye[0], y: away * eye[1], z: away * eye[2] }, center: { x: 0, y: 0, z: -0.05 }, up: { x: 0, y: 0, z: 1 } };
  }

  function fail(element, error) {
    element.classList.add("broken");
    element.textContent = "This browser could not draw the figure: " + error.message;
  }

  Object.keys(figures).forEach(function (id) {
    const element = document.getElementById(id);
    if (id === "scene-figure") { figures[id].layout.scene.camera = camera(element, START); }
    const options = Object.assign({}, bar, id === "matrix-figure" ? { displayModeBar: false } : {});
    try {
      Plotly.newPlot(element, figures[id].data, figures[id].layout, options).then(
        function () { element.dataset.drawn = "yes"; },
        function (error) { fail(element, error); });
    } catch (error) {
      fail(element, error);
    }
  });

  const scene = document.getElementById("scene-figure");
  if (scene === null) { return; }

  // A wheel over the picture scrolls the page until the picture was clicked.
  let active = false;
  scene.addEventListener("pointerdown", function () { active = true; });
  document.addEventListener("pointerdown", function (event) { if (!scene.contains(event.target)) { active = false; } });
  scene.addEventListener("wheel", function (event) { if (!active) { event.stopPropagation(); } }, { capture: true });

  document.querySelectorAll("button[data-eye]").forEach(function (button) {
    button.addEventListener("click", function () {
      const eye = button.dataset.eye.split(",").map(Number);
      Plotly.relayout(scene, { "scene.camera": camera(scene, eye) });
    });
  });
})();
