// Serves a fresh build of src and passes everything else to a running `wildcity serve`: no Rust build is needed.
// node dev.mjs [PORT] [SERVER], by default 5173 and 127.0.0.1:8080.
import { createServer, request } from "node:http";
import { connect } from "node:net";
import { readFile } from "node:fs/promises";
import { context } from "esbuild";

const [port = "5173", server = "127.0.0.1:8080"] = process.argv.slice(2);
const [host, serverPort] = server.split(":");
const root = new URL(".", import.meta.url);
const files = {
  "/": ["src/index.html", "text/html; charset=utf-8"],
  "/icon.svg": ["src/icon.svg", "image/svg+xml"],
};
const bundle = await context({
  entryPoints: { viewer: new URL("src/main.ts", root).pathname, style: new URL("src/style.css", root).pathname },
  bundle: true,
  format: "esm",
  sourcemap: "inline",
  outdir: "/",
  write: false,
});
const forwarded = (headers) => {
  const { origin, ...others } = headers;
  return { ...others, host: server };
};

const proxy = createServer(async (incoming, outgoing) => {
  const path = new URL(incoming.url, "http://localhost").pathname;
  if (files[path]) {
    const [file, type] = files[path];
    outgoing.writeHead(200, { "content-type": type }).end(await readFile(new URL(file, root)));
  } else if (path === "/viewer.js" || path === "/style.css") {
    const built = (await bundle.rebuild()).outputFiles.find((file) => file.path === path);
    const type = path.endsWith(".js") ? "text/javascript" : "text/css";
    outgoing.writeHead(200, { "content-type": type }).end(built.contents);
  } else {
    const { method, headers, url } = incoming;
    const onward = request({ host, port: serverPort, path: url, method, headers: forwarded(headers) }, (answer) => {
      outgoing.writeHead(answer.statusCode, answer.headers);
      answer.pipe(outgoing);
    });
    onward.on("error", () => outgoing.writeHead(502).end());
    incoming.pipe(onward);
  }
});
proxy.on("upgrade", (incoming, socket, head) => {
  const onward = connect(Number(serverPort), host, () => {
    const lines = Object.entries(forwarded(incoming.headers)).map(([name, value]) => `${name}: ${value}`);
    onward.write(`GET ${incoming.url} HTTP/1.1\r\n${lines.join("\r\n")}\r\n\r\n`);
    onward.write(head);
    onward.pipe(socket).pipe(onward);
  });
  onward.on("error", () => socket.destroy());
  socket.on("error", () => onward.destroy());
});
proxy.listen(Number(port), "127.0.0.1", () => console.log(`http://127.0.0.1:${port}`));
