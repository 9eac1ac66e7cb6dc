// A new twin from files of this machine: uploads them, and pushes.

import { el, messageOf } from "./dom";
import type { TwinInfo } from "./messages";
import { append, get, post } from "./server";
import { Sha256 } from "./sha256";
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
const MOST_IN_MEMORY = 1 << 30;
const POLL_MS = 300;
/** Characters that the name of a twin may have. */
const NAME_CHARACTERS = 64;
const DONE = new Set(["ready", "refused", "failed"]);

export class Adder {
  readonly element: HTMLElement;
  private readonly progress = el("span.dim", { role: "status" });
  /** Asks for a name, if that of the file is taken. */
  private readonly naming = el("form.naming", { hidden: true });
  /** Set while files are added. */
  private isBusy = false;
  private readonly onAdded: () => void;

  constructor(onAdded: () => void) {
    this.onAdded = onAdded;
    const file = el("input", { type: "file", multiple: true, ariaLabel: "scene files" });
    const folder = el("input", { type: "file", ariaLabel: "scene folder", webkitdirectory: true });
    for (const input of [file, folder]) {
      input.addEventListener("change", () => {
        const files = [...(input.files ?? [])];
        input.value = "";
        if (files.length && !this.isBusy) void this.add(files);
      });
    }
    this.element = el("div.adder", {}, el("label", {}, "Add a twin: file", file), el("label", {}, "folder", folder), this.naming, this.progress);
  }

  private async add(files: File[]): Promise<void> {
    this.isBusy = true;
    try {
      const first = files.find(({ name }) => /\.(ply|spz|splat|ksplat|sog|glb|gltf|usdz|safetensors|zip)$/i.test(name)) ?? files[0]!;
      const folder = first.webkitRelativePath.split("/")[0];
      const twin = await this.chooseName(nameOf(folder || first.name));
      if (twin === undefined) return this.showProgress("");
      this.showProgress(`reading ${first.name}`);
      // A folder becomes one archive: its files have equal names in different folders.
      const isLone = files.length === 1;
      const sent = isLone ? first : new File([await archive(files)], `${twin}.zip`);
      const upload = await this.upload(sent);
      const pushed = await post<Push>(`v1/twins/${twin}/pushes`, { files: [{ upload, axes: "identity" }], cells: "all", note: `added in the viewer from ${sent.name}`.slice(0, 1000) });
      let push = pushed;
      while (!DONE.has(push.state)) {
        this.showProgress(`${twin}: ${push.state}`);
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        push = await get<Push>(`v1/twins/${twin}/pushes/${pushed.id}`);
      }
      if (push.state !== "ready") throw new Error(push.error?.message ?? push.state);
      this.showProgress(`${twin} was added`);
      this.onAdded();
      location.hash = `#/place/${encodeURIComponent(twin)}`;
    } catch (error) {
      this.showProgress(messageOf(error), true);
    } finally {
      this.isBusy = false;
    }
  }

  /** The name of the file if it is free; otherwise the one that the user chooses, or undefined. */
  private async chooseName(wanted: string): Promise<string | undefined> {
    const { twins, damaged = [] } = await get<{ twins: TwinInfo[]; damaged?: { name: string }[] }>("v1/twins");
    const taken = new Set([...twins, ...damaged].map(({ name }) => name));
    if (!taken.has(wanted)) return wanted;
    const field = el("input", { type: "text", value: freeName(wanted, taken), spellcheck: false, ariaLabel: "name of the twin" });
    const add = el("button", { type: "submit" });
    const cancel = el("button", { type: "button" }, "Cancel");
    const describe = (): void => {
      const name = field.value.trim();
      add.textContent = taken.has(name) ? `Replace ${name} by a new version` : `Add as ${name}`;
      add.disabled = !name;
    };
    field.addEventListener("input", describe);
    describe();
    this.showProgress("");
    this.naming.replaceChildren(`There is a twin ${wanted}. Name of the new one:`, field, add, cancel);
    this.naming.hidden = false;
    const chosen = await new Promise<string | undefined>((resolve) => {
      cancel.onclick = () => resolve(undefined);
      this.naming.onsubmit = (event) => {
        event.preventDefault();
        resolve(field.value.trim());
      };
    });
    this.naming.hidden = true;
    return chosen;
  }

  private async upload(file: File): Promise<string> {
    const digest = await this.digest(file);
    const upload = await post<Upload>("v1/uploads", { name: file.name.slice(0, 200), size: file.size, digest: `sha-256:${digest}` });
    for (let at = upload.offset; at < file.size; at += PART_BYTES) {
      this.showProgress(`uploading ${file.name}: ${Math.round((100 * at) / file.size)} %`);
      await append(`v1/uploads/${upload.id}`, file.slice(at, at + PART_BYTES), at);
    }
    return upload.id;
  }

  /** The SHA-256 of a file, in hexadecimal digits. */
  private async digest(file: File): Promise<string> {
    // Absent in pages that come over plain HTTP from another machine. It is much faster, but needs the whole file at once.
    const { subtle } = crypto as { subtle?: SubtleCrypto };
    if (subtle && file.size <= MOST_IN_MEMORY) {
      const digest = await subtle.digest("SHA-256", await file.arrayBuffer());
      return [...new Uint8Array(digest)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    }
    const hash = new Sha256();
    for (let at = 0; at < file.size; at += PART_BYTES) {
      this.showProgress(`reading ${file.name}: ${Math.round((100 * at) / file.size)} %`);
      hash.update(new Uint8Array(await file.slice(at, at + PART_BYTES).arrayBuffer()));
    }
    return hash.hex();
  }

  /** The page's own status is that of its list, which is read again and again. */
  private showProgress(text: string, isError = false): void {
    this.progress.textContent = text;
    this.progress.className = isError ? "bad" : "dim";
  }
}

/** A name of a twin from that of a file. */
export function nameOf(file: string): string {
  const stem = file.toLowerCase().replace(/\.[a-z]+$/, "").replace(/\.compressed$/, "");
  return stem.replace(/[^a-z0-9._-]+/g, "-").replace(/^[.-]+/, "").slice(0, NAME_CHARACTERS) || "twin";
}

/** The name, or the first of NAME-2, NAME-3, .. that is free. */
export function freeName(name: string, taken: ReadonlySet<string>): string {
  for (let number = 1; ; number++) {
    const end = number === 1 ? "" : `-${number}`;
    const free = name.slice(0, NAME_CHARACTERS - end.length) + end;
    if (!taken.has(free)) return free;
  }
}
