// Draws the surface with WebGL, or without it triangle by triangle on a 2D canvas.
'use strict';

// Drawn with dark stripes, which hold in greyscale and for the colour-blind.
const NOWHERE = [196, 196, 200];
const COUNT_COLOURS = [[250, 226, 158], [202, 208, 148], [146, 189, 150], [96, 160, 152], [52, 122, 148], [16, 80, 136]];
// By number of the reason. Triangles have only four: too few cameras, too coarse, too inaccurate, cannot be matched; colours that the
// colour-blind and a greyscale print can tell apart.
const REASON_COLOURS = Array(11).fill([150, 150, 150]);
REASON_COLOURS[0] = [238, 240, 242];
REASON_COLOURS[4] = [52, 40, 84];
REASON_COLOURS[6] = [104, 164, 226];
REASON_COLOURS[7] = [242, 206, 70];
REASON_COLOURS[8] = [190, 66, 40];
// Not shown well by any planned map, by one that no other confirms, by as many as fusion wants.
const MAP_COLOURS = [[250, 226, 158], [200, 92, 52], [16, 84, 140]];
const IMPROVED = [176, 58, 134];
// Surfaces with fewer triangles are antialiased.
const SMOOTH = 10000;

function ramp(share) {
  const place = Math.min(Math.max(share, 0), 1) * 2;
  const from = data.ramp[place < 1 ? 0 : 1], to = data.ramp[place < 1 ? 1 : 2], t = place < 1 ? place : place - 1;
  return from.map((value, i) => value + t * (to[i] - value));
}

// End of the triangle's steps by the first `cut` clusters; the start of its steps if there are none.
function stepsUpTo(triangle, cut) {
  let end = surface.offsets[triangle];
  const last = surface.offsets[triangle + 1];
  while (end < last && surface.ranks[end] <= cut) end++;
  return end;
}

function chosenViews(triangle, cut) {
  let count = 0;
  while (count < COUNTED && surface.first[triangle * COUNTED + count] <= cut) count++;
  return count;
}

function improvedBy(triangle, rank) {
  const end = stepsUpTo(triangle, rank);
  return end > surface.offsets[triangle] && surface.ranks[end - 1] === rank;
}

const RAMP_TABLE = Array.from({ length: 256 }, (_, i) => ramp(i / 255));

function colourOf(triangle) {
  if (state.colour === 'reason') return REASON_COLOURS[surface.reason[triangle]];
  if (state.colour === 'weight') return RAMP_TABLE[surface.weightShade[triangle]];
  if (data.makes_maps && surface.reason[triangle]) return NOWHERE;
  if (state.colour === 'maps') return MAP_COLOURS[(surface.alone[triangle] <= state.cut) + (surface.kept[triangle] <= state.cut)];
  if (state.colour === 'count') return COUNT_COLOURS[chosenViews(triangle, state.cut)];
  if (state.colour === 'real') return RAMP_TABLE[surface.real[triangle]];
  const end = stepsUpTo(triangle, state.cut);
  return RAMP_TABLE[end > surface.offsets[triangle] ? surface.shares[end - 1] : 0];
}

// Outside the region, colours are pale: what is added to a quarter of them.
const OUTSIDE = 168;

function isInside(triangle) {
  return !data.region || data.region.inside[triangle] === 1;
}

// Stripes mark what no cluster fulfils, where colours show something else than the reason.
function isStriped(triangle) {
  return data.makes_maps && surface.reason[triangle] > 0 && state.colour !== 'reason' && state.colour !== 'weight';
}

// Colour of every triangle for the state of the page: red, green, blue, and 0 where striped, else 255.
const triangleColours = (() => {
  const colours = new Uint8Array(4 * surface.count);
  let made = null;
  return () => {
    const wanted = `${state.colour} ${state.cut} ${state.selected}`;
    if (wanted === made) return colours;
    made = wanted;
    const rank = state.selected >= 0 ? views.rank[state.selected] : 0;
    for (let t = 0; t < surface.count; t++) {
      const colour = isInside(t) ? colourOf(t) : colourOf(t).map(value => 0.25 * value + OUTSIDE), own = rank && improvedBy(t, rank) ? 0.35 : 1;
      for (let i = 0; i < 3; i++) colours[4 * t + i] = own * colour[i] + (1 - own) * IMPROVED[i];
      colours[4 * t + 3] = isStriped(t) ? 0 : 255;
    }
    return colours;
  };
})();

// Brightness of each triangle under a light from the upper left.
const shading = (() => {
  const light = [-0.35, 0.35, 0.87], shades = new Float32Array(surface.count), { vertices: p, triangles } = surface;
  for (let t = 0; t < surface.count; t++) {
    const [a, b, c] = [0, 1, 2].map(i => 3 * triangles[3 * t + i]);
    const u = [0, 1, 2].map(i => p[b + i] - p[a + i]), v = [0, 1, 2].map(i => p[c + i] - p[a + i]);
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const length = Math.hypot(...n) || 1;
    shades[t] = 0.62 + 0.38 * Math.max(0, (n[0] * light[0] + n[1] * light[1] + n[2] * light[2]) / length);
  }
  return shades;
})();

// Bounding box of points, each given as (list, offset).
function boxOf(points) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const [list, from] of points) {
    for (let i = 0; i < 3; i++) {
      low[i] = Math.min(low[i], list[from + i]);
      high[i] = Math.max(high[i], list[from + i]);
    }
  }
  const box = low[0] > high[0] ? { low: [0, 0, 0], high: [1, 1, 1] } : { low, high };
  return { ...box, span: Math.hypot(...box.high.map((top, i) => top - box.low[i])) || 1 };
}

function* cameras() {
  for (let view = 0; view < views.count; view++) yield [views.centres, 3 * view];
}

function* points() {
  yield* cameras();
  for (let corner = 0; corner < 3 * surface.count; corner++) yield [surface.vertices, 3 * surface.triangles[corner]];
}

// The initial view: the subject, and of the cameras around it those within half its size.
function subjectAndCameras() {
  const { low, high } = data.subject, seen = boxOf(cameras());
  const room = 0.25 * Math.hypot(...high.map((top, i) => top - low[i]));
  return { low: low.map((x, i) => Math.max(Math.min(x, seen.low[i]), x - room)), high: high.map((x, i) => Math.min(Math.max(x, seen.high[i]), x + room)) };
}

// The box enlarged by `room` on every side.
function padded({ low, high }, room) {
  return { low: low.map(x => x - room), high: high.map(x => x + room), span: Math.hypot(...low.map((x, i) => high[i] - x + 2 * room)) || 1 };
}

const all = boxOf(points()), bounds = data.subject ? padded(subjectAndCameras(), 0) : all;

const VERTEX = `
  attribute vec3 place; attribute vec4 colour; uniform mat4 view; varying vec4 shade;
  void main() { gl_Position = view * vec4(place, 1.0); shade = colour; }`;
const FRAGMENT = `
  precision mediump float; varying vec4 shade;
  void main() {
    bool dark = shade.a < 0.5 && mod(gl_FragCoord.x + gl_FragCoord.y, 7.0) < 2.5;
    gl_FragColor = vec4(dark ? 0.35 * shade.rgb : shade.rgb, 1.0);
  }`;

// Draws the surface with WebGL.
class GlPainter {
  constructor(canvas) {
    // Without a GPU, antialiasing many triangles would double the time of drawing.
    const gl = canvas.getContext('webgl', { alpha: true, antialias: surface.count < SMOOTH, preserveDrawingBuffer: true });
    if (!gl) throw new Error('no WebGL');
    this.gl = gl;
    const program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.view = gl.getUniformLocation(program, 'view');
    this.bind(program, 'place', this.places(), gl.FLOAT);
    this.colours = this.bind(program, 'colour', new Uint8Array(12 * surface.count), gl.UNSIGNED_BYTE, 4);
    gl.enable(gl.DEPTH_TEST);
  }

  places() {
    const places = new Float32Array(9 * surface.count);
    for (let corner = 0; corner < 3 * surface.count; corner++) {
      const from = 3 * surface.triangles[corner];
      for (let i = 0; i < 3; i++) places[3 * corner + i] = surface.vertices[from + i];
    }
    return places;
  }

  bind(program, name, values, type, size = 3) {
    const { gl } = this, buffer = gl.createBuffer(), at = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, type !== gl.FLOAT, 0, 0);
    return buffer;
  }

  paint(colours) {
    const shaded = new Uint8Array(12 * surface.count);
    for (let t = 0; t < surface.count; t++) {
      for (let i = 0; i < 12; i++) shaded[12 * t + i] = colours[4 * t + i % 4] * (i % 4 < 3 ? shading[t] : 1);
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.colours);
    this.gl.bufferSubData(this.gl.ARRAY_BUFFER, 0, shaded);
  }

  draw(camera, width, height) {
    const { gl } = this, { right, up, towards, centre, scale } = camera;
    const sx = 2 * scale / width, sy = 2 * scale / height, sz = -1 / camera.depth;
    const rows = [right.map(v => v * sx), up.map(v => v * sy), towards.map(v => v * sz)];
    const matrix = new Float32Array(16);
    rows.forEach((row, r) => {
      row.forEach((value, c) => { matrix[4 * c + r] = value; });
      matrix[12 + r] = -(row[0] * centre[0] + row[1] * centre[1] + row[2] * centre[2]);
    });
    matrix[15] = 1;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.view, false, matrix);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * surface.count);
  }
}

// Draws the surface on a 2D canvas, far triangles first.
class PlainPainter {
  constructor(canvas) {
    this.context = canvas.getContext('2d');
    this.colours = null;
    const tile = document.createElement('canvas').getContext('2d');
    [tile.canvas.width, tile.canvas.height] = [6, 6];
    tile.fillStyle = `rgb(${NOWHERE})`;
    tile.fillRect(0, 0, 6, 6);
    tile.strokeStyle = '#45454b';
    tile.lineWidth = 2;
    for (const x of [-6, 0, 6]) { tile.moveTo(x, 6); tile.lineTo(x + 6, 0); }
    tile.stroke();
    this.stripes = this.context.createPattern(tile.canvas, 'repeat');
  }

  paint(colours) {
    this.colours = colours;
  }

  draw(camera, width, height) {
    const { context } = this, ratio = context.canvas.width / width;
    const at = new Float32Array(surface.vertices.length);
    for (let v = 0; v < surface.vertices.length; v += 3) at.set(camera.screen(surface.vertices, v, width, height), v);
    const depth = t => at[3 * surface.triangles[3 * t] + 2] + at[3 * surface.triangles[3 * t + 1] + 2] + at[3 * surface.triangles[3 * t + 2] + 2];
    const order = Array.from({ length: surface.count }, (_, t) => t).sort((a, b) => depth(a) - depth(b));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    for (const t of order) {
      const rgb = [0, 1, 2].map(i => Math.round(this.colours[4 * t + i] * shading[t]));
      context.strokeStyle = `rgb(${rgb})`;
      context.fillStyle = this.colours[4 * t + 3] ? context.strokeStyle : this.stripes;
      context.beginPath();
      for (let i = 0; i < 3; i++) {
        const v = 3 * surface.triangles[3 * t + i];
        if (i) context.lineTo(at[v], at[v + 1]); else context.moveTo(at[v], at[v + 1]);
      }
      context.closePath();
      context.fill();
      context.stroke();
    }
  }
}

function painterFor(canvas) {
  try {
    return new GlPainter(canvas);
  } catch {
    return new PlainPainter(canvas);
  }
}

// Parallel projection; a pitch of 90 degrees looks straight down, with y up the screen.
class Camera {
  constructor(yaw, pitch) {
    Object.assign(this, { yaw, pitch, scale: 1, centre: [0, 1, 2].map(i => 0.5 * (bounds.low[i] + bounds.high[i])) });
    this.home = { yaw, pitch };
    this.depth = all.span;
    this.turn(0, 0);
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(90, Math.max(5, this.pitch + pitch));
    const [a, p] = [this.yaw, this.pitch].map(degrees => degrees * Math.PI / 180);
    this.right = [Math.cos(a), Math.sin(a), 0];
    this.up = [-Math.sin(a) * Math.sin(p), Math.cos(a) * Math.sin(p), Math.cos(p)];
    this.towards = [Math.sin(a) * Math.cos(p), -Math.cos(a) * Math.cos(p), Math.sin(p)];
  }

  // Fits the initial view into the canvas.
  fit(width, height) {
    this.turn(this.home.yaw - this.yaw, this.home.pitch - this.pitch);
    const spans = [this.right, this.up].map(axis => {
      let low = Infinity, high = -Infinity;
      for (let corner = 0; corner < 8; corner++) {
        const along = [0, 1, 2].reduce((sum, i) => sum + axis[i] * (corner >> i & 1 ? bounds.high[i] : bounds.low[i]), 0);
        low = Math.min(low, along);
        high = Math.max(high, along);
      }
      return high - low || 1;
    });
    this.centre = [0, 1, 2].map(i => 0.5 * (bounds.low[i] + bounds.high[i]));
    this.scale = this.whole = 0.94 * Math.min(width / spans[0], height / spans[1]);
  }

  // Pixel of the point at `offset` of a list, and its nearness (larger is nearer).
  screen(points, offset, width, height) {
    const { right: r, up: u, towards: d, centre: c, scale } = this;
    const x = points[offset] - c[0], y = points[offset + 1] - c[1], z = points[offset + 2] - c[2];
    return [0.5 * width + scale * (r[0] * x + r[1] * y + r[2] * z), 0.5 * height - scale * (u[0] * x + u[1] * y + u[2] * z), d[0] * x + d[1] * y + d[2] * z];
  }

  pan(dx, dy) {
    this.centre = this.centre.map((c, i) => c - (this.right[i] * dx - this.up[i] * dy) / this.scale);
  }
}
