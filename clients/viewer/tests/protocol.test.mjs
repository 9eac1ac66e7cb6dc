// The golden messages of the protocol: good ones are read, damaged ones are refused.
import assert from "node:assert/strict";
import { readFile, readdir } from "node:fs/promises";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const vectors = new URL("../../../protocol/vectors/", import.meta.url);
const { ProtocolError, parseObservation } = await bundled("protocol");

async function messages(folder) {
  const names = (await readdir(new URL(folder, vectors))).filter((name) => name.endsWith(".bin"));
  assert.ok(names.length > 4, `${folder} has ${names.length} messages`);
  return Promise.all(names.map(async (name) => {
    const bytes = await readFile(new URL(`${folder}${name}`, vectors));
    return [name, bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length)];
  }));
}

test("observations are read", async () => {
  for (const [name, message] of await messages("observations/")) {
    const { metadata, tensors } = parseObservation(message);
    const expected = JSON.parse(await readFile(new URL(`observations/${name.replace(".bin", ".expected.json")}`, vectors)));
    assert.deepEqual(metadata, expected.observation, name);
    assert.ok(tensors.has("ego.history_rot"), name);
  }
});

test("damaged observations are refused", async () => {
  const index = JSON.parse(await readFile(new URL("damaged/index.json", vectors)));
  // The decoder of the browser finds what is wrong within an image's file.
  const found = new Set(index.filter((entry) => entry.refused_at === "image").map(({ file }) => file));
  assert.ok(found.size < 3, `${[...found]}`);
  for (const [name, message] of await messages("damaged/")) {
    if (!found.has(name)) assert.throws(() => parseObservation(message), ProtocolError, name);
  }
});
