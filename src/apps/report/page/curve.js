// The curve of shares: predicted and, with finished depth maps, measured.
'use strict';

const plot = { left: 54, right: 546, top: 28, bottom: 262 };

// Choices for the x axis; `at(i)`: value after i clusters.
const overs = {
  maps: { label: products, one: products.slice(0, -1), at: cut => cut },
  pairs: { label: 'image pairs', one: 'image pair', at: cut => pairsUpTo[cut] },
  work: { label: '% of the work', one: '% of the work', at: cut => cut && 100 * ranking.work[cut - 1] },
  time: { label: 'hours of matching', one: 'hour of matching', at: cut => secondsUpTo(cut) / 3600 },
};

function timesKnown() {
  return state.perPair != null || state.perMap != null;
}

function secondsFor(maps, pairs) {
  return (state.perMap || 0) * maps + (state.perPair || 0) * pairs;
}

// Finished depth maps take no time.
function secondsUpTo(cut) {
  const done = Math.min(cut, data.finished);
  return secondsFor(fullMapsUpTo[cut] - fullMapsUpTo[done], fullPairsUpTo[cut] - fullPairsUpTo[done]);
}

function over() {
  return overs[byId('over').value] || overs.maps;
}

function drawCurve() {
  const at = over().at, most = at(clusters) || 1;
  const top = Math.max(1, ...(data.real ? data.real.share : []));
  const x = value => plot.left + (plot.right - plot.left) * value / most;
  const y = share => plot.bottom - (plot.bottom - plot.top) * share / top;
  const parts = [];
  const grid = tickStep(top);
  for (let tick = 0; tick <= top * 1.0001; tick += grid) {
    parts.push(`<path class="grid" d="M${plot.left} ${y(tick)}H${plot.right}"/>`,
      `<text x="${plot.left - 7}" y="${y(tick) + 4}" text-anchor="end">${percent(tick, 0)}</text>`);
  }
  const step = tickStep(most);
  for (let tick = 0; tick <= most * 1.0001; tick += step) {
    parts.push(`<text x="${x(tick)}" y="${plot.bottom + 18}" text-anchor="middle">${rounded(tick)}</text>`);
  }
  parts.push(`<text x="8" y="13">share ${ofAll}</text>`);
  parts.push(`<text x="${(plot.left + plot.right) / 2}" y="${plot.bottom + 35}" text-anchor="middle">${over().label}</text>`);
  parts.push(`<polyline class="predicted" points="${line(clusters, i => [x(at(i)), y(shareAt(i))])}"/>`);
  if (data.real) {
    // Depth maps outside the ranking have no x value.
    const { ranks, share } = data.real, last = ranks.findLastIndex(rank => rank <= clusters);
    parts.push(`<polyline class="real" points="${x(0)},${y(0)} ${line(last, i => [x(at(ranks[i])), y(share[i])])}"/>`);
  }
  const [cx, cy] = [x(at(state.cut)), y(reachedAt(state.cut))];
  parts.push(`<path class="cut" d="M${cx} ${plot.bottom}V${cy}H${plot.left}"/><circle class="dot" cx="${cx}" cy="${cy}" r="5"/>`);
  const left = cx > 320;
  parts.push(`<text class="strong" x="${cx + (left ? -10 : 10)}" y="${Math.min(cy + 20, plot.bottom - 8)}" text-anchor="${left ? 'end' : 'start'}">`
    + `${reachedText()}</text>`);
  byId('curve').innerHTML = parts.join('');
  byId('curve').setAttribute('aria-label', `Share ${ofAll}, over ${over().label}: ${reachedText()}, ${percent(shareAt(clusters))} with ${rounded(most)}`);
}

// Measured where the maps up to a rank are finished, else predicted.
function reachedAt(cut) {
  return measuredAt(cut) ?? shareAt(cut);
}

function reachedText() {
  const value = over().at(state.cut);
  return `${percent(reachedAt(state.cut))} with ${rounded(value)} ${value === 1 ? over().one : over().label}`;
}

// Points of a polyline, thinned to about 500 including the last.
function line(last, point) {
  const points = [], step = Math.max(1, Math.ceil(last / 500));
  for (let i = 0; i <= last; i++) {
    if (i % step === 0 || i === last) points.push(point(i).map(value => value.toFixed(1)).join(','));
  }
  return points.join(' ');
}

// 1, 2 or 5 times a power of ten, at most 7 of which fit.
function tickStep(most) {
  const power = 10 ** Math.floor(Math.log10(most / 7 || 1));
  return [1, 2, 5, 10].map(m => m * power).find(step => most / step <= 7);
}

// The cut nearest to a pointer event in the plot.
function cutAt(event) {
  const box = byId('curve').getBoundingClientRect(), inside = (event.clientX - box.left) / box.width * 560;
  const wanted = over().at(clusters) * (inside - plot.left) / (plot.right - plot.left), at = over().at;
  let low = 0, high = clusters;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (at(middle) < wanted) low = middle + 1; else high = middle;
  }
  return low > 0 && wanted - at(low - 1) < at(low) - wanted ? low - 1 : low;
}

function setUpCurve() {
  const curve = byId('curve');
  curve.addEventListener('pointerdown', event => {
    change({ cut: cutAt(event) });
    curve.setPointerCapture(event.pointerId);
  });
  curve.addEventListener('pointermove', event => { if (event.buttons & 1) change({ cut: cutAt(event) }); });
  byId('over').addEventListener('change', drawCurve);
  const around = data.finished ? `Ranked around ${counted(data.finished, 'finished depth map')}: up to there the curve is by what they really keep. ` : '';
  const note = data.real
    ? `Dashed: what fusion keeps of the ${counted(data.real.maps, 'depth map')} in ${data.real.folder}${data.real.reference ? ' against the reference'
      : ' (without --reference every depth counts as right)'}, over what is expected of all depth maps: an estimate of the share of the area${data.finished ? ' around the finished ones' : ''}.`
    : !data.makes_maps ? 'Predicted.' : 'Predicted. To add finished depth maps from another folder to the curve: viewrank report --depth-maps DIR.';
  byId('curve-note').textContent = around + note;
  byId('bound').textContent = boundText();
  byId('bound').parentElement.hidden = !boundText();
}

// What all depth maps give, and the bound of method 5.2 for the plan's cut.
function boundText() {
  const { reachable, reachable_band: band, fulfilment, fulfilment_bound: bound, given_up: lost, pairs_beyond_gate: beyond } = data.limits;
  if (!data.makes_maps || !(fulfilment > 0)) return '';
  const better = Math.max(0, bound / fulfilment - 1);
  const range = ({ low, high }) => `${Math.floor(100 * low)} to ${Math.ceil(100 * high)}\u00a0%`;
  const part = weight => percent(reachable ? weight / reachable : 0);
  const once = lost.single_map > 0 ? `; ${part(lost.single_map)} of it is shown well by one planned map only` : '';
  const givenUp = lost.border + lost.inside > 0 ? ` The plan gives up ${part(lost.border)} at the border and ${part(lost.inside)} inside${once}.` : '';
  const gate = beyond ? ` ${counted(beyond, 'pair')} of the plan exceed the limits of the backend, for want of better partners.` : '';
  return `All depth maps give ${percent(reachable, 0)} of what is wanted (likely ${range(band)}).${givenUp}${gate} No other choice of ${grouped.format(data.cut)} has a fulfilment ${better < 0.005 ? 'even 0.5 %' : `more than ${percent(better, 0)}`} higher than the plan's.`;
}

function fillOver() {
  const chosen = byId('over').value || 'maps';
  const known = Object.keys(overs).filter(key => (key === 'maps' || data.makes_maps) && (key !== 'time' || timesKnown()) && (key !== 'work' || ranking.work));
  byId('over').replaceChildren(...known.map(key => make('option', { value: key }, overs[key].label)));
  byId('over').parentElement.hidden = known.length < 2;
  byId('over').value = known.includes(chosen) ? chosen : 'maps';
}
