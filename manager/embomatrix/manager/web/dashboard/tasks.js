// Tasks of the dataset: a gallery with pictures of their scenes, and a page for each task.
import {ask, picture} from "./ask.js";
import {at, categoryWords, count, counted, decoded, h, lastPage, none, put, splitWords} from "./dom.js";
import {drawn} from "./plan.js";
import * as task from "./task.js";

const CARDS = 24, TYPING_MS = 250, AGAIN_MS = 5000;
const filters = {search: "", scene: "", category: "", offset: 0};
let pictures = new Map(), watcher = null, typed = 0, again = 0, total = 0;
/** Number of the latest request for a page of tasks; answers of earlier ones are not shown. */
let asked = 0;

export function open(main) {
  const chosen = location.hash.split("?")[1];
  if (chosen) {
    main.replaceChildren(h("section", {}, none("Loading the task…")));
    task.open(main, decoded(chosen));
    return;
  }
  watcher = new IntersectionObserver(seen => seen.filter(one => one.isIntersecting).forEach(({target}) => { watcher.unobserve(target); look(target); }), {rootMargin: "200px"});
  main.replaceChildren(h("section", {}, h("h2", {}, "Scenes and tasks ", h("small", {id: "total"})),
    h("div", {class: "bar"},
      h("input", {type: "search", maxlength: 200, placeholder: "words of the instruction", "aria-label": "search", value: filters.search, oninput: event => { clearTimeout(typed); typed = setTimeout(() => turn({search: event.target.value}), TYPING_MS); }}),
      h("select", {id: "scene", "aria-label": "scene", onchange: event => turn({scene: event.target.value})}),
      h("select", {id: "category", "aria-label": "category", onchange: event => turn({category: event.target.value})}),
      h("button", {id: "before", type: "button", onclick: () => turn({offset: Math.max(0, filters.offset - CARDS)})}, "Previous"),
      h("button", {id: "after", type: "button", onclick: () => turn({offset: filters.offset + CARDS})}, "Next")),
    h("div", {id: "cards", class: "cards"}, none("Loading the dataset…"))));
  turn({offset: filters.offset});
}

export function close() {
  asked += 1;
  task.close();
  clearTimeout(typed);
  clearTimeout(again);
  watcher?.disconnect();
  watcher = null;
}

/** Tasks are read from files and are not part of the snapshot. */
export function show() {}

async function turn(changes) {
  Object.assign(filters, {offset: 0}, changes);
  const mine = ++asked;
  let shown = false;
  try {
    const page = await ask(`tasks?${new URLSearchParams({...filters, limit: CARDS})}`);
    if (mine !== asked) return;
    if (!page.items.length && page.total) {
      turn({offset: lastPage(page.total, CARDS)});
      return;
    }
    list(page);
    shown = !page.notice;
  } catch (error) {
    if (mine !== asked) return;
    put(at("cards"), none(error.message));
  }
  clearTimeout(again);
  // A dataset may be written while the page is open.
  if (!shown) again = setTimeout(() => turn({offset: filters.offset}), AGAIN_MS);
}

function list(page) {
  ({total} = page);
  const last = page.offset + page.items.length;
  at("total").textContent = total ? `${count(page.offset + 1)} to ${count(last)} of ${counted(total, "task")}, ${counted(page.scenes.length, "scene")}` : "";
  at("before").disabled = page.offset === 0;
  at("after").disabled = last >= total;
  choices("scene", "all scenes", page.scenes.map(one => [one.scene_id, `${one.scene_id} (${count(one.tasks)})`]));
  choices("category", "all categories", page.categories.map(name => [name, categoryWords(name)]));
  put(at("cards"), page.items.length ? page.items.map(card) : none(page.notice || "No task matches."));
  for (const place of at("cards").querySelectorAll(".thumb:empty")) watcher.observe(place);
}

function choices(id, every, pairs) {
  put(at(id), h("option", {value: ""}, every), pairs.map(([value, words]) => h("option", {value, selected: value === filters[id]}, words)));
}

function card(one) {
  return h("a", {class: "card", href: `#tasks?${encodeURIComponent(one.task_id)}`}, h("span", {class: "thumb", "data-digest": one.bundle_digest, "data-picture": String(one.picture), "data-scene": one.scene_id}),
    h("span", {class: "instruction"}, one.instruction), h("span", {class: "muted facts"}, [categoryWords(one.category), one.scene_id, `${one.steps} steps`, splitWords(one.split)].map(fact => h("span", {}, fact))));
}

async function look(place) {
  const {digest, scene} = place.dataset;
  try {
    if (place.dataset.picture === "true") {
      place.replaceChildren(h("img", {alt: `picture of ${scene}`, src: await once(`scenes/${digest}/picture`, picture)}));
    } else {
      place.replaceChildren(drawn(await once(`scenes/${digest}/floor`, ask), {label: `floor plan of ${scene}`}).picture);
    }
  } catch (error) {
    place.replaceChildren(none(error.message));
  }
}

/** Each scene is requested once, however many of its tasks are shown. */
function once(path, how) {
  if (pictures.size > 4 * CARDS) pictures = new Map();
  if (!pictures.has(path)) pictures.set(path, how(path).catch(error => { pictures.delete(path); throw error; }));
  return pictures.get(path);
}
