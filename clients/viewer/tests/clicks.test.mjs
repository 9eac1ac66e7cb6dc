// Places that are clicked, and the scale that they give.
import assert from "node:assert/strict";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const { Clicks, scaleOf } = await bundled("clicks");

const [a, b, c, d] = [[0, 0, 0], [2, 0, 0], [0, 1, 0], [5, 5, 0]];

function clicked(step, ...places) {
  const clicks = new Clicks();
  for (const at of places) clicks.click(step, at);
  return clicks;
}

test("a double click leaves the places as they were", () => {
  // Full, one missing, and empty: the first click of the two begins a full list again.
  for (const [step, places] of [["scale", [a, b]], ["ground", [a, b, c]], ["ground", [a, b]], ["scale", [a]], ["path", [a, b, c]], ["path", []]]) {
    const clicks = clicked(step, ...places);
    clicks.click(step, d);
    clicks.click(step, d);
    clicks.restoreBeforeDoubleClick(step);
    assert.deepEqual(clicks.of(step), places, step);
    // Undo then takes back what was clicked before.
    clicks.undo(step);
    assert.deepEqual(clicks.of(step), places.slice(0, -1), step);
  }
});

test("clicks of a double click that hit nothing are not taken back", () => {
  for (const pair of [[undefined, undefined], [d, undefined], [undefined, d]]) {
    const clicks = clicked("path", a, b);
    for (const at of pair) clicks.click("path", at);
    clicks.restoreBeforeDoubleClick("path");
    assert.deepEqual(clicks.of("path"), [a, b]);
  }
});

test("undo brings back what a further click or Clear removed", () => {
  const clicks = clicked("scale", a, b, d);
  assert.deepEqual(clicks.of("scale"), [d]);
  clicks.undo("scale");
  assert.deepEqual(clicks.of("scale"), [a, b]);
  clicks.clear("scale");
  assert.deepEqual(clicks.of("scale"), []);
  clicks.undo("scale");
  assert.deepEqual(clicks.of("scale"), [a, b]);
  for (let more = 0; more < 5; more++) clicks.undo("scale");
  assert.deepEqual(clicks.of("scale"), []);
});

test("a scale of 1 is assumed only if no place was clicked", () => {
  assert.deepEqual(scaleOf([], 0), { metresPerUnit: 1, state: "assumed", missing: "" });
  assert.deepEqual(scaleOf([a, b], 5), { metresPerUnit: 2.5, state: "given", missing: "" });
  for (const [places, metres, missing] of [[[a], 5, /1 of 2/], [[a, b], 0, /distance/], [[a, b], NaN, /distance/], [[a, b], -1, /distance/], [[a, a], 5, /same/]]) {
    const scale = scaleOf(places, metres);
    assert.equal(scale.state, "incomplete");
    assert.match(scale.missing, missing);
  }
});
