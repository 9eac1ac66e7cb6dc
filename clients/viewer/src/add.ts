// A new twin from files of this machine: uploads them, and pushes.

import { el, say } from "./dom";
import { append, get, post } from "./server";
import { archive } from "./zip";

interface Upload {
  id: string;
  offset: number;
  complete: boolean;
}

interface Push {
  id: string;
  state: string;
  error?: { message: string };
}

const PART_BYTES = 4 << 20;
const POLL_MS = 300;
const DONE = new Set(["ready", "refused", "failed"]);

export class Adder {
  readonly element: HTMLElement;
  private readonly state = el("span.dim");
  private readonly onAdded: () => void;

  constructor(onAdded: () => void) {
    this.onAdded = onAdded;
    const file = el("input", { type: "file", multiple: true, ariaLabel: "scene files" });
    const folder = el("input", { type: "file", ariaLabel: "scene folder", webkitdirectory: true });
    for (const input of [file, folder]) {
      input.addEventListener("change", () => {
        const files = [...(input.files ?? [])];
        input.value = "";
        if (files.length) void this.add(files);
      });
    }
    this.element = el("div.adder", {}, el("label", {}, "Add a twin: file", file), el("label", {}, "folder", folder), this.state);
  }

  private async add(files: File[]): Promise<void> {
    try {
      const first = files.find(({ name }) => /\.(ply|spz|splat|ksplat|sog|glb|gltf|usdz|safetensors|zip)$/i.test(name)) ?? files[0]!;
      const isLone = files.length === 1;
      const folder = first.webkitRelativePath.split("/")[0];
      const twin = nameOf(folder || first.name);
      this.tell(`reading ${first.name}`);
      // A folder becomes one archive: its files have equal names in different folders.
      const sent = isLone ? first : new File([await archive(files)], `${twin}.zip`);
      const upload = await this.upload(sent);
      const pushed = await post<Push>(`v1/twins/${twin}/pushes`, { files: [{ upload, axes: "identity" }], cells: "all", note: `added in the viewer from ${sent.name}`.slice(0, 1000) });
      let push = pushed;
      while (!DONE.has(push.state)) {
        this.tell(`${twin}: ${push.state}`);
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        push = await get<Push>(`v1/twins/${twin}/pushes/${pushed.id}`);
      }
      if (push.state !== "ready") throw new Error(push.error?.message ?? push.state);
      this.tell(`${twin} is there`);
      this.onAdded();
      location.hash = `#/place/${encodeURIComponent(twin)}`;
    } catch (error) {
      this.tell("");
      say(error instanceof Error ? error.message : String(error), "bad");
    }
  }

  private async upload(file: File): Promise<string> {
    const digest = await crypto.subtle.digest("SHA-256", await file.arrayBuffer());
    const hex = [...new Uint8Array(digest)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    const upload = await post<Upload>("v1/uploads", { name: file.name.slice(0, 200), size: file.size, digest: `sha-256:${hex}` });
    for (let at = upload.offset; at < file.size; at += PART_BYTES) {
      this.tell(`uploading ${file.name}: ${Math.round((100 * at) / file.size)} %`);
      await append(`v1/uploads/${upload.id}`, file.slice(at, at + PART_BYTES), at);
    }
    return upload.id;
  }

  private tell(text: string): void {
    this.state.textContent = text;
    say("");
  }
}

/** A name of a twin from that of a file. */
export function nameOf(file: string): string {
  const stem = file.toLowerCase().replace(/\.[a-z]+$/, "").replace(/\.compressed$/, "");
  return stem.replace(/[^a-z0-9._-]+/g, "-").replace(/^[.-]+/, "").slice(0, 64) || "twin";
}
