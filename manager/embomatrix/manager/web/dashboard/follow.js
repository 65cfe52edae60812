// A plan or an episode on the floor plan, entry by entry: buttons to step through it, and a list of its entries.
import {h} from "./dom.js";

const STEP_MS = 1200;
let playing = 0;

/** Stop the entry that plays. */
export function close() {
  clearInterval(playing);
  playing = 0;
}

/** Controls and list for entries `{words, moment, below}`; `moment` is a place in `moments`, `below` an element or "". The floor plan `view` may be null. */
export function follower(view, moments, entries) {
  let number = 0;
  const last = entries.length - 1, said = h("span", {id: "said", role: "status"});
  const control = (id, words, act) => h("button", {type: "button", id, onclick: act}, words), jump = to => () => { close(); go(to()); };
  const first = control("first", "Start", jump(() => 0)), back = control("back", "Back", jump(() => number - 1)), next = control("next", "Next", jump(() => number + 1)), play = control("play", "Play", toggle);
  const buttons = entries.map(({words}, i) => h("button", {type: "button", class: "step", onclick: jump(() => i)}, words));
  const list = h("ol", {class: "calls", start: "0", onkeydown: key}, entries.map(({below}, i) => h("li", {}, buttons[i], below)));

  function go(to) {
    number = Math.max(0, Math.min(last, to));
    const place = entries[number].moment, {held, active} = moments[place] ?? {held: [], active: []};
    view?.show(moments, place);
    buttons.forEach((button, i) => { if (i === number) button.setAttribute("aria-current", "step"); else button.removeAttribute("aria-current"); });
    said.textContent = `${number} of ${last}${held.length ? `, holds ${held.join(", ")}` : ""}${active.length ? `, open or on: ${active.join(", ")}` : ""}`;
    back.disabled = first.disabled = number === 0;
    next.disabled = number === last;
    play.textContent = playing ? "Pause" : "Play";
    // Scrolls the list, not the page.
    const item = buttons[number].parentElement;
    if (item.offsetTop < list.scrollTop || item.offsetTop + item.offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = item.offsetTop;
  }

  function toggle() {
    if (playing) { close(); go(number); return; }
    if (number === last) number = 0;
    playing = setInterval(() => { if (number >= last - 1) close(); go(number + 1); }, STEP_MS);
    go(number);
  }

  function key(event) {
    const moves = {ArrowDown: 1, ArrowUp: -1};
    if (!(event.key in moves)) return;
    event.preventDefault();
    close();
    go(number + moves[event.key]);
    buttons[number].focus();
  }

  return {list, controls: h("div", {class: "bar"}, first, back, play, next, said), go};
}
