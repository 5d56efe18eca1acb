// Contents of the page: the JSON of src/apps/report/contents.rs with its arrays decoded.
'use strict';

const data = JSON.parse(document.getElementById('data').textContent);

function decode(text, Type) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return new Type(bytes.buffer);
}

const names = data.views.names;
const views = {
  count: names.length,
  centres: decode(data.views.centres, Float32Array),
  directions: decode(data.views.directions, Float32Array),
  footprints: decode(data.views.footprints, Float32Array),
  footprintOffsets: decode(data.views.footprint_offsets, Uint32Array),
  rank: decode(data.views.rank, Uint32Array),
  reason: decode(data.views.reason, Uint8Array),
  likestOffsets: decode(data.views.likest_offsets, Uint32Array),
  likest: decode(data.views.likest, Uint32Array),
  likestShares: decode(data.views.likest_shares, Float32Array),
  seen: decode(data.views.seen, Uint32Array),
};
const ranking = {
  keys: decode(data.ranking.keys, Uint32Array),
  partners: decode(data.ranking.partners, Uint32Array),
  partnerOffsets: decode(data.ranking.partner_offsets, Uint32Array),
  gains: decode(data.ranking.gains, Float64Array),
  shares: decode(data.ranking.shares, Float64Array),
  points: decode(data.ranking.points, Float64Array),
  // Null where all depth maps have one size.
  ofFull: data.ranking.sizes && decode(data.ranking.sizes.of_full, Float64Array),
  work: data.ranking.sizes && decode(data.ranking.sizes.work, Float64Array),
};
const surface = {
  vertices: decode(data.surface.vertices, Float32Array),
  triangles: decode(data.surface.triangles, Uint32Array),
  offsets: decode(data.surface.offsets, Uint32Array),
  ranks: decode(data.surface.ranks, Uint32Array),
  shares: decode(data.surface.shares, Uint8Array),
  first: decode(data.surface.first, Uint32Array),
  alone: decode(data.surface.alone, Uint32Array),
  kept: decode(data.surface.kept, Uint32Array),
  reachable: decode(data.surface.reachable, Uint8Array),
  reason: decode(data.surface.reason, Uint8Array),
  real: data.real ? decode(data.real.triangles, Uint8Array) : null,
  weightShade: decode(data.surface.weights, Uint8Array),
};
// Images to take.
const flight = {
  centres: decode(data.flight.centres, Float32Array),
  directions: decode(data.flight.directions, Float32Array),
  count: data.flight.holes.length,
};
surface.count = surface.triangles.length / 3;
if (data.region) {
  data.region.inside = decode(data.region.inside, Uint8Array);
  data.region.border = decode(data.region.border, Uint32Array);
  for (const rings of ['outline', 'unseen', 'seen_once', 'unbuilt']) data.region[rings] = data.region[rings].map(ring => decode(ring, Float32Array));
}
const COUNTED = surface.count ? surface.first.length / surface.count : 0;
const clusters = ranking.keys.length;

// Rank (from 1) of the first key view that each view is a partner of.
const partnerFrom = new Uint32Array(views.count).fill(0xffffffff);
// Sums over the first i clusters.
const pairsUpTo = new Float64Array(clusters + 1), pointsUpTo = new Float64Array(clusters + 1), halvesUpTo = new Uint32Array(clusters + 1);
// In depth maps and pairs at full size.
const fullMapsUpTo = new Float64Array(clusters + 1), fullPairsUpTo = new Float64Array(clusters + 1);
for (let i = 0; i < clusters; i++) {
  for (const view of partnersOf(i + 1)) partnerFrom[view] = Math.min(partnerFrom[view], i + 1);
  const pairs = ranking.partnerOffsets[i + 1] - ranking.partnerOffsets[i], ofFull = ranking.ofFull ? ranking.ofFull[i] : 1;
  pairsUpTo[i + 1] = pairsUpTo[i] + pairs;
  fullMapsUpTo[i + 1] = fullMapsUpTo[i] + ofFull;
  fullPairsUpTo[i + 1] = fullPairsUpTo[i] + ofFull * pairs;
  halvesUpTo[i + 1] = halvesUpTo[i] + (ofFull < 1 ? 1 : 0);
  pointsUpTo[i + 1] = pointsUpTo[i] + ranking.points[i];
}

// True if the depth map of this rank is computed at half the size.
function isHalf(rank) {
  return rank > 0 && halvesUpTo[rank] > halvesUpTo[rank - 1];
}

function partnersOf(rank) {
  return ranking.partners.subarray(ranking.partnerOffsets[rank - 1], ranking.partnerOffsets[rank]);
}

// The cluster up to the cut that best substitutes for the view: its rank, and the share of the view's own fulfilment that it gives; or undefined.
function substituteAt(view, cut) {
  const end = views.likestOffsets[view + 1];
  let at = views.likestOffsets[view];
  while (at < end && views.likest[at] <= cut) at++;
  return at > views.likestOffsets[view] ? { rank: views.likest[at - 1], share: views.likestShares[at - 1] } : undefined;
}

function shareAt(cut) {
  return cut > 0 ? ranking.shares[cut - 1] : 0;
}

// The smallest number of depth maps that reaches a share.
function cutFor(share) {
  let low = 0, high = clusters;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (shareAt(middle) < share - 1e-12) low = middle + 1; else high = middle;
  }
  return low;
}

function statusOf(view, cut) {
  if (views.rank[view] && views.rank[view] <= cut) return 'key';
  return data.makes_maps && partnerFrom[view] <= cut ? 'partner' : 'unused';
}

// State of the page; listeners redraw what depends on the changed keys.
// The page begins with the finished maps, if those are the first of the plan and more than it was made around, so that its headline is what was measured; else with the plan.
const begun = finishedUpTo(Infinity);
const firstCut = measuredAt(begun) === null || begun <= data.finished ? data.cut : begun;
const state = { cut: firstCut, selected: -1, hovered: -1, colour: 'share', perPair: data.forecast.seconds_per_pair, perMap: data.forecast.seconds_per_map };
const listeners = [];

function change(what) {
  Object.assign(state, what);
  for (const listener of listeners) listener(what);
}

const grouped = new Intl.NumberFormat('en');

function percent(share, digits = 1) {
  return `${(100 * share).toFixed(digits).replace(/^-(0(\.0*)?)$/, '$1')}\u00a0%`;
}

// Number of finished depth maps among those up to a rank.
function finishedUpTo(rank) {
  return data.real ? data.real.ranks.filter(finished => finished <= rank).length : 0;
}

// Measured share of the maps up to a rank; null unless all of them are finished.
function measuredAt(rank) {
  return rank && finishedUpTo(rank) === rank ? data.real.share[rank - 1] : null;
}

// Share added by a cluster at its rank, with more digits where it is small. None where another map has to confirm it first.
function gainText(rank) {
  const share = shareAt(rank) - shareAt(rank - 1);
  // Of the first map, nothing counts until another agrees.
  if (rank === 1 && share <= 0) return 'with others';
  return `+${percent(share, share >= 0.001 || share <= 0 ? 1 : 4)}`;
}

function short(number) {
  if (number < 9999.5) return grouped.format(Math.round(number));
  // 0.9995 of a power rounds up to the power itself.
  const [power, letter] = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k']].find(([power]) => number >= 0.9995 * power);
  return `${(number / power).toPrecision(3)} ${letter}`;
}

// "1 depth map", "2 depth maps".
function counted(number, what) {
  return `${rounded(number)} ${what}${number === 1 ? '' : 's'}`;
}

function duration(seconds) {
  const minutes = Math.round(seconds / 60);
  if (seconds < 120) return `${Number(seconds.toPrecision(3))} s`;
  if (minutes < 120) return `${minutes} min`;
  if (minutes < 48 * 60) return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
  return `${(minutes / 1440).toFixed(1)} days`;
}

function rounded(number) {
  if (!number) return '0';
  const digits = Math.max(0, 2 - Math.floor(Math.log10(Math.abs(number))));
  return digits > 8 ? number.toPrecision(3) : Number(number.toFixed(digits)).toLocaleString('en', { maximumFractionDigits: digits });
}

// A program that uses the images themselves makes no depth maps (method 5.10).
const products = data.makes_maps ? 'depth maps' : 'images';
const statusWords = data.makes_maps ? { key: 'key view', partner: 'partner', unused: 'unused' } : { key: 'taken', unused: 'left out' };
// The denominator of every share.
const ofAll = data.makes_maps ? 'of the area that all depth maps cover' : 'of what all images draw';

// Follows the denominator.
const inRegion = data.region ? ' inside the region' : '';

// Lengths of the scene are shown in metres where these are known.
const unit = data.metres ? 'm' : 'units';
const perUnit = data.metres || 1;

// Creates an element; `onclick` is a listener, other attributes are text.
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === 'onclick') element.addEventListener('click', value); else element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

function viewButton(view, text = names[view]) {
  return make('button', { type: 'button', class: 'link', onclick: () => change({ selected: view }) }, text);
}

function byId(id) {
  return document.getElementById(id);
}
