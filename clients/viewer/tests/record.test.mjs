// Records, with the lines that the session and a scenario write (src/session/record/format.rs, src/episode/lines.rs).
import assert from "node:assert/strict";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const pose = (x) => ({ xyz: [x, 0, 0], q: [1, 0, 0, 0] });
const camera = (name) => ({ name, width: 4, height: 3, camera_to_rig: pose(0) });
const frame = (request, step, images, more = {}) =>
  ({ kind: "frame", request, step, time_us: step * 100_000, poses: [pose(step)], terminated: false, frame_hash: "h", images, ...more });

const lines = [
  { kind: "episode", twin: "street", version: 3, backend: "cpu", profile: { near: 0.01, reach_m: null },
    rig: { name: "two", cameras: [camera("front"), camera("rear")] } },
  { kind: "scenario", name: "cut-in", actors: [{ name: "van", class: "vehicle", size: [5, 2, 2], asset: "a" }],
    lanes: [{ outline: [[0, 0], [1, 0], [1, 1]] }] },
  frame("reset", 0, ["a0", "b0"]),
  frame("observe", 0, ["x", "y"]),
  frame("step", 1, ["a1", "b1"]),
  { kind: "version", version: 4 },
  { kind: "actors", step: 2, time_us: 200_000, actors: [[0, [7, 1, 0], [1, 0, 0, 0], [0, 0, 0], 0]] },
  // Two poses: an earlier frame of the bundle, and the current one of the second camera alone.
  frame("step", 2, ["a", "b", "b2"], { poses: [pose(1), pose(2)], cameras: [[0, 1], [1]] }),
  { kind: "event", step: 2, time_us: 150_000, event: "contact", actor: 0, collision: "active_front", ego_at_fault: true },
  frame("step", 3, ["old", "old"]),
  frame("step", 3, ["a3", "b3"]),
  { kind: "event", step: 3, time_us: 300_000, event: "ended", rule: "route_done" },
  { kind: "end", outcome: "completed", steps: 3 },
];

globalThis.sessionStorage = { getItem: () => null };
const { load } = await bundled("record");

/** Lets the server have a record. */
function serve(record) {
  const text = `${record.map((line) => JSON.stringify(line)).join("\n")}\n`;
  globalThis.fetch = async (path) => {
    assert.equal(path, "v1/episodes/run-1");
    return new Response(text);
  };
}

test("a record is read as it was driven", async () => {
  serve(lines);
  const { frames, events, profile, outcome, lanes, drawsActors } = await load("run-1");
  assert.deepEqual(profile, { near: 0.01 });
  assert.equal(outcome, "completed");
  assert.equal(drawsActors, true);
  assert.deepEqual(lanes, [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]]);
  assert.deepEqual(frames.map(({ step, version, images }) => [step, version, Object.fromEntries(images)]), [
    [0, 3, { front: "a0", rear: "b0" }],
    [1, 3, { front: "a1", rear: "b1" }],
    [2, 4, { rear: "b2" }],
    [3, 4, { front: "a3", rear: "b3" }],
  ]);
  assert.deepEqual(frames[2].pose, pose(2));
  assert.deepEqual(frames[1].actors, []);
  assert.deepEqual(frames[2].actors, [{ name: "van", kind: "vehicle", size: [5, 2, 2], pose: { xyz: [7, 1, 0], q: [1, 0, 0, 0] } }]);
  assert.deepEqual(events, [
    { time_us: 150_000, text: "contact van (ego at fault)", isBad: true },
    { time_us: 300_000, text: "ended route done", isBad: false },
  ]);
});

test("reading takes a time in proportion to the number of frames", async () => {
  const seconds = async (count) => {
    const frames = Array.from({ length: count }, (_, step) => frame("step", step, ["a", "b"]));
    // A restore in the middle replaces the second half.
    const again = frames.slice(count / 2).map((line) => ({ ...line, images: ["c", "d"] }));
    serve([lines[0], ...frames, ...again]);
    // Of the processor: others that compute on the machine do not count.
    const begun = process.cpuUsage();
    const recording = await load("run-1");
    const { user, system } = process.cpuUsage(begun);
    const taken = (user + system) * 1e-6;
    assert.deepEqual(recording.frames.map(({ step }) => step), frames.map(({ step }) => step));
    assert.equal(recording.frames.at(-1).images.get("rear"), "d");
    assert.equal(recording.frames[0].images.get("rear"), "b");
    return taken;
  };
  await seconds(4_000);
  const least = async (count) => Math.min(await seconds(count), await seconds(count), await seconds(count));
  // Sixteen times the frames take about sixteen times as long (the garbage collector adds to it);
  // if each frame looked at all others, 256 times.
  const ratio = (await least(64_000)) / (await least(4_000));
  assert.ok(ratio < 64, `${ratio}`);
});
