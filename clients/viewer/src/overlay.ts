// What is drawn over the picture of a twin: the grid of the ground behind what stands on it, the axes of the twin, the
// distance, the path.

import type { Clicks } from "./clicks";
import { el } from "./dom";
import { anyAcross, normalOf } from "./ground";
import type { Ground } from "./ground";
import { RIG_FROM_CAMERA } from "./orbit";
import type { Orbit } from "./orbit";
import { add, cross, dot, rotate, scaled, subtract } from "./pose";
import type { Pose, Vector } from "./pose";

const GRID_LINES = 10;
/** Places of a grid line, between which it is drawn or hidden as a whole. */
const GRID_PLACES = 121;
/** A surface that is nearer by this share hides the grid; one that lies on the ground does not. */
const HIDES = 0.97;
const AXES = [["x", "#ff5a5a"], ["y", "#5fd35f"], ["z", "#5aa0ff"]] as const;
const COLOURS = { ground: "#ff6032", scale: "#5fbf96", path: "#6bb5ee" } as const;

/** The picture that is shown. */
export interface Shown {
  pose: Pose;
  /** Width and height, and the focal length, in pixels of the picture. */
  size: [number, number];
  focal: number;
  /** Where the picture is in the window, in CSS pixels. */
  box: { left: number; top: number; width: number };
  /** Depth of the surface at a pixel of the picture; 0 where there is none. */
  depthAt: (column: number, row: number) => number;
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
    const line = (places: readonly Vector[], style: string, thickness: number, isHidden: (at: Vector) => boolean = () => false): void => {
      context.beginPath();
      let isDown = false;
      for (const at of places) {
        const point = isHidden(at) ? undefined : toScreen(at);
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
        const row = (u: Vector, v: Vector): Vector[] => Array.from({ length: GRID_PLACES }, (_, i) =>
          add(centre, add(scaled(u, at * step), scaled(v, ((2 * i) / (GRID_PLACES - 1) - 1) * GRID_LINES * step))));
        const isHidden = (place: Vector): boolean => isBehind(place, shown);
        line(row(across, along), `${COLOURS.ground}88`, 1, isHidden);
        line(row(along, across), `${COLOURS.ground}88`, 1, isHidden);
      }
    }
    if (orbit) {
      for (const [axis, [name, style]] of AXES.entries()) {
        const end = add(orbit.pivot, scaled([Number(axis === 0), Number(axis === 1), Number(axis === 2)], orbit.distance / 8));
        line([orbit.pivot, end], style, 2);
        const at = toScreen(end);
        if (!at) continue;
        context.fillStyle = style;
        context.font = "bold 13px sans-serif";
        context.fillText(name, at[0] + 3, at[1] - 3);
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
  private toScreen(at: Vector, shown: Shown, own: DOMRect): [number, number] | undefined {
    const { size: [w], box } = shown;
    const seen = toPicture(at, shown);
    const pixels = box.width / w;
    return seen && [box.left - own.left + seen.column * pixels, box.top - own.top + seen.row * pixels];
  }
}

/** Column, row and depth of a place in the picture; undefined behind the camera. */
function toPicture(at: Vector, { pose, size: [w, h], focal }: Shown): { column: number; row: number; depth: number } | undefined {
  const inverse = (q: Pose["q"]): Pose["q"] => [q[0], -q[1], -q[2], -q[3]];
  const [x, y, z] = rotate(inverse(RIG_FROM_CAMERA.q), rotate(inverse(pose.q), subtract(at, pose.xyz)));
  return z <= 1e-6 ? undefined : { column: w / 2 + (x * focal) / z, row: h / 2 + (y * focal) / z, depth: z };
}

/** Whether the picture shows a surface before a place. */
function isBehind(at: Vector, shown: Shown): boolean {
  const seen = toPicture(at, shown);
  if (!seen) return false;
  const surface = shown.depthAt(Math.floor(seen.column), Math.floor(seen.row));
  return surface > 0 && surface < HIDES * seen.depth;
}
