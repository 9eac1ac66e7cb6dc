// A capture becomes a driven twin with the mouse alone: add its files, keep or click the ground, a known distance, a path.
import assert from "node:assert/strict";
import { mkdtemp, mkdir, rm } from "node:fs/promises";
import { existsSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { launch, open, serve, steps, tokenFile } from "./wildcity.mjs";

const data = process.env.WILDCITY_DATA ?? new URL("../../../../shared/data", import.meta.url).pathname;
const pictures = process.env.WILDCITY_PICTURES;
const skip = existsSync(data) ? false : `no real data at ${data}`;
const PHONE = { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true };

let folder, server, browser;

before(async () => {
  folder = await mkdtemp(join(tmpdir(), "viewer-"));
  await mkdir(join(folder, "twins"));
  [server, browser] = await Promise.all([serve(folder), launch()]);
});

after(async () => {
  await browser?.close();
  await server?.stop();
  await rm(folder, { recursive: true, force: true });
});

/** A click at shares of the picture's width and height. */
async function click(page, x, y) {
  const box = await page.locator(".picture").boundingBox();
  await page.mouse.click(box.x + x * box.width, box.y + y * box.height);
  // Two clicks at once would be a double click; the server draws meanwhile.
  await page.waitForTimeout(350);
}

const placed = (page, step, count) =>
  page.waitForFunction(([name, number]) => document.querySelector(".placing")?.dataset[name] === number, [step, String(count)]);

/** Clicks until so many places were hit: a picture has holes. */
async function clickPlaces(page, step, places, count) {
  for (const [x, y] of places) {
    await click(page, x, y);
    if (Number(await page.getAttribute(".placing", `data-${step}`)) === count) return;
  }
  assert.fail(`fewer than ${count} places of the ${step} were hit`);
}

async function photograph(page, name) {
  if (pictures) await page.screenshot({ path: join(pictures, `${name}.jpg`), type: "jpeg", quality: 70 });
}

/** Rows of places around the middle, from below. */
const lattice = (from, to) => Array.from({ length: 12 }, (_, row) => from + ((to - from) * row) / 11)
  .flatMap((y) => [0.5, 0.45, 0.55, 0.4, 0.6].map((x) => [x, y]));

/** What a person sees in them: the biker is a man without a ground whose up is -y, the robot stands on a meadow. */
const SCENES = [
  {
    name: "biker", input: "scene files", files: "scenes/biker/biker.compressed.ply",
    ground: { up: "−y", places: lattice(0.9, 0.55), count: 1 },
    scale: { places: [...lattice(0.7, 0.6), ...lattice(0.35, 0.45)], metres: 1 },
    path: [[0.2, 0.85], [0.35, 0.75], [0.45, 0.7]],
  },
  {
    name: "playbot", input: "scene folder", files: "scenes/playbot",
    ground: { places: [[0.3, 0.7], [0.6, 0.75], [0.45, 0.85], [0.25, 0.2], [0.15, 0.5], [0.35, 0.2]], count: 3 },
    scale: { places: [[0.35, 0.7], [0.65, 0.7], [0.4, 0.75], [0.6, 0.8]], metres: 5 },
    path: [[0.4, 0.9], [0.43, 0.8], [0.46, 0.7]],
  },
];

for (const { name, input, files, ground, scale, path } of SCENES) {
  test(`${name} becomes a driven twin with the mouse alone, in under three minutes`, { skip }, async () => {
    const begun = performance.now();
    const { page, complaints, close } = await open(browser, server);
    await page.getByLabel(input).setInputFiles(join(data, files));
    await page.waitForSelector(".placing[data-step]");
    await steps(page, 1);
    const found = await page.textContent(".found");
    console.log(`${name}: ${found}`);

    // 1. The ground: an axis and a place, or three places, unless the right one was found.
    if (ground.up) {
      await page.click(`.up >> text="${ground.up}"`);
      await steps(page, 2);
      await page.waitForTimeout(1000);
    }
    if (ground.up || !/using the ground/.test(found)) await clickPlaces(page, "ground", ground.places, ground.count);
    await page.waitForTimeout(1500);
    await photograph(page, `place-${name}`);

    // 2. Two places are as far apart as the buttons say.
    await page.click("text=Next");
    await clickPlaces(page, "scale", scale.places, 2);
    for (let more = 1; more < scale.metres; more++) await page.click('.distance >> text="+1"');
    assert.match(await page.textContent(".found"), /m per unit/);

    // 3. A path.
    await page.click("text=Next");
    await clickPlaces(page, "path", path, path.length);
    await photograph(page, `place-${name}-path`);
    await page.click("text=Save and drive");

    // 4. The car stands on it, and drives.
    await page.waitForSelector(".view:not(.placing)[data-step]");
    await steps(page, 1);
    assert.match(await page.textContent("#where"), new RegExp(`${name} v2`));
    await page.keyboard.down("KeyW");
    // The first fact is the speed.
    await page.waitForFunction(() => /^[1-9]/.test(document.querySelector(".facts dd").textContent));
    await page.keyboard.up("KeyW");
    const seconds = (performance.now() - begun) / 1000;
    console.log(`${name}: ${seconds.toFixed(1)} s from the file to a driven twin`);
    await photograph(page, `drive-${name}`);
    assert.ok(seconds < 180, `${seconds} s`);
    assert.deepEqual(complaints, []);
    await close();
  });
}

test("dragging turns, the wheel zooms, and clicks can be undone", { skip }, async () => {
  const { page, complaints, close } = await open(browser, server, "#/place/biker");
  await steps(page, 1);
  const box = await page.locator(".picture").boundingBox();
  const middle = [box.x + box.width / 2, box.y + box.height / 2];
  await page.mouse.move(...middle);
  await page.mouse.down();
  await page.mouse.move(middle[0] + 80, middle[1] + 20);
  await page.mouse.up();
  await steps(page, 2);
  assert.equal(await page.getAttribute(".placing", "data-ground"), "0", "a drag is no click");
  await page.mouse.wheel(0, -300);
  await steps(page, 3);
  await page.click("text=3 Path");
  await clickPlaces(page, "path", [[0.5, 0.5], [0.5, 0.6], [0.45, 0.5], [0.55, 0.55]], 1);
  await page.click("text=Undo");
  await placed(page, "path", 0);
  assert.deepEqual(complaints, []);
  await close();
});

test("the page fits a phone", { skip }, async () => {
  const { page, complaints, close } = await open(browser, server, "#/place/biker", PHONE);
  await steps(page, 1);
  const fits = await page.evaluate(() => [document.documentElement, document.getElementById("page")]
    .every(({ scrollWidth }) => scrollWidth <= innerWidth));
  assert.ok(fits);
  await page.tap("text=3 Path");
  await photograph(page, "place-phone");
  assert.deepEqual(complaints, []);
  await close();
});

test("a token that may not push is told so", async () => {
  const token = "a-token-for-the-viewer";
  const path = await tokenFile(folder, [{ name: "viewer", role: "drive", token }]);
  // Only one server at a time may use a folder of uploads.
  const other = join(folder, "other");
  await mkdir(join(other, "twins"), { recursive: true });
  const guarded = await serve(other, "--tokens", path);
  try {
    const { page, close } = await open(browser, guarded);
    await page.fill("input[type=password]", token);
    await page.click("text=Continue");
    await page.waitForSelector("h2");
    await page.evaluate(() => (location.hash = "#/place/nothing"));
    await page.waitForFunction(() => /its role is drive, not push/.test(document.getElementById("state").textContent));
    await close();
  } finally {
    await guarded.stop();
  }
});
