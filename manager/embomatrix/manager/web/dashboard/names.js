// Scene names from the dataset; without one, the first digits of the bundle digest.
import {ask} from "./ask.js";
import {brief} from "./dom.js";

const AGAIN_MS = 60_000, MOST = 1000;
let known = {}, due = 0;

export const named = digest => known[digest] ?? brief(digest);
/** Message with scene names in place of digests. */
export const worded = text => text.replace(/sha256:[0-9a-f]{64}/g, named);

/** Load the names, and reload them regularly, since a dataset may grow. */
export async function learn() {
  if (performance.now() < due) return;
  due = performance.now() + AGAIN_MS;
  try {
    known = Object.fromEntries((await ask(`scenes?limit=${MOST}`)).map(scene => [scene.bundle_digest, scene.scene_id]));
  } catch { /* digests are shown until the next attempt */ }
}
