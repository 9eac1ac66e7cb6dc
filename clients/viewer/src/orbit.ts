// A camera that turns about a place, with any direction up.

import { add, clamp, cross, dot, normalize, rotate, scaled, subtract } from "./pose";
import type { Pose, Quaternion, Vector } from "./pose";

/** A camera (x right, y down, z forward) that looks along the rig's x axis. */
export const RIG_FROM_CAMERA: Pose = { xyz: [0, 0, 0], q: [0.5, -0.5, 0.5, -0.5] };

/** The rotation of a rig (x forward, z up) that looks along a direction. */
export function lookAt(forward: Vector, up: Vector): Quaternion {
  const x = normalize(forward);
  const left = cross(up, x);
  // Straight up or down, any side is left.
  const y = normalize(Math.hypot(...left) > 1e-9 ? left : cross(Math.abs(x[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], x));
  return quaternion([x, y, cross(x, y)]);
}

/** The rotation whose columns are three axes (Shepperd 1978). */
function quaternion([x, y, z]: [Vector, Vector, Vector]): Quaternion {
  const [a, b, c] = [x[0], y[1], z[2]];
  const squares = [1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c];
  const most = squares.indexOf(Math.max(...squares));
  const half = Math.sqrt(squares[most]!) / 2;
  const s = 0.25 / half;
  const [zy, xz, yx] = [y[2] - z[1], z[0] - x[2], x[1] - y[0]];
  const [xy, zx, yz] = [x[1] + y[0], z[0] + x[2], y[2] + z[1]];
  return ([[half, s * zy, s * xz, s * yx], [s * zy, half, s * xy, s * zx], [s * xz, s * xy, half, s * yz],
    [s * yx, s * zx, s * yz, half]] as Quaternion[])[most]!;
}

export class Orbit {
  pivot: Vector;
  distance: number;
  private upwards: Vector = [0, 0, 1];
  /** From the pivot to the camera. */
  private away: Vector = normalize([-1, -0.6, 0.7]);

  constructor(pivot: Vector, distance: number) {
    this.pivot = pivot;
    this.distance = distance;
  }

  get up(): Vector {
    return this.upwards;
  }

  /** Turns the picture to another up. The camera keeps its angle above the ground. */
  set up(up: Vector) {
    const height = clamp(dot(this.away, this.upwards), -0.95, 0.95);
    const flat = subtract(this.away, scaled(up, dot(this.away, up)));
    const side: Vector = Math.hypot(...flat) > 0.1 ? normalize(flat) : normalize(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
    this.upwards = up;
    this.away = add(scaled(up, height), scaled(side, Math.sqrt(1 - height * height)));
  }

  pose(): Pose {
    const xyz = add(this.pivot, scaled(this.away, this.distance));
    return { xyz, q: lookAt(scaled(this.away, -1), this.upwards) };
  }

  /** Turns by angles to the right and downwards, in radians. */
  turn(right: number, down: number): void {
    const height = Math.asin(clamp(dot(this.away, this.upwards), -1, 1));
    const flat = normalize(subtract(this.away, scaled(this.upwards, dot(this.away, this.upwards))));
    const side = cross(this.upwards, flat);
    const turned = add(scaled(flat, Math.cos(right)), scaled(side, -Math.sin(right)));
    const raised = clamp(height + down, -1.5, 1.5);
    this.away = add(scaled(turned, Math.cos(raised)), scaled(this.upwards, Math.sin(raised)));
  }

  zoom(factor: number): void {
    this.distance = clamp(this.distance * factor, 1e-4, 1e7);
  }

  /** Moves by shares of the picture's width. */
  pan(right: number, down: number): void {
    const { q } = this.pose();
    const width = this.distance * 1.15;
    const move = add(scaled(rotate(q, [0, 1, 0]), right * width), scaled(rotate(q, [0, 0, 1]), down * width));
    this.pivot = add(this.pivot, move);
  }
}
