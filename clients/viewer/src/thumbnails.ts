// Two small pictures of each twin on the first page: ahead from the start of its drive, and from above with its drives.

import { Client } from "./client";
import { colour, el, messageOf } from "./dom";
import type { Camera, TwinInfo } from "./messages";
import { decode } from "./mosaic";
import { RIG_FROM_CAMERA, lookAt } from "./orbit";
import { heading } from "./pose";
import type { Pose, Vector } from "./pose";
import { get } from "./server";
import { viewerSession } from "./session";

const WIDTH = 240;
const HEIGHT = 150;
const FOCAL = WIDTH / 2 / Math.tan(Math.PI / 5);
const EYE_M = 1.65;
/** Around the drives in the picture from above. */
const MARGIN_M = 15;
/** Points of a drive that are drawn: more than there are pixels. */
const POINTS = 300;

const CAMERA: Camera = {
  name: "thumbnail", width: WIDTH, height: HEIGHT, fx: FOCAL, fy: FOCAL, cx: WIDTH / 2, cy: HEIGHT / 2, camera_to_rig: RIG_FROM_CAMERA,
};

export class Thumbnails {
  /** The pictures of a version, by twin and version: the list of twins is made again every few seconds. */
  private readonly made = new Map<string, HTMLElement>();
  private readonly wanted = new Map<Element, TwinInfo>();
  private last: Promise<unknown> = Promise.resolve();
  private client: Client | undefined;
  private ended = false;
  /** Only what is seen is rendered. */
  private readonly seen = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      const twin = this.wanted.get(target);
      if (!isIntersecting || !twin) continue;
      this.wanted.delete(target);
      this.seen.unobserve(target);
      // One after the other, so that a server of many twins has one session of this page at a time.
      this.last = this.last.then(() => this.fill(target, twin));
    }
  });

  of(twin: TwinInfo): HTMLElement {
    const key = `${twin.name}@${twin.version}`;
    const known = this.made.get(key);
    if (known) return known;
    const element = el("div.pictures");
    this.made.set(key, element);
    this.wanted.set(element, twin);
    this.seen.observe(element);
    return element;
  }

  end(): void {
    this.ended = true;
    this.seen.disconnect();
    // A session that its page leaves behind would wait to be resumed.
    void this.client?.end();
  }

  private async fill(element: Element, twin: TwinInfo): Promise<void> {
    if (this.ended) return;
    try {
      const client = new Client();
      this.client = client;
      await client.connect();
      const outputs = { encoding: "jpeg", quality: 80 };
      const rig = { name: "thumbnail", cameras: [CAMERA] };
      const opened = await client.open({ twin: twin.name, version: twin.version, session: viewerSession("thumbnail"), record: false, rig, outputs });
      const [x, y, z] = opened.start.xyz;
      const yaw = heading(opened.start.q);
      const ahead: Pose = { xyz: [x, y, z + EYE_M], q: lookAt([Math.cos(yaw), Math.sin(yaw), 0], [0, 0, 1]) };
      element.append(await picture(client, ahead, `${twin.name} ahead`));
      const drives = await Promise.all(twin.trajectories.map(({ name, length_m: length }) => points(twin, name, length)));
      const above = over(drives.flat());
      if (above) {
        const canvas = await picture(client, above, `${twin.name} from above, with its recorded drives`);
        for (const drive of drives) draw(canvas, above, drive);
        element.append(canvas);
      }
    } catch (error) {
      if (!this.ended) element.append(el("span.dim", {}, `no picture: ${messageOf(error)}`));
    } finally {
      await this.client?.end();
      this.client = undefined;
    }
  }
}

async function picture(client: Client, pose: Pose, text: string): Promise<HTMLCanvasElement> {
  const observation = await client.observation({ type: "observe", poses: [pose] });
  const image = observation.metadata.images[0]!;
  const decoded = await decode(observation, image);
  const canvas = el("canvas", { width: WIDTH, height: HEIGHT, title: text });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", text);
  canvas.dataset.hash = image.hash;
  const context = canvas.getContext("2d")!;
  if (decoded instanceof ImageData) context.putImageData(decoded, 0, 0);
  else context.drawImage(decoded, 0, 0);
  return canvas;
}

async function points(twin: TwinInfo, name: string, length: number): Promise<Vector[]> {
  const everyM = Math.max(1, Math.ceil(length / POINTS));
  const path = `v1/twins/${twin.name}/trajectories/${name}?version=${twin.version}&every_m=${everyM}`;
  return (await get<{ poses: { pose: Pose }[] }>(path)).poses.map(({ pose }) => pose.xyz);
}

/** A pose that sees all points from above, north up. */
function over(points: Vector[]): Pose | undefined {
  if (points.length === 0) return undefined;
  const bounds = [0, 1, 2].map((axis) => {
    const values = points.map((point) => point[axis]!);
    return [Math.min(...values), Math.max(...values)] as const;
  });
  const [[west, east], [south, north], [, top]] = bounds as [readonly [number, number], readonly [number, number], readonly [number, number]];
  const halfWidth = (east - west) / 2 + MARGIN_M;
  const halfHeight = (north - south) / 2 + MARGIN_M;
  const away = FOCAL * Math.max(halfWidth / (WIDTH / 2), halfHeight / (HEIGHT / 2));
  return { xyz: [(west + east) / 2, (south + north) / 2, top + away], q: lookAt([0, 0, -1], [0, 1, 0]) };
}

function draw(canvas: HTMLCanvasElement, { xyz: [east, north, up] }: Pose, drive: Vector[]): void {
  const context = canvas.getContext("2d")!;
  context.strokeStyle = colour("accent");
  context.lineWidth = 2;
  context.beginPath();
  for (const [x, y, z] of drive) {
    const scale = FOCAL / (up - z);
    context.lineTo(WIDTH / 2 + (x - east) * scale, HEIGHT / 2 - (y - north) * scale);
  }
  context.stroke();
}
