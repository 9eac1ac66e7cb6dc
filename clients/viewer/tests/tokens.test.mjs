// What the page shows to tokens of each role.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { home, launch, open, scene, serve, steps, tokenFile } from "./wildcity.mjs";

const TOKENS = { drive: "a-token-that-drives", push: "a-token-that-pushes", admin: "a-token-for-everything" };

let place, server, browser;

before(async () => {
  place = await home();
  const path = await tokenFile(place.folder, Object.entries(TOKENS).map(([role, token]) => ({ name: role, role, token })));
  [server, browser] = await Promise.all([serve(place.folder, "--tokens", path), launch()]);
});

after(async () => {
  await browser?.close();
  await server?.stop();
  await place?.remove();
});

async function give(page, token) {
  await page.fill("input[type=password]", token);
  await page.click("text=Continue");
}

/** What the table of twins offers, once it is there. */
async function actions(page) {
  await page.waitForSelector("td.actions a");
  return page.$$eval("td.actions a", (links) => links.map(({ textContent }) => textContent));
}

const refused = (status) => new RegExp(`^Failed to load resource: the server responded with a status of ${status} `);

/** Chromium logs each refused request: these, and nothing else. */
function assertComplaints(complaints, ...statuses) {
  assert.equal(complaints.length, statuses.length, complaints.join("\n"));
  for (const [at, status] of statuses.entries()) assert.match(complaints[at], refused(status));
}

test("a server with tokens asks for one, and a ticket opens the session", async () => {
  const { page, complaints, close } = await open(browser, server);
  await page.waitForSelector("input[type=password]");
  // The first request finds out that tokens are needed; later ones are not tried without.
  assertComplaints(complaints, 401);
  await page.reload();
  await give(page, "not-this-one-at-all");
  await page.waitForSelector("text=the server does not know this token");
  assertComplaints(complaints, 401, 401);
  await give(page, TOKENS.drive);
  await page.click("td >> text=demo");
  await steps(page, 1);
  assert.ok(!(await page.content()).includes(TOKENS.drive));
  // Sessions are not listed for it, which names its role.
  assertComplaints(complaints, 401, 401, 403);
  await close();
});

test("a token that drives finds its own session by its name", async () => {
  const { page, complaints, close } = await open(browser, server, "#/drive/demo");
  await give(page, TOKENS.drive);
  await steps(page, 1);
  const session = await page.getAttribute(".view", "data-session");
  const other = await page.context().newPage();
  await other.goto(server.url);
  await give(other, TOKENS.drive);
  await other.waitForSelector("text=role of your token: drive");
  assert.deepEqual(await actions(other), ["Drive", "Free camera"]);
  assert.ok(!(await other.isVisible("text=Add a twin")));
  await other.getByLabel("session", { exact: true }).fill(session);
  await other.getByRole("button", { name: "Watch" }).click();
  await steps(other, 1);
  // The WebSocket without a token; the request that says why it was refused, and the list of scenarios. In any order.
  const requests = complaints.filter((complaint) => !/WebSocket/.test(complaint));
  assert.equal(complaints.length - requests.length, 1);
  assertComplaints(requests, 401, 401);
  await close();
});

test("a token that pushes adds a twin and places a drive", async () => {
  const { page, close } = await open(browser, server);
  await give(page, TOKENS.push);
  await page.waitForSelector("text=role of your token: push");
  await page.getByLabel("scene files").setInputFiles(scene("pushed.ply"));
  await page.waitForFunction(() => location.hash === "#/place/pushed");
  await page.waitForSelector("text=click");
  await page.evaluate(() => (location.hash = ""));
  await page.waitForSelector("td >> text=pushed");
  assert.deepEqual((await actions(page)).slice(0, 3), ["Drive", "Free camera", "Place a drive"]);
  await close();
});

test("a token of an administrator has everything", async () => {
  const { page, close } = await open(browser, server);
  await give(page, TOKENS.admin);
  await page.waitForSelector("text=role of your token: admin");
  await page.waitForSelector("text=Recorded episodes");
  assert.deepEqual((await actions(page)).slice(0, 3), ["Drive", "Free camera", "Place a drive"]);
  assert.ok(await page.isVisible("text=Add a twin"));
  assert.ok(!(await page.isVisible("text=Your sessions")));
  await close();
});
