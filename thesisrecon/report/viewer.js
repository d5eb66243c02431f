"use strict";
// Shows the model from the JSON of the page with WebGL 2.
(function () {
  const data = JSON.parse(document.getElementById("model-data").textContent);
  const stage = document.getElementById("model-figure"), canvas = stage.querySelector("canvas");
  const select = document.getElementById("model-viewpoint");
  const paintButtons = Array.from(document.querySelectorAll("button[data-paint]"));
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (gl === null) {
    return fail("This browser cannot show the model: it has no WebGL 2. Open the file model.glb beside this page in a 3D viewer.");
  }

  const VERTEX = `#version 300 es
    in vec3 position; in vec2 uv; in vec3 color;
    uniform vec3 low, extent; uniform mat4 view, projection;
    out vec3 place, paint; out vec2 at;
    void main() {
      vec4 seen = view * vec4(low + extent * position, 1.0);
      place = seen.xyz; paint = color; at = uv;
      gl_Position = projection * seen;
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 place, paint; in vec2 at;
    uniform sampler2D picture; uniform bool textured, shape;
    out vec4 shown;
    void main() {
      vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
      float lit = 0.18 + 0.82 * max(dot(normal, normalize(vec3(-0.35, 0.5, 0.8))), 0.0);
      vec3 own = textured ? texture(picture, at).rgb : paint;
      vec3 colour = shape ? vec3(0.86, 0.88, 0.90) * lit : own;
      // Back faces are translucent, so that a courtyard can be seen from outside.
      shown = gl_FrontFacing ? vec4(colour, 1.0) : vec4(vec3(0.42, 0.52, 0.62) * lit, 0.25);
    }`;
  const TAN_HALF_FIELD = Math.tan(Math.PI / 8);  // tangent of half the vertical field of view
  const reducedMotion = window.matchMedia("(prefers-reduced-motion: reduce)");
  const samples = sampleVertices(3000), radius = modelRadius();
  let pose = null, shape = false, textured = false, ready = false, waiting = false, moving = 0;
  let place = null;

  // ---- vectors ----
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function add(a, b, s) { return [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]; }
  function axes(p) {
    const c = Math.cos(p.pitch), s = Math.sin(p.pitch), x = Math.cos(p.yaw), y = Math.sin(p.yaw);
    return { right: [-y, x, 0], up: [-s * x, -s * y, c], back: [c * x, c * y, s] };
  }
  function towards(direction) {
    return { yaw: Math.atan2(direction[1], direction[0]), pitch: Math.asin(direction[2] / Math.hypot(...direction)) };
  }
  function clamp(value, low, high) { return Math.min(Math.max(value, low), high); }
  function quantile(values, share) {
    values.sort(function (a, b) { return a - b; });
    return values[Math.round(share * (values.length - 1))];
  }
  function share(points, d, part) { return quantile(points.map(function (p) { return p[d]; }), part); }

  // ---- the model ----
  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let n = 0; n < raw.length; n += 1) { out[n] = raw.charCodeAt(n); }
    return out;
  }
  function sampleVertices(most) {
    const q = new Uint16Array(bytes(data.positions).buffer), found = [];
    const step = Math.max(1, Math.floor(q.length / 3 / most));
    for (let n = 0; n < q.length; n += 3 * step) {
      found.push([0, 1, 2].map(function (d) { return data.low[d] + q[n + d] / 65535 * (data.high[d] - data.low[d]); }));
    }
    return found;
  }
  function modelRadius() {
    const spans = [0, 1, 2].map(function (d) { return share(samples, d, 0.99) - share(samples, d, 0.01); });
    return Math.hypot(...spans) / 2 || 1;
  }
  function compiled(kind, text) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    return shader;
  }
  function attribute(program, name, values, size, type) {
    const index = gl.getAttribLocation(program, name);
    if (index < 0) { return; }
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, bytes(values), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, size, type, true, 0, 0);
  }
  function upload() {
    const program = gl.createProgram();
    gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      if (gl.isContextLost()) { return; }
      return fail("This browser could not draw the model: " + gl.getProgramInfoLog(program));
    }
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    attribute(program, "position", data.positions, 3, gl.UNSIGNED_SHORT);
    if (data.uv) { attribute(program, "uv", data.uv, 2, gl.UNSIGNED_SHORT); }
    if (data.colors) { attribute(program, "color", data.colors, 3, gl.UNSIGNED_BYTE); }
    const indices = bytes(data.indices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    place = { count: indices.length / 4 };
    ["low", "extent", "view", "projection", "textured", "shape"].forEach(function (name) {
      place[name] = gl.getUniformLocation(program, name);
    });
    gl.uniform3fv(place.low, data.low);
    gl.uniform3fv(place.extent, data.high.map(function (v, d) { return v - data.low[d]; }));
    if (!data.texture) { ready = true; return redraw(); }
    const image = new Image();
    image.onload = function () { uploadTexture(image); ready = textured = true; redraw(); };
    image.onerror = function () { fail("This browser could not read the texture of the model."); };
    image.src = data.texture;
  }
  function uploadTexture(image) {
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    let source = image;
    if (Math.max(image.width, image.height) > most) {
      source = document.createElement("canvas");
      source.width = Math.min(image.width, most);
      source.height = Math.min(image.height, most);
      source.getContext("2d").drawImage(image, 0, 0, source.width, source.height);
    }
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, source);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameterf(gl.TEXTURE_2D, gl.TEXTURE_MAX_LOD, 2);  // higher levels mix neighbours in the atlas
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  // ---- poses: target, yaw, pitch, distance, field of view ----
  function aspect() { return Math.max(stage.clientWidth, 1) / Math.max(stage.clientHeight, 1); }
  function poseOf(viewpoint) {
    const back = viewpoint.eye.map(function (v, d) { return v - viewpoint.target[d]; });
    const field = Math.max(viewpoint.field[1], viewpoint.field[0] / aspect());
    return Object.assign({ target: viewpoint.target, distance: Math.hypot(...back), field: field }, towards(back));
  }
  // Fit nearly all of the model into the view from a direction.
  function fitted(direction) {
    const p = towards(direction), a = axes(p), fields = [TAN_HALF_FIELD * aspect(), TAN_HALF_FIELD];
    const seen = samples.map(function (v) { return [dot(v, a.right), dot(v, a.up), dot(v, a.back)]; });
    const middle = [0, 1, 2].map(function (d) { return (share(seen, d, 0.01) + share(seen, d, 0.99)) / 2; });
    let distance = 0;
    for (let round = 0; round < 6; round += 1) {
      const need = seen.map(function (v) {
        return v[2] - middle[2] + Math.max(Math.abs(v[0] - middle[0]) / fields[0], Math.abs(v[1] - middle[1]) / fields[1]);
      });
      distance = Math.max(quantile(need, 0.985), 0.05 * radius);
      const flat = seen.map(function (v) {
        const deep = Math.max(distance - (v[2] - middle[2]), 0.05 * distance);
        return [(v[0] - middle[0]) / deep, (v[1] - middle[1]) / deep];
      });
      [0, 1].forEach(function (d) { middle[d] += distance * (share(flat, d, 0.01) + share(flat, d, 0.99)) / 2; });
    }
    const target = add(add(add([0, 0, 0], a.right, middle[0]), a.up, middle[1]), a.back, middle[2]);
    return Object.assign({ target: target, distance: 1.04 * distance, field: TAN_HALF_FIELD }, p);
  }
  function moveTo(end) {
    cancelAnimationFrame(moving);
    if (reducedMotion.matches || pose === null) { pose = end; return redraw(); }
    const from = pose, began = performance.now();
    const turn = Math.atan2(Math.sin(end.yaw - from.yaw), Math.cos(end.yaw - from.yaw));
    function step(now) {
      const t = clamp((now - began) / 450, 0, 1), s = t * t * (3 - 2 * t);
      pose = {
        target: from.target.map(function (v, d) { return v + s * (end.target[d] - v); }),
        yaw: from.yaw + s * turn, pitch: from.pitch + s * (end.pitch - from.pitch),
        distance: from.distance * Math.pow(end.distance / from.distance, s), field: from.field + s * (end.field - from.field),
      };
      redraw();
      if (t < 1) { moving = requestAnimationFrame(step); }
    }
    moving = requestAnimationFrame(step);
  }
  function applyChange(change) {
    cancelAnimationFrame(moving);
    select.value = "";
    const next = Object.assign({}, pose, change);
    next.pitch = clamp(next.pitch, -1.55, 1.55);
    next.distance = clamp(next.distance, 0.02 * radius, 12 * radius);
    pose = next;
    redraw();
  }
  function turn(dx, dy) { applyChange({ yaw: pose.yaw - 0.006 * dx, pitch: pose.pitch + 0.006 * dy }); }
  function zoom(factor) { applyChange({ distance: pose.distance * factor }); }
  function shift(dx, dy) {
    const a = axes(pose), s = 2 * pose.field * pose.distance / Math.max(stage.clientHeight, 1);
    applyChange({ target: add(add(pose.target, a.right, -s * dx), a.up, s * dy) });
  }

  // ---- drawing, only when something changed ----
  function redraw() {
    if (!waiting) { waiting = true; requestAnimationFrame(draw); }
  }
  function draw() {
    waiting = false;
    if (!ready || pose === null || gl.isContextLost()) { return; }
    const a = axes(pose), eye = add(pose.target, a.back, pose.distance);
    const far = pose.distance + 6 * radius, near = 0.002 * far, f = 1 / pose.field;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.075, 0.102, 0.133, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const r = a.right, u = a.up, b = a.back;
    gl.uniformMatrix4fv(place.view, false, [r[0], u[0], b[0], 0, r[1], u[1], b[1], 0, r[2], u[2], b[2], 0, -dot(r, eye), -dot(u, eye), -dot(b, eye), 1]);
    gl.uniformMatrix4fv(place.projection, false, [f / aspect(), 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) / (near - far), -1, 0, 0, 2 * near * far / (near - far), 0]);
    gl.uniform1i(place.textured, textured ? 1 : 0);
    gl.uniform1i(place.shape, shape ? 1 : 0);
    gl.cullFace(gl.BACK);
    gl.drawElements(gl.TRIANGLES, place.count, gl.UNSIGNED_INT, 0);
    gl.cullFace(gl.FRONT);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    gl.drawElements(gl.TRIANGLES, place.count, gl.UNSIGNED_INT, 0);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    stage.dataset.drawn = "yes";
  }
  function resized() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(ratio * stage.clientWidth));
    canvas.height = Math.max(1, Math.round(ratio * stage.clientHeight));
    if (select.value !== "") { pose = poseOf(data.viewpoints[Number(select.value)]); }
    waiting = false;
    draw();  // at once: resizing clears the canvas
  }
  function fail(words) {
    stage.classList.add("broken");
    stage.textContent = words;
    document.querySelectorAll(".of-model").forEach(function (element) { element.hidden = true; });
  }
  function setShape(bare) {
    shape = bare;
    paintButtons.forEach(function (button) { button.setAttribute("aria-pressed", String((button.dataset.paint === "shape") === bare)); });
    redraw();
  }
  function reset() { select.value = String(data.start); setShape(false); moveTo(poseOf(data.viewpoints[data.start])); }

  // ---- input: until the canvas is clicked, the wheel and vertical swipes scroll the page ----
  const down = new Map();
  function awake(on) { stage.classList.toggle("awake", on); }
  canvas.addEventListener("pointerdown", function (event) {
    down.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", function (event) {
    const before = down.get(event.pointerId);
    if (before === undefined) { return; }
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    if (down.size === 2) {
      const other = Array.from(down.entries()).find(function (entry) { return entry[0] !== event.pointerId; })[1];
      zoom(Math.hypot(before[0] - other[0], before[1] - other[1]) / Math.max(Math.hypot(now[0] - other[0], now[1] - other[1]), 1));
      shift(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons > 1) { shift(dx, dy); } else { turn(dx, dy); }
    down.set(event.pointerId, now);
  });
  ["pointerup", "pointercancel"].forEach(function (name) {
    canvas.addEventListener(name, function (event) { down.delete(event.pointerId); if (name === "pointerup") { awake(true); } });
  });
  document.addEventListener("pointerdown", function (event) { if (event.target !== canvas) { awake(false); } });
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("wheel", function (event) {
    if (!stage.classList.contains("awake")) { return; }
    event.preventDefault();
    zoom(Math.exp(clamp((event.deltaMode === 0 ? 1 : 30) * event.deltaY, -200, 200) * 0.0015));
  }, { passive: false });
  const KEYS = {
    ArrowLeft: function () { turn(-25, 0); }, ArrowRight: function () { turn(25, 0); },
    ArrowUp: function () { turn(0, -25); }, ArrowDown: function () { turn(0, 25); },
    "+": function () { zoom(0.87); }, "=": function () { zoom(0.87); }, "-": function () { zoom(1.15); },
    Home: reset, "0": reset, t: function () { setShape(!shape); },
  };
  canvas.addEventListener("keydown", function (event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) { return; }
    event.preventDefault();
    KEYS[event.key]();
  });
  document.querySelectorAll("button[data-direction]").forEach(function (button) {
    button.addEventListener("click", function () { select.value = ""; moveTo(fitted(data.directions[Number(button.dataset.direction)].from)); });
  });
  paintButtons.forEach(function (button) { button.addEventListener("click", function () { setShape(button.dataset.paint === "shape"); }); });
  select.addEventListener("change", function () { if (select.value !== "") { moveTo(poseOf(data.viewpoints[Number(select.value)])); } });
  document.getElementById("model-reset").addEventListener("click", reset);
  canvas.addEventListener("webglcontextlost", function (event) { event.preventDefault(); ready = false; });
  canvas.addEventListener("webglcontextrestored", upload);

  pose = poseOf(data.viewpoints[data.start]);
  select.value = String(data.start);
  new ResizeObserver(resized).observe(stage);
  upload();
})();
