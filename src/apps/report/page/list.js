// The ranked list. Only visible rows are elements, so that thousands of views scroll smoothly.
'use strict';

const ROW = 64;
const collator = new Intl.Collator('en', { numeric: true });
// By rank; views without a rank last, by name.
const inOrder = Array.from({ length: views.count }, (_, view) => view)
  .sort((a, b) => (views.rank[a] || Infinity) - (views.rank[b] || Infinity) || collator.compare(names[a], names[b]));
let listed = inOrder;

function filterList() {
  const wanted = byId('search').value.trim().toLowerCase(), which = byId('which').value;
  listed = inOrder.filter(view => (!wanted || names[view].toLowerCase().includes(wanted)) && (which === 'all' || statusOf(view, state.cut) === which));
  byId('list-space').style.height = `${listed.length * ROW}px`;
  drawList();
}

function drawList() {
  const list = byId('list'), first = Math.max(0, Math.floor(list.scrollTop / ROW) - 2);
  const last = Math.min(listed.length, Math.ceil((list.scrollTop + list.clientHeight) / ROW) + 2);
  const rows = [];
  for (let place = first; place < last; place++) rows.push(listRow(place));
  if (!listed.length) rows.push(make('p', { class: 'empty' }, emptyText()));
  byId('list-space').replaceChildren(...rows);
  const on = listed.indexOf(state.selected);
  if (on >= first && on < last) list.setAttribute('aria-activedescendant', `row-${state.selected}`); else list.removeAttribute('aria-activedescendant');
}

function emptyText() {
  const wanted = byId('search').value.trim(), found = data.unregistered.find(name => name.toLowerCase().includes(wanted.toLowerCase()));
  return found && wanted ? `${found} has no pose in the sparse model and cannot be used.` : data.makes_maps ? 'No such view.' : 'No such image.';
}

function listRow(place) {
  const view = listed[place], rank = views.rank[view], status = statusOf(view, state.cut);
  const picture = data.thumbnails[view]
    ? make('img', { src: `data:image/jpeg;base64,${data.thumbnails[view]}`, alt: '', width: 76, height: 56 })
    : make('span', { class: 'no-image' });
  const row = make('div', { class: 'row', role: 'option', id: `row-${view}`, 'aria-selected': view === state.selected,
    'aria-posinset': place + 1, 'aria-setsize': listed.length },
    make('span', { class: 'rank' }, rank ? String(rank) : '–'), picture,
    make('span', {}, make('div', { class: 'name', title: names[view] }, make('bdi', {}, names[view])),
      make('div', { class: 'because' }, make('span', { class: `tag ${status}` }, `${statusWords[status]}${status === 'key' && isHalf(rank) ? ', half size' : ''}`), ` ${becauseShort(view)}`)),
    make('span', { class: 'gain', title: `Share ${ofAll} that it adds at its rank` }, rank ? gainText(rank) : '0'));
  row.style.top = `${place * ROW}px`;
  if (view === state.selected) row.classList.add('on');
  if (rank === state.cut + 1) row.classList.add('first-left-out');
  row.addEventListener('click', () => change({ selected: view }));
  row.addEventListener('pointerenter', () => change({ hovered: view }));
  row.addEventListener('pointerleave', () => change({ hovered: -1 }));
  return row;
}

// Scrolls to the selected view.
function showInList() {
  const list = byId('list'), place = listed.indexOf(state.selected);
  if (place < 0) return;
  if (place * ROW < list.scrollTop) list.scrollTop = place * ROW;
  if ((place + 1) * ROW > list.scrollTop + list.clientHeight) list.scrollTop = (place + 1) * ROW - list.clientHeight;
}

function setUpList() {
  const list = byId('list');
  list.addEventListener('scroll', () => requestAnimationFrame(drawList));
  list.addEventListener('keydown', event => {
    const page = Math.max(1, Math.floor(list.clientHeight / ROW) - 1), place = listed.indexOf(state.selected);
    const moves = { ArrowDown: place + 1, ArrowUp: place - 1, PageDown: place + page, PageUp: place - page, Home: 0, End: listed.length - 1 };
    if (!(event.key in moves) || !listed.length) return;
    event.preventDefault();
    change({ selected: listed[Math.min(listed.length - 1, Math.max(0, moves[event.key]))] });
  });
  byId('search').addEventListener('input', () => { list.scrollTop = 0; filterList(); });
  byId('search').addEventListener('keydown', event => {
    if (event.key === 'Enter' && listed.length) { event.preventDefault(); change({ selected: listed[0] }); }
  });
  byId('which').addEventListener('change', () => { list.scrollTop = 0; filterList(); });
  window.addEventListener('resize', drawList);
  window.addEventListener('beforeprint', fillPrintList);
}

// Key views on the printed list, so that the print fits two sheets.
const PRINTED = 18;

// The first key views up to the cut as a plain table.
function fillPrintList() {
  const shown = Math.min(state.cut, PRINTED), partners = rank => Array.from(partnersOf(rank), p => names[p]);
  const some = list => list.length > 5 ? `${list.slice(0, 5).join(', ')} and ${list.length - 5} more` : list.join(', ');
  const columns = ['rank', 'adds', 'reached', ...(data.makes_maps ? ['key view', 'partners'] : ['image'])];
  const head = make('tr', {}, ...columns.map(text => make('th', { scope: 'col' }, text)));
  const rows = Array.from(ranking.keys.subarray(0, shown), (view, i) => make('tr', {},
    ...[i + 1, gainText(i + 1), percent(shareAt(i + 1)), `${names[view]}${isHalf(i + 1) ? ' (half size)' : ''}`, ...(data.makes_maps ? [some(partners(i + 1))] : [])].map(text => make('td', {}, String(text)))));
  if (shown < state.cut) rows.push(make('tr', {}, make('td', { colspan: 5 }, `and ${grouped.format(state.cut - shown)} more in viewrank/manifest.csv`)));
  byId('print-list').replaceChildren(head, ...rows);
}
