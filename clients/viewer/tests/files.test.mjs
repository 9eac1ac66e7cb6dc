// Files that the user chooses: their hashes, the names of twins, reports; and what the browser has stored.
import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const { Sha256 } = await bundled("sha256");
const { freeName, nameOf } = await bundled("add");
const { parseReport, parseWindows } = await bundled("report-file");
const { parseStored } = await bundled("settings");

test("SHA-256 is that of Node, whatever the parts", () => {
  const bytes = Uint8Array.from({ length: 1000 }, (_, n) => (n * 167 + (n >> 3)) & 255);
  for (const length of [0, 1, 54, 55, 56, 63, 64, 65, 119, 120, 128, 1000]) {
    const expected = createHash("sha256").update(bytes.subarray(0, length)).digest("hex");
    for (const part of [1, 7, 64, 100, 1000]) {
      const hash = new Sha256();
      for (let at = 0; at < length; at += part) hash.update(bytes.subarray(at, Math.min(length, at + part)));
      assert.equal(hash.hex(), expected, `${length} bytes in parts of ${part}`);
    }
  }
});

test("names of twins are free, and not too long", () => {
  assert.equal(nameOf("My Scene (2).compressed.PLY"), "my-scene-2-");
  assert.equal(freeName("demo", new Set(["street"])), "demo");
  assert.equal(freeName("demo", new Set(["demo"])), "demo-2");
  assert.equal(freeName("demo", new Set(["demo", "demo-2", "demo-3"])), "demo-4");
  const long = "n".repeat(64);
  assert.equal(freeName(long, new Set([long])), `${"n".repeat(62)}-2`);
});

test("a report is read", async () => {
  const [json, html] = await Promise.all(["json", "html"].map((end) => readFile(new URL(`report/report.${end}`, import.meta.url), "utf8")));
  const { twin, version, places, settings } = parseReport(json);
  assert.deepEqual([twin, version], ["demo", 1]);
  assert.deepEqual(places.slice(0, 3).map(({ drive }) => drive), [{ stationM: 71, leftM: 0 }, { stationM: 71, leftM: 1 }, { stationM: 71, leftM: 3 }]);
  assert.deepEqual(settings.map(({ name }) => name), ["tau_px=0", "tau_px=4 alpha_cut=0.032 stop=0.004"]);
  assert.equal(settings[1].worstDb[1].toFixed(2), "34.82");

  const windows = parseWindows(html);
  assert.deepEqual([...windows.keys()], settings.map(({ name }) => name));
  const { place, files } = windows.get("tau_px=0");
  assert.equal(place, "71 m, 1 m left");
  assert.equal(files.length, 3);
  for (const file of files) assert.equal(Buffer.from(await file.arrayBuffer()).toString("latin1", 1, 4), "PNG");

  const changed = JSON.parse(json);
  changed.places[0] = "12.5° around";
  changed.places[1] = "71 m, 3 m right";
  changed.settings[0].by_place[0].least_db = "inf";
  const { places: [around, right], settings: [exact] } = parseReport(JSON.stringify(changed));
  assert.equal(around.drive, undefined);
  assert.equal(right.drive.leftM, -3);
  assert.equal(exact.worstDb[0], Infinity);
});

test("another file is not taken for a report", () => {
  for (const text of ["", "{", "null", "[]", "{}", '{"subject": {"twin": "a"}, "places": ["1 m"], "settings": [{"name": "b", "by_place": []}]}']) {
    assert.throws(() => parseReport(text), /report/, text);
  }
  assert.equal(parseWindows("<p>no report</p>").size, 0);
});

test("damaged settings are left out", () => {
  assert.deepEqual(parseStored('{"width": 640, "quality": 70, "pace": false}'), { width: 640, quality: 70, pace: false });
  for (const text of [null, "", "{", "null", "7", '"text"', "[]", '{"width": "wide", "quality": 1e9, "pace": "no"}', '{"width": 641, "quality": 70.5}', '{"width": null}']) {
    assert.deepEqual(parseStored(text), {}, text);
  }
  assert.deepEqual(parseStored('{"width": -1, "quality": 50}'), { quality: 50 });
});
