// The two drawings of the surface, overlaid with cameras, partners and footprints.
'use strict';

let theme = {};
// Colour of the holes' numbers, which have a white outline in both themes.
const HOLE = '#a8281a';
// Colour of the region's border, which has a white outline in both themes.
const BORDER = '#1d2329';
// Colours of ground that no photograph shows, that a single one does, and that lacks sparse points: stripes, so that none is taken for a surface.
const MISSED = { unseen: '#a8281a', seen_once: '#c98a1b', unbuilt: '#8b98a5' };
// Colour of images to take, which have a white outline in both themes.
const FLIGHT = '#127a3d';
// Holes that are numbered whatever their size.
const NUMBERED = 5;
// More cameras than this are drawn as squares: arcs would take longer than the surface.
const MANY = 1500;

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['text', 'soft', 'key', 'partner', 'unused', 'hole', 'card', 'accent', 'line']) {
    theme[name] = style.getPropertyValue(`--${name}`).trim();
  }
}

class Scene {
  constructor(element, camera, turns) {
    Object.assign(this, { element, camera, turns, hole: null, asked: false, repaint: true, moved: true, onScreen: true, stale: false });
    [this.canvas, this.marks] = element.querySelectorAll('canvas');
    this.painter = painterFor(this.canvas);
    this.context = this.marks.getContext('2d');
    new ResizeObserver(() => this.resize()).observe(element);
    // What nobody sees is drawn once it comes into view, or on paper.
    new IntersectionObserver(entries => this.comesIntoView(entries.at(-1).isIntersecting)).observe(element);
    window.addEventListener('beforeprint', () => { if (this.stale) this.drawNow(); });
    this.listen();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.element, ratio = Math.min(2, window.devicePixelRatio || 1);
    if (!width || !height) return;
    const first = !this.width;
    const zoom = first ? 1 : Math.min(width / this.width, height / this.height);
    [this.width, this.height] = [width, height];
    for (const canvas of [this.canvas, this.marks]) [canvas.width, canvas.height] = [width * ratio, height * ratio];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (first) this.camera.fit(width, height);
    else for (const scale of ['scale', 'whole']) this.camera[scale] *= zoom;
    this.move();
  }

  comesIntoView(onScreen) {
    this.onScreen = onScreen;
    if (onScreen && this.stale) this.draw();
  }

  listen() {
    const { element } = this;
    let from = null, moved = false;
    element.addEventListener('pointerdown', event => {
      if (event.target.closest('button')) return;
      [from, moved] = [[event.clientX, event.clientY], false];
      element.setPointerCapture(event.pointerId);
    });
    element.addEventListener('pointermove', event => {
      const box = element.getBoundingClientRect();
      if (!from) {
        const hovered = this.nearest(event.clientX - box.left, event.clientY - box.top);
        if (hovered !== state.hovered) change({ hovered });
        return;
      }
      const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
      if (!moved && Math.hypot(dx, dy) < 4) return;
      [from, moved] = [[event.clientX, event.clientY], true];
      if (this.turns && !event.shiftKey) this.camera.turn(-0.4 * dx, 0.4 * dy); else this.camera.pan(dx, dy);
      this.move();
    });
    element.addEventListener('pointerup', event => {
      const box = element.getBoundingClientRect();
      if (from && !moved) change({ selected: this.nearest(event.clientX - box.left, event.clientY - box.top) });
      from = null;
    });
    element.addEventListener('pointercancel', () => { from = null; });
    element.addEventListener('pointerleave', () => { if (state.hovered >= 0) change({ hovered: -1 }); });
    element.addEventListener('wheel', event => {
      // Scrolling the page over a drawing must not zoom it.
      if (!event.ctrlKey && document.activeElement !== element) return;
      event.preventDefault();
      const box = element.getBoundingClientRect();
      this.zoom(Math.exp(-0.0015 * event.deltaY), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
    element.addEventListener('keydown', event => this.key(event));
    for (const button of element.querySelectorAll('[data-zoom]')) {
      button.addEventListener('click', () => { if (+button.dataset.zoom) this.zoom(+button.dataset.zoom); else this.home(); });
    }
  }

  key(event) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey) { this.camera.pan(-40 * arrow[0], -40 * arrow[1]); this.move(); }
    else if (arrow && this.turns) { this.camera.turn(8 * arrow[0], -6 * arrow[1]); this.move(); }
    else if (arrow) change({ selected: this.next(arrow) });
    else if (event.key === '+' || event.key === '=') this.zoom(1.25);
    else if (event.key === '-') this.zoom(0.8);
    else if (event.key === 'Home') this.home();
    else if (event.key === 'Escape') change({ selected: -1 });
    else return;
    event.preventDefault();
  }

  home() {
    this.camera.fit(this.width, this.height);
    this.move();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const [dx, dy] = [x - this.width / 2, y - this.height / 2];
    this.camera.pan(-dx, -dy);
    this.camera.scale *= factor;
    this.camera.pan(dx, dy);
    this.move();
  }

  at(view) {
    return this.camera.screen(views.centres, 3 * view, this.width, this.height);
  }

  // The camera nearest to a pixel, or -1; key views have precedence.
  nearest(x, y) {
    let best = -1, least = 16;
    for (let view = 0; view < views.count; view++) {
      const [vx, vy] = this.at(view), distance = Math.hypot(vx - x, vy - y) - (statusOf(view, state.cut) === 'key' ? 4 : 0);
      if (distance < least) [best, least] = [view, distance];
    }
    return best;
  }

  // The nearest camera in a direction of the screen.
  next([dx, dy]) {
    if (state.selected < 0) return ranking.keys.length ? ranking.keys[0] : 0;
    const [x, y] = this.at(state.selected);
    let best = state.selected, least = Infinity;
    for (let view = 0; view < views.count; view++) {
      const [vx, vy] = this.at(view), along = (vx - x) * dx + (vy - y) * dy, aside = Math.abs((vx - x) * dy) + Math.abs((vy - y) * dx);
      if (along > 0.5 && along + 2.5 * aside < least && along >= 0.6 * aside) [best, least] = [view, along + 2.5 * aside];
    }
    return best;
  }

  // Draws in the next frame after the camera has moved.
  move() {
    this.moved = true;
    this.draw();
  }

  // Draws in the next frame; `repaint`: triangle colours have changed.
  draw(repaint = false) {
    this.repaint ||= repaint;
    this.stale = true;
    if (this.asked || !this.onScreen) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.drawNow();
    });
  }

  // The surface only if it has changed: hovering over cameras changes marks alone.
  drawNow() {
    if (!this.width) return;
    if (this.repaint) this.painter.paint(triangleColours());
    if (this.repaint || this.moved) this.painter.draw(this.camera, this.width, this.height);
    this.repaint = this.moved = this.stale = false;
    this.drawMarks();
  }

  drawMarks() {
    const { context } = this;
    context.clearRect(0, 0, this.width, this.height);
    const shown = state.hovered >= 0 ? state.hovered : state.selected;
    if (shown >= 0) this.drawFootprint(shown);
    const size = Math.max(1.6, Math.min(4.5, 0.22 * Math.sqrt(this.width * this.height / Math.max(views.count, 1))));
    this.drawMissed();
    this.drawBorder();
    this.drawHoles();
    this.drawFlight(size);
    if (views.count > MANY) this.drawSquares(size); else this.drawCameras(size);
    if (shown >= 0) this.drawCluster(shown, size);
    if (!this.turns) { this.drawScale(); this.drawNorth(); }
  }

  // Key views last, so that they are on top.
  drawCameras(size) {
    const { context } = this, paths = { unused: new Path2D(), partner: new Path2D(), key: new Path2D() };
    for (let view = 0; view < views.count; view++) {
      const status = statusOf(view, state.cut), [x, y] = this.at(view), radius = status === 'key' ? size * 1.35 : size;
      if (x < -9 || y < -9 || x > this.width + 9 || y > this.height + 9) continue;
      paths[status].moveTo(x + radius, y);
      if (status === 'key' && isHalf(views.rank[view])) diamond(paths.key, x, y, radius);
      else paths[status].arc(x, y, radius, 0, 7);
    }
    for (const [status, path] of Object.entries(paths)) {
      context.fillStyle = theme[status];
      if (status !== 'unused') context.fill(path);
      // A white outline keeps dots and rings visible on a surface of any colour.
      const lines = { key: [['#fff', 1.5]], partner: [['#fff', 1.2]], unused: [['#fff', 3.6], [theme.unused, 1.6]] };
      for (const [colour, width] of lines[status]) {
        context.strokeStyle = colour;
        context.lineWidth = width;
        context.stroke(path);
      }
    }
  }

  // Like drawCameras, as squares in a white outline.
  drawSquares(size) {
    const { context } = this, square = (x, y, half) => context.fillRect(x - half, y - half, 2 * half, 2 * half);
    const places = { unused: [], partner: [], key: [] };
    for (let view = 0; view < views.count; view++) {
      const place = this.at(view);
      if (place[0] > -9 && place[1] > -9 && place[0] < this.width + 9 && place[1] < this.height + 9) places[statusOf(view, state.cut)].push(place);
    }
    for (const [status, list] of Object.entries(places)) {
      const half = (status === 'key' ? 1.15 : 0.85) * size;
      for (const [colour, reach] of [['#fff', half + 0.8], [theme[status], half], ...(status === 'unused' ? [['#fff', half - 0.9]] : [])]) {
        context.fillStyle = colour;
        for (const [x, y] of list) square(x, y, Math.max(reach, 0.5));
      }
    }
  }

  // A view with its partners, or with the key views that it is a partner of.
  drawCluster(view, size) {
    const { context } = this, rank = views.rank[view], [x, y] = this.at(view);
    const others = rank && rank <= state.cut ? partnersOf(rank) : keysWith(view, state.cut);
    const lines = new Path2D();
    for (const other of others) {
      const [ox, oy] = this.at(other);
      lines.moveTo(x, y);
      lines.lineTo(ox, oy);
      lines.moveTo(ox + size + 3, oy);
      lines.arc(ox, oy, size + 3, 0, 7);
    }
    // The white outline keeps lines visible on a surface of any colour.
    for (const [colour, width] of [['#fff', 4], [theme.partner, 2]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke(lines);
    }
    context.beginPath();
    context.arc(x, y, size + 4, 0, 7);
    context.strokeStyle = theme.text;
    context.lineWidth = 2.5;
    context.stroke();
    context.font = '600 13px system-ui, sans-serif';
    const text = names[view], half = context.measureText(text).width / 2 + 4;
    const left = Math.min(Math.max(x - half, 2), Math.max(2, this.width - 2 * half - 2)), top = y > 34 ? y - size - 26 : y + size + 8;
    context.fillStyle = theme.card;
    context.globalAlpha = 0.85;
    context.fillRect(left, top, 2 * half, 18);
    context.globalAlpha = 1;
    context.fillStyle = theme.text;
    context.fillText(text, left + 4, top + 13.5);
  }

  drawFootprint(view) {
    const { context } = this, [from, to] = [views.footprintOffsets[view], views.footprintOffsets[view + 1]];
    if (to - from < 3) return;
    context.beginPath();
    for (let corner = from; corner < to; corner++) {
      const [x, y] = this.camera.screen(views.footprints, 3 * corner, this.width, this.height);
      if (corner > from) context.lineTo(x, y); else context.moveTo(x, y);
    }
    context.closePath();
    context.strokeStyle = theme.text;
    context.lineWidth = 1.5;
    context.setLineDash([6, 4]);
    context.stroke();
    context.setLineDash([]);
  }

  // Adds a corner to a path.
  lineTo(path, points, at, isFirst) {
    const [x, y] = this.camera.screen(points, 3 * at, this.width, this.height);
    if (isFirst) path.moveTo(x, y); else path.lineTo(x, y);
  }

  // Closed rings on the ground.
  ringsPath(rings) {
    const path = new Path2D();
    for (const ring of rings) {
      for (let corner = 0; corner < ring.length / 3; corner++) this.lineTo(path, ring, corner, corner === 0);
      path.closePath();
    }
    return path;
  }

  // Ground of the region that photographs miss.
  drawMissed() {
    if (!data.region) return;
    const { context } = this;
    for (const [rings, colour] of Object.entries(MISSED)) {
      context.save();
      context.clip(this.ringsPath(data.region[rings]), 'evenodd');
      context.beginPath();
      for (let x = -this.height; x < this.width; x += 8) {
        context.moveTo(x, this.height);
        context.lineTo(x + this.height, 0);
      }
      context.strokeStyle = colour;
      context.lineWidth = 2.5;
      context.stroke();
      context.restore();
    }
  }

  // The border of the region.
  drawBorder() {
    if (!data.region) return;
    const { context } = this, { border, outline } = data.region, lines = this.ringsPath(outline);
    // From above, the outline is all of the border, also where there is no surface.
    if (this.turns || !outline.length) border.forEach((vertex, end) => this.lineTo(lines, surface.vertices, vertex, end % 2 === 0));
    for (const [colour, width] of [['#fff', 3], [BORDER, 1.5]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke(lines);
    }
  }

  // Numbers as in the list, for the first holes, large holes and the selected hole, which also gets a ring.
  drawHoles() {
    const { context } = this;
    context.font = '700 13px system-ui, sans-serif';
    context.textAlign = 'center';
    for (const [i, hole] of data.holes.entries()) {
      if (hole !== this.hole && i >= NUMBERED && hole.area < 0.01 * data.area) continue;
      const [x, y] = this.camera.screen(hole.centre, 0, this.width, this.height);
      context.strokeStyle = '#fff';
      context.lineWidth = 4;
      context.strokeText(i + 1, x, y + 5);
      context.fillStyle = HOLE;
      context.fillText(i + 1, x, y + 5);
      if (hole !== this.hole) continue;
      context.beginPath();
      context.arc(x, y, Math.max(14, 0.8 * Math.sqrt(hole.area) * this.camera.scale), 0, 7);
      context.strokeStyle = theme.hole;
      context.lineWidth = 3;
      context.stroke();
    }
    context.textAlign = 'start';
  }

  // Images to take: rings with a line to where they look.
  drawFlight(size) {
    const { context } = this, lines = new Path2D();
    const reach = 0.25 * data.usual_distance, end = [0, 0, 0];
    for (let w = 0; w < flight.count; w++) {
      const [x, y] = this.camera.screen(flight.centres, 3 * w, this.width, this.height);
      for (let i = 0; i < 3; i++) end[i] = flight.centres[3 * w + i] + reach * flight.directions[3 * w + i];
      const [ex, ey] = this.camera.screen(end, 0, this.width, this.height);
      lines.moveTo(x, y);
      lines.lineTo(ex, ey);
      lines.moveTo(x + size, y);
      lines.arc(x, y, size, 0, 7);
    }
    for (const [colour, width] of [['#fff', 4], [FLIGHT, 2]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke(lines);
    }
  }

  drawScale() {
    const { context } = this, scale = this.camera.scale / perUnit, wanted = 110 / scale, power = 10 ** Math.floor(Math.log10(wanted));
    const length = [5, 2, 1].map(m => m * power).find(l => l <= wanted) || power, px = length * scale;
    context.fillStyle = theme.card;
    context.globalAlpha = 0.75;
    context.fillRect(6, this.height - 34, px + 12, 28);
    context.globalAlpha = 1;
    context.strokeStyle = context.fillStyle = theme.text;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(12, this.height - 18);
    context.lineTo(12, this.height - 12);
    context.lineTo(12 + px, this.height - 12);
    context.lineTo(12 + px, this.height - 18);
    context.stroke();
    context.font = '12px system-ui, sans-serif';
    context.fillText(`${rounded(length)} ${length === 1 && !data.metres ? 'unit' : unit}`, 18, this.height - 18);
  }

  // An arrow to the north, in the lower right corner.
  drawNorth() {
    if (!data.north) return;
    const { context } = this, [x, y] = data.north, middle = [this.width - 26, this.height - 26], size = 16;
    const at = (along, across) => [middle[0] + size * (along * x + across * y), middle[1] - size * (along * y - across * x)];
    context.fillStyle = theme.card;
    context.globalAlpha = 0.75;
    context.fillRect(middle[0] - 22, middle[1] - 22, 44, 44);
    context.globalAlpha = 1;
    context.fillStyle = theme.text;
    context.beginPath();
    for (const [along, across] of [[1, 0], [-0.4, 0.5], [-0.1, 0], [-0.4, -0.5]]) context.lineTo(...at(along, across));
    context.fill();
    context.font = '600 11px system-ui, sans-serif';
    const [left, top] = at(-0.85, 0);
    context.fillText('N', left - 4, top + 4);
  }
}

// A square on its tip: a key view at half the size.
function diamond(path, x, y, radius) {
  const reach = 1.25 * radius;
  path.moveTo(x + reach, y);
  path.lineTo(x, y + reach);
  path.lineTo(x - reach, y);
  path.lineTo(x, y - reach);
  path.closePath();
}

// Chosen key views with this partner, best first.
function keysWith(view, cut) {
  const found = [];
  for (let rank = partnerFrom[view]; rank <= cut; rank++) {
    if (partnersOf(rank).includes(view)) found.push(ranking.keys[rank - 1]);
  }
  return found;
}
