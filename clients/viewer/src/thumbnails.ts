// Two small pictures of each twin on the first page: ahead from the start of its drive, and from above with its drives.

import { camera, over, picture } from "./aerial";
import { Client } from "./client";
import { colour, el, messageOf } from "./dom";
import type { TwinInfo } from "./messages";
import { lookAt } from "./orbit";
import { heading } from "./pose";
import type { Pose, Vector } from "./pose";
import { get } from "./server";
import { viewerSession } from "./session";

const WIDTH = 240;
const HEIGHT = 150;
const EYE_M = 1.65;
/** Points of a drive that are drawn: more than there are pixels. */
const POINTS = 300;

const CAMERA = camera("thumbnail", WIDTH, HEIGHT);

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
      const above = over(drives.flat(), CAMERA);
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

async function points(twin: TwinInfo, name: string, length: number): Promise<Vector[]> {
  const everyM = Math.max(1, Math.ceil(length / POINTS));
  const path = `v1/twins/${twin.name}/trajectories/${name}?version=${twin.version}&every_m=${everyM}`;
  return (await get<{ poses: { pose: Pose }[] }>(path)).poses.map(({ pose }) => pose.xyz);
}

function draw(canvas: HTMLCanvasElement, { xyz: [east, north, up] }: Pose, drive: Vector[]): void {
  const context = canvas.getContext("2d")!;
  context.strokeStyle = colour("accent");
  context.lineWidth = 2;
  context.beginPath();
  for (const [x, y, z] of drive) {
    const scale = CAMERA.fx! / (up - z);
    context.lineTo(WIDTH / 2 + (x - east) * scale, HEIGHT / 2 - (y - north) * scale);
  }
  context.stroke();
}
