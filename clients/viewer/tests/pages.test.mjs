// Addresses, settings, new twins and reports.
import assert from "node:assert/strict";
import { mkdir, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { home, launch, open, scene, serve, steps } from "./wildcity.mjs";

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

const sessions = async () => (await (await fetch(`${server.url}v1/sessions`)).json()).sessions;
/** Without that of a map's picture, which lasts for an image. */
const driven = async () => (await sessions()).filter(({ session }) => !session.startsWith("viewer-map-"));
const versions = async () => {
  const { twins } = await (await fetch(`${server.url}v1/twins`)).json();
  return Object.fromEntries(twins.map(({ name, version }) => [name, version]));
};

/** Waits until something holds; the test's own time is the limit. */
async function until(holds) {
  while (!(await holds())) await new Promise((resolve) => setTimeout(resolve, 100));
}

test("a damaged address has a message, and ends the page before", async () => {
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  assert.equal((await driven()).length, 1);
  await page.evaluate(() => (location.hash = "#/drive/%E0%A4%A"));
  await page.waitForSelector("text=The name in the address #/drive/%E0%A4%A is damaged");
  assert.equal(await page.$(".view"), null);
  await until(async () => (await sessions()).length === 0);
  await page.click("text=To the first page");
  await page.waitForSelector("text=Recorded episodes");
  assert.deepEqual(complaints, []);
  await close();
});

test("the first page shows each twin ahead and from above, and leaves nothing", async () => {
  const before = (await (await fetch(`${server.url}v1/episodes`)).json()).episodes.length;
  const { page, complaints, close } = await open(browser, server, "#/");
  await page.waitForSelector(".pictures canvas:nth-child(2)");
  const pictures = await page.$$eval(".pictures canvas", (all) => all.map((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return { text: canvas.title, hash: canvas.dataset.hash, colours: new Set(data).size };
  }));
  assert.deepEqual(pictures.map(({ text }) => text), ["demo ahead", "demo from above, with its recorded drives"]);
  assert.notEqual(pictures[0].hash, pictures[1].hash);
  assert(pictures.every(({ colours }) => colours > 100), JSON.stringify(pictures));
  await until(async () => (await sessions()).length === 0);
  const { episodes } = await (await fetch(`${server.url}v1/episodes`)).json();
  assert.equal(episodes.length, before);
  // The list is made again after 3 s, with the same pictures.
  const first = await page.$(".pictures canvas");
  await page.waitForTimeout(3500);
  assert(await first.evaluate((canvas) => canvas.isConnected));
  assert.deepEqual(complaints, []);
  await close();
});

test("damaged settings do not stop the drive", async () => {
  const { page, complaints, close } = await open(browser, server);
  await page.evaluate(() => localStorage.setItem("wildcity-settings", '{"width": 4'));
  await page.click("text=demo");
  await steps(page, 1);
  assert.deepEqual(complaints, []);

  // In a recorded episode the arrows step; with Alt they are the browser's.
  const session = await page.getAttribute(".view", "data-session");
  await steps(page, 3);
  await page.click("#home");
  await page.click(`text=${session}-1`);
  await page.waitForSelector(".player[data-same]");
  const at = () => page.$eval(".track input", ({ value }) => value);
  await page.keyboard.press("ArrowRight");
  assert.equal(await at(), "1");
  for (const modifier of ["Alt", "Control", "Meta"]) {
    const isFree = await page.evaluate((key) => {
      const event = new KeyboardEvent("keydown", { code: "ArrowLeft", cancelable: true, bubbles: true, [`${key}Key`]: true });
      return document.body.dispatchEvent(event);
    }, { Alt: "alt", Control: "ctrl", Meta: "meta" }[modifier]);
    assert.ok(isFree, `${modifier} and left is taken`);
  }
  assert.equal(await at(), "1");
  await close();
});

test("a scenario is chosen from those of the server", async () => {
  const scenario = {
    format: "wildcity.scenario/1", name: "brief", twin: { name: "demo" },
    ego: { start: { trajectory: "log", station_m: 20 }, dynamics: { model: "dynamic", speed: 3 } }, end: { time_s: 60 },
  };
  await mkdir(join(place.folder, "scenarios"), { recursive: true });
  await writeFile(join(place.folder, "scenarios", "brief.json"), JSON.stringify(scenario));
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 1);
  await page.click("text=Settings");
  const before = await page.getAttribute(".view", "data-session");
  await page.getByLabel("scenario").selectOption("brief");
  // Until the session with the scenario is open, the view has the steps of the one before.
  await page.waitForSelector(`.view:not([data-session="${before}"])`);
  await steps(page, 2);
  const session = await page.getAttribute(".view", "data-session");
  await page.click("#home");
  // The list is read again until the episode has ended.
  await page.waitForSelector(`tr:has-text("${session}-1"):has-text("brief")`);
  assert.deepEqual(complaints, []);
  await close();
});

test("lanes lie over the picture from above, and a scenario is chosen on the first page", async () => {
  const line = (y) => [[20, y, 0], [160, y, 0]];
  const lane = (id, y) => ({ id, center: line(y), left: line(y + 1.75), right: line(y - 1.75) });
  const write = (name, value) => writeFile(join(place.folder, "scenarios", name), JSON.stringify(value));
  const scenario = (name, file) => ({
    format: "wildcity.scenario/1", name, twin: { name: "demo" }, ...(file ? { map: { file } } : {}),
    ego: { start: { trajectory: "log", station_m: 20 }, dynamics: { model: "dynamic", speed: 3 } }, end: { time_s: 60 },
  });
  await mkdir(join(place.folder, "scenarios"), { recursive: true });
  await write("road.map.json", { format: "wildcity.map/1", lanes: [lane("a", 0), lane("b", 3.5), lane("c", 40)] });
  await write("one.map.json", { format: "wildcity.map/1", lanes: [lane("a", 0)] });
  const files = [["on-road", "road.map.json"], ["one", "one.map.json"], ["lost", "gone.map.json"]];
  await Promise.all(files.map(([name, file]) => write(`${name}.json`, scenario(name, file))));

  const { page, complaints, close } = await open(browser, server, "#/");
  const above = page.locator(".pictures canvas").nth(1);
  await above.waitFor();
  assert.equal(await above.getAttribute("title"), "demo from above, with its recorded drives and lanes");
  assert.equal(await above.getAttribute("data-lanes"), "4");
  const pixels = () => above.evaluate((canvas) => canvas.toDataURL());
  const all = await pixels();
  await page.getByLabel("scenario of demo").selectOption("one");
  assert.equal(await above.getAttribute("data-lanes"), "1");
  assert.notEqual(await pixels(), all);
  // The table is made again with the address of the scenario, and the list keeps it.
  await page.click('a[href="#/drive/demo/one"]:has-text("Drive")');
  await steps(page, 2);
  assert.equal(await page.getByLabel("scenario").inputValue(), "one");
  assert.equal(await page.getAttribute(".map", "data-lanes"), "1");
  assert.ok(!(await page.isVisible(".omitted")));
  await page.click("#home");
  await page.waitForSelector('tr:has-text("by-hand"):has-text("one")');
  // Without a scenario the map has all lanes, and says which it has not.
  await page.click('a[href="#/drive/demo"]:has-text("Drive")');
  await steps(page, 1);
  assert.equal(await page.getAttribute(".map", "data-lanes"), "4");
  assert.equal(await page.textContent(".omitted"), "lanes not drawn, too large or not readable: gone.map.json");
  assert.deepEqual(complaints, []);
  await close();
});

test("a page that is closed while it drives leaves no session", async () => {
  const { page, close } = await open(browser, server, "#/drive/demo");
  await steps(page, 2);
  await close();
  const running = async () => (await (await fetch(`${server.url}v1/sessions`)).json()).sessions.length;
  // Far less than the minute for which a lost session waits.
  for (let tries = 0; tries < 40 && (await running()) > 0; tries += 1) await new Promise((resolve) => setTimeout(resolve, 250));
  assert.equal(await running(), 0);
});

test("a file with the name of a twin asks for a name", async () => {
  const { page, complaints, close } = await open(browser, server);
  const before = await versions();
  await page.getByLabel("scene files").setInputFiles(scene("demo.ply"));
  const name = page.getByLabel("name of the twin");
  await name.waitFor();
  assert.equal(await name.inputValue(), "demo-2");
  await page.getByRole("button", { name: "Cancel" }).click();
  await name.waitFor({ state: "hidden" });
  assert.deepEqual(await versions(), before);

  await page.getByLabel("scene files").setInputFiles(scene("demo.ply"));
  await page.click("text=Add as demo-2");
  await page.waitForSelector(".placing[data-step]");
  assert.deepEqual(await versions(), { ...before, "demo-2": 1 });

  // The same name again only if the user says so.
  await page.click("#home");
  await page.getByLabel("scene files").setInputFiles(scene("demo-2.ply"));
  await name.fill("demo-2");
  await page.click("text=Replace demo-2 by a new version");
  await page.waitForSelector(".placing[data-step]");
  assert.deepEqual(await versions(), { ...before, "demo-2": 2 });
  assert.deepEqual(complaints, []);
  await close();
});

test("an error of a new twin stays", async () => {
  const { page, close } = await open(browser, server);
  await page.getByLabel("scene files").setInputFiles({ name: "broken.ply", mimeType: "", buffer: Buffer.from("ply\nno\n") });
  const error = page.locator(".adder .bad");
  await error.waitFor();
  const text = await error.textContent();
  assert.ok(text.length > 10, text);
  // The lists are read again meanwhile.
  for (let read = 0; read < 2; read++) await page.waitForResponse(/v1\/twins$/);
  await page.waitForResponse(/v1\/sessions$/);
  assert.equal(await error.textContent(), text);
  await close();
});

test("a double click keeps the places, and a missing scale is not saved in silence", async () => {
  const { page, complaints, close } = await open(browser, server, "#/place/demo");
  await steps(page, 1);
  const box = await page.locator(".picture").boundingBox();
  const at = (x, y) => [box.x + x * box.width, box.y + y * box.height];
  const placed = (step) => page.getAttribute(".placing", `data-${step}`);
  const click = async (x, y) => {
    await page.mouse.click(...at(x, y));
    // Two clicks at once would be a double click.
    await page.waitForTimeout(600);
  };
  await page.click("text=2 Scale");
  for (const [x, y] of [[0.5, 0.5], [0.5, 0.55], [0.45, 0.5], [0.55, 0.5], [0.5, 0.6], [0.4, 0.55]]) {
    if ((await placed("scale")) !== "2") await click(x, y);
  }
  assert.equal(await placed("scale"), "2");
  const text = await page.textContent(".found");
  await page.mouse.dblclick(...at(0.52, 0.52));
  assert.equal(await placed("scale"), "2");
  assert.equal(await page.textContent(".found"), text);

  // One place is no scale.
  await page.getByRole("button", { name: "Undo" }).click();
  await page.click("text=3 Path");
  for (const [x, y] of [[0.45, 0.5], [0.5, 0.5], [0.55, 0.5], [0.5, 0.6]]) await click(x, y);
  assert.match(await page.textContent(".found"), /the scale has 1 of 2 places/);
  assert.ok(await page.isDisabled(".save"));
  await page.click("text=2 Scale");
  await page.getByRole("button", { name: "Clear" }).click();
  await page.click("text=3 Path");
  assert.match(await page.textContent(".found"), /no distance: 1 m per unit/);
  assert.doesNotMatch(await page.textContent(".found"), /shorter than a car/);
  // With a scale that is far too small, the path is shorter than a car.
  await page.click("text=2 Scale");
  for (const [x, y] of [[0.45, 0.5], [0.55, 0.5], [0.5, 0.6], [0.4, 0.55]]) {
    if ((await placed("scale")) !== "2") await click(x, y);
  }
  await page.getByLabel("distance in metres").fill("0.01");
  await page.click("text=3 Path");
  assert.match(await page.textContent(".found"), /m, shorter than a car of 4.6 m: is the scale right\?/);
  await page.click("text=2 Scale");
  await page.getByRole("button", { name: "Clear" }).click();
  await page.click("text=3 Path");
  const before = await versions();
  await page.getByRole("button", { name: "Save and drive" }).click();
  assert.match(await page.textContent(".found"), /No distance was given/);
  assert.deepEqual(await versions(), before);
  await page.getByRole("button", { name: "Save with 1 m per unit" }).click();
  await page.waitForSelector(".view:not(.placing)[data-step]");
  assert.equal((await versions()).demo, before.demo + 1);
  assert.deepEqual(complaints, []);
  await close();
});

test("the errors of a report are on the map", async () => {
  const { page, complaints, close } = await open(browser, server);
  await page.click("text=Show the errors of a report on the map");
  const files = ["report.json", "report.html"].map((name) => new URL(`report/${name}`, import.meta.url).pathname);
  await page.getByLabel("report files").setInputFiles(files);
  await page.waitForSelector("text=71 m, 1 m left: 115.8 dB");
  await page.getByLabel("setting").selectOption("tau_px=4 alpha_cut=0.032 stop=0.004");
  await page.waitForSelector("text=71 m, 1 m left: 34.8 dB");
  await page.waitForSelector("text=The worst window is at 71 m, 1 m left.");
  const captions = await page.$$eval("figcaption", (all) => all.map(({ textContent }) => textContent));
  assert.deepEqual(captions, ["as rendered", "reference", "error"]);
  // The map has a dot of the colour of each place, and they fit in it.
  const dots = await page.$$eval(".dot", (all) => all.map((dot) => getComputedStyle(dot).backgroundColor));
  assert.equal(dots.length, 8);
  await page.waitForFunction((colours) => {
    const map = document.querySelector(".map");
    const copy = new OffscreenCanvas(map.width, map.height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(map, 0, 0);
    const { data } = copy.getImageData(0, 0, map.width, map.height);
    const seen = new Set();
    for (let at = 0; at < data.length; at += 4) seen.add(`rgb(${data[at]}, ${data[at + 1]}, ${data[at + 2]})`);
    return colours.every((colour) => seen.has(colour));
  }, dots);

  await page.getByLabel("report files").setInputFiles({ name: "other.json", mimeType: "", buffer: Buffer.from("{}") });
  await page.waitForSelector("text=this JSON is no report");
  assert.deepEqual(complaints, []);
  await close();
});
