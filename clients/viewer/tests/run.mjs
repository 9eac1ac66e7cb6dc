// Runs the tests. The demo twin is built once for all of them.
import { spawnSync } from "node:child_process";
import { readdirSync } from "node:fs";
import { mkdtemp, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { buildTwins } from "./wildcity.mjs";

const folder = await mkdtemp(join(tmpdir(), "viewer-"));
try {
  await buildTwins(join(folder, "twins"));
  const tests = process.argv.slice(2);
  if (tests.length === 0) {
    const here = new URL(".", import.meta.url).pathname;
    tests.push(...readdirSync(here).filter((name) => name.endsWith(".test.mjs")).sort().map((name) => join(here, name)));
  }
  const env = { ...process.env, WILDCITY_VIEWER_TWINS: join(folder, "twins") };
  process.exitCode = spawnSync(process.execPath, ["--test", ...tests], { stdio: "inherit", env }).status ?? 1;
} finally {
  await rm(folder, { recursive: true });
}
