// The plane of the ground, in the axes of the twin.

import { add, cross, dot, normalize, scaled, subtract } from "./pose";
import type { Vector } from "./pose";

export interface Ground {
  points: [Vector, Vector, Vector];
  /** A place above the ground. */
  above: Vector;
}

/** The unit normal of the ground, on its upper side. */
export function normalOf({ points: [a, b, c], above }: Ground): Vector {
  const normal = normalize(cross(subtract(b, a), subtract(c, a)));
  return dot(normal, subtract(above, a)) < 0 ? scaled(normal, -1) : normal;
}

/** The foot of a place on the ground. */
export function toPlane(at: Vector, ground: Ground): Vector {
  const normal = normalOf(ground);
  return add(at, scaled(normal, dot(subtract(ground.points[0], at), normal)));
}

/** The level ground through a place, whose normal is a unit vector. */
export function levelGround(at: Vector, up: Vector): Ground {
  const across = anyAcross(up);
  return { points: [at, add(at, across), add(at, cross(up, across))], above: add(at, up) };
}

/** A unit vector at right angles to another one. */
export const anyAcross = (v: Vector): Vector => normalize(cross(v, Math.abs(v[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));

/** The unit vector of an axis: "z", "-y". */
export function axisOf(name: string): Vector {
  const sign = name.startsWith("-") ? -1 : 1;
  const at = "xyz".indexOf(name.at(-1)!);
  const axis: Vector = [0, 0, 0];
  axis[at] = sign;
  return axis;
}
