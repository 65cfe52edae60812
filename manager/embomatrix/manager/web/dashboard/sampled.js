// One plan or episode that a trainer reported: what the policy wrote, what became of it, and the robot's way on the floor plan.
import {Refused, ask} from "./ask.js";
import {at, count, counted, h, none} from "./dom.js";
import {close as stop, follower} from "./follow.js";
import {verdict} from "./parts.js";
import {drawn} from "./plan.js";

const ENDS = {done: "the policy said that it was done", goal: "the goal was reached", calls: "the budget of calls was used up", loop: "the same call failed time after time", tokens: "the policy had no room for another answer"};
let shown = null, loaded = false;

export function open(main, run_id, number) {
  shown = {run_id, number}; loaded = false;
  main.replaceChildren(h("section", {id: "loading"}, none("Loading the plan…")));
}

export const close = stop;

/** The plan is shown as it was when the page was opened: the next step of the trainer brings others. */
export async function show() {
  if (loaded) return;
  const {run_id, number} = shown;
  try {
    const view = await ask(`training/${encodeURIComponent(run_id)}/plans/${encodeURIComponent(number)}`);
    if (!at("loading") || shown.run_id !== run_id || shown.number !== number) return;
    loaded = true;
    draw(at("main"), view);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (at("loading")) at("loading").replaceChildren(h("p", {}, above(run_id)), none(error.message));
  }
}

const address = (run_id, number) => `#training?${encodeURIComponent(run_id)}&${number}`;
const above = run_id => h("a", {href: `#training?${encodeURIComponent(run_id)}`}, "Training of this run");

function draw(main, {step, number, count: all, plan, task, notice}) {
  const about = new Set(task?.objects.filter(row => row.goal).map(row => row.name));
  const moments = task?.moments ?? [], fits = moments.length === plan.steps.length + 1;
  const view = task && drawn(task.floor, {rooms: task.rooms, about, things: task.things, label: `floor plan of ${task.card.scene_id}`});
  const calls = plan.steps.map(call => moments.length && fits ? null : call.call || call.skill);
  const words = i => calls[i] ?? moments[i + 1].call;
  const entries = plan.turns.length ? ofEpisode(plan, words) : ofPlan(plan, words);
  const {list, controls, go} = follower(fits ? view : null, fits ? moments : [], entries);
  const others = Array.from({length: all}, (_, i) => h("a", {href: address(shown.run_id, i + 1), "aria-current": i + 1 === number ? "page" : false, class: "other"}, `${i + 1}`));
  main.replaceChildren(
    h("section", {}, h("h2", {}, above(shown.run_id), h("small", {}, `step ${count(step)}, ${plan.turns.length ? "episode" : "plan"} ${number} of ${all}, from the best to the worst of one task: `, others)),
      h("p", {class: "instruction"}, plan.instruction), h("p", {}, verdict(plan)), plan.problem && h("p", {class: "bad message"}, plan.problem),
      plan.end && h("p", {class: "sentence"}, `The episode ended after ${counted(plan.turns.length, "answer")} with ${counted(plan.steps.length, "call")}: ${ENDS[plan.end] ?? plan.end}.`)),
    h("section", {class: "half"}, h("h2", {}, "Floor plan ", h("small", {}, "moved objects are drawn at their targets")), view ? [view.picture, view.key] : none(notice), task?.problem ? h("p", {class: "bad"}, task.problem) : "", controls,
      task ? h("p", {}, h("a", {href: `#tasks?${encodeURIComponent(plan.task_id)}`}, "The task, with the oracle's plan")) : ""),
    h("section", {class: "half"}, h("h2", {}, plan.turns.length ? "Turns " : "Calls ", h("small", {}, "arrow keys move through them")), list),
    plan.opening ? h("section", {}, h("h2", {}, "What the policy was told first"), h("pre", {class: "goaltext", tabindex: "0"}, plan.opening)) : "",
    plan.turns.length ? "" : h("section", {}, h("h2", {}, "What the policy wrote"), h("pre", {class: "goaltext", tabindex: "0"}, plan.text || "(nothing)")));
  go(0);
}

/** Result of a call in words. */
const result = step => h("p", {class: step.ok ? "told" : "told bad"}, step.message || (step.ok ? "done" : "failed"));

function ofPlan(plan, words) {
  return [{words: "start", moment: 0, below: ""}, ...plan.steps.map((step, i) => ({words: words(i), moment: i + 1, below: result(step)}))];
}

/** An entry for each answer, with what the policy was told after it. */
function ofEpisode(plan, words) {
  let place = 0;
  return [{words: "start", moment: 0, below: ""}, ...plan.turns.map(turn => {
    const from = place;
    place = Math.min(place + turn.steps, plan.steps.length);
    const steps = plan.steps.slice(from, place), bad = steps.some(step => !step.ok) || (!steps.length && turn !== plan.turns.at(-1));
    const said = steps.length ? steps.map((_, i) => words(from + i)).join("; ") : turn.answer.slice(0, 80) || "(nothing)";
    const written = turn.answer.trim() !== said && h("pre", {class: "answer", tabindex: "0"}, turn.answer || "(nothing)");
    return {words: said, moment: place, below: [written, h("p", {class: bad ? "told bad" : "told"}, turn.observation)]};
  })];
}
