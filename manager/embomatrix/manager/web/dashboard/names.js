// What scenes are called: where the manager shows a dataset, by its names, else by the first letters of their digests.
import {ask} from "./ask.js";
import {brief} from "./dom.js";

const AGAIN_MS = 60_000, MOST = 1000;
let known = {}, due = 0;

export const named = digest => known[digest] ?? brief(digest);
/** A sentence of a worker's or the manager's, with scenes by their names. */
export const worded = text => text.replace(/sha256:[0-9a-f]{64}/g, named);

/** Ask for names, and again now and then: a dataset may grow. */
export async function learn() {
  if (performance.now() < due) return;
  due = performance.now() + AGAIN_MS;
  try {
    known = Object.fromEntries((await ask(`scenes?limit=${MOST}`)).map(scene => [scene.bundle_digest, scene.scene_id]));
  } catch { /* digests will do until then */ }
}
