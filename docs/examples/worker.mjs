// A worker in JavaScript for Node.js 20: the whole WorkerService, with a placeholder for the simulator.
//
//   npm install @grpc/grpc-js@1 @grpc/proto-loader@0.8
//   node worker.mjs PROTO_FOLDER HOST:PORT[,HOST:PORT...] NAME
//
// EMBOMATRIX_TOKEN holds the token, EMBOMATRIX_CA the file with the authority's certificate (PEM). SIGTERM or Ctrl-C
// drains the worker. To make it yours, replace the section "Placeholder simulator".
import { createHash, randomBytes } from "node:crypto";
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { availableParallelism } from "node:os";
import { setTimeout as sleep } from "node:timers/promises";
import { inflateSync } from "node:zlib";
import grpc from "@grpc/grpc-js";
import { loadSync } from "@grpc/proto-loader";

const [protoFolder, managers, name] = process.argv.slice(2);
const addresses = managers.split(",");

const SLOTS = availableParallelism();
const MIB = 2 ** 20;
const BUNDLE = { bytes: 8 * MIB, ratio: 100, values: 400_000, format: 3 };
const RESULT_BYTES = 65_536;
const MESSAGE = { results: 256, bytes: 2 * MIB }; // results that one message carries at most
const PACE_MS = { saturated: 90, hungry: 3 }; // shortest time between two messages with results
const WAIT_MS = { first: 200, longest: 3_000 }; // between two attempts to connect
const RELOAD_MS = 5_000; // between two attempts to load a scene that failed
const CONFLICTS = { most: 3, withinMs: 60_000 };
const DEFAULT_REWARD = { format: 0.5, relevancePerObject: 0.2, relevanceLimit: 1, goal: 30 };

// 64-bit numbers stay text: a JavaScript number would round an epoch, which makes it another epoch. Fields that the other
// side did not set are undefined, so the arguments of a call are exactly those of its skill.
const options = { includeDirs: [protoFolder], longs: String, enums: String, arrays: true };
const loaded = loadSync("embomatrix/proto/v1/worker_service.proto", options);
const { WorkerService } = grpc.loadPackageDefinition(loaded).embomatrix.proto.v1;
const { status } = grpc;

// ---- State of the worker. It outlives sessions. ----

const bootId = randomBytes(8).toString("hex");
const scenes = new Map(); // digest -> { state, loadS, memoryMb, error, code, content }
const held = new Map(); // key of a lease without a result -> the lease, with `started`, `steps`, `stop` and its arrival
const outbox = new Map(); // key of a finished lease -> { ref, origin, result, bytes }, until it is acknowledged
const unsent = new Set(); // keys in `outbox` that the present stream has not sent
const freeSlots = Array.from({ length: SLOTS }, (_, index) => index + 1);

let desired = []; // digests of the scenes to hold, most urgent first
let isStopping = false; // the operator of this machine stops the worker
let isDrained = false; // the manager asks the worker to leave
let session = null; // { sessionId, sessionEpoch, client, stream } while a stream is open
let renewedMs = performance.now(); // last time at which the manager renewed the leases
let lifetimeMs = Infinity; // of a lease without renewal

const keyOf = (ref) => `${ref.leaseId}/${ref.leaseEpoch}`;
const isLeaving = () => isStopping || isDrained;
const hasLeft = () => isLeaving() && held.size === 0 && outbox.size === 0;

// ---- Scenes ----

// Take over the complete set of scenes to hold, and report what changed.
function hold(digests) {
  desired = digests;
  const needed = new Set([...desired, ...[...held.values()].map((lease) => lease.rollout.bundleDigest)]);
  for (const digest of scenes.keys()) if (!needed.has(digest)) scenes.delete(digest);
  for (const digest of desired) if (!scenes.has(digest)) load(digest);
  reportState();
}

// Fetch, check and unpack a scene. Leases that wait for it start afterwards, or fail with it.
async function load(digest) {
  const scene = { state: "RESIDENT_STATE_LOADING", loadS: 0, memoryMb: 0 };
  scenes.set(digest, scene);
  const beganMs = performance.now();
  const asked = session;
  try {
    scene.content = decode(await fetchChecked(digest));
    Object.assign(scene, { state: "RESIDENT_STATE_WARM", memoryMb: 1 }); // a simulator would measure its memory
  } catch (error) {
    // The connection broke: leases that wait here, or the next desired set, ask for the scene again.
    if (asked !== session && !(error instanceof BundleError)) return scenes.delete(digest);
    const code = error instanceof BundleError ? "BUNDLE_CORRUPT" : "SCENE_LOAD_FAILED";
    Object.assign(scene, { state: "RESIDENT_STATE_FAILED", error: error.message, code });
    setTimeout(() => loadAgain(digest, scene), RELOAD_MS).unref();
  }
  scene.loadS = (performance.now() - beganMs) / 1000;
  reportState();
  startLeases();
}

function loadAgain(digest, failed) {
  if (scenes.get(digest) !== failed) return;
  scenes.delete(digest);
  if (desired.includes(digest)) load(digest);
  reportState();
}

// A bundle that does not have the format of the documents.
class BundleError extends Error {}

// Return the bytes of a bundle. A broken transfer and a wrong digest are repeated once.
async function fetchChecked(digest) {
  for (const isLast of [false, true]) {
    try {
      const data = await fetchBundle(digest);
      const found = `sha256:${createHash("sha256").update(data).digest("hex")}`;
      if (found === digest) return data;
      throw new BundleError(`the bundle's digest is ${found}: expected ${digest}`);
    } catch (error) {
      if (isLast || error.code === status.NOT_FOUND || error.code === status.PERMISSION_DENIED) throw error;
      await sleep(250);
    }
  }
}

function fetchBundle(digest) {
  return new Promise((resolve, reject) => {
    if (!session) throw new Error("there is no connection to the manager");
    const chunks = [];
    let bytes = 0;
    const request = { sessionId: session.sessionId, bundleDigest: digest };
    const call = session.client.fetchBundle(request, metadata(), { deadline: Date.now() + 30_000 });
    call.on("error", reject).on("end", () => resolve(Buffer.concat(chunks)));
    call.on("data", ({ chunk }) => {
      chunks.push(chunk);
      bytes += chunk.length;
      if (bytes <= BUNDLE.bytes) return;
      reject(new BundleError(`the bundle has more than ${BUNDLE.bytes} bytes`));
      call.cancel();
    });
  });
}

// Return the JSON of a bundle. Whatever is wrong with it is an error of the bundle.
function decode(data) {
  try {
    return unpack(data);
  } catch (error) {
    throw new BundleError(`the bundle can't be read: ${error.message}`);
  }
}

// This simulator needs none of the arrays that follow the JSON.
function unpack(data) {
  const { buffer, engine } = inflateSync(data, { maxOutputLength: BUNDLE.ratio * data.length + MIB, info: true });
  if (engine.bytesWritten !== data.length) throw new Error("bytes follow its end");
  if (buffer.toString("latin1", 0, 4) !== "EMBX") throw new Error("it does not begin with EMBX");
  const format = buffer.readUInt32LE(4);
  if (format !== BUNDLE.format) throw new Error(`it has format ${format}: expected ${BUNDLE.format}`);
  const text = buffer.subarray(12, 12 + buffer.readUInt32LE(8)).toString("utf8");
  const values = 1 + (text.match(/[,[{]/g)?.length ?? 0);
  if (values > BUNDLE.values) throw new Error(`it has ${values} values: expected at most ${BUNDLE.values}`);
  return JSON.parse(text);
}

// ---- Leases ----

// An execution that ends without a result; `code` is an InfraCode.
class LeaseError extends Error {
  constructor(code, message) {
    super(message);
    this.code = code;
  }
}

// Start waiting leases in free slots, in the order in which they came, as far as their scenes are loaded.
function startLeases() {
  for (const lease of [...held.values()]) {
    if (lease.started) continue;
    const scene = scenes.get(lease.rollout.bundleDigest);
    if (!scene) {
      if (session) load(lease.rollout.bundleDigest);
    } else if (scene.state === "RESIDENT_STATE_FAILED") finish(lease, failure(scene.code, scene.error));
    else if (scene.state === "RESIDENT_STATE_WARM" && freeSlots.length > 0) run(lease, scene);
  }
}

async function run(lease, scene) {
  lease.started = true;
  const slot = freeSlots.shift();
  const beganMs = performance.now();
  const seconds = () => (performance.now() - beganMs) / 1000;
  const deadline = AbortSignal.timeout(1000 * lease.deadlineS);
  let outcome;
  try {
    const completed = await execute(scene.content, lease, AbortSignal.any([deadline, lease.stop.signal]));
    const loadS = lease.foundWarm ? 0 : Math.min(scene.loadS, (beganMs - lease.arrivedMs) / 1000);
    outcome = { completed: { ...completed, timings: { loadS, executeS: seconds() }, warm: lease.foundWarm } };
  } catch (error) {
    const code = deadline.aborted ? "SLOT_TIMEOUT" : error instanceof LeaseError ? error.code : "SLOT_CRASHED";
    outcome = failure(code, deadline.aborted ? `the plan took longer than ${lease.deadlineS} s` : error.message);
  }
  freeSlots.push(slot);
  finish(lease, outcome, slot, seconds());
  startLeases();
}

const failure = (code, message) => ({ infraFailure: { code: `INFRA_CODE_${code}`, message: String(message).slice(0, 2_000) } });

// Keep the one result of a lease until the manager acknowledges it. A lease that was cancelled meanwhile has none.
function finish(lease, outcome, slot = 0, heldS = 0) {
  const key = keyOf(lease.ref);
  if (!held.delete(key)) return;
  let result = { lease: lease.ref, ...outcome, slot, heldS };
  if (bytesOf(result) > RESULT_BYTES) {
    result = { lease: lease.ref, ...failure("SLOT_CRASHED", `the result has ${bytesOf(result)} bytes`), slot, heldS };
  }
  outbox.set(key, { ref: lease.ref, origin: lease.origin, result, bytes: bytesOf(result) });
  unsent.add(key);
  sendResultsSoon();
}

const bytesOf = (result) => WorkerService.service.Session.requestSerialize({ results: [result] }).length;

// Stop a lease and drop its result: it belongs to another worker by now, or the manager has the result.
function forget(key) {
  held.get(key)?.stop.abort();
  for (const known of [held, outbox, unsent]) known.delete(key);
}

// Leases that no heartbeat renewed for their lifetime belong to other workers.
setInterval(() => {
  if (performance.now() - renewedMs > lifetimeMs) [...held.keys()].forEach(forget);
}, 500).unref();

// ---- Placeholder simulator: it goes to rooms. Put yours here. ----

// Execute a plan in a scene and return the `Completed` message. `signal` ends an execution that is too late or cancelled.
async function execute({ scene, tasks }, lease, signal) {
  const { plan, taskId } = lease.rollout;
  const task = tasks.find((one) => one.task_id === taskId);
  if (!task) throw new LeaseError("SLOT_CRASHED", `the bundle has no task ${taskId}`);
  const steps = [];
  for (const call of plan) {
    await sleep(5, undefined, { signal });
    steps.push({ call, ...outcomeOf(call, task, scene) });
    lease.steps = steps.length;
    if (steps.at(-1).failure) break; // a failed step stops the plan
  }
  // Nothing but the robot has moved: the goal is judged in the state that the bundle describes.
  const reward = score(task, (atom) => holdsAtStart(scene, atom), 0, lease.reward ?? DEFAULT_REWARD);
  const seen = JSON.stringify([lease.rollout.bundleDigest, steps]);
  return { reward, steps, traceDigest: `sha256:${createHash("sha256").update(seen).digest("hex")}` };
}

// Return the failure of a call, empty for a success, and the message about it. A call that this simulator does not support is an
// infrastructure failure: a failed step would be a statement about the plan.
function outcomeOf(call, task, scene) {
  // An index is a text of digits and may be any 64-bit number. Every skill with indices first asks whether they are in the table.
  for (const index of [call.objectIndex, call.sourceIndex]) {
    if (index === undefined || Object.hasOwn(task.table, index)) continue;
    const message = `there is no object with index ${index}: the table has indices 0 to ${task.table.length - 1}`;
    return { failure: "unknown_index", message };
  }
  if (typeof call.skill === "number") {
    throw new LeaseError("VERSION_SKEW", `there is no skill ${call.skill}: upgrade this worker`);
  }
  if (call.skill !== "SKILL_KIND_GO_TO_ROOM") {
    throw new LeaseError("SLOT_CRASHED", `this worker does not support ${call.skill}`);
  }
  const rooms = scene.rooms.map((room) => room.name);
  if (rooms.includes(call.roomName)) return { failure: "", message: `stands in ${call.roomName}` };
  return { failure: "unknown_room", message: `there is no room ${call.roomName}: the rooms are ${rooms.join(", ")}` };
}

// Truth of an atom at the start of a scene, as far as the bundle says it in words.
function holdsAtStart(scene, [predicate, first, second]) {
  const object = scene.objects.find((one) => one.name === first);
  if (["ontop", "inside", "under"].includes(predicate)) return object.relation === predicate && object.host === second;
  if (["covered", "filled", "contains", "saturated"].includes(predicate)) {
    return (object.substances ?? []).some(([fact, substance]) => fact === predicate && substance === second);
  }
  if (predicate === "open") return object.joints.some((share) => share > 0.05);
  if (["toggled_on", "cooked", "frozen", "hot", "sliced"].includes(predicate)) return object.states.includes(predicate);
  throw new LeaseError("SLOT_CRASHED", `this worker can't judge ${predicate}`);
}

// ---- Goals and rewards ----

// Return the `Reward` message. `touched` counts the goal objects that successful calls named. The manager computes the tiers
// again, to the bit: the order of the operations matters.
function score(task, isTrue, touched, coefficients) {
  const goal = parseGoal(task.goal);
  const atoms = atomsOf(goal, task.types).map((atom) => ({ text: render(atom), holds: holds(atom, task.types, isTrue) }));
  const held = atoms.filter((atom) => atom.holds).length;
  return {
    format: coefficients.format ?? 0,
    relevance: Math.min(coefficients.relevanceLimit ?? 0, (coefficients.relevancePerObject ?? 0) * touched),
    goal: ((coefficients.goal ?? 0) * held) / atoms.length,
    atoms,
    success: held === atoms.length,
  };
}

// Read a formula as nested arrays of words: ["not", ["open", "fridge_1"]]. A "?" stays before bound variables only.
function parseGoal(text) {
  const words = text
    .toLowerCase()
    .replace(/;.*$/gm, "")
    .match(/[()]|[^\s()]+/g);
  const variables = new Set(words.filter((word, index) => words[index + 1] === "-"));
  const read = () => {
    const word = words.shift();
    if (word !== "(") return word.startsWith("?") && !variables.has(word) ? word.slice(1) : word;
    const list = [];
    while (words[0] !== ")") list.push(read());
    words.shift();
    return list;
  };
  return read();
}

const render = (formula) => (Array.isArray(formula) ? `(${formula.map(render).join(" ")})` : formula);

// Scored sub-goals: conjuncts, and the instances of `forall`.
function atomsOf(formula, types) {
  const [operator, ...parts] = formula;
  if (operator === "and") return parts.flatMap((part) => atomsOf(part, types));
  if (operator === "forall") return instancesOf(formula, types).flatMap((part) => atomsOf(part, types));
  return [formula];
}

// The body of a quantifier over one variable, once for each object of the type.
function instancesOf(formula, types) {
  const [[variable, , type], body] = formula.slice(-2);
  const replaced = (part, member) =>
    Array.isArray(part) ? part.map((inner) => replaced(inner, member)) : part === variable ? member : part;
  return types[type].map((member) => replaced(body, member));
}

function holds(formula, types, isTrue) {
  const [operator, ...parts] = formula;
  const truth = (part) => holds(part, types, isTrue);
  const count = () => instancesOf(formula, types).filter(truth).length;
  switch (operator) {
    case "not":
      return !truth(parts[0]);
    case "and":
      return parts.every(truth);
    case "or":
      return parts.some(truth);
    case "imply":
      return !truth(parts[0]) || truth(parts[1]);
    case "forall":
      return instancesOf(formula, types).every(truth);
    case "exists":
      return count() > 0;
    case "forn":
      return count() === Number(parts[0]);
    case "forpairs":
    case "fornpairs":
      throw new LeaseError("SLOT_CRASHED", `this worker can't judge ${operator}`);
    default:
      return isTrue(formula);
  }
}

// ---- Messages of a session ----

function say(message) {
  session?.stream.write({ sessionId: session.sessionId, sessionEpoch: session.sessionEpoch, ...message });
}

const residents = () =>
  [...scenes].map(([bundleDigest, { state, loadS, memoryMb, error }]) => ({ bundleDigest, state, loadS, memoryMb, error }));

function reportState() {
  say({ state: { residents: residents(), running: unfinished(), draining: isLeaving() } });
}

// The first message of a stream: everything that this worker holds. Kept results follow it, since all of them may not fit into
// one message; until then their leases count as running.
function reportEverything() {
  for (const key of outbox.keys()) unsent.add(key);
  const claims = [...held.values(), ...outbox.values()].map(({ ref, origin }) => ({ ref, origin }));
  say({ state: { residents: residents(), running: unfinished(), draining: isLeaving(), claims } });
  sendResultsSoon();
}

// Leases whose results the manager does not have.
const unfinished = () => [...held.values(), ...[...unsent].map((key) => outbox.get(key))].map(({ ref }) => ref);

// Results for one message, oldest first.
function takeUnsent() {
  const results = [];
  let bytes = 0;
  for (const key of unsent) {
    const kept = outbox.get(key);
    if (results.length === MESSAGE.results || (results.length > 0 && bytes + kept.bytes > MESSAGE.bytes)) break;
    results.push(kept.result);
    bytes += kept.bytes;
    unsent.delete(key);
  }
  return results;
}

// A message costs the manager more than a result in it. While enough leases wait here, results travel together.
let sentMs = 0;
let sending;
function sendResultsSoon() {
  const isSaturated = freeSlots.length === 0 && held.size >= 3 * SLOTS;
  const dueMs = sentMs + (isSaturated ? PACE_MS.saturated : PACE_MS.hungry);
  clearTimeout(sending);
  sending = setTimeout(sendResults, Math.max(0, dueMs - performance.now()));
}

function sendResults() {
  while (session && unsent.size > 0) say({ results: takeUnsent() });
  sentMs = performance.now();
}

// Handle a message of the manager.
function take(message) {
  if (message.drain || message.resume) {
    isDrained = !message.resume;
    reportState();
  }
  if (message.desired) hold(message.desired.bundleDigests);
  for (const ref of [...message.acknowledged, ...message.cancelled]) forget(keyOf(ref));
  for (const lease of message.leases) {
    const foundWarm = scenes.get(lease.rollout.bundleDigest)?.state === "RESIDENT_STATE_WARM";
    const key = keyOf(lease.ref);
    if (held.has(key) || outbox.has(key)) continue;
    held.set(key, { ...lease, arrivedMs: performance.now(), foundWarm, started: false, steps: 0, stop: new AbortController() });
  }
  startLeases();
  if (hasLeft()) session?.stream.end();
}

// ---- Connection to the manager ----

const credentialFile = `${name}.credential`;
let token = existsSync(credentialFile) ? readFileSync(credentialFile, "ascii") : process.env.EMBOMATRIX_TOKEN;
let turn = 0; // index of the manager that is tried

function metadata() {
  const made = new grpc.Metadata();
  if (token) made.set("authorization", `Bearer ${token}`);
  return made;
}

// Each client has its own connection: `use_local_subchannel_pool` keeps heartbeats apart from bundles.
function connect() {
  const authority = process.env.EMBOMATRIX_CA;
  const security = authority ? grpc.credentials.createSsl(readFileSync(authority)) : grpc.credentials.createInsecure();
  return new WorkerService(addresses[turn], security, {
    "grpc.use_local_subchannel_pool": 1,
    "grpc.keepalive_time_ms": 30_000,
    "grpc.max_receive_message_length": 32 * MIB,
  });
}

const call = (client, method, request, seconds) =>
  new Promise((resolve, reject) => {
    client[method](request, metadata(), { deadline: Date.now() + 1000 * seconds }, (error, answer) =>
      error ? reject(error) : resolve(answer),
    );
  });

async function register() {
  const client = connect();
  try {
    const resources = { slots: SLOTS, cores: SLOTS, memoryMb: 512, score: 1, versions: { platform: "worker.mjs 2" } };
    const answer = await call(client, "register", { workerId: name, bootId, protocolVersion: 2, protocolLow: 2, resources }, 10);
    if (answer.credential) {
      token = answer.credential;
      writeFileSync(credentialFile, token, { mode: 0o600 });
    }
    lifetimeMs = 1000 * answer.leaseTtlS;
    return answer;
  } finally {
    client.close();
  }
}

// Hold one stream until it breaks or the worker has drained.
async function serve({ sessionId, sessionEpoch, heartbeatIntervalS }) {
  const client = connect();
  const pulse = connect();
  const closing = new AbortController();
  const stream = client.session(metadata());
  session = { sessionId, sessionEpoch, client, stream };
  const ended = new Promise((resolve, reject) => stream.on("end", resolve).on("error", reject));
  stream.on("data", take);
  stream.once("data", () => {
    renewedMs = performance.now(); // the manager has read the first state, which lists the leases
    attempts = 0;
  });
  const beating = beat(pulse, session, heartbeatIntervalS, closing.signal);
  beating.catch(() => {}); // also rejects when the stream is closed
  try {
    reportEverything();
    await Promise.race([ended, beating]);
    if (!hasLeft()) throw Object.assign(new Error("the manager ended the session"), { code: status.UNAVAILABLE });
    await call(client, "deregister", { sessionId, sessionEpoch }, 2).catch(() => {}); // the manager notices its absence anyway
  } finally {
    session = null;
    closing.abort();
    ended.catch(() => {});
    stream.cancel();
    client.close();
    pulse.close();
  }
}

// Send heartbeats until the signal. Reject when the manager is silent for three of them, or refuses one.
async function beat(client, { sessionId, sessionEpoch }, intervalS, signal) {
  for (let missed = 0; missed < 3;) {
    await sleep(1000 * intervalS, undefined, { signal });
    const running = unfinished();
    const progress = [...held.values()].filter((lease) => lease.started).map(({ ref, steps }) => ({ ref, steps }));
    const load = 1 - freeSlots.length / SLOTS;
    try {
      const request = { sessionId, sessionEpoch, running, progress, load, memoryUsedMb: scenes.size };
      const answer = await call(client, "heartbeat", request, 2);
      renewedMs = performance.now();
      intervalS = answer.nextIntervalS || intervalS;
      missed = 0;
    } catch (error) {
      if (error.code !== status.UNAVAILABLE && error.code !== status.DEADLINE_EXCEEDED) throw error;
      missed += 1;
    }
  }
  throw Object.assign(new Error("three heartbeats had no answer"), { code: status.UNAVAILABLE });
}

// ---- Life of the worker ----

const PASSING = [status.UNAVAILABLE, status.DEADLINE_EXCEEDED, status.RESOURCE_EXHAUSTED, status.INTERNAL, status.CANCELLED];
const conflictsMs = []; // times at which another process took over the session
let attempts = 0;

// The first signal drains the worker, the second ends it at once.
function drain() {
  if (isStopping) process.exit(1);
  isStopping = true;
  reportState();
  if (hasLeft()) session?.stream.end();
}
process.on("SIGTERM", drain).on("SIGINT", drain);

let registration = null;
while (!hasLeft()) {
  try {
    registration ??= await register();
    await serve(registration);
  } catch (error) {
    const detail = (key) => error.metadata?.get(key)[0];
    if (error.code === status.ABORTED) {
      registration = null;
      // A new manager adopts the leases that this worker claims. Otherwise they belong to other workers.
      const reason = detail("embomatrix-error");
      if (reason !== "unknown-session") {
        [...held.keys(), ...outbox.keys()].forEach(forget);
      }
      if (reason === undefined) {
        conflictsMs.push(Date.now());
        if (conflictsMs.at(-1) - conflictsMs.at(-1 - CONFLICTS.most) < CONFLICTS.withinMs) {
          throw new Error(`another worker named ${name} takes the session over again and again: stop it`, { cause: error });
        }
      }
    } else if (PASSING.includes(error.code)) {
      const leader = addresses.indexOf(detail("embomatrix-leader"));
      turn = leader >= 0 ? leader : (turn + 1) % addresses.length;
    } else {
      throw error;
    }
    const waitMs = Math.min(WAIT_MS.first * 2 ** attempts, WAIT_MS.longest) * (0.8 + 0.4 * Math.random());
    attempts += 1;
    console.error(`${error.details ?? error.message} (next attempt in ${(waitMs / 1000).toFixed(1)} s)`);
    await sleep(waitMs);
  }
}
process.exit();
