// The viewer in Chromium, against the real server.
import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { isDeepStrictEqual } from "node:util";
import { behindWire, decodedByPython, home, launch, open, serve, steps } from "./wildcity.mjs";

let place, server, browser;

before(async () => {
  place = await home();
  [server, browser] = await Promise.all([serve(place.folder), launch()]);
});

after(async () => {
  await browser?.close();
  await server?.stop();
  await place?.remove();
});

/** The hashes of the images that a page shows, by camera. */
const hashes = (page) => page.$$eval("canvas[data-hash]", (all) =>
  Object.fromEntries(all.map(({ dataset }) => [dataset.camera, dataset.hash])));

test("the first page lists the twin, and its link opens a session", async () => {
  const { page, complaints, close } = await open(browser, server);
  await page.click("text=demo");
  await steps(page, 1);
  assert.equal(await page.$$eval("canvas[data-hash]", (all) => all.length), 6);
  assert.match(await page.textContent("#where"), /demo v2/);
  assert.deepEqual(complaints, []);
  await close();
});

test("the mosaic is what the Python client decodes", async () => {
  const { page, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  const shown = await page.$$eval("canvas[data-hash]", (all) => all.map((canvas) => {
    const { width, height, dataset } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    // As a text: an array of a million numbers takes seconds to get here.
    let text = "";
    for (let at = 0; at < data.length; at += 8192) text += String.fromCharCode(...data.subarray(at, at + 8192));
    return { camera: dataset.camera, width, height, pixels: btoa(text) };
  }));
  const sizes = Object.fromEntries(shown.map(({ camera, width, height }) => [camera, [width, height]]));
  const folder = await decodedByPython(server.socket, "demo", sizes);
  assert.equal(shown.length, 6);
  for (const { camera, width, height, pixels: text } of shown) {
    const pixels = Buffer.from(text, "base64");
    assert.equal(pixels.length, width * height * 4);
    const expected = await readFile(join(folder, camera));
    assert.equal(expected.length, width * height * 3);
    let most = 0;
    for (let at = 0; at < width * height; at++) {
      for (let part = 0; part < 3; part++) most = Math.max(most, Math.abs(pixels[4 * at + part] - expected[3 * at + part]));
    }
    assert.ok(most <= 2, `${camera} differs by ${most}`);
  }
  await close();
});

test("cameras are in the rig's order, the large one has time and speed, and the map a picture", async () => {
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  const cameras = await page.$$eval(".cell canvas", (all) => all.map(({ dataset }) => dataset.camera));
  assert.deepEqual(cameras, ["front", "front_left", "front_right", "left", "right", "rear"]);
  assert.match(await page.textContent(".cell.main .hud"), /^\d+\.\d s · -?\d+\.\d m\/s · -?\d+ km\/h$/);
  await page.waitForSelector(".map:not([data-ground=''])[data-ground]");
  await page.click("canvas[data-camera=rear]");
  assert.ok(await page.isVisible(".cell.large .hud"));
  assert.equal(await page.$(".cell.main .hud"), null);
  assert.deepEqual(complaints, []);
  await close();
});

/** A session with a LiDAR, as an agent drives it; from a page, since Node has no WebSocket. */
async function agent(name) {
  const { page, close } = await open(browser, server, "#/report");
  await page.evaluate(async ({ address, session }) => {
    const socket = new WebSocket(address, "wildcity.v1");
    await new Promise((resolve) => (socket.onopen = resolve));
    let seq = 0;
    window.ask = (request) => new Promise((resolve) => {
      socket.onmessage = () => resolve();
      socket.send(JSON.stringify({ ...request, seq: seq++ }));
    });
    await window.ask({ type: "hello", client: { name: "agent", version: "1" }, protocols: ["wildcity.v1"] });
    const outputs = { encoding: "jpeg", cameras: ["front"], images: { front: { size: [320, 206] } } };
    await window.ask({ type: "open", twin: "demo", session, rig: "vehicle6-lidar", outputs });
    await window.ask({ type: "reset" });
  }, { address: server.socket, session: name });
  return { observe: () => page.evaluate(() => window.ask({ type: "reset" })), end: close };
}

test("a watcher sees the points of a LiDAR, and can turn them", async () => {
  const { observe, end } = await agent("with-lidar");
  const { page, complaints, close } = await open(browser, server, "#/watch/with-lidar");
  await observe();
  await page.waitForSelector(".lidar[data-points]");
  const points = Number(await page.getAttribute(".lidar", "data-points"));
  assert.ok(points > 20_000, `${points} points`);
  assert.match(await page.textContent(".lidar p"), /^top: \d+ of 64 × 1800 beams$/);
  /** How many pixels have points, and a number that changes with them. */
  const drawn = () => page.$eval(".points", (canvas) => {
    const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    let sum = 0;
    for (let at = 0; at < data.length; at += 4) {
      if (data[at + 3] === 0) continue;
      count += 1;
      sum = (sum * 31 + at + data[at]) % 1_000_003;
    }
    return { count, sum };
  });
  const changed = async (from) => {
    for (let tries = 0; tries < 100; tries += 1) {
      const now = await drawn();
      if (now.sum !== from.sum) return now;
      await page.waitForTimeout(50);
    }
    assert.fail("the points stay as they are");
  };
  const before = await changed({ sum: 0 });
  assert.ok(before.count > 5_000, `${before.count} pixels`);
  const box = await page.locator(".points").boundingBox();
  await page.mouse.move(box.x + 100, box.y + 100);
  await page.mouse.down();
  await page.mouse.move(box.x + 180, box.y + 120, { steps: 4 });
  await page.mouse.up();
  await changed(before);
  assert.deepEqual(complaints, []);
  await close();
  await end();

  // Without a LiDAR there is no place for its points.
  const other = await open(browser, server, "#/drive/demo");
  await steps(other.page, 1);
  assert.equal(await other.page.isVisible(".lidar"), false);
  await other.close();
});

test("keys move the car, watchers see it, and the record has its hashes", async () => {
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  const view = () => page.$eval(".view", ({ dataset }) =>
    ({ x: Number(dataset.x), step: Number(dataset.step), session: dataset.session }));
  const [start, first] = [await view(), await hashes(page)];
  const watcher = await open(browser, server, `#/watch/${start.session}`);
  await page.keyboard.down("KeyW");
  await page.waitForFunction((x) => Number(document.querySelector(".view").dataset.x) > x + 1, start.x);
  await steps(watcher.page, 1);
  await page.keyboard.up("KeyW");
  await page.keyboard.down("Space");
  await page.waitForFunction(() => document.querySelector(".facts dd").textContent === "0 km/h");
  // The car nearly stands: images change so slowly that both pages show the same ones, which are not those of the start.
  const limit = performance.now() + 120_000;
  for (let both = []; !both.length || !isDeepStrictEqual(...both); ) {
    assert.ok(performance.now() < limit, "the watcher's images are not the agent's");
    await steps(page, (await view()).step + 1);
    both = await Promise.all([hashes(page), hashes(watcher.page)]);
    assert.equal(Object.keys(both[0]).length, 6);
    assert.notDeepEqual(both[1], first);
  }
  assert.deepEqual(watcher.complaints, []);
  await watcher.close();

  // Leaving the page ends the session; then its episode can be looked at.
  await page.click("#home");
  await page.click(`text=${start.session}-1`);
  await page.waitForSelector(".player[data-same=true]");
  assert.match(await page.textContent(".verdict"), /^6 of 6 images have the recorded hash$/);
  assert.equal(await page.locator(`text=${start.session}-1`).count(), 1, "the name stands once");
  // The drive begins near an end of the picture from above, which reaches the edges of the map all the same.
  await page.waitForSelector(".map:not([data-ground=''])[data-ground]");
  await page.waitForFunction(() => {
    const map = document.querySelector(".map");
    const { data } = map.getContext("2d").getImageData(0, Math.round(map.height / 2), map.width, 1);
    return Math.min(data[3], data.at(-1)) > 100;
  });
  const last = Number(await page.getAttribute(".track input", "max"));
  assert.ok(last > 3, `${last} frames`);
  for (const at of [last, Math.floor(last / 2)]) {
    await page.$eval(".track input", (input, value) => {
      input.value = String(value);
      input.dispatchEvent(new Event("input"));
    }, at);
    await page.waitForFunction(() =>
      document.querySelector(".player").dataset.timeUs === document.querySelector("output").dataset.timeUs);
    assert.equal(await page.getAttribute(".player", "data-same"), "true");
  }
  assert.deepEqual(complaints, []);
  await close();
});

test("the free camera moves and looks around", async () => {
  const { page, complaints, close } = await open(browser, server, "#/fly/demo");
  await steps(page, 1);
  const before = await hashes(page);
  await page.keyboard.down("KeyW");
  await steps(page, 3);
  await page.keyboard.up("KeyW");
  const after = await hashes(page);
  assert.notDeepEqual(after, before);
  const { x, y } = await page.locator(".mosaic canvas").boundingBox();
  await page.mouse.move(x + 300, y + 200);
  await page.mouse.down();
  await page.mouse.move(x + 200, y + 200);
  await page.mouse.up();
  await page.waitForFunction((hash) => document.querySelector("canvas[data-hash]").dataset.hash !== hash, after.free);
  assert.deepEqual(complaints, []);
  await close();
});

test("a gamepad drives", async () => {
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  const pose = () => page.$eval(".view", ({ dataset }) => Number(dataset.x));
  const start = await pose();
  await page.evaluate(() => {
    const buttons = Array.from({ length: 17 }, (_, at) => ({ pressed: at === 7, value: at === 7 ? 1 : 0 }));
    navigator.getGamepads = () => [null, { connected: true, mapping: "standard", axes: [-1, 0, 0, 0], buttons }];
  });
  await page.waitForFunction((x) => Number(document.querySelector(".view").dataset.x) > x + 1, start);
  // The fourth number is the steering: to the left.
  assert.match(await page.textContent(".facts div:nth-child(4) dd"), /^[1-9][0-9.]*°$/);
  assert.deepEqual(complaints, []);
  await close();
});

test("a lost connection is resumed", async () => {
  const wire = await behindWire(server);
  const { page, close } = await open(browser, wire, "#/drive/demo");
  await steps(page, 2);
  const view = () => page.$eval(".view", ({ dataset }) => ({ step: Number(dataset.step), session: dataset.session }));
  const before = await view();
  wire.cut();
  await steps(page, before.step + 3);
  assert.equal((await view()).session, before.session);
  await close();
  wire.stop();
});

test("nothing is wider than a phone, and the pads drive", async () => {
  const phone = { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true };
  const { page, complaints, close } = await open(browser, server, "", phone);
  const fits = () => page.evaluate(() => [document.documentElement, document.getElementById("page")]
    .every(({ scrollWidth }) => scrollWidth <= innerWidth));
  // The last of its lists.
  await page.waitForSelector("text=Recorded episodes");
  assert.ok(await fits(), "the first page");
  const [table, adder] = await page.$$eval(".home table, .adder label", ([first, second]) => [first, second].map((one) => one.getBoundingClientRect()));
  assert.ok(adder.top >= table.bottom + 6, `the table ends at ${table.bottom}, and the adder begins at ${adder.top}`);
  await page.click("text=demo");
  await steps(page, 1);
  assert.ok(await fits(), "the mosaic");
  const pads = await page.$$eval(".pad", (all) => all.map((pad) => {
    const { top, height } = pad.getBoundingClientRect();
    return `${top} ${height} ${getComputedStyle(pad).color}`;
  }));
  assert.equal(pads.length, 4);
  assert.equal(new Set(pads).size, 1, `pads differ in place, height or colour: ${pads}`);
  const x = Number(await page.getAttribute(".view", "data-x"));
  await page.getByLabel("up", { exact: true }).dispatchEvent("pointerdown");
  await page.waitForFunction((start) => Number(document.querySelector(".view").dataset.x) > start + 0.2, x);
  assert.deepEqual(complaints, []);
  await close();
});
