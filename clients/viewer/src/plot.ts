// Where the time of each step went: one stacked bar per step. The legend has the mean of each stage.

import { Drawing, colour, el, fixed } from "./dom";
import type { Metadata } from "./messages";

const BARS = 120;
/** The line above the bars. */
const CAPTION_PX = 18;
/** Colours of the stages, in the order of the stages; further stages begin again. */
const COLOURS = ["#5b8fd1", "#4fb0a5", "#a7c957", "#e0ae4e", "#de7c4b", "#c2557a", "#8a6fc9", "#7d8a97"];

interface Bar {
  parts: { name: string; ms: number }[];
  total: number;
}

export class StagePlot {
  readonly element: HTMLElement;
  private readonly drawing = new Drawing((context, width, height) => this.draw(context, width, height));
  private readonly legend = el("div.legend");
  private bars: Bar[] = [];
  private names: string[] = [];

  constructor() {
    this.drawing.canvas.className = "stages";
    this.element = el("div.plot", {}, this.drawing.canvas, this.legend);
  }

  show({ timings, images }: Metadata): void {
    if (images.length === 0) return;
    const stages = timings.stages_ms ?? [];
    const known = stages.reduce((sum, { ms }) => sum + ms, 0);
    const parts = [{ name: "queue", ms: timings.queue_ms }, ...stages];
    // What is between the stages, on the host.
    parts.push({ name: "other", ms: Math.max(0, timings.render_ms - known) }, { name: "encode", ms: timings.encode_ms });
    this.bars.push({ parts, total: parts.reduce((sum, { ms }) => sum + ms, 0) });
    if (this.bars.length > BARS) this.bars.shift();
    for (const { name } of parts) if (!this.names.includes(name)) this.names.push(name);
    this.describe();
    this.drawing.redraw();
  }

  private colourOf(name: string): string {
    return COLOURS[this.names.indexOf(name) % COLOURS.length]!;
  }

  private describe(): void {
    const means = this.names.map((name) => {
      const ms = this.bars.reduce((sum, bar) => sum + (bar.parts.find((part) => part.name === name)?.ms ?? 0), 0);
      return { name, ms: ms / this.bars.length };
    });
    this.legend.replaceChildren(el("span", {}, "mean ms"), ...means.filter(({ ms }) => ms >= 0.05).map(({ name, ms }) => {
      const swatch = el("i");
      swatch.style.background = this.colourOf(name);
      return el("span", { title: `mean of the last ${this.bars.length} steps` }, swatch, `${name} `, el("b", {}, fixed(ms, ms < 9.95 ? 1 : 0)));
    }));
  }

  private draw(context: CanvasRenderingContext2D, width: number, height: number): void {
    const sorted = this.bars.map(({ total }) => total).sort((a, b) => a - b);
    // One slow step, as the first one, does not press all others flat.
    const top = 1.25 * (sorted[Math.floor(sorted.length * 0.95)] ?? 1);
    const step = width / BARS;
    this.bars.forEach(({ parts }, at) => {
      let y = height;
      for (const { name, ms } of parts) {
        const tall = (ms / top) * (height - CAPTION_PX);
        context.fillStyle = this.colourOf(name);
        const up = Math.max(CAPTION_PX, y - tall);
        context.fillRect(width - (this.bars.length - at) * step, up, Math.max(1, step - 0.6), Math.max(0, y - up));
        y -= tall;
      }
    });
    context.fillStyle = colour("dim");
    context.font = `11px ${colour("font")}`;
    const median = sorted[Math.floor(sorted.length / 2)];
    if (median !== undefined) context.fillText(`a bar is a step; their median is ${fixed(median, median < 9.95 ? 1 : 0)} ms`, 6, 13);
  }
}
