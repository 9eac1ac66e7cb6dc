// Poses and the little vector algebra that the viewer needs. Quaternions are (w, x, y, z), as on the wire.

export type Vector = [number, number, number];
export type Quaternion = [number, number, number, number];

/** A rigid transform: p_a = R(q) p_b + xyz. */
export interface Pose {
  xyz: Vector;
  q: Quaternion;
}

export function rotate([w, x, y, z]: Quaternion, [a, b, c]: Vector): Vector {
  const s = 2 * (y * c - z * b);
  const t = 2 * (z * a - x * c);
  const u = 2 * (x * b - y * a);
  return [a + w * s + y * u - z * t, b + w * t + z * s - x * u, c + w * u + x * t - y * s];
}

export function transform(pose: Pose, point: Vector): Vector {
  const [x, y, z] = rotate(pose.q, point);
  return [x + pose.xyz[0], y + pose.xyz[1], z + pose.xyz[2]];
}

export function multiply(a: Quaternion, b: Quaternion): Quaternion {
  const [aw, ax, ay, az] = a;
  const [bw, bx, by, bz] = b;
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

/** The direction of the x axis in the plane, in radians from east towards north. */
export function heading(q: Quaternion): number {
  const [x, y] = rotate(q, [1, 0, 0]);
  return Math.atan2(y, x);
}

/** The rotation of a rig (x forward, z up) that looks along a heading, and up by a pitch, both in radians. */
export function looking(yaw: number, pitch: number): Quaternion {
  const turn: Quaternion = [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)];
  const tilt: Quaternion = [Math.cos(pitch / 2), 0, -Math.sin(pitch / 2), 0];
  return multiply(turn, tilt);
}

export const add = (a: Vector, b: Vector): Vector => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];

export const subtract = (a: Vector, b: Vector): Vector => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

export const scaled = (v: Vector, factor: number): Vector => [v[0] * factor, v[1] * factor, v[2] * factor];

export const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export const cross = (a: Vector, b: Vector): Vector =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export const normalize = (v: Vector): Vector => scaled(v, 1 / (Math.hypot(...v) || 1));

export const length = (v: Vector): number => Math.hypot(...v);

export const clamp = (value: number, low: number, high: number): number => Math.min(high, Math.max(low, value));
