// Sets up the page: cut, costs, holes, legends, and which parts are redrawn on a change.
'use strict';

const map = new Scene(byId('map'), new Camera(0, 90), false);
const turn = new Scene(byId('turn'), new Camera(25, 38), true);
const scenes = [map, turn];
const colours = data.makes_maps
  ? { share: 'share reached', count: 'number of key views', maps: 'what fusion keeps', reason: 'reason for holes', weight: 'how much it counts', ...(data.real ? { real: 'measured fulfilment' } : {}) }
  : { share: 'share shown', count: 'number of images', weight: 'how much it counts' };

function drawCut() {
  const { cut } = state;
  byId('slider').value = byId('number').value = cut;
  byId('slider').setAttribute('aria-valuetext', `${cut} ${products}, ${percent(shareAt(cut))}`);
  const halves = halvesUpTo[cut], atHalf = halves ? ` (${grouped.format(halves)} of them at half size)` : '';
  const all = data.makes_maps ? `${grouped.format(views.count)} views` : `${grouped.format(data.clusters_total)} images`;
  const chosen = make('b', {}, `${grouped.format(cut)} of ${all}`), measured = measuredAt(cut);
  const mapped = data.makes_maps ? [` ${measured === null ? 'get' : 'have'} a depth map${atHalf}, `, make('b', {}, `${grouped.format(pairsUpTo[cut])} image pairs`)] : [];
  byId('verdict').replaceChildren(chosen, ...mapped, `: ${measured === null ? percent(shareAt(cut)) : `about ${percent(measured)}`} ${ofAll}${inRegion}.`);
  for (const button of byId('jumps').children) button.setAttribute('aria-pressed', Number(button.dataset.cut) === cut);
}

// In place of the page's words for programs that make depth maps; what says nothing of images is left out.
function speakOfImages() {
  document.body.classList.add('of-images');
  byId('views-title').textContent = 'Images, best first';
  byId('slider').labels[0].textContent = 'Images to take';
  byId('curve-title').textContent = 'What each further image adds';
  byId('curve').setAttribute('aria-label', `Share ${ofAll}, along the ranking`);
  for (const option of [...byId('which').options]) {
    if (option.value === 'partner') option.remove();
    else if (option.value !== 'all') option.textContent = statusWords[option.value];
  }
}

function setUpCut() {
  if (!data.makes_maps) speakOfImages();
  for (const input of [byId('slider'), byId('number')]) {
    input.max = clusters;
    input.addEventListener('input', () => change({ cut: Math.round(Math.min(clusters, Math.max(0, Number(input.value) || 0))) }));
  }
  byId('cut').addEventListener('submit', event => event.preventDefault());
  const jump = (cut, text) => {
    const button = make('button', { type: 'button', 'data-cut': cut, onclick: () => change({ cut }) }, text);
    byId('jumps').append(button);
  };
  jump(data.cut, `the plan (${grouped.format(data.cut)})`);
  for (const share of [0.5, 0.7, 0.8, 0.9, 0.95, 1]) jump(cutFor(share), percent(share, 0));
  byId('marks').append(make('option', { value: data.cut }));
}

// The numbers of a plan: maps, work, and the share of what all give.
function drawNumbers() {
  const { cut } = state, { share_band: share } = data.limits, planned = cut === data.cut;
  const range = ({ low, high }) => `${Math.floor(100 * low)} to ${Math.ceil(100 * high)}\u00a0%`;
  const halves = halvesUpTo[cut], sizes = halves ? `, ${grouped.format(cut - halves)} at full and ${grouped.format(halves)} at half size` : '';
  const finished = finishedUpTo(cut), soFar = finished && percent(data.real.share[finished - 1]), measured = measuredAt(cut);
  const likely = planned ? `likely ${range(share)}` : 'predicted';
  const given = measured !== null ? [percent(measured), `estimated from these maps${data.finished ? '' : `; the plan said ${percent(shareAt(cut))}`}`]
    : [percent(shareAt(cut)), finished ? `${likely}; the ${counted(finished, 'finished depth map')}: ${soFar}` : likely];
  const numbers = !data.makes_maps ? [
    ['Images', grouped.format(cut), `of ${grouped.format(data.clusters_total)}`],
    ['Of what all images draw', percent(shareAt(cut)), 'how well every photograph can be drawn again, as predicted'],
  ] : [
    ['Depth maps', grouped.format(cut), `of ${grouped.format(views.count)} views${sizes}`],
    ['Work', ...work(cut)],
    ['Of the area that all depth maps cover', ...given],
  ];
  byId('numbers').replaceChildren(...numbers.map(([what, value, of]) =>
    make('div', {}, make('dt', {}, what), make('dd', {}, make('b', {}, value), make('small', { class: 'of' }, of)))));
}

// In time where that is known, else in what is matched.
function work(cut) {
  if (timesKnown()) return [duration(secondsUpTo(cut)), `of ${duration(secondsFor(data.clusters_total, data.pairs_total))} for all${ranking.work ? ' at full size' : ''}`];
  if (ranking.work) return [percent(cut && ranking.work[cut - 1], 0), 'of the work of all depth maps at full size'];
  return [grouped.format(pairsUpTo[cut]), `image pairs of ${grouped.format(data.pairs_total)} (${percent(data.pairs_total ? pairsUpTo[cut] / data.pairs_total : 0, 0)})`];
}

function drawForecast() {
  const { cut } = state, cuts = [cut, clusters];
  const matched = data.makes_maps ? [['image pairs', i => pairsUpTo[i]], ['points before fusion', i => pointsUpTo[i]]] : [];
  const table = [[products, i => i], ...matched]
    .map(([what, upTo]) => [what, ...cuts.map(i => short(upTo(i)))]);
  if (timesKnown()) table.push(['time of matching', ...cuts.map(i => duration(secondsUpTo(i)))]);
  byId('forecast').replaceChildren(make('tr', {}, ...['', 'up to the cut', 'whole ranking'].map(text => make('th', {}, text))),
    ...table.map(row => make('tr', {}, ...row.map(text => make('td', {}, text)))));
  byId('worth').textContent = worth(cut);
}

// Method 5.6.
function worth(cut) {
  const chosen = secondsUpTo(cut), left = data.clusters_total - data.finished;
  if (!timesKnown() || !chosen) return '';
  const all = secondsFor(left, data.pairs_total - pairsUpTo[data.finished]);
  return `${(all / chosen).toFixed(1)} times faster than computing depth maps for each of the ${left} views ${data.finished ? 'still without one' : 'that can have one'}.`;
}

function setUpForecast() {
  for (const [id, key] of [['per-pair', 'perPair'], ['per-map', 'perMap']]) {
    if (state[key] != null) byId(id).value = state[key];
    byId(id).addEventListener('input', () => change({ [key]: byId(id).value === '' ? null : Math.max(0, Number(byId(id).value)) }));
  }
  byId('warnings').replaceChildren(...data.warnings.map(text => make('p', {}, text)));
  byId('notes').classList.toggle('any', data.notes.length > 0);
  byId('notes').querySelector('ul').replaceChildren(...data.notes.map(text => make('li', {}, text)));
  byId('cost').open = timesKnown();
}

function drawLegends() {
  const swatch = (colour, text) => make('span', {}, Object.assign(make('i'), { style: `background: rgb(${colour})` }), text);
  const striped = () => data.makes_maps ? make('span', {}, make('i', { class: 'hatched' }), 'no cluster fulfils it') : '';
  const lists = {
    share: () => [rampSwatch('0', `as much as all ${products} ${data.makes_maps ? 'give' : 'show'}`), striped()],
    real: () => [rampSwatch('0', '1, measured'), striped()],
    count: () => [...COUNT_COLOURS.map((colour, n) => swatch(colour, n === COUNTED ? `${n} or more` : n)), striped()],
    maps: () => [swatch(MAP_COLOURS[2], 'kept'), swatch(MAP_COLOURS[1], 'one planned map only'), swatch(MAP_COLOURS[0], 'no planned map'), striped()],
    weight: () => [rampSwatch('little', 'much weight in every share')],
    reason: () => {
      const used = new Set(surface.reason);
      return [swatch(REASON_COLOURS[0], 'some cluster fulfils it'), ...data.reasons.flatMap((text, i) => used.has(i + 1) ? [swatch(REASON_COLOURS[i + 1], text)] : [])];
    },
  };
  const cameras = Object.entries(statusWords).map(([status, text]) =>
    make('span', {}, make('i', { class: status === 'unused' ? 'ring' : '', style: `background: var(--${status}); color: var(--${status}); border-radius: 50%` }), text));
  if (ranking.ofFull) cameras.splice(1, 0, make('span', {}, make('i', { class: 'diamond', style: 'background: var(--key)' }), 'key view at half size'));
  if (flight.count) cameras.push(make('span', {}, make('i', { class: 'ring', style: `color: ${FLIGHT}` }), 'image to take'));
  const missed = { unbuilt: 'ground without sparse points', seen_once: 'ground that only one shows', unseen: `ground that no photograph shows${data.region?.too_coarse ? ' finely enough' : ''}` };
  for (const [rings, text] of Object.entries(missed)) {
    const stripes = `repeating-linear-gradient(135deg, ${MISSED[rings]} 0 2.5px, transparent 2.5px 5.7px)`;
    if (data.region?.[rings].length) cameras.unshift(make('span', {}, make('i', { style: `background: ${stripes}` }), text));
  }
  if (data.region) cameras.unshift(make('span', {}, make('i', { style: 'height: 3px; background: #1d2329' }), 'border of the region'));
  for (const legend of document.querySelectorAll('.legend')) legend.replaceChildren(...lists[state.colour](), ...cameras.map(c => c.cloneNode(true)));
}

function rampSwatch(from, to) {
  const stops = [0, 0.25, 0.5, 0.75, 1].map(share => `rgb(${ramp(share).map(Math.round)})`);
  return make('span', {}, `${from} `, make('i', { class: 'ramp', style: `background: linear-gradient(90deg, ${stops})` }), to);
}

function setUpColours() {
  for (const select of document.querySelectorAll('select.colour')) {
    select.append(...Object.entries(colours).map(([value, text]) => make('option', { value }, text)));
    select.addEventListener('change', () => change({ colour: select.value }));
  }
}

function drawHoles() {
  const area = hole => squared(hole.area * perUnit ** 2);
  if (!data.holes.length) {
    const none = data.far_area > 0 ? `No holes near the cameras: the surface that no view cluster can reconstruct (striped on the map) is ${background}.`
      : 'No holes: some view cluster can reconstruct every part of the surface.';
    byId('holes').replaceChildren(...(data.holes_area > data.far_area ? holesOfSurface() : [make('p', {}, none)]));
    byId('holes-box').hidden = !data.makes_maps;
    return;
  }
  const where = (hole, i) => hole.place ? `${i + 1}: ${hole.place.map(degrees => degrees.toFixed(6)).join(', ')}` : `hole ${i + 1}`;
  const rows = data.holes.map((hole, i) => make('tr', {},
    make('td', {}, make('button', { type: 'button', class: 'link', onclick: () => showHole(hole) }, where(hole, i))),
    make('td', {}, `${area(hole)}${hole.triangles ? '' : ' on the map'}`), make('td', {}, hole.missing), make('td', {}, fillText(hole, i))));
  byId('holes').replaceChildren(
    ...holesOfSurface(),
    make('table', {}, make('tr', {}, ...['where', 'area', 'what is missing', 'what would fill it'].map(text => make('th', { scope: 'col' }, text))), ...rows),
    ...flightText(),
    make('p', { class: 'note advice' }, 'Parts of the scene without sparse points have no surface and, outside a region, are not listed.'));
}

const background = `more than ${data.far} times the usual camera distance of sparse points away from every camera`;

// How much of the surface no cluster reconstructs, as a share: areas along slopes are others than those on the map.
function holesOfSurface() {
  if (!data.makes_maps || !(data.holes_area > 0)) return [];
  const share = part => percent(data.area > 0 ? part / data.area : 0);
  const far = data.far_area > 0 ? ` ${share(data.far_area)} is background, ${background}.` : '';
  return [make('p', {}, `No view cluster reconstructs ${share(data.holes_area)} of the surface${inRegion} (striped on the map).${far}${data.holes.some(hole => hole.triangles) ? ' The largest holes within the subject, numbered on the map:' : ''}`)];
}

// In hectares where it is large, as in the summary.
function squared(area) {
  return data.metres && area >= 1e4 ? `${rounded(area / 1e4)} ha` : `${rounded(area)} ${unit}²`;
}

// What would fill a hole: the images planned for it, or advice where none are.
function fillText(hole, i) {
  const own = data.flight.holes.flatMap((of, w) => of === i ? [w] : []);
  const filled = data.flight.of_holes[i] || 0;
  if (!own.length) return filled > 0.5 ? `the images for other holes: they fill ${percent(filled, 0)} of it` : `${hole.advice}; of the poses that were tried, none fills much of it`;
  const range = (values, digits) => {
    const [low, high] = [Math.min(...values), Math.max(...values)].map(value => digits === 0 ? `${Math.round(100 * value)}` : rounded(value));
    return low === high ? low : `${low} to ${high}`;
  };
  return `${counted(own.length, 'image')}: ${range(own.map(w => data.flight.heights[w] * perUnit))} ${unit} above, overlap ${range(own.map(w => data.flight.overlaps[w]), 0)}\u00a0%; ${own.length === 1 ? 'it fills' : 'they fill'} ${filled < 0.005 ? 'hardly any' : percent(filled, 0)} of it`;
}

function flightText() {
  if (!flight.count) return [];
  const { for_holes: forHoles } = data.flight, forGround = flight.count - forHoles, files = 'viewrank/flight';
  // By the rows of the table.
  const areas = data.holes.map((hole, i) => hole.triangles ? [hole.area, hole.area * (data.flight.of_holes[i] || 0)] : [0, 0]);
  const [all, filled] = [0, 1].map(which => areas.reduce((sum, of) => sum + of[which], 0));
  const ofHoles = `${grouped.format(forHoles)} for the listed holes in the surface, which would fill ${percent(all > 0 ? filled / all : 0, 0)} of their area`;
  const ofGround = `${grouped.format(forGround)} straight down over bare ground`;
  const what = [...(forHoles ? [ofHoles] : []), ...(forGround ? [ofGround] : [])].join('; ');
  return [make('p', {}, make('b', {}, `${counted(flight.count, 'image')} to take`), ` (green rings on the map): ${what}. Forecast from geometry alone: what cannot be matched stays a hole. ${data.flight.remarks}`
    + ` ${files} has the waypoints, with direction, height and overlap${data.holes.some(hole => !hole.triangles) ? ', and the outlines of what was missed' : ''}.`)];
}

function showHole(hole) {
  for (const scene of scenes) {
    scene.hole = hole;
    scene.camera.centre = hole.centre.slice();
    const wanted = Math.min(scene.width, scene.height) / Math.max(5 * Math.sqrt(hole.area), 0.12 * bounds.span);
    scene.camera.scale = Math.max(wanted, scene.camera.whole);
    scene.moved = true;
  }
  change({ colour: 'reason', selected: -1 });
  byId('map-box').scrollIntoView({ block: 'center' });
  byId('map').focus({ preventScroll: true });
}

function drawPointer() {
  const view = state.hovered >= 0 ? state.hovered : state.selected;
  byId('under-pointer').replaceChildren(...(view < 0 ? ['Point at a camera, or move between cameras with the arrow keys.']
    : [make('a', { href: '#why-box' }, names[view]), `: ${becauseShort(view)}`]));
}

function drawFacts() {
  document.title = `${data.title}: viewrank`;
  byId('title').textContent = data.title;
  const left = data.unregistered.length ? `, ${counted(data.unregistered.length, 'image')} without a pose` : '';
  byId('facts').textContent = `${grouped.format(views.count)} views${left}, ${grouped.format(data.points)} sparse points, a surface of ${grouped.format(data.triangles)} triangles;`
    + ` planned for the backend ${data.backend}${data.makes_maps ? `, ${rounded(data.gsd * perUnit)} ${unit} per pixel wanted` : ''}`;
  if (data.region) {
    const lines = data.region.words.split('\n'), last = lines.pop();
    byId('facts').after(make('p', {}, lines.join(' '), ' ', data.region.is_incomplete ? make('b', {}, last) : last));
  }
  byId('footer').textContent = `${data.tool}. ${data.surface.coarser ? 'The surface is drawn with fewer triangles than in the plan. ' : ''}`
    + (views.count > data.most_thumbnails ? `Only the first ${data.most_thumbnails} of the ranking have thumbnails. ` : '')
    + (data.finished || data.real ? 'Colours of the surface are predicted unless labelled measured' : (data.makes_maps ? 'Predicted before any depth map was computed' : 'Predicted'))
    + '; viewrank/manifest.json has the whole plan.';
}

listeners.push(what => {
  const any = (...keys) => keys.some(key => key in what);
  if (any('cut')) drawCut();
  if (any('cut', 'perPair', 'perMap')) { fillOver(); drawCurve(); drawForecast(); drawNumbers(); remember(); }
  if (any('cut') && byId('which').value !== 'all') filterList();
  if (any('selected')) { if (state.selected >= 0 && !listed.includes(state.selected)) clearFilter(); showInList(); }
  // Screen readers announce a newly selected view, but not its changes with the slider: the verdict is announced then.
  byId('why-box').setAttribute('aria-live', any('selected') && !any('cut') ? 'polite' : 'off');
  if (any('cut', 'selected')) { drawList(); drawWhy(); }
  if (any('selected', 'colour')) remember();
  if (any('colour')) {
    for (const select of document.querySelectorAll('select.colour')) select.value = state.colour;
    drawLegends();
  }
  for (const scene of scenes) {
    if (any('selected') && state.selected >= 0) scene.hole = null;
    scene.draw(any('cut', 'colour', 'selected'));
  }
  drawPointer();
});

function clearFilter() {
  byId('search').value = '';
  byId('which').value = 'all';
  filterList();
}

function followTheme() {
  readTheme();
  for (const scene of scenes) scene.move();
}

// The address keeps the cut, the view and the colours, so that they survive a reload after a new plan.
function remember() {
  const kept = new URLSearchParams({ ...(state.cut !== firstCut && { cut: state.cut }), ...(state.selected >= 0 && { view: names[state.selected] }),
    ...(state.colour !== 'share' && { colour: state.colour }) });
  try { history.replaceState(null, '', kept.size ? `#${kept}` : location.pathname); } catch { /* some browsers refuse it for files */ }
}

function remembered() {
  const kept = new URLSearchParams(location.hash.slice(1)), cut = Number(kept.get('cut')) || firstCut;
  const colour = kept.get('colour');
  return { cut: Math.min(clusters, Math.max(0, Math.round(cut))), selected: names.indexOf(kept.get('view')), colour: colours[colour] ? colour : 'share' };
}

followTheme();
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', followTheme);
drawFacts();
setUpCut();
setUpCurve();
setUpForecast();
setUpColours();
setUpList();
drawHoles();
drawLegends();
filterList();
change(remembered());
