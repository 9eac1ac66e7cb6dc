// What is drawn over the picture of a twin: the grid of the ground, the distance, the path.

import type { Clicks } from "./clicks";
import { el } from "./dom";
import { anyAcross, normalOf } from "./ground";
import type { Ground } from "./ground";
import { RIG_FROM_CAMERA } from "./orbit";
import type { Orbit } from "./orbit";
import { add, cross, dot, rotate, scaled, subtract } from "./pose";
import type { Pose, Vector } from "./pose";

const GRID_LINES = 10;
const COLOURS = { ground: "#ff6032", scale: "#5fbf96", path: "#6bb5ee" } as const;

/** The picture that is shown. */
export interface Shown {
  pose: Pose;
  /** Width and height, and the focal length, in pixels of the picture. */
  size: [number, number];
  focal: number;
  /** Where the picture is in the window, in CSS pixels. */
  box: { left: number; top: number; width: number };
}

export class Overlay {
  readonly canvas = el("canvas.overlay");

  draw(shown: Shown | undefined, clicks: Clicks, ground: Ground | undefined, orbit: Orbit | undefined): void {
    const { canvas } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    canvas.width = width * devicePixelRatio;
    canvas.height = height * devicePixelRatio;
    if (!shown) return;
    const context = canvas.getContext("2d")!;
    context.scale(devicePixelRatio, devicePixelRatio);
    const own = canvas.getBoundingClientRect();
    const toScreen = (at: Vector): [number, number] | undefined => this.toScreen(at, shown, own);
    const line = (places: readonly Vector[], style: string, thickness: number): void => {
      context.beginPath();
      let isDown = false;
      for (const at of places) {
        const point = toScreen(at);
        if (point && isDown) context.lineTo(...point);
        else if (point) context.moveTo(...point);
        isDown = point !== undefined;
      }
      context.strokeStyle = style;
      context.lineWidth = thickness;
      context.stroke();
    };
    if (ground && orbit) {
      const normal = normalOf(ground);
      const centre = add(orbit.pivot, scaled(normal, dot(subtract(ground.points[0], orbit.pivot), normal)));
      const across = anyAcross(normal);
      const along = cross(normal, across);
      const step = orbit.distance / GRID_LINES;
      for (let at = -GRID_LINES; at <= GRID_LINES; at++) {
        const row = (u: Vector, v: Vector): Vector[] => Array.from({ length: 21 }, (_, i) =>
          add(centre, add(scaled(u, at * step), scaled(v, (i - 10) * step))));
        line(row(across, along), `${COLOURS.ground}88`, 1);
        line(row(along, across), `${COLOURS.ground}88`, 1);
      }
    }
    line(clicks.of("scale"), COLOURS.scale, 2);
    line(clicks.of("path"), COLOURS.path, 4);
    for (const step of ["ground", "scale", "path"] as const) {
      for (const at of clicks.of(step)) {
        const point = toScreen(at);
        if (!point) continue;
        context.beginPath();
        context.arc(...point, 6, 0, 2 * Math.PI);
        context.fillStyle = COLOURS[step];
        context.fill();
        context.strokeStyle = "#fff";
        context.lineWidth = 2;
        context.stroke();
      }
    }
  }

  /** Where a place is in the picture, in CSS pixels of the canvas; undefined behind the camera. */
  private toScreen(at: Vector, { pose, size: [w, h], focal, box }: Shown, own: DOMRect): [number, number] | undefined {
    const inverse = (q: Pose["q"]): Pose["q"] => [q[0], -q[1], -q[2], -q[3]];
    const [x, y, z] = rotate(inverse(RIG_FROM_CAMERA.q), rotate(inverse(pose.q), subtract(at, pose.xyz)));
    if (z <= 1e-6) return undefined;
    const pixels = box.width / w;
    return [box.left - own.left + (w / 2 + (x * focal) / z) * pixels, box.top - own.top + (h / 2 + (y * focal) / z) * pixels];
  }
}
