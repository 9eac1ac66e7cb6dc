// Elements, colours and numbers.

type Child = Node | string;

/** An element: `el("div.row", {title: "x"}, "text")`. */
export function el<K extends keyof HTMLElementTagNameMap>(
  name: K | `${K}.${string}`,
  properties: Partial<HTMLElementTagNameMap[K]> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const [tag, ...classes] = name.split(".");
  const element = document.createElement(tag as K);
  element.className = classes.join(" ");
  Object.assign(element, properties);
  element.append(...children);
  return element;
}

export function byId(id: string): HTMLElement {
  const element = document.getElementById(id);
  if (!element) throw new Error(`no element ${id}`);
  return element;
}

/** The status at the right of the bar. */
export function showStatus(text: string, kind: "" | "good" | "bad" = ""): void {
  const state = byId("state");
  state.textContent = text;
  state.className = kind;
}

/** The title in the bar: what the page shows. */
export function showTitle(...children: Child[]): void {
  byId("where").replaceChildren(...children);
}

/** A colour of the style sheet. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Trust 0 is red, one half is amber, 1 is blue: these differ for all kinds of colour vision. */
export function trustColour(value: number): string {
  const stops = [[214, 72, 92], [228, 174, 78], [74, 160, 214]] as const;
  const at = Math.min(1, Math.max(0, value)) * 2;
  const [from, to] = at < 1 ? [stops[0], stops[1]] : [stops[1], stops[2]];
  const share = at < 1 ? at : at - 1;
  return `rgb(${from.map((part, i) => Math.round(part + (to[i]! - part) * share)).join()})`;
}

export const fixed = (value: number, digits: number): string => {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text;
};

/** 432744 as 433 k. */
export function count(value: number): string {
  for (const [unit, size] of [["G", 1e9], ["M", 1e6], ["k", 1e3]] as const) {
    if (value >= size) return `${(value / size).toPrecision(3)} ${unit}`;
  }
  return String(value);
}

export const messageOf = (error: unknown): string => (error instanceof Error ? error.message : String(error));

/** A canvas that is as sharp as the screen. `draw` gets its size in CSS pixels, whenever that changes and when asked. */
export class Drawing {
  readonly canvas = el("canvas");
  private readonly draw: (context: CanvasRenderingContext2D, width: number, height: number) => void;
  private asked = false;

  constructor(draw: (context: CanvasRenderingContext2D, width: number, height: number) => void) {
    this.draw = draw;
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
  }

  /** Draws before the next frame of the screen, once however often it is asked. */
  redraw(): void {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      const { clientWidth: width, clientHeight: height } = this.canvas;
      if (width === 0 || height === 0) return;
      const scale = devicePixelRatio;
      this.canvas.width = Math.round(width * scale);
      this.canvas.height = Math.round(height * scale);
      const context = this.canvas.getContext("2d")!;
      context.scale(scale, scale);
      this.draw(context, width, height);
    });
  }
}
