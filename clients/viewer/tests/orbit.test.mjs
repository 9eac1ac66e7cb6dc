// The camera that turns about a place, names of twins, and archives.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtemp, rm, writeFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const { Orbit, lookAt } = await bundled("orbit");
const { rotate } = await bundled("pose");

const near = (a, b) => a.every((value, at) => Math.abs(value - b[at]) < 1e-9);

test("a rig that looks somewhere has its x axis there and its z axis up", () => {
  for (const [forward, up] of [[[1, 2, -0.5], [0, 0, 1]], [[0, 0, -1], [0, 0, 1]], [[0.3, -1, 0.2], [0, -1, 0]], [[-1, 0, 0], [0, 1, 0]]]) {
    const q = lookAt(forward, up);
    assert.ok(Math.abs(Math.hypot(...q) - 1) < 1e-12);
    const length = Math.hypot(...forward);
    assert.ok(near(rotate(q, [1, 0, 0]), forward.map((value) => value / length)), `${forward}`);
    const z = rotate(q, [0, 0, 1]);
    assert.ok(z[0] * up[0] + z[1] * up[1] + z[2] * up[2] > -1e-9, `${forward}`);
  }
});

test("the camera keeps its distance and looks at the pivot, whatever is up", () => {
  const orbit = new Orbit([1, 2, 3], 5);
  for (const up of [[0, 0, 1], [0, -1, 0], [1, 0, 0]]) {
    orbit.up = up;
    for (let turn = 0; turn < 10; turn++) {
      orbit.turn(0.7, 0.4);
      const { xyz, q } = orbit.pose();
      const ahead = rotate(q, [1, 0, 0]);
      assert.ok(near(xyz.map((value, at) => value + 5 * ahead[at]), [1, 2, 3]));
    }
  }
});

test("a folder becomes an archive that Python reads", async () => {
  const { archive } = await bundled("zip");
  const files = [["0_0/meta.json", "{}"], ["lod-meta.json", "a".repeat(1000)]].map(([path, text]) => {
    const file = new File([text], path.split("/").at(-1));
    Object.defineProperty(file, "webkitRelativePath", { value: `scene/${path}` });
    return file;
  });
  const folder = await mkdtemp(join(tmpdir(), "viewer-"));
  const path = join(folder, "scene.zip");
  await writeFile(path, Buffer.from(await (await archive(files)).arrayBuffer()));
  const script = "import sys, zipfile\nz = zipfile.ZipFile(sys.argv[1])\nassert z.testzip() is None\nprint([(i.filename, i.file_size) for i in z.infolist()])";
  const listed = execFileSync("python3", ["-c", script, path], { encoding: "utf8" }).trim();
  assert.equal(listed, "[('0_0/meta.json', 2), ('lod-meta.json', 1000)]");
  await rm(folder, { recursive: true });
});
