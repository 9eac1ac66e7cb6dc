// Two pictures of each twin on the first page: ahead from the start of its drive, and from above with its drives and
// the lanes of its scenarios, of which one can be chosen.

import { camera, isTooWide, over, picture } from "./aerial";
import { Client } from "./client";
import { colour, el, messageOf } from "./dom";
import type { TwinInfo } from "./messages";
import { lookAt } from "./orbit";
import { heading } from "./pose";
import type { Pose, Vector } from "./pose";
import { lanesOf, omittedText, scenariosOf } from "./scenarios";
import type { TwinScenarios } from "./scenarios";
import { get } from "./server";
import { viewerSession } from "./session";

const WIDTH = 480;
const HEIGHT = 300;
const EYE_M = 1.65;
/** Points of a drive that are drawn: more than there are pixels. */
const POINTS = 300;

const CAMERA = camera("thumbnail", WIDTH, HEIGHT);

export class Thumbnails {
  /** Called when a scenario of a twin is chosen, or none. */
  private readonly onScenario: (twin: string, scenario: string) => void;
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

  constructor(onScenario: (twin: string, scenario: string) => void) {
    this.onScenario = onScenario;
  }

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
      element.append(...await this.above(client, twin, z));
    } catch (error) {
      if (!this.ended) element.append(el("span.dim", {}, `no picture: ${messageOf(error)}`));
    } finally {
      await this.client?.end();
      this.client = undefined;
    }
  }

  /**
   * The picture from above, if the twin has a drive or lanes that fit into one, and the list of its
   * scenarios, if it has any.
   */
  private async above(client: Client, twin: TwinInfo, ground: number): Promise<HTMLElement[]> {
    const drives = await Promise.all(twin.trajectories.map(({ name, length_m: length }) => points(twin, name, length)));
    const found = await scenariosOf(twin.name);
    const all = lanesOf(found, Object.keys(found.maps), ground);
    const around = drives.length ? drives.flat() : all.flat();
    const pose = isTooWide(around) ? undefined : over(around, CAMERA);
    const elements: HTMLElement[] = [];
    let show: (rings: Vector[][]) => void = () => {};
    if (pose) {
      const shown = [...(drives.length ? ["its recorded drives"] : []), ...(all.length ? ["lanes"] : [])].join(" and ");
      const canvas = await picture(client, pose, `${twin.name} from above, with ${shown}`);
      const bare = el("canvas", { width: WIDTH, height: HEIGHT });
      bare.getContext("2d")!.drawImage(canvas, 0, 0);
      show = (rings) => {
        canvas.getContext("2d")!.drawImage(bare, 0, 0);
        canvas.dataset.lanes = String(rings.length);
        for (const ring of rings) draw(canvas, pose, [...ring, ring[0]!], "#fff", 1.5);
        for (const drive of drives) draw(canvas, pose, drive, colour("accent"), 3);
      };
      show(all);
      elements.push(canvas);
    }
    const omitted = omittedText(found.omitted_maps);
    if (omitted) elements.push(el("span.dim", {}, omitted));
    const { scenarios } = found;
    if (scenarios.length) {
      elements.push(this.chooser(twin.name, scenarios, (map) => show(map === undefined ? all : lanesOf(found, [map], ground))));
    }
    return elements;
  }

  /** The list of a twin's scenarios; `show` gets the map of the chosen one. */
  private chooser(twin: string, scenarios: TwinScenarios["scenarios"], show: (map?: string) => void): HTMLElement {
    const options = scenarios.map(({ name }) => el("option", { value: name }, name));
    const select = el("select", { ariaLabel: `scenario of ${twin}` }, el("option", { value: "" }, "no scenario"), ...options);
    select.addEventListener("change", () => {
      show(scenarios.find(({ name }) => name === select.value)?.map);
      this.onScenario(twin, select.value);
    });
    return el("label", {}, "Drive with ", select);
  }
}

async function points(twin: TwinInfo, name: string, length: number): Promise<Vector[]> {
  const everyM = Math.max(1, Math.ceil(length / POINTS));
  const path = `v1/twins/${twin.name}/trajectories/${name}?version=${twin.version}&every_m=${everyM}`;
  return (await get<{ poses: { pose: Pose }[] }>(path)).poses.map(({ pose }) => pose.xyz);
}

function draw(canvas: HTMLCanvasElement, { xyz: [east, north, up] }: Pose, line: Vector[], style: string, width: number): void {
  const context = canvas.getContext("2d")!;
  context.strokeStyle = style;
  context.lineWidth = width;
  context.beginPath();
  for (const [x, y, z] of line) {
    const scale = CAMERA.fx! / (up - z);
    context.lineTo(WIDTH / 2 + (x - east) * scale, HEIGHT / 2 - (y - north) * scale);
  }
  context.stroke();
}
