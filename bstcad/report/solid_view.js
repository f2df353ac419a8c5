"use strict";
// Replaces the picture of a lens by a model that can be rotated.  The picture stays if WebGL 2 is missing, and on paper.
// There is no animation, so a request for reduced motion needs no action.
//
// A page calls solidView.begin(figure, solid) once with the JSON of rendering.turnable, and update(solid) of its result
// for each new lens.  With rays there are two framings: look("lens") is the close view, z up; look("way") is the whole
// path of the light with its walls (the screens), to scale, y up.  The pictures on walls are data URLs, which the
// policy of the page has to allow (img-src data:).
globalThis.solidView = (() => {
  // rotation per key press (radians); zoom factor per key press; limits of zoom and shift; largest zoom and filled
  // fraction of the first view
  const STEP = Math.PI / 36, ZOOM_STEP = 1.25, MIN_ZOOM = 0.6, MAX_ZOOM = 8, MAX_HOME_ZOOM = 1.5, FILLED = 0.92;
  const MAX_TILT = 1.55, MAX_PIXEL_RATIO = 2; // largest elevation of the eye (radians); device pixels per CSS pixel
  const RAY_STEP = 2, RAY_REACH = 2; // close view: every second ray; length outside the lens, in diagonals of the lens
  const VISIBLE_REACH = 0.5, LAMP_REACH = 1.5; // diagonals: length of rays, and distance of a lamp, that the view includes
  const EYE_DISTANCE = 2.4; // distance of the eye from the centre of the whole path, in diagonals of the path
  const MIN_OPACITY = 0.35, CLOSE_OPACITY = 0.75, PATH_OPACITY = 0.4; // opacity of rays: factor at zero flux; in the close view; in the whole path
  const SCREEN_OPACITY = 0.8; // opacity of a wall in front of another one
  const GLASS = [0.62, 0.75, 0.88], SHARP_COSINE = 0.82; // colour of glass; cosine of the smallest angle of an edge
  const RAY = 0, BORDER = 1, EDGE = 2, LAMP = 3; // kinds of lines: ray, border of a wall, edge of the lens, point source
  const LINE = 9; // numbers per line: both ends, the opacity at both, and the kind

  // Positions in mm, seen from `distance` along the last of the axes (right, up, towards the eye); `focal` is
  // 1 / tan(half the angle of view); `range` is the nearest and the farthest distance that is drawn.
  const SIGHT = `#version 300 es
    precision highp float;
    uniform vec3 axes[3], centre;
    uniform vec2 focal, shift, range;
    uniform float distance;
    vec3 turned(vec3 way) { return way * mat3(axes[0], axes[1], axes[2]); }
    vec3 seenAt(vec3 place) { return turned(place - centre) - vec3(0.0, 0.0, distance); }
    vec4 drawnAt(vec3 seen) {
      float depth = ((range.x + range.y) * seen.z + 2.0 * range.x * range.y) / (range.x - range.y);
      return vec4(focal * seen.xy - shift * seen.z, depth, -seen.z);
    }`;

  const SOLID = [`${SIGHT}
    layout(location = 0) in vec3 place;
    layout(location = 1) in vec3 normal;
    out vec3 seen, facing;
    void main() {
      seen = seenAt(place);
      facing = turned(normal);
      gl_Position = drawnAt(seen);
    }`,
  // Clay with the lights of the picture; or glass, whose opacity increases with the angle of view.
  `#version 300 es
    precision highp float;
    in vec3 seen, facing;
    uniform vec3 clay, lamps[3], bright, finish;
    uniform float gloss;
    uniform vec2 veil; // opacity at normal view, and at grazing view
    out vec4 colour;
    void main() {
      vec3 normal = normalize(facing), eye = normalize(-seen), light = finish.x * clay;
      float shone = 0.0;
      if (!gl_FrontFacing) normal = -normal;
      for (int i = 0; i < 3; i++) {
        float cosine = max(dot(normal, lamps[i]), 0.0);
        float shine = cosine > 0.0 ? pow(max(dot(reflect(-lamps[i], normal), eye), 0.0), gloss) : 0.0;
        light += bright[i] * (finish.y * cosine * clay + finish.z * shine);
        shone += bright[i] * finish.z * shine;
      }
      float slant = 1.0 - abs(dot(normal, eye));
      colour = vec4(min(light, 1.0), 1.0) * min(mix(veil.x, veil.y, slant * slant) + shone, 1.0);
    }`];

  // A line is a strip with the width of its kind in pixels, since WebGL lines are one device pixel wide.
  const LINES = [`${SIGHT}
    layout(location = 0) in vec3 begin;
    layout(location = 1) in vec3 end;
    layout(location = 2) in vec3 look;
    uniform vec2 pixels;
    uniform float ratio;
    const float WIDTHS[4] = float[4](1.2, 1.6, 1.2, 9.0); // widths in CSS pixels, by kind
    const vec3 COLOURS[4] = vec3[4](
      vec3(0.93, 0.46, 0.05), vec3(0.55, 0.59, 0.63), vec3(0.42, 0.53, 0.64), vec3(1.0, 0.70, 0.05));
    out vec4 ink;
    out vec2 off;
    out float thick;
    void main() {
      vec3 a = seenAt(begin), b = seenAt(end);
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside the view: the whole line is behind the eye
      if (max(-a.z, -b.z) <= range.x) return;
      if (-a.z < range.x) a = mix(b, a, (range.x + b.z) / (b.z - a.z));
      if (-b.z < range.x) b = mix(a, b, (range.x + a.z) / (a.z - b.z));
      vec4 p = drawnAt(a), q = drawnAt(b);
      p /= p.w;
      q /= q.w;
      vec2 way = (q.xy - p.xy) * pixels / 2.0;
      way = length(way) > 0.001 ? normalize(way) : vec2(1.0, 0.0);
      int kind = int(look.z);
      bool last = gl_VertexID > 1;
      thick = WIDTHS[kind] * ratio / 2.0;
      float along = kind == 3 ? thick + 1.0 : 0.0; // a lamp is a disc
      off = vec2(last ? along : -along, gl_VertexID % 2 == 0 ? thick + 1.0 : -thick - 1.0);
      vec4 drawn = last ? q : p;
      gl_Position = vec4(drawn.xy + (way * off.x + vec2(-way.y, way.x) * off.y) * 2.0 / pixels, drawn.z, 1.0);
      ink = vec4(COLOURS[kind], 1.0) * (last ? look.y : look.x);
    }`,
  `#version 300 es
    precision highp float;
    in vec4 ink;
    in vec2 off;
    in float thick;
    out vec4 colour;
    void main() { colour = ink * clamp(thick + 0.5 - length(off), 0.0, 1.0); }`];

  // Row 0 of a picture is the first of a texture, and lies at the last two corners.
  const WALL = [`${SIGHT}
    uniform vec3 corners[4];
    out vec2 at;
    void main() {
      at = vec2(gl_VertexID == 1 || gl_VertexID == 2, gl_VertexID < 2);
      gl_Position = drawnAt(seenAt(corners[gl_VertexID]));
    }`,
  `#version 300 es
    precision highp float;
    in vec2 at;
    uniform sampler2D picture;
    uniform float opacity;
    out vec4 colour;
    void main() { colour = vec4(texture(picture, at).rgb, 1.0) * opacity; }`];

  // Returns the triangles of the faces and of the side wall; six numbers per vertex: position and normal.
  function meshOf(solid) {
    const bytes = Uint8Array.from(atob(solid.values), (letter) => letter.charCodeAt(0));
    const values = new Uint16Array(bytes.buffer);
    const mesh = { corners: [], triangles: [], rim: [] };
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
          const rising = i < face.cells / 2 === j < face.cells / 2; // the diagonal that points to the centre
          const two = rising ? [a, b, c, a, c, d] : [a, b, d, b, c, d]; // counterclockwise from above
          mesh.triangles.push(...(face.up > 0 ? two : two.reverse()));
        }
      }
      at += 5 * count;
    }
    const rim = (k) => values.subarray(at + k * solid.rim, at + (k + 1) * solid.rim);
    const [x, y, low, high] = [0, 1, 2, 3].map(rim);
    for (let i = 0; i < solid.rim; i++) {
      mesh.rim.push([low, high].map((z) => [place(0, x[i]), place(1, y[i]), place(2, z[i])]));
      const next = (i + 1) % solid.rim, first = mesh.corners.length / 6;
      const [x0, x1, y0, y1] = [place(0, x[i]), place(0, x[next]), place(1, y[i]), place(1, y[next])];
      const length = Math.hypot(x1 - x0, y1 - y0) || 1, normal = [(y1 - y0) / length, (x0 - x1) / length, 0];
      mesh.corners.push(x0, y0, place(2, low[i]), ...normal, x1, y1, place(2, low[next]), ...normal);
      mesh.corners.push(x1, y1, place(2, high[next]), ...normal, x0, y0, place(2, high[i]), ...normal);
      mesh.triangles.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
    return mesh;
  }

  // Returns the lines of every `every`-th ray, cut at `longest` mm in front of and behind the lens.
  function raysOf(solid, every, longest, opacity) {
    const lines = [], begins = solid.lamp.length ? 1 : 0; // opacity at the start: parallel light fades in
    solid.rays.forEach((stops, ray) => {
      if (ray % every) return;
      const tone = opacity * (MIN_OPACITY + (1 - MIN_OPACITY) * solid.flux[ray]), last = stops.length - 2;
      for (let k = 0; k <= last; k++) {
        const [begin, end] = [stops[k], stops[k + 1]];
        const share = longest / Math.hypot(...end.map((part, axis) => part - begin[axis])), cut = share < 1;
        const from = (place, other) => place.map((part, axis) => part + share * (other[axis] - part));
        const first = k === 0 && cut ? from(end, begin) : begin, final = k === last && cut ? from(begin, end) : end;
        // A ray fades where it is cut, and is faint on the wall, so that the picture is visible.
        lines.push(...first, ...final, k ? tone : cut ? 0 : tone * begins, k < last ? tone : cut ? 0 : tone / 2, RAY);
      }
    });
    return lines;
  }

  const lampOf = (solid) => solid.lamp.flatMap((place) => [...place, ...place, 1, 1, LAMP]);
  const bordersOf = ({ corners }) => corners.flatMap((at, k) => [...at, ...corners[(k + 1) % 4], 1, 1, BORDER]);

  // Returns the edges between the faces and the side wall, and the sharp edges of the wall.
  function edgesOf({ rim }) {
    const lines = [], add = (a, b) => lines.push(...a, ...b, 0.9, 0.9, EDGE);
    rim.forEach(([low, high], k) => {
      const [before, after] = [rim.at(k - 1)[0], rim[(k + 1) % rim.length][0]];
      add(low, after);
      add(high, rim[(k + 1) % rim.length][1]);
      const [a, b] = [[low[0] - before[0], low[1] - before[1]], [after[0] - low[0], after[1] - low[1]]];
      if (a[0] * b[0] + a[1] * b[1] < SHARP_COSINE * Math.hypot(...a) * Math.hypot(...b)) add(low, high);
    });
    return lines;
  }

  const isTransparent = (solid) => Boolean(solid.rays) && !solid.mirror; // a lens without rays is of clay

  // Returns the drawn objects and the position of the eye: the lens alone, with its rays, or the whole path with walls.
  function framingOf(solid, mesh, look) {
    const reach = Math.hypot(...solid.size), distance = reach * Math.hypot(...solid.eye);
    const centre = solid.low.map((low, k) => low + solid.size[k] / 2), glass = isTransparent(solid);
    const range = [distance - 0.55 * reach, distance + 0.55 * reach];
    const alone = { look, eye: solid.eye, centre, distance, range, glass, walls: [], lines: [], points: [] };
    if (!solid.rays) return withExtent(alone, mesh);
    const edges = glass ? edgesOf(mesh) : [];
    if (look === "lens") {
      const near = ([x, y, z]) => Math.hypot(x - centre[0], y - centre[1], z - centre[2]) < LAMP_REACH * reach;
      const begun = raysOf(solid, RAY_STEP, VISIBLE_REACH * reach, 1).filter((part, k) => k % LINE < 6);
      return withExtent({
        ...alone, range: [0.05 * reach, distance + (RAY_REACH + 0.6) * reach],
        points: [...begun, ...solid.lamp.filter(near).flat()],
        lines: [...edges, ...raysOf(solid, RAY_STEP, RAY_REACH * reach, CLOSE_OPACITY), ...lampOf(solid)],
      }, mesh);
    }
    const points = [solid.rays, solid.screens.map((screen) => screen.corners), solid.lamp].flat(Infinity);
    const ends = solid.low.map((low, axis) => [low, low + solid.size[axis]]);
    points.forEach((part, k) => ends[k % 3].push(part));
    const [low, high] = [Math.min, Math.max].map((choose) => ends.map((parts) => choose(...parts)));
    const whole = Math.hypot(...high.map((end, axis) => end - low[axis])); // diameter of a sphere around the whole path
    return withExtent({
      ...alone, eye: solid.aside, centre: low.map((end, axis) => (end + high[axis]) / 2), distance: EYE_DISTANCE * whole,
      range: [(EYE_DISTANCE - 0.55) * whole, (EYE_DISTANCE + 0.55) * whole], walls: solid.screens, points,
      lines: [
        ...edges, ...solid.screens.flatMap(bordersOf), ...raysOf(solid, 1, Infinity, PATH_OPACITY), ...lampOf(solid),
      ],
    }, mesh);
  }

  // Adds the extent of all points of a framing in the view from its eye, at a focal length of 1.
  function withExtent(framing, mesh) {
    const { look, eye, centre, distance } = framing, axes = axesOf(look, ...anglesOf(look, eye));
    let [left, right, lowest, highest] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [points, stride] of [[mesh.corners, 6], [framing.points, 3]]) {
      for (let at = 0; at < points.length; at += stride) {
        const along = (axis) => axis.reduce((sum, part, k) => sum + part * (points[at + k] - centre[k]), 0);
        const scale = 1 / (distance - along(axes[2])), x = scale * along(axes[0]), y = scale * along(axes[1]);
        [left, right] = [Math.min(left, x), Math.max(right, x)];
        [lowest, highest] = [Math.min(lowest, y), Math.max(highest, y)];
      }
    }
    if (framing.walls.length) { // symmetric, since a long path would rotate out of a view that is not centred
      [right, highest] = [Math.max(right, -left), Math.max(highest, -lowest)];
      [left, lowest] = [-right, -highest];
    }
    return { ...framing, extent: { left, right, lowest, highest } };
  }

  // Returns the first view of a framing, centred, with a zoom that is small enough for rotation.
  function homeOf({ look, eye, extent: { left, right, lowest, highest } }, focal, canvas) {
    const [around, above] = anglesOf(look, eye);
    const ratio = canvas.clientHeight / canvas.clientWidth || 1; // 1: the canvas is not visible yet
    const nearer = Math.min(MAX_HOME_ZOOM, (2 * FILLED) / focal / Math.max((right - left) * ratio, highest - lowest));
    const half = (nearer * focal) / 2;
    return { around, above, nearer, x: -half * ratio * (left + right), y: -half * (lowest + highest) };
  }

  function programOf(gl, texts) {
    const program = gl.createProgram();
    [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, texts[k]);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    return gl.getProgramParameter(program, gl.LINK_STATUS) ? program : null;
  }

  // Returns a painter that draws solids in the same buffers and textures; null without WebGL 2.
  function painter(canvas, redraw) {
    const wanted = { antialias: true, stencil: true, preserveDrawingBuffer: true }; // the last for printing
    const gl = canvas.getContext("webgl2", wanted);
    const programs = gl && [SOLID, LINES, WALL].map((texts) => programOf(gl, texts));
    if (!programs?.every(Boolean)) return null;
    const [ofSolid, ofLines, ofWall] = programs;
    const send = (program, values) => {
      gl.useProgram(program);
      for (const [name, value] of Object.entries(values)) {
        const at = gl.getUniformLocation(program, name);
        if (typeof value === "number") gl.uniform1f(at, value);
        else gl[value.length === 2 ? "uniform2fv" : "uniform3fv"](at, value);
      }
    };
    const [solidArray, linesArray, noArray] = [1, 2, 3].map(() => gl.createVertexArray());
    const [corners, lines] = [gl.createBuffer(), gl.createBuffer()];
    const parts = (array, buffer, stride, sizes) => { // attributes that follow each other in a buffer
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      sizes.forEach((size, index) => {
        gl.enableVertexAttribArray(index);
        gl.vertexAttribPointer(index, size, gl.FLOAT, false, 4 * stride, 12 * index);
        if (array === linesArray) gl.vertexAttribDivisor(index, 1);
      });
    };
    parts(linesArray, lines, LINE, [3, 3, 3]);
    parts(solidArray, corners, 6, [3, 3]);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const pour = (buffer, numbers) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(numbers), gl.DYNAMIC_DRAW);
    };
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.polygonOffset(1, 1); // for walls, so that their borders are in front

    let count = 0, focal = 1, framing = null, mesh = null, solid = null;
    const hung = []; // texture of each wall, and the picture that it shows or loads
    const hang = (picture, k) => {
      if (!hung[k]) {
        hung[k] = { texture: gl.createTexture() };
        gl.bindTexture(gl.TEXTURE_2D, hung[k].texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([0, 0, 0, 255]));
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
      }
      const wall = hung[k];
      if (wall.picture === picture) return;
      wall.picture = picture; // the previous picture stays until this one is decoded
      const image = new Image();
      image.onload = () => {
        if (wall.picture !== picture || !gl.isTexture(wall.texture)) return; // a newer picture, or no context
        gl.bindTexture(gl.TEXTURE_2D, wall.texture);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
        gl.generateMipmap(gl.TEXTURE_2D);
        if (framing?.walls.length) redraw();
      };
      image.src = picture;
    };

    const take = (given) => {
      [solid, mesh, framing] = [given, meshOf(given), null];
      count = mesh.triangles.length;
      focal = 1 / Math.tan((solid.angle * Math.PI) / 360);
      pour(corners, mesh.corners);
      gl.bindVertexArray(solidArray);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(mesh.triangles), gl.DYNAMIC_DRAW);
      const start = axesOf("lens", ...anglesOf("lens", solid.eye)); // lights move with the eye
      send(ofSolid, {
        lamps: solid.lamps.flatMap((lamp) => through(start, lamp)), bright: solid.bright, gloss: solid.specular_power,
        clay: isTransparent(solid) ? GLASS : solid.clay, finish: [solid.ambient, solid.diffuse, solid.specular],
      });
      const pictures = (solid.screens ?? []).map((screen) => screen.picture);
      for (const { texture } of hung.splice(pictures.length)) gl.deleteTexture(texture);
      pictures.forEach(hang);
    };
    const frame = (look) => {
      if (framing?.look !== look) {
        framing = framingOf(solid, mesh, look);
        pour(lines, framing.lines);
      }
      return homeOf(framing, focal, canvas);
    };

    const drawSolid = (veil, hidden) => {
      send(ofSolid, { veil });
      gl.enable(gl.CULL_FACE); // otherwise the rim of the far wall would be visible along the near edge
      gl.cullFace(hidden);
      gl.bindVertexArray(solidArray);
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
    };
    const drawLines = (depth) => {
      gl.useProgram(ofLines);
      gl.disable(gl.CULL_FACE);
      gl.depthFunc(depth);
      gl.depthMask(false);
      gl.bindVertexArray(linesArray);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, framing.lines.length / LINE);
      gl.depthMask(true);
      gl.depthFunc(gl.LEQUAL);
    };
    // Draws the far side of the glass, the rays behind its near side, and the near side; `draw` adds the other rays.
    const drawClear = () => {
      gl.depthMask(false);
      drawSolid([0.25, 0.5], gl.FRONT);
      gl.depthMask(true);
      gl.enable(gl.STENCIL_TEST); // 1 where the glass is visible
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
      gl.stencilFunc(gl.ALWAYS, 1, 1);
      gl.colorMask(false, false, false, false);
      drawSolid([1, 1], gl.BACK);
      gl.colorMask(true, true, true, true);
      gl.stencilFunc(gl.EQUAL, 1, 1);
      drawLines(gl.GREATER);
      gl.disable(gl.STENCIL_TEST);
      drawSolid([0.35, 0.8], gl.BACK);
    };
    const drawWalls = (axes) => {
      gl.disable(gl.CULL_FACE);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.bindVertexArray(noArray);
      const along = (axis, { corners }) => dot(axis, corners[0]) + dot(axis, corners[2]); // centre, twice
      const last = Math.max(...framing.walls.map((wall) => along([0, 0, 1], wall)));
      const farthestFirst = [...framing.walls].sort((a, b) => along(axes[2], a) - along(axes[2], b));
      for (const wall of farthestFirst) {
        gl.bindTexture(gl.TEXTURE_2D, hung[framing.walls.indexOf(wall)].texture);
        send(ofWall, { corners: wall.corners.flat(), opacity: along([0, 0, 1], wall) < last ? SCREEN_OPACITY : 1 });
        gl.drawArrays(gl.TRIANGLE_FAN, 0, 4);
      }
      gl.disable(gl.POLYGON_OFFSET_FILL);
    };
    const draw = (view) => {
      const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
      const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
      if (!wide || !high || gl.isContextLost()) return;
      if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
      gl.viewport(0, 0, wide, high);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
      const { look, centre, distance, range, glass } = framing, near = focal * view.nearer;
      const axes = axesOf(look, view.around, view.above);
      const fit = { focal: [(near * high) / wide, near], shift: [view.x, view.y] };
      for (const program of programs) send(program, { axes: axes.flat(), centre, distance, range, ...fit });
      send(ofLines, { pixels: [wide, high], ratio });
      gl.disable(gl.BLEND);
      if (!framing.lines.length) return drawSolid([1, 1], gl.BACK);
      gl.enable(gl.BLEND);
      drawWalls(axes);
      if (glass) drawClear();
      else drawSolid([1, 1], gl.BACK);
      drawLines(gl.LEQUAL);
    };
    return { take, frame, draw };
  }

  // Returns the angles (azimuth, elevation) of an eye; z is up in the close view, y in the whole path.
  const anglesOf = (look, eye) => {
    const [x, y, z] = look === "way" ? [eye[2], eye[0], eye[1]] : eye;
    return [Math.atan2(y, x), Math.atan2(z, Math.hypot(x, y))];
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const through = (axes, lamp) => axes.map((axis) => dot(axis, lamp) / Math.hypot(...lamp));

  // Returns the axes right, up and towards the eye, for the elevation `above` and the azimuth `around` (radians).
  function axesOf(look, around, above) {
    const [c, s, level, up] = [Math.cos(around), Math.sin(around), Math.cos(above), Math.sin(above)];
    const axes = [[-s, c, 0], [-up * c, -up * s, level], [level * c, level * s, up]];
    return look === "way" ? axes.map(([z, x, y]) => [x, y, z]) : axes;
  }

  function begin(figure, solid) {
    const canvas = figure.querySelector("canvas"), views = {}, homes = {}; // current and first view by framing
    let view = null, home = null, waiting = false, painted = null, look = "lens";
    const between = (low, value, high) => Math.min(Math.max(value, low), high);
    const draw = () => {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => { waiting = false; painted.draw(view); });
    };
    const turn = (right, up) => {
      view.around -= right;
      view.above = between(-MAX_TILT, view.above - up, MAX_TILT);
    };
    const shift = (right, up) => {
      view.x = between(-MAX_ZOOM, view.x + right, MAX_ZOOM);
      view.y = between(-MAX_ZOOM, view.y + up, MAX_ZOOM);
    };
    const zoom = (factor) => {
      const farthest = MIN_ZOOM * Math.min(1, home.nearer);
      const nearer = between(farthest, view.nearer * factor, MAX_ZOOM), ratio = nearer / view.nearer;
      Object.assign(view, { nearer, x: view.x * ratio, y: view.y * ratio });
    };
    const actions = {
      ArrowLeft: () => turn(-STEP, 0), ArrowRight: () => turn(STEP, 0),
      ArrowUp: () => turn(0, STEP), ArrowDown: () => turn(0, -STEP),
      "+": () => zoom(ZOOM_STEP), "=": () => zoom(ZOOM_STEP), "-": () => zoom(1 / ZOOM_STEP),
      Home: () => { Object.assign(view, home); },
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
      if (!event.ctrlKey) return; // without Ctrl the page scrolls
      event.preventDefault();
      zoom(Math.exp(-between(-50, event.deltaY, 50) / 100));
      draw();
    }, { passive: false });

    // One finger or the mouse rotates, with Shift it moves; two fingers zoom and move.
    const pointers = new Map();
    const spread = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a.x - b.x, a.y - b.y) || 1;
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const distance = pointers.size === 2 && spread();
      const [right, up] = [event.clientX - before.x, before.y - event.clientY];
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (event.shiftKey || pointers.size === 2) {
        shift((2 * right) / canvas.clientWidth / pointers.size, (2 * up) / canvas.clientHeight / pointers.size);
      } else turn((right * Math.PI) / canvas.clientWidth, (up * Math.PI) / canvas.clientWidth);
      if (distance) zoom(spread() / distance);
      draw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }

    // Sets the view of the present framing: changes by the user stay, the rest follows the solid and the canvas.
    const frame = () => {
      const name = solid.rays ? look : "lens", before = homes[name];
      [home, view] = [painted.frame(name), views[name] ??= {}];
      for (const [part, value] of Object.entries(home)) if (!before || view[part] === before[part]) view[part] = value;
      homes[name] = home;
      draw();
    };
    const show = () => {
      figure.classList.add("drawn"); // first, since a hidden canvas has no size
      painted = painter(canvas, draw);
      if (!painted) return figure.classList.remove("drawn");
      painted.take(solid);
      frame();
    };
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      figure.classList.remove("drawn");
    });
    canvas.addEventListener("webglcontextrestored", show);
    show();
    const drawing = () => painted && figure.classList.contains("drawn"); // otherwise wait until the context is restored
    if (painted) new ResizeObserver(() => drawing() && frame()).observe(canvas);
    return {
      update: (other) => {
        solid = other;
        if (!drawing()) return;
        painted.take(solid);
        frame();
      },
      look: (name) => {
        look = name;
        if (drawing()) frame();
      },
    };
  }

  const text = document.getElementById("solid");
  if (text) begin(document.querySelector(".turnable"), JSON.parse(text.textContent));
  return { begin };
})();
