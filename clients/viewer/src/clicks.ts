// The places that were clicked for the ground, the scale and the path.

import { length, subtract } from "./pose";
import type { Vector } from "./pose";

export type Step = "ground" | "scale" | "path";

/** How many places a step has at most: a further click begins again. */
const MAX_PLACES: Record<Step, number> = { ground: 3, scale: 2, path: 1000 };

export class Clicks {
  private readonly places: Record<Step, Vector[]> = { ground: [], scale: [], path: [] };
  /** Earlier lists of each step, the newest last: for undo. */
  private readonly earlier: Record<Step, Vector[][]> = { ground: [], scale: [], path: [] };
  /** The lists before the last two clicks, also before those that hit nothing: for a double click. */
  private before: Vector[][] = [];

  of(step: Step): readonly Vector[] {
    return this.places[step];
  }

  /** A click on a place, or on none. */
  click(step: Step, at: Vector | undefined): void {
    const old = this.places[step];
    this.before = [...this.before.slice(-1), old];
    if (!at) return;
    this.set(step, old.length >= MAX_PLACES[step] ? [at] : [...old, at]);
  }

  /** Restores the list before the two clicks of a double click, which meant no place. */
  restoreBeforeDoubleClick(step: Step): void {
    const [first] = this.before;
    if (!first) return;
    while (this.places[step] !== first) {
      const old = this.earlier[step].pop();
      if (!old) return;
      this.places[step] = old;
    }
    this.before = [];
  }

  /** Takes back the last change: a click, or a clearing. */
  undo(step: Step): void {
    this.places[step] = this.earlier[step].pop() ?? [];
    this.before = [];
  }

  clear(step: Step): void {
    if (this.places[step].length > 0) this.set(step, []);
    this.before = [];
  }

  private set(step: Step, places: Vector[]): void {
    this.earlier[step].push(this.places[step]);
    this.places[step] = places;
  }
}

/** Metres per unit of the twin, and why it is so. */
export interface Scale {
  metresPerUnit: number;
  /** `assumed`: no place was clicked. `incomplete`: something is missing, and `missing` says what. */
  state: "given" | "assumed" | "incomplete";
  missing: string;
}

/** The scale that two places of a known distance give, in metres; 1 without them. */
export function scaleOf(places: readonly Vector[], distanceM: number): Scale {
  const [a, b] = places;
  const incomplete = (missing: string): Scale => ({ metresPerUnit: 1, state: "incomplete", missing });
  if (!a) return { metresPerUnit: 1, state: "assumed", missing: "" };
  if (!b) return incomplete("the scale has 1 of 2 places: click the other end, or clear the scale");
  if (!(distanceM > 0)) return incomplete("the scale has no distance: give one above 0 m, or clear the scale");
  const units = length(subtract(a, b));
  if (!(units > 0)) return incomplete("both places of the scale are the same: clear the scale");
  return { metresPerUnit: distanceM / units, state: "given", missing: "" };
}
