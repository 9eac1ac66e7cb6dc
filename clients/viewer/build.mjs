// Bundles src into dist, which the server embeds. `--check` compares instead of writing, and fails on a difference.
import { readFile, writeFile, mkdir } from "node:fs/promises";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const LIMIT_BYTES = 60 * 1024;
const root = new URL(".", import.meta.url);
const at = (name) => new URL(name, root);

const bundle = await build({
  entryPoints: { viewer: at("src/main.ts").pathname, style: at("src/style.css").pathname },
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2023",
  charset: "utf8",
  legalComments: "none",
  outdir: at("dist").pathname,
  write: false,
});
const files = new Map(bundle.outputFiles.map((file) => [file.path.split("/").pop(), Buffer.from(file.contents)]));
// The server embeds these as they are.
const unbuilt = await Promise.all(["src/index.html", "src/icon.svg"].map((name) => readFile(at(name))));

const bytes = [...files.values(), ...unbuilt].reduce((sum, content) => sum + gzipSync(content).length, 0);
console.log(`${bytes} bytes gzipped, ${LIMIT_BYTES} allowed`);
if (bytes > LIMIT_BYTES) throw new Error("the viewer is too large");

await mkdir(at("dist"), { recursive: true });
for (const [name, content] of files) {
  const path = at(`dist/${name}`);
  if (!process.argv.includes("--check")) await writeFile(path, content);
  else if (!content.equals(await readFile(path).catch(() => Buffer.alloc(0)))) {
    throw new Error(`dist/${name} is not what src gives: run npm run build, and commit it`);
  }
}
