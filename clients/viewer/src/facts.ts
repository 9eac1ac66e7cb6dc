// Numbers of the ego.

import { el, fixed } from "./dom";
import { rotate } from "./pose";
import type { Metadata } from "./messages";

export class Facts {
  readonly element = el("dl.facts");

  /** Shows an observation, and rows of the page's own. */
  show(metadata: Metadata, own: [string, string][] = []): void {
    const trusts = metadata.images.flatMap(({ trust }) => (trust ? [trust] : []));
    const rows: [string, string][] = [
      ["speed", `${fixed(forwardSpeed(metadata) * 3.6, 0)} km/h`],
      ["time", `${fixed(metadata.time_us * 1e-6, 1)} s`],
      ...own,
      ["steering", metadata.ego.steering === undefined ? "–" : `${fixed((metadata.ego.steering * 180) / Math.PI, 1)}°`],
      ["trust", trusts.length ? fixed(trusts.reduce((sum, { value }) => sum + value, 0) / trusts.length, 2) : "–"],
      ["to a recorded pose", trusts[0] ? `${fixed(trusts[0].distance_m, 1)} m` : "–"],
    ];
    const { route } = metadata;
    if (route) rows.push(["route", `${route.text ?? route.command} · ${fixed(route.station_m, 0)} of ${fixed(route.length_m, 0)} m`]);
    this.set(rows);
  }

  set(rows: [string, string][]): void {
    this.element.replaceChildren(...rows.map(([name, value]) => el(name === "route" ? "div.route" : "div", {}, el("dt", {}, name), el("dd", {}, value))));
  }
}

/** Speed along the rig's x axis, in m/s: negative backwards. */
export function forwardSpeed({ ego }: Metadata): number {
  const ahead = rotate(ego.pose.q, [1, 0, 0]);
  return ego.velocity.reduce((sum, part, at) => sum + part * ahead[at]!, 0);
}
