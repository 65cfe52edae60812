// A worker in JavaScript with the whole WorkerService. Put your simulator into `execute`.
//
//   npm install @grpc/grpc-js@1 @grpc/proto-loader@0.8
//   node worker.mjs PROTO_FOLDER HOST:PORT NAME      (EMBOMATRIX_TOKEN, EMBOMATRIX_CA as for other commands)
//
// SIGTERM or Ctrl-C drains it.
import { createHash, randomBytes } from "node:crypto";
import { readFileSync } from "node:fs";
import { cpus } from "node:os";
import { setTimeout as sleep } from "node:timers/promises";
import { inflateSync } from "node:zlib";
import grpc from "@grpc/grpc-js";
import { loadSync } from "@grpc/proto-loader";

const [protoFolder, address, name] = process.argv.slice(2);
const BUNDLE_BYTES = 8 * 1024 * 1024;
const GROWTH = 100;
const RETRY_MS = [200, 400, 800, 1600, 2000];
const SLOTS = cpus().length;

// 64-bit numbers stay text: JavaScript numbers would lose digits, and epochs must match exactly.
const loaded = loadSync("embomatrix/proto/v1/worker_service.proto", { includeDirs: [protoFolder], keepCase: true, longs: String, enums: String, arrays: true });
const { WorkerService } = grpc.loadPackageDefinition(loaded).embomatrix.proto.v1;
const authority = process.env.EMBOMATRIX_CA;
const security = authority ? grpc.credentials.createSsl(readFileSync(authority)) : grpc.credentials.createInsecure();
const metadata = new grpc.Metadata();
if (process.env.EMBOMATRIX_TOKEN) metadata.set("authorization", `Bearer ${process.env.EMBOMATRIX_TOKEN}`);
// The manager accepts one ping per 10 s. Separate subchannel pools give heartbeats their own connection.
const connect = () => new WorkerService(address, security, { "grpc.keepalive_time_ms": 30000, "grpc.use_local_subchannel_pool": 1, "grpc.max_receive_message_length": 32 << 20 });

// State across sessions: scenes by digest, queued and running leases, unacknowledged results.
const residents = new Map();
const leases = new Map();
const outbox = new Map();
const waiting = [];
const bootId = randomBytes(8).toString("hex");
let desired = [];
let busy = 0;
let draining = false;
let session = null;

const keyOf = (ref) => `${ref.lease_id}/${ref.lease_epoch}`;
const say = (message) => session?.stream.write({ session_id: session.session_id, session_epoch: session.session_epoch, ...message });
const left = () => draining && leases.size === 0 && outbox.size === 0;

function state(first = false) {
  const reported = {
    residents: [...residents].map(([bundle_digest, { scene, ...resident }]) => ({ bundle_digest, ...resident })),
    running: [...leases.values()].map((lease) => lease.ref), // every held lease, including queued ones
    draining,
  };
  if (!first) return reported;
  const claims = [...leases.values(), ...outbox.values()].map(({ ref, origin }) => ({ ref, origin }));
  return { ...reported, finished: [...outbox.values()].map((kept) => kept.result), claims };
}

// Scenes: `desired` is the complete set. Drop scenes that are not in it; fetch, check and load new ones.
function want(digests) {
  desired = digests;
  for (const digest of residents.keys()) if (!desired.includes(digest)) residents.delete(digest);
  for (const digest of desired) if (!residents.has(digest)) load(digest);
  say({ state: state() });
}

async function load(digest) {
  const began = Date.now();
  const asked = session;
  const note = (phase, more) => residents.set(digest, { state: `RESIDENT_STATE_${phase}`, load_s: (Date.now() - began) / 1000, memory_mb: 1, ...more });
  note("LOADING");
  try {
    const scene = decode(await fetchBundle(digest), digest);
    if (desired.includes(digest)) note("WARM", { scene });
  } catch (error) {
    if (asked !== session) residents.delete(digest); // the session ended: the manager requests the scene again in the next one
    else if (desired.includes(digest)) note("FAILED", { error: error.message });
  }
  say({ state: state() });
  begin();
}

function fetchBundle(digest) {
  return new Promise((resolve, reject) => {
    const parts = [];
    const request = { session_id: session.session_id, bundle_digest: digest };
    const call = session.client.FetchBundle(request, metadata, { deadline: Date.now() + 30000 });
    call.on("data", ({ chunk }) => parts.push(chunk));
    call.on("error", reject);
    call.on("end", () => resolve(Buffer.concat(parts)));
  });
}

function decode(data, digest) {
  const found = `sha256:${createHash("sha256").update(data).digest("hex")}`;
  if (data.length > BUNDLE_BYTES) throw new Error(`the bundle has ${data.length} bytes, expected at most ${BUNDLE_BYTES}`);
  if (found !== digest) throw new Error(`the bundle's digest is ${found}, expected ${digest}`);
  const content = inflateSync(data, { maxOutputLength: GROWTH * data.length + (1 << 20) });
  if (content.toString("latin1", 0, 4) !== "EMBX") throw new Error("the bundle does not begin with EMBX");
  return JSON.parse(content.toString("utf8", 12, 12 + content.readUInt32LE(8)));
}

// Leases: execute each in a free slot and a warm scene, and keep its result until it is acknowledged.
function begin() {
  while (busy < SLOTS) {
    const at = waiting.findIndex((lease) => residents.get(lease.rollout.bundle_digest)?.scene);
    if (at < 0) return;
    run(waiting.splice(at, 1)[0]);
  }
}

async function run(lease) {
  busy += 1;
  lease.steps = 0;
  const began = performance.now();
  const seconds = () => (performance.now() - began) / 1000;
  let outcome;
  try {
    const { scene } = residents.get(lease.rollout.bundle_digest);
    const done = await execute(scene, lease, () => (lease.steps += 1));
    outcome = { completed: { ...done, worker_id: name, timings: { execute_s: seconds() }, warm: true } };
  } catch (error) {
    outcome = { infra_failure: { code: "INFRA_CODE_SLOT_CRASHED", message: String(error.message), worker_id: name } };
  }
  busy -= 1;
  if (leases.delete(keyOf(lease.ref))) {
    const result = { lease: lease.ref, ...outcome, slot: 1, held_s: seconds() };
    outbox.set(keyOf(lease.ref), { ref: lease.ref, origin: lease.origin, result });
    say({ results: [result] });
  }
  begin();
}

// Replace this placeholder with your simulator. It supports go_to_room only; every other call is an infrastructure failure without a reward.
async function execute(scene, lease, onStep) {
  const { plan, task_id } = lease.rollout;
  if (!scene.tasks.some((task) => task.task_id === task_id)) throw new Error(`the bundle has no task ${task_id}`);
  const rooms = new Set(scene.scene.rooms.map((room) => room.name));
  const steps = [];
  for (const call of plan) {
    if (call.skill !== "SKILL_KIND_GO_TO_ROOM") throw new Error(`this worker does not support ${call.skill}`);
    await sleep(5);
    const there = rooms.has(call.room_name);
    const message = there ? `the robot is in ${call.room_name}` : `there is no room ${call.room_name}: the rooms are ${[...rooms].join(", ")}`;
    steps.push({ call, failure: there ? "" : "unknown_room", message });
    onStep();
    if (!there) break; // a failed step stops the plan
  }
  const trace_digest = createHash("sha256").update(JSON.stringify(steps)).digest("hex");
  const format = lease.reward?.format ?? 0.5;
  return { reward: { format, relevance: 0, goal: 0, atoms: [], success: false }, steps, final_state: [], trace_digest };
}

// Handle a message from the manager. Every field may be absent.
function take(message) {
  if (message.drain) draining = true;
  if (message.resume) draining = false;
  if (message.drain || message.resume) say({ state: state() });
  if (message.desired) want(message.desired.bundle_digests);
  for (const ref of message.acknowledged) outbox.delete(keyOf(ref));
  for (const ref of message.cancelled) forget(keyOf(ref));
  for (const lease of message.leases) {
    if (leases.has(keyOf(lease.ref))) continue;
    leases.set(keyOf(lease.ref), lease);
    waiting.push(lease);
  }
  begin();
  if (left()) session?.stream.end();
}

function forget(key) {
  leases.delete(key);
  outbox.delete(key);
  const at = waiting.findIndex((lease) => keyOf(lease.ref) === key);
  if (at >= 0) waiting.splice(at, 1);
}

const unary = (client, method, request, seconds) =>
  new Promise((resolve, reject) => client[method](request, metadata, { deadline: Date.now() + 1000 * seconds }, (error, answer) => (error ? reject(error) : resolve(answer))));

async function beat(client) {
  const mine = session;
  let interval_s = session.heartbeat_interval_s;
  let renewed = Date.now();
  while (mine === session) {
    await sleep(1000 * interval_s);
    const held = [...leases.values()];
    const progress = held.filter((lease) => lease.steps > 0).map((lease) => ({ ref: lease.ref, steps: lease.steps }));
    const { session_id, session_epoch } = mine;
    const request = { session_id, session_epoch, running: held.map((lease) => lease.ref), progress, load: busy / SLOTS };
    try {
      interval_s = (await unary(client, "Heartbeat", request, 2)).next_interval_s || interval_s;
      renewed = Date.now();
    } catch {
      // The stream reports the end of the session. Leases that can't be renewed belong to other workers by now.
      if (Date.now() - renewed > 1000 * mine.lease_ttl_s) held.forEach(({ ref }) => forget(keyOf(ref)));
    }
  }
}

// One session, from registration to the end of its stream. Leases and results continue in the next one.
async function serve() {
  const client = connect();
  const pulse = connect();
  const resources = { slots: SLOTS, cores: SLOTS, memory_mb: 512, score: 1, versions: { platform: "worker.mjs" } };
  const announced = { worker_id: name, boot_id: bootId, protocol_version: 2, resources };
  try {
    session = { ...(await unary(client, "Register", announced, 10)), client };
    session.stream = client.Session(metadata);
    const closed = new Promise((resolve, reject) => session.stream.on("end", resolve).on("error", reject));
    session.stream.on("data", take);
    say({ state: state(true) });
    beat(pulse);
    await closed;
    const { session_id, session_epoch } = session;
    if (left()) await unary(client, "Deregister", { session_id, session_epoch }, 2);
  } finally {
    session = null;
    client.close();
    pulse.close();
  }
}

for (const signal of ["SIGTERM", "SIGINT"]) {
  process.on(signal, () => {
    draining = true;
    say({ state: state() });
    if (left()) session?.stream.end();
  });
}

for (let attempt = 0; !left(); attempt += 1) {
  try {
    await serve();
    attempt = 0;
  } catch (error) {
    const { UNAVAILABLE, DEADLINE_EXCEEDED, ABORTED, INTERNAL, CANCELLED } = grpc.status;
    if (![UNAVAILABLE, DEADLINE_EXCEEDED, ABORTED, INTERNAL, CANCELLED].includes(error.code)) throw error;
    console.error(`${error.details ?? error.message}: trying again`);
    // If another process took over the session, held leases are void. A new manager gets them as claims.
    const kind = error.metadata?.get("embomatrix-error")[0];
    if (error.code === ABORTED && kind !== "unknown-session") [...leases.keys(), ...outbox.keys()].forEach(forget);
    await sleep(RETRY_MS[Math.min(attempt, RETRY_MS.length - 1)] * (0.8 + 0.4 * Math.random()));
  }
}
process.exit(0);
