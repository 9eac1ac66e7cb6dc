// A picture of a twin from above, over which the map is drawn.

import { Client } from "./client";
import { el } from "./dom";
import type { Camera } from "./messages";
import { decode } from "./mosaic";
import { RIG_FROM_CAMERA, lookAt } from "./orbit";
import type { Pose, Vector } from "./pose";
import { viewerSession } from "./session";

const SIDE_PX = 960;
/** Around the drives in a picture, unless the caller wants more. */
const MARGIN_M = 15;
/** Around the drives under a map, which the ego at their end has in its middle. */
const MAP_MARGIN_M = 60;
/** What is wider gets no picture: the server would load the whole city for it. */
const MOST_M = 1500;

/** A picture with north up. */
export interface Aerial {
  picture: HTMLCanvasElement;
  /** East and north of its middle. */
  middle: [number, number];
  /** Its sides on the ground. */
  widthM: number;
  heightM: number;
}

/** A pinhole camera that sees 72° across. */
export function camera(name: string, width: number, height: number): Camera {
  const focal = width / 2 / Math.tan(Math.PI / 5);
  return { name, width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2, camera_to_rig: RIG_FROM_CAMERA };
}

/** A pose from which a camera sees all points from above, north up. */
export function over(points: Vector[], { width, height, fx }: Camera, margin = MARGIN_M): Pose | undefined {
  if (points.length === 0) return undefined;
  const [[west, east], [south, north], [, top]] = [range(points, 0), range(points, 1), range(points, 2)];
  const halfWidth = (east - west) / 2 + margin;
  const halfHeight = (north - south) / 2 + margin;
  const away = fx! * Math.max(halfWidth / (width / 2), halfHeight / (height / 2));
  return { xyz: [(west + east) / 2, (south + north) / 2, top + away], q: lookAt([0, 0, -1], [0, 1, 0]) };
}

function range(points: Vector[], axis: 0 | 1 | 2): [number, number] {
  let [low, high] = [Infinity, -Infinity];
  // A loop: the points of a large map are too many for the arguments of one call.
  for (const { [axis]: value } of points) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return [low, high];
}

/** Whether points are too far apart for a picture of all of them. */
export function isTooWide(points: Vector[]): boolean {
  return [range(points, 0), range(points, 1)].some(([low, high]) => high - low > MOST_M);
}

/** What the camera of a session sees from a pose. */
export async function picture(client: Client, pose: Pose, text: string): Promise<HTMLCanvasElement> {
  const observation = await client.observation({ type: "observe", poses: [pose] });
  const image = observation.metadata.images[0]!;
  const decoded = await decode(observation, image);
  const canvas = el("canvas", { width: image.width, height: image.height, title: text });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", text);
  canvas.dataset.hash = image.hash;
  const context = canvas.getContext("2d")!;
  if (decoded instanceof ImageData) context.putImageData(decoded, 0, 0);
  else context.drawImage(decoded, 0, 0);
  return canvas;
}

/** The picture of a version around its drives; undefined without a drive, and for a long one. */
export async function aerial(twin: string, version: number, points: Vector[]): Promise<Aerial | undefined> {
  const from = camera("above", SIDE_PX, SIDE_PX);
  const pose = over(points, from, MAP_MARGIN_M);
  if (!pose || isTooWide(points)) return undefined;
  const client = new Client();
  try {
    await client.connect();
    const outputs = { encoding: "jpeg", quality: 80 };
    await client.open({ twin, version, session: viewerSession("map"), record: false, rig: { name: "map", cameras: [from] }, outputs });
    const canvas = await picture(client, pose, `${twin} from above`);
    const [east, north, up] = pose.xyz;
    const metresPerPixel = (up - points[0]![2]) / from.fx!;
    return { picture: canvas, middle: [east, north], widthM: canvas.width * metresPerPixel, heightM: canvas.height * metresPerPixel };
  } finally {
    await client.end();
  }
}
