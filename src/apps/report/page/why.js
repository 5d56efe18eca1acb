// Explains why a view is a chosen key view or not.
'use strict';

function reasonOf(view) {
  return views.reason[view] ? data.reasons[views.reason[view] - 1] : '';
}

// Explains the view's refused pairs if they are the reason.
function pairsOf(view) {
  return data.views.partners[view] ? ` (${data.views.partners[view]})` : '';
}

// One line for the list.
function becauseShort(view) {
  const rank = views.rank[view];
  if (rank && rank <= data.finished) return `finished, ${percent(shareAt(rank))} so far`;
  if (data.real && data.real.ranks.includes(rank)) return `finished; ${percent(shareAt(rank))} was planned so far`;
  if (rank && rank <= state.cut) return `${percent(shareAt(rank))} so far`;
  const substitute = substituteAt(view, state.cut);
  if (substitute && substitute.share >= 0.5) return `${names[ranking.keys[substitute.rank - 1]]} gives ${percent(substitute.share, 0)} of what it could`;
  if (rank) return `after the cut, at rank ${rank}`;
  return reasonOf(view) || 'adds nothing to those before it';
}

function drawWhy() {
  const view = state.selected, box = byId('why-box');
  box.classList.toggle('chosen', view >= 0);
  byId('why-name').textContent = view < 0 ? `Why is ${data.makes_maps ? 'a view' : 'an image'} chosen or not?` : names[view];
  if (view < 0) {
    byId('why').replaceChildren(make('p', {}, `Select ${data.makes_maps ? 'a view' : 'an image'} in the list or on the map, or search by name.`), summary());
    return;
  }
  const parts = [];
  if (data.thumbnails[view]) parts.push(make('img', { src: `data:image/jpeg;base64,${data.thumbnails[view]}`, alt: `Thumbnail of ${names[view]}` }));
  if (data.makes_maps && data.expected[view]) {
    parts.push(make('img', { src: `data:image/jpeg;base64,${data.expected[view]}`, alt: `Where the depth map of ${names[view]} is expected to succeed` }));
    parts.push(make('p', { class: 'note' }, 'Second picture: where its depth map is expected to succeed, from dark (fails) to yellow (succeeds); grey: no surface that it sees.'));
  }
  const status = statusOf(view, state.cut);
  parts.push(make('p', {}, make('span', { class: `tag ${status}` }, `${statusWords[status]}${isHalf(views.rank[view]) && status === 'key' ? ', half size' : status === 'partner' ? ' only' : ''}`)));
  parts.push(...(status === 'key' ? whyIn(view) : whyNot(view)));
  const keys = data.makes_maps ? keysWith(view, state.cut) : [];
  if (keys.length) parts.push(make('p', {}, `${keys.length} chosen key view${keys.length > 1 ? 's are' : ' is'} matched against it:`), viewList(keys));
  parts.push(make('p', { class: 'note' }, `It sees ${grouped.format(views.seen[view])} of the ${grouped.format(data.triangles)} triangles; the dashed line on the map outlines them.`));
  byId('why').replaceChildren(...parts);
}

function whyIn(view) {
  const rank = views.rank[view], partners = Array.from(partnersOf(rank));
  const why = rank <= data.finished ? 'Chosen: its depth map is finished, and the others are ranked after it. Measured, it adds'
    : `Chosen: rank ${rank} of ${state.cut}, because no other adds more at that rank. It adds`;
  const parts = [
    make('p', { class: 'answer' }, `${why} ${gainText(rank)} ${ofAll}, from ${percent(shareAt(rank - 1))} to ${percent(shareAt(rank))}.`
      + ' Triangles that it improves are purple on the map.')];
  if (!data.makes_maps) return parts;
  parts.push(make('p', {}, `It is matched against ${partners.length} partner${partners.length === 1 ? '' : 's'}, best first:`), viewList(partners));
  if (isHalf(rank)) parts.push(make('p', {}, 'It is matched at half the size, which gives most for the work of the plan.'));
  if (partners.length < data.wanted_partners) {
    parts.push(make('p', {}, `Fewer than the ${data.wanted_partners} wanted, because ${reasonOf(view) || 'there are no others'}${pairsOf(view)}.`));
  }
  return parts;
}

function whyNot(view) {
  const rank = views.rank[view], substitute = substituteAt(view, state.cut), reason = reasonOf(view), parts = [];
  if (rank) {
    parts.push(make('p', { class: 'answer' }, `Not chosen: its rank is ${rank}, and the cut is at ${state.cut}. It would add ${gainText(rank)}.`),
      make('button', { type: 'button', onclick: () => change({ cut: rank }) }, `Move the cut to ${rank}`));
  } else {
    parts.push(make('p', { class: 'answer' }, reason ? `Not chosen, because ${reason}${pairsOf(view)}.` : 'Not chosen: others add more at every rank, until it adds nothing.'));
  }
  if (substitute && data.makes_maps) {
    parts.push(make('p', {}, viewButton(ranking.keys[substitute.rank - 1]), ` (key view ${substitute.rank}) gives ${percent(substitute.share, 0)} of what it could do by itself.`));
  }
  if (rank && reason && state.cut === data.cut) parts.push(make('p', {}, `At the plan's cut it is not chosen because ${reason}${pairsOf(view)}.`));
  return parts;
}

function viewList(list) {
  const button = view => make('li', {}, viewButton(view));
  const rest = list.length > 12 ? [make('li', {}, `and ${list.length - 12} more`)] : [];
  return make('ul', {}, ...list.slice(0, 12).map(button), ...rest);
}

// Counts the views by status, and at the plan's cut by reason.
function summary() {
  const counts = { key: 0, partner: 0, unused: 0 }, reasons = new Map();
  for (let view = 0; view < views.count; view++) {
    const status = statusOf(view, state.cut);
    counts[status]++;
    if (status !== 'key' && reasonOf(view)) reasons.set(reasonOf(view), (reasons.get(reasonOf(view)) || 0) + 1);
  }
  const tests = data.kept_for_tests, forTests = tests ? [['kept apart for tests', tests]] : [];
  const rows = data.makes_maps ? [['key views', counts.key], ['partners only', counts.partner], ['unused', counts.unused]]
    : [['taken', counts.key], ['left out', counts.unused - tests], ...forTests];
  if (data.unregistered.length) rows.push(['without a pose in the sparse model', data.unregistered.length]);
  const table = make('table', {}, ...rows.map(([what, n]) => make('tr', {}, make('td', {}, what), make('td', {}, grouped.format(n)))));
  if (state.cut !== data.cut || !reasons.size) return table;
  const why = [...reasons].sort((a, b) => b[1] - a[1]).map(([reason, n]) => make('li', {}, `${grouped.format(n)}: ${reason}`));
  return make('div', {}, table, make('p', {}, `${data.makes_maps ? 'Views' : 'Images'} that are left out, by reason:`), make('ul', {}, ...why));
}
