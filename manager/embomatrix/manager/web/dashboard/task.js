// One task: instruction, objects, transcript, and the oracle's plan on the floor plan.
import {ask, picture} from "./ask.js";
import {at, categoryWords, h, none, put, splitWords, table} from "./dom.js";
import {close as stop, follower} from "./follow.js";
import {drawn} from "./plan.js";

/** Raised when the page is opened or closed: answers to an earlier page are not shown. */
let turn = 0;

export function close() {
  turn += 1;
  stop();
}

/** Show the task in a place, or why the manager does not show it. */
export async function open(place, task_id) {
  const mine = ++turn;
  let detail;
  try {
    detail = await ask(`tasks/${encodeURIComponent(task_id)}`);
  } catch (error) {
    if (mine === turn) place.replaceChildren(h("section", {}, h("p", {}, h("a", {href: "#tasks"}, "All tasks")), none(error.message)));
    return;
  }
  if (mine !== turn) return;
  draw(place, detail);
  if (detail.card.picture) await depict(detail.card, mine);
}

/** Show the scene's picture, or why there is none. */
async function depict(card, mine) {
  let shown;
  try {
    shown = h("img", {alt: `rendered picture of ${card.scene_id}`, src: await picture(`scenes/${card.bundle_digest}/picture`)});
  } catch (error) {
    shown = none(error.message);
  }
  if (mine === turn) put(at("picture"), shown);
}

function draw(place, detail) {
  const {card} = detail, about = new Set(detail.objects.filter(row => row.goal).map(row => row.name));
  const {moments} = detail, view = drawn(detail.floor, {rooms: detail.rooms, about, things: detail.things, label: `floor plan of ${card.scene_id}`});
  const facts = [["scene", card.scene_id], ["category", categoryWords(card.category)], ["split", splitWords(card.split)], ["source", detail.source], ["profile", detail.profile], ["goal type", detail.signature]];
  const {list, controls, go} = follower(view, moments, moments.map((moment, i) => ({words: moment.call || "start", moment: i, below: ""})));
  place.replaceChildren(
    h("section", {}, h("h2", {}, h("a", {href: "#tasks"}, "All tasks"), h("small", {}, card.task_id)), h("p", {class: "instruction"}, card.instruction),
      h("dl", {class: "facts"}, facts.filter(([, value]) => value).map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))))),
    h("section", {class: "most"}, h("h2", {}, "The oracle's plan ", h("small", {}, "moved objects are drawn at their targets, not at their verified poses")), view.picture, view.key,
      controls),
    h("section", {class: "third"}, h("h2", {}, "Steps ", h("small", {}, detail.problem)), list),
    card.picture ? h("section", {class: "half"}, h("h2", {}, "Picture"), h("div", {id: "picture"})) : "",
    h("section", {class: card.picture ? "half" : ""}, h("h2", {}, "Goal"), h("pre", {class: "goaltext", tabindex: "0"}, detail.goal)),
    h("section", {}, h("h2", {}, "Objects ", h("small", {}, "object table of the plans; goal objects in bold")), objects(detail.objects)),
    detail.transcript ? h("section", {class: detail.tree ? "half" : ""}, h("h2", {}, "Transcript"), transcript(detail.transcript)) : "",
    detail.tree ? h("section", {class: detail.transcript ? "half" : ""}, h("h2", {}, "Layout tree"), tree(detail.tree)) : "");
  go(0);
}

function objects(rows) {
  return table([["row", "n"], "name", "room", "where", ["size (m)", "wideonly"], ["mass (kg)", "n wideonly"], "state"], rows.map((row, i) => h("tr", {class: row.goal ? "goal" : ""},
    h("td", {class: "n fit"}, i), h("td", {}, row.name), h("td", {}, row.room), h("td", {}, row.where), h("td", {class: "wideonly"}, row.size_m.map(m => m.toFixed(2)).join(" × ")), h("td", {class: "n wideonly"}, row.mass_kg), h("td", {}, row.states))), "objects of the task", "loose");
}

/** Markdown of the social agents: headings, lists, bold; everything else stays text. */
function transcript(text) {
  const strong = line => line.split(/\*\*(.+?)\*\*/).map((part, i) => i % 2 ? h("strong", {}, part) : part);
  return h("div", {class: "talk"}, text.trim().split(/\n\s*\n/).filter(block => !block.startsWith("# ")).map(block => {
    if (block.startsWith("## ")) return h("h3", {}, strong(block.slice(3)));
    if (block.startsWith("* ")) return h("ul", {}, block.split("\n").map(line => h("li", {}, strong(line.replace(/^\* /, "")))));
    return h("p", {}, strong(block));
  }));
}

function tree(node) {
  if (Array.isArray(node)) return h("ul", {}, node.map(inner => h("li", {}, tree(inner))));
  if (node && typeof node === "object") return h("ul", {}, Object.entries(node).map(([name, inner]) => h("li", {}, `${name} `, tree(inner))));
  return h("span", {}, node === null ? "" : String(node));
}
