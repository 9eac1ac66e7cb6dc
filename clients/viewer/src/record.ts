// The record of an episode: a JSON object a line, as the server writes it.

import type { Pose, Quaternion, Vector } from "./pose";
import type { Actor, Camera } from "./messages";
import { getText } from "./server";

export interface RecordedFrame {
  step: number;
  time_us: number;
  pose: Pose;
  /** Version of the twin that was shown. */
  version: number;
  /** Hash of the images of the cameras, by camera; only of those with an image at this time. */
  images: Map<string, string>;
  /** Where the actors of the scenario are. */
  actors: Actor[];
}

export interface RecordedEvent {
  time_us: number;
  text: string;
  isBad: boolean;
}

export interface Recording {
  name: string;
  twin: string;
  backend: string;
  cameras: Camera[];
  profile: Record<string, unknown>;
  frames: RecordedFrame[];
  events: RecordedEvent[];
  /** Outlines of the lanes near the route. */
  lanes: Vector[][];
  /** Whether actors are drawn in the images: those that are rendered again do not have them. */
  drawsActors: boolean;
  outcome: string | undefined;
}

/** Loads a record. A step that was driven again after a restore replaces what followed it. */
export async function load(name: string): Promise<Recording> {
  const text = await getText(`v1/episodes/${encodeURIComponent(name)}`);
  const [header, ...lines] = text.split("\n").filter(Boolean).map((line) => JSON.parse(line) as any);
  const cameras = header.rig.cameras as Camera[];
  const set = Object.entries(header.profile as Record<string, unknown>).filter(([, value]) => value !== null);
  const recording: Recording = {
    name, cameras, twin: header.twin, backend: header.backend, profile: Object.fromEntries(set), frames: [], events: [],
    lanes: [], drawsActors: false, outcome: undefined,
  };
  const { frames } = recording;
  let version: number = header.version;
  let known: { name: string; class: string; size: Vector; asset?: string }[] = [];
  let actors: Actor[] = [];
  for (const line of lines) {
    if (line.kind === "version") version = line.version;
    if (line.kind === "end") recording.outcome = line.outcome;
    if (line.kind === "event") recording.events.push(eventOf(line, known.map((actor) => actor.name)));
    if (line.kind === "scenario") {
      known = line.actors ?? [];
      recording.lanes = (line.lanes ?? []).map(({ outline }: any) => outline.map(([x, y]: [number, number]) => [x, y, 0]));
      recording.drawsActors = known.some(({ asset }) => asset);
    }
    // They stand before the frame of their step.
    if (line.kind === "actors") {
      actors = line.actors.map(([index, xyz, q]: [number, Vector, Quaternion]) => {
        const { name = "", class: kind = "", size = [4, 2, 1.5] as Vector } = known[index] ?? {};
        return { name, kind, size, pose: { xyz, q } };
      });
    }
    if (line.kind !== "frame" || line.request === "observe" || line.poses.length === 0) continue;
    while (frames.length > 0 && frames.at(-1)!.step >= line.step) frames.pop();
    frames.push({ step: line.step, time_us: line.time_us, pose: line.poses.at(-1), version, images: lastImages(line, cameras), actors });
  }
  return recording;
}

/** The images of the last pose: an answer may hold those of earlier poses before them. */
function lastImages(line: any, cameras: Camera[]): Map<string, string> {
  const rendered: number[][] = line.cameras ?? line.poses.map(() => cameras.map((_, index) => index));
  const last = rendered.at(-1) ?? [];
  const hashes: string[] = (line.images ?? []).slice(-last.length || Infinity);
  return new Map(last.map((index, at) => [cameras[index]!.name, hashes[at]!]));
}

function eventOf(line: any, names: string[]): RecordedEvent {
  const { time_us: timeUs, event, actor, rule, trust, ego_at_fault: atFault } = line;
  const parts = [String(event).replaceAll("_", " "), names[actor] ?? "", rule?.replaceAll("_", " ") ?? "",
    trust === undefined ? "" : `trust ${trust.toFixed(2)}`, atFault ? "(ego at fault)" : ""];
  const isBad = event === "contact" || event === "static_contact" || (event === "ended" && !["route_done", "time", "condition"].includes(rule));
  return { time_us: timeUs, text: parts.filter(Boolean).join(" "), isBad };
}
