"use strict";
// Puts a lens that can be turned in the place of its picture.  The picture stays where this cannot draw, and on paper.
// Nothing moves by itself, so there is nothing to still for those who asked for less motion.
(() => {
  const STEP = Math.PI / 36, NEARER = 1.25, FARTHEST = 0.6, NEAREST = 8, CLOSE = 1.5, FILLED = 0.92;
  const UPRIGHT = 1.55, MOST_PIXELS = 2; // radians; device pixels a pixel of the page

  // Positions in mm, seen from `distance` along the axis `turn[2]` of the eye; `focal` is 1 / tan(half the angle).
  const VERTEX = `#version 300 es
    layout(location = 0) in vec3 place;
    layout(location = 1) in vec3 normal;
    uniform mat3 turn;
    uniform vec3 centre;
    uniform vec2 focal, shift;
    uniform float distance, reach;
    out vec3 seen, facing;
    void main() {
      seen = turn * (place - centre) - vec3(0.0, 0.0, distance);
      facing = turn * normal;
      float near = distance - 0.55 * reach, far = distance + 0.55 * reach;
      float depth = ((near + far) * seen.z + 2.0 * near * far) / (near - far);
      gl_Position = vec4(focal * seen.xy - shift * seen.z, depth, -seen.z);
    }`;

  // The same clay under the same lamps as in the picture.
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 seen, facing;
    uniform vec3 clay, lamps[3], finish;
    uniform float bright[3], gloss;
    out vec4 colour;
    void main() {
      vec3 normal = normalize(facing), eye = normalize(-seen), light = finish.x * clay;
      for (int i = 0; i < 3; i++) {
        float cosine = max(dot(normal, lamps[i]), 0.0);
        float shine = cosine > 0.0 ? pow(max(dot(reflect(-lamps[i], normal), eye), 0.0), gloss) : 0.0;
        light += bright[i] * (finish.y * cosine * clay + finish.z * shine);
      }
      colour = vec4(min(light, 1.0), 1.0);
    }`;

  // Triangles of the faces and of the wall between their rims, six numbers a corner: place and normal.
  function meshOf(solid) {
    const bytes = Uint8Array.from(atob(solid.values), (letter) => letter.charCodeAt(0));
    const values = new Uint16Array(bytes.buffer);
    const mesh = { corners: [], triangles: [] };
    const place = (axis, value) => solid.low[axis] + (solid.size[axis] * value) / 65535;
    let at = 0;
    for (const face of solid.faces) {
      const side = face.cells + 1, count = side * side, first = mesh.corners.length / 6;
      const slope = (value) => face.steepest * ((2 * value) / 65535 - 1);
      const part = (k) => values.subarray(at + k * count, at + (k + 1) * count);
      const [x, y, z, alongX, alongY] = [0, 1, 2, 3, 4].map(part);
      for (let i = 0; i < count; i++) {
        const normal = [-face.up * slope(alongX[i]), -face.up * slope(alongY[i]), face.up];
        const length = Math.hypot(...normal);
        mesh.corners.push(place(0, x[i]), place(1, y[i]), place(2, z[i]), ...normal.map((part) => part / length));
      }
      for (let i = 0; i < face.cells; i++) {
        for (let j = 0; j < face.cells; j++) {
          const a = first + i * side + j, b = a + side, c = b + 1, d = a + 1;
          const rising = i < face.cells / 2 === j < face.cells / 2; // along the diagonal that points to the middle
          const two = rising ? [a, b, c, a, c, d] : [a, b, d, b, c, d]; // counterclockwise from above
          mesh.triangles.push(...(face.up > 0 ? two : two.reverse()));
        }
      }
      at += 5 * count;
    }
    const rim = (k) => values.subarray(at + k * solid.rim, at + (k + 1) * solid.rim);
    const [x, y, low, high] = [0, 1, 2, 3].map(rim);
    for (let i = 0; i < solid.rim; i++) {
      const next = (i + 1) % solid.rim, first = mesh.corners.length / 6;
      const [x0, x1, y0, y1] = [place(0, x[i]), place(0, x[next]), place(1, y[i]), place(1, y[next])];
      const length = Math.hypot(x1 - x0, y1 - y0) || 1, normal = [(y1 - y0) / length, (x0 - x1) / length, 0];
      mesh.corners.push(x0, y0, place(2, low[i]), ...normal, x1, y1, place(2, low[next]), ...normal);
      mesh.corners.push(x1, y1, place(2, high[next]), ...normal, x0, y0, place(2, high[i]), ...normal);
      mesh.triangles.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
    return mesh;
  }

  // A program that draws the mesh; null where there is no WebGL 2.
  function painter(canvas, solid) {
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }); // kept: it may be printed
    if (!gl) return null;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
    gl.useProgram(program);
    const mesh = meshOf(solid);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(mesh.corners), gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(mesh.triangles), gl.STATIC_DRAW);
    for (const [index, offset] of [[0, 0], [1, 12]]) {
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, 3, gl.FLOAT, false, 24, offset);
    }
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE); // or the far wall's rim would shine through along the edge before it
    const name = (text) => gl.getUniformLocation(program, text);
    const reach = Math.hypot(...solid.size), distance = reach * Math.hypot(...solid.eye);
    const start = axesOf(...anglesOf(solid.eye)); // the lamps stay with the eye: what is turned catches the light anew
    gl.uniform3fv(name("centre"), solid.low.map((low, k) => low + solid.size[k] / 2));
    gl.uniform3fv(name("clay"), solid.clay);
    gl.uniform3fv(name("finish"), [solid.ambient, solid.diffuse, solid.specular]);
    gl.uniform3fv(name("lamps"), solid.lamps.flatMap((lamp) => through(start, lamp)));
    gl.uniform1fv(name("bright"), solid.bright);
    gl.uniform1f(name("gloss"), solid.specular_power);
    gl.uniform1f(name("reach"), reach);
    gl.uniform1f(name("distance"), distance);
    const focal = 1 / Math.tan((solid.angle * Math.PI) / 360);
    const draw = (view) => {
      const ratio = Math.min(window.devicePixelRatio || 1, MOST_PIXELS);
      const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
      if (!wide || !high || gl.isContextLost()) return;
      if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
      gl.viewport(0, 0, wide, high);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const axes = axesOf(view.around, view.above), near = focal * view.nearer;
      gl.uniformMatrix3fv(name("turn"), true, axes.flat());
      gl.uniform2f(name("focal"), (near * high) / wide, near);
      gl.uniform2f(name("shift"), view.x, view.y);
      gl.drawElements(gl.TRIANGLES, mesh.triangles.length, gl.UNSIGNED_INT, 0);
    };
    return { draw, fitting: fitting(mesh.corners, solid, start, distance, focal, canvas) };
  }

  // The view from the picture's eye with all of the solid in the middle; not so near that a turn would cut much off.
  function fitting(corners, solid, axes, distance, focal, canvas) {
    const middle = solid.low.map((low, k) => low + solid.size[k] / 2);
    let [left, right, lowest, highest] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let at = 0; at < corners.length; at += 6) {
      const along = (axis) => axis.reduce((sum, part, k) => sum + part * (corners[at + k] - middle[k]), 0);
      const scale = focal / (distance - along(axes[2])), x = scale * along(axes[0]), y = scale * along(axes[1]);
      [left, right] = [Math.min(left, x), Math.max(right, x)];
      [lowest, highest] = [Math.min(lowest, y), Math.max(highest, y)];
    }
    const ratio = canvas.clientHeight / canvas.clientWidth;
    const nearer = Math.min(CLOSE, (2 * FILLED) / Math.max((right - left) * ratio, highest - lowest));
    return { nearer, x: (-nearer * ratio * (left + right)) / 2, y: (-nearer * (lowest + highest)) / 2 };
  }

  const anglesOf = ([x, y, z]) => [Math.atan2(y, x), Math.atan2(z, Math.hypot(x, y))];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const through = (axes, lamp) => axes.map((axis) => dot(axis, lamp) / Math.hypot(...lamp));

  // What is right, up and towards the eye, for one that stands `above` the x-y plane, turned `around` z (radians).
  function axesOf(around, above) {
    const [c, s, level, up] = [Math.cos(around), Math.sin(around), Math.cos(above), Math.sin(above)];
    return [[-s, c, 0], [-up * c, -up * s, level], [level * c, level * s, up]];
  }

  function begin(figure, solid) {
    const canvas = figure.querySelector("canvas"), [around, above] = anglesOf(solid.eye);
    let view = null, waiting = false, painted = null;
    const between = (low, value, high) => Math.min(Math.max(value, low), high);
    const draw = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; painted.draw(view); });
    };
    const turn = (right, up) => {
      view.around -= right;
      view.above = between(-UPRIGHT, view.above - up, UPRIGHT);
    };
    const shift = (right, up) => {
      view.x = between(-NEAREST, view.x + right, NEAREST);
      view.y = between(-NEAREST, view.y + up, NEAREST);
    };
    const zoom = (factor) => {
      const nearer = between(FARTHEST, view.nearer * factor, NEAREST), ratio = nearer / view.nearer;
      Object.assign(view, { nearer, x: view.x * ratio, y: view.y * ratio });
    };
    const actions = {
      ArrowLeft: () => turn(-STEP, 0), ArrowRight: () => turn(STEP, 0),
      ArrowUp: () => turn(0, STEP), ArrowDown: () => turn(0, -STEP),
      "+": () => zoom(NEARER), "=": () => zoom(NEARER), "-": () => zoom(1 / NEARER),
      Home: () => { view = { around, above, ...painted.fitting }; },
    };
    const act = (key) => {
      const known = Object.hasOwn(actions, key);
      if (known) { actions[key](); draw(); }
      return known;
    };
    canvas.addEventListener("keydown", (event) => {
      if (!event.ctrlKey && !event.metaKey && !event.altKey && act(event.key)) event.preventDefault();
    });
    figure.addEventListener("click", (event) => act(event.target.dataset.key));
    canvas.addEventListener("dblclick", () => act("Home"));
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return; // without it the page scrolls
      event.preventDefault();
      zoom(Math.exp(-between(-50, event.deltaY, 50) / 100));
      draw();
    }, { passive: false });

    // One finger or the mouse turns, with shift it moves; two fingers zoom, and move too.
    const held = new Map();
    const spread = () => {
      const [a, b] = [...held.values()];
      return Math.hypot(a.x - b.x, a.y - b.y) || 1;
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const apart = held.size === 2 && spread();
      const [right, up] = [event.clientX - before.x, before.y - event.clientY];
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (event.shiftKey || held.size === 2) {
        shift((2 * right) / canvas.clientWidth / held.size, (2 * up) / canvas.clientHeight / held.size);
      } else turn((right * Math.PI) / canvas.clientWidth, (up * Math.PI) / canvas.clientWidth);
      if (apart) zoom(spread() / apart);
      draw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    }

    const show = () => {
      figure.classList.add("drawn"); // first: a canvas that is not shown has no size
      painted = painter(canvas, solid);
      if (!painted) return figure.classList.remove("drawn");
      view = { around, above, ...painted.fitting };
      painted.draw(view);
    };
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      figure.classList.remove("drawn");
    });
    canvas.addEventListener("webglcontextrestored", show);
    show();
    if (painted) new ResizeObserver(() => painted.draw(view)).observe(canvas);
  }

  const text = document.getElementById("solid");
  if (text) begin(document.querySelector(".turnable"), JSON.parse(text.textContent));
})();
