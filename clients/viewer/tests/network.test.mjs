// Pages of other sites, plain HTTP from another machine, and TLS with a private CA.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { createHash, X509Certificate } from "node:crypto";
import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { home, launch, open, scene, serve, steps, tokenFile } from "./wildcity.mjs";

/** Stand for this machine in Chromium, but not as its own names do: pages of them are not "secure contexts". */
const NAMES = "--host-resolver-rules=MAP *.test 127.0.0.1";
const TOKEN = "a-token-for-everything";

let place, browser;

before(async () => {
  [place, browser] = await Promise.all([home(), launch(NAMES)]);
});

after(async () => {
  await browser?.close();
  await place?.remove();
});

/** A page of another site. */
async function site() {
  const server = createServer((_, answer) => answer.writeHead(200, { "content-type": "text/html" }).end("<!doctype html><title>other</title>"));
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  return { origin: `http://other.test:${server.address().port}`, stop: () => server.close() };
}

/** Whether a page can open a session's WebSocket. */
async function opensFrom(url, socket) {
  const context = await browser.newContext();
  const page = await context.newPage();
  await page.goto(url);
  const isOpen = await page.evaluate((address) => new Promise((resolve) => {
    const opened = new WebSocket(address, "wildcity.v1");
    opened.onopen = () => resolve(true);
    opened.onerror = () => resolve(false);
  }), socket);
  await context.close();
  return isOpen;
}

test("the page of another site opens no session, unless its origin is listed", async () => {
  const other = await site();
  const plain = await serve(place.folder);
  assert.equal(await opensFrom(`${other.origin}/`, plain.socket), false);
  assert.equal(await opensFrom(plain.url, plain.socket), true);
  await plain.stop();
  const listing = await serve(place.folder, "--origin", other.origin);
  assert.equal(await opensFrom(`${other.origin}/`, listing.socket), true);
  await listing.stop();
  other.stop();
});

test("by a name that is not the server's, the viewer says what is refused", async () => {
  const server = await serve(place.folder);
  const url = server.url.replace("127.0.0.1", "rebound.test");
  const { page, close } = await open(browser, { ...server, url });
  await page.waitForFunction(() => /origin|host/.test(document.getElementById("state").textContent));
  await close();
  await server.stop();
});

test("a file is added over plain HTTP from another machine", async () => {
  const path = await tokenFile(place.folder, [{ name: "all", role: "admin", token: TOKEN }]);
  const server = await serve(place.folder, "--tokens", path);
  const url = server.url.replace("127.0.0.1", "plain.test");
  const { page, close } = await open(browser, { ...server, url });
  await page.fill("input[type=password]", TOKEN);
  await page.click("text=Continue");
  assert.deepEqual(await page.evaluate(() => [isSecureContext, crypto.subtle === undefined]), [false, true]);
  await page.getByLabel("scene files").setInputFiles(scene("plain.ply"));
  await page.waitForSelector(".placing[data-step]");
  await close();
  await server.stop();
});

test("the viewer drives over TLS with a private CA", async () => {
  const at = (name) => join(place.folder, name);
  const openssl = (...args) => execFileSync("openssl", args, { stdio: ["ignore", "ignore", "pipe"] });
  openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=private CA",
    "-keyout", at("ca.key"), "-out", at("ca.pem"));
  openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=server",
    "-addext", "subjectAltName=IP:127.0.0.1", "-addext", "basicConstraints=critical,CA:FALSE", "-CA", at("ca.pem"), "-CAkey", at("ca.key"),
    "-keyout", at("tls.key"), "-out", at("tls.pem"));
  const server = await serve(place.folder, "--tls-cert", at("tls.pem"), "--tls-key", at("tls.key"));
  assert.match(server.url, /^https:/);
  // A browser that does not know the CA refuses.
  const stranger = await browser.newContext();
  await assert.rejects((await stranger.newPage()).goto(server.url), /ERR_CERT_AUTHORITY_INVALID/);
  await stranger.close();

  // Chromium takes the keys of this list for known.
  const key = new X509Certificate(readFileSync(at("ca.pem"))).publicKey.export({ type: "spki", format: "der" });
  const serverKey = new X509Certificate(readFileSync(at("tls.pem"))).publicKey.export({ type: "spki", format: "der" });
  const hashes = [key, serverKey].map((der) => createHash("sha256").update(der).digest("base64"));
  const knowing = await launch(`--ignore-certificate-errors-spki-list=${hashes.join()}`);
  const { page, complaints, close } = await open(knowing, server, "#/drive/demo");
  await steps(page, 2);
  assert.deepEqual(complaints, []);
  await close();
  await knowing.close();
  await server.stop();
});
