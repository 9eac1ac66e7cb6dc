// A server with the demo twin, and Chromium.
import assert from "node:assert/strict";
import { execFile, spawn } from "node:child_process";
import { connect, createServer } from "node:net";
import { cp, mkdtemp, rm, writeFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";
import { promisify } from "node:util";
import { chromium } from "playwright-core";

const run = promisify(execFile);
const binary = process.env.WILDCITY_BIN;
assert.ok(binary, "set WILDCITY_BIN to the built wildcity binary");

/** Builds the demo twin, and removes its sky, which each server would prepare for 0.6 s. */
export async function buildTwins(twins) {
  await run(binary, ["demo", "--steps", "1", "--out", `${twins}.drive`, "--twins", twins]);
  await rm(`${twins}.drive`, { recursive: true });
  await run(binary, ["twin", "sky", "demo", "--remove", "--twins", twins]);
}

/** A folder with the demo twin: a copy of the one that run.mjs has built, if that runs the tests. */
export async function home() {
  const folder = await mkdtemp(join(tmpdir(), "viewer-"));
  const built = process.env.WILDCITY_VIEWER_TWINS;
  if (built) await cp(built, join(folder, "twins"), { recursive: true });
  else await buildTwins(join(folder, "twins"));
  return { folder, remove: () => rm(folder, { recursive: true }) };
}

/** Starts `wildcity serve`; `url` is that of its page. */
export async function serve(folder, ...options) {
  const directories = ["twins", "episodes", "uploads", "scenarios"].flatMap((name) => [`--${name}`, join(folder, name)]);
  const child = spawn(binary, ["serve", "--listen", "127.0.0.1:0", "--log", "warn", ...directories, ...options]);
  let errors = "";
  child.stderr.on("data", (text) => (errors += text));
  for await (const line of createInterface(child.stdout)) {
    const socket = line.match(/^listening on (ws\S+)$/)?.[1];
    if (socket) return { socket, url: socket.replace("ws", "http").replace("v1/session", ""), stop: () => stop(child) };
  }
  throw new Error(`wildcity serve ended: ${errors}`);
}

function stop(child) {
  const ended = new Promise((resolve) => child.once("exit", resolve));
  child.kill("SIGTERM");
  return ended;
}

/** The same server behind connections that can be cut. */
export async function behindWire(server) {
  const { hostname, port } = new URL(server.url);
  const sockets = new Set();
  const wire = createServer((near) => {
    const far = connect(Number(port), hostname);
    for (const socket of [near, far]) {
      sockets.add(socket);
      socket.on("error", () => {}).on("close", () => sockets.delete(socket));
    }
    near.pipe(far).pipe(near);
  });
  await new Promise((resolve) => wire.listen(0, "127.0.0.1", resolve));
  const cut = () => {
    for (const socket of sockets) socket.destroy();
  };
  const stop = () => {
    wire.close();
    cut();
  };
  return { url: `http://127.0.0.1:${wire.address().port}/`, cut, stop };
}

export async function tokenFile(folder, tokens) {
  const path = join(folder, "tokens.json");
  await writeFile(path, JSON.stringify({ tokens }));
  return path;
}

/** A scene of some Gaussians, as a PLY file. */
export function scene(name) {
  const properties = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
  const count = 200;
  const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n${properties.map((property) => `property float ${property}\n`).join("")}end_header\n`;
  const values = Float32Array.from({ length: count * properties.length }, (_, at) => {
    const [n, property] = [Math.floor(at / properties.length), at % properties.length];
    // A patch of ground: 20 by 10 of them, 0.1 apart, flat.
    return [0.1 * (n % 20), 0.1 * Math.floor(n / 20), 0, (n % 7) / 7, 0.5, 0.2, 4, -3, -3, -5, 1, 0, 0, 0][property];
  });
  return { name, mimeType: "application/octet-stream", buffer: Buffer.concat([Buffer.from(header), Buffer.from(values.buffer)]) };
}

/** The pixels of the twin's start, by camera, as the Python client decodes them. */
export async function decodedByPython(socket, twin, sizes) {
  const out = await mkdtemp(join(tmpdir(), "viewer-"));
  const script = new URL("decode.py", import.meta.url).pathname;
  await run(process.env.WILDCITY_PYTHON ?? "python3", [script, socket, twin, JSON.stringify(sizes), out]);
  return out;
}

export const launch = (...args) => chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", ...args],
});

/** Lets a page have the files of dist in place of those in the program, which then need not be built again. */
async function replaceByDist(context) {
  for (const name of ["viewer.js", "style.css"]) {
    const path = new URL(`../dist/${name}`, import.meta.url).pathname;
    await context.route(`**/${name}`, (route) => route.fulfill({ path }));
  }
}

/** A page that fails the test if it says anything on its console, fails, or asks another server for anything. */
export async function open(browser, server, address = "", options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
  // Six cameras take seconds on a machine of two cores that runs other tests too.
  context.setDefaultTimeout(120_000);
  // The least width that the settings have.
  await context.addInitScript(() => {
    const isNew = location.protocol.startsWith("http") && localStorage.length === 0;
    if (isNew) localStorage.setItem("wildcity-settings", '{"width":320}');
  });
  const page = await context.newPage();
  const complaints = [];
  page.on("console", (message) => complaints.push(message.text()));
  page.on("pageerror", (error) => complaints.push(error.message));
  page.on("request", (request) => {
    const url = request.url();
    if (!url.startsWith(server.url) && !url.startsWith("blob:")) complaints.push(`asked for ${url}`);
  });
  if (process.env.WILDCITY_DIST) await replaceByDist(context);
  await page.goto(`${server.url}${address}`);
  return { page, complaints, close: () => context.close() };
}

/** Waits until the page has shown so many steps. */
export const steps = (page, count) =>
  page.waitForFunction((least) => Number(document.querySelector("[data-step]")?.dataset.step) >= least, count);
