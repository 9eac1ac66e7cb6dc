// What the driver can choose; remembered by the browser.

import { el, messageOf } from "./dom";
import { clamp } from "./pose";
import { get } from "./server";

const KEY = "wildcity-settings";
const WIDTHS = [320, 480, 640, 960, 1280, 99_999];

/** What the browser remembers. */
export interface Stored {
  width?: number;
  quality?: number;
  pace?: boolean;
}

/** The settings that a text of the browser's storage has. Those that are missing or damaged are left out. */
export function parseStored(text: string | null): Stored {
  let value: unknown;
  try {
    value = JSON.parse(text ?? "{}");
  } catch {
    return {};
  }
  const { width, quality, pace } = Object(value) as Record<string, unknown>;
  const stored: Stored = {};
  if (WIDTHS.includes(width as number)) stored.width = width as number;
  if (Number.isInteger(quality) && clamp(quality as number, 1, 100) === quality) stored.quality = quality;
  if (typeof pace === "boolean") stored.pace = pace;
  return stored;
}

/** Adds the scenarios of the server; one may be chosen already. */
async function fillScenarios(select: HTMLSelectElement, chosen: string): Promise<void> {
  let names: string[] = [];
  try {
    names = (await get<{ scenarios: string[] }>("v1/scenarios")).scenarios;
  } catch (error) {
    select.title = `The scenarios cannot be listed: ${messageOf(error)}`;
  }
  // The list is empty for a token of some twins; the scenario that is in use is shown all the same.
  if (chosen !== "" && !names.includes(chosen)) names.push(chosen);
  select.append(...names.map((name) => el("option", { value: name, selected: name === chosen }, name)));
}

export class Settings {
  readonly element: HTMLElement;
  keepsPace: boolean;
  scenario: string;
  quality: number;
  private chosenWidth: number | undefined;
  private suitable = 480;
  private readonly widths = el("select", { title: "Smaller images are faster" });

  constructor(onChange: () => void, scenario: string) {
    this.scenario = scenario;
    const stored = parseStored(localStorage.getItem(KEY));
    this.chosenWidth = stored.width;
    this.quality = stored.quality ?? 85;
    this.keepsPace = stored.pace ?? true;
    const quality = el("input", { type: "number", min: "1", max: "100", value: String(this.quality) });
    const pace = el("input", { type: "checkbox", checked: this.keepsPace });
    const scenarios = el("select", {}, el("option", { value: "" }, "none"));
    void fillScenarios(scenarios, scenario);
    const change = (then: () => void) => (): void => {
      then();
      this.store();
      onChange();
    };
    this.widths.addEventListener("change", change(() => (this.chosenWidth = Number(this.widths.value))));
    quality.addEventListener("change", change(() => (this.quality = clamp(Math.round(Number(quality.value)) || 85, 1, 100))));
    scenarios.addEventListener("change", change(() => (this.scenario = scenarios.value)));
    pace.addEventListener("change", () => {
      this.keepsPace = pace.checked;
      this.store();
    });
    const label = (text: string, title: string, field: HTMLElement): HTMLElement => el("label", { title }, text, field);
    this.element = el("details.settings", {}, el("summary", {}, "Settings"),
      label("width of the front image", "Smaller images are faster; the other cameras are smaller still", this.widths),
      label("JPEG quality", "1 to 100", quality),
      label("scenario", "One of the server's scenarios", scenarios),
      label("keep pace", "On a slow server, render fewer images rather than slow time down", pace));
    this.list();
  }

  get width(): number {
    return this.chosenWidth ?? this.suitable;
  }

  /** Chooses a width for the renderer, unless the driver has. */
  suit(backend: string): void {
    this.suitable = backend === "gpu" ? 1280 : 480;
    this.list();
  }

  private list(): void {
    this.widths.replaceChildren(...WIDTHS.map((width) => {
      const text = width > 9999 ? "full" : `${width} px`;
      return el("option", { value: String(width), selected: width === this.width }, text);
    }));
  }

  private store(): void {
    const stored: Stored = { quality: this.quality, pace: this.keepsPace };
    if (this.chosenWidth !== undefined) stored.width = this.chosenWidth;
    localStorage.setItem(KEY, JSON.stringify(stored));
  }
}
