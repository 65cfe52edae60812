// Role of the viewer's token. Commands that it may not send are disabled, with the reason.
import {ask, change} from "./ask.js";
import {at, h, put} from "./dom.js";

/** States of workers that are no longer connected. */
export const GONE = ["lost", "left"];
/** Name of the command for a worker in this state. Resume ends a drain, and lifts a quarantine. */
export const steering = state => ["draining", "quarantined"].includes(state) ? "Resume" : "Drain";

let known = null, owner = null, asking = null;

/** Reason why this viewer may not send commands; empty if it may. */
export const refusal = () => known?.refusal ?? "";

/** Ask for the role once for each token. */
export async function learnRole() {
  const token = sessionStorage.getItem("token") ?? "";
  if (known && owner === token) return;
  asking ??= ask("caller").finally(() => { asking = null; });
  known = await asking;
  owner = token;
}

/** Attributes of a button that sends a command. */
export const command = (attributes = {}) => refusal() ? {...attributes, disabled: true, title: refusal(), "aria-describedby": "allowed"} : attributes;

/** Send a command, show why it failed in the element "answer", and refresh the page after `ready`. */
export async function steer(path, ready = () => {}) {
  at("answer").textContent = "";
  try {
    await change(path);
  } catch (error) {
    if (at("answer")) at("answer").textContent = error.message;
  }
  ready();
  dispatchEvent(new Event("embomatrix-changed"));
}

/** Show the reason beside disabled buttons, with a way out, in the element "allowed". */
export function showRefusal() {
  put(at("allowed"), refusal() ? [h("span", {}, `${refusal()} `), h("button", {type: "button", class: "small", onclick: enter}, "Enter another token")] : []);
}

/** Open the form for a token; a second press closes it. */
function enter() {
  const form = at("ask");
  if (form.dataset.wanted) {
    delete form.dataset.wanted;
    form.hidden = true;
    return;
  }
  form.dataset.wanted = "yes";
  form.hidden = false;
  at("token").focus();
}
